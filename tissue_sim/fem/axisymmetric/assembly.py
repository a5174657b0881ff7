"""Mixed displacement-pressure elements as Taichi functions: nodal forces, stiffness, assembly of the band matrix.

The potential of an element is the integral of W(F J^(-1/3)) + p (J - 1) - p^2 / (2 K) with a discontinuous pressure
p = sum of p_m phi_m. Its stationarity gives the nodal forces f = integral of P : grad N with P = dW/dF + p dJ/dF, and
J - 1 = p / K in the mean over each mode (one mode: mean dilatation; Simo, Taylor and Pister, Comput. Methods Appl.
Mech. Eng. 51 (1985) 177, for U(J) = K/2 (J - 1)^2). The pressure is an unknown of Newton's method that is eliminated
element by element from the linearised equations (`condensation`); with p = K (v/V - 1) inserted before the
linearisation, the tangent becomes indefinite at the first large step. The interior node is eliminated likewise.

A batch of `LANES` elements is evaluated at once, one element in each lane of SIMD vectors. The compiler generates
vector instructions only if the index of a vector is a plain variable (``array[i]``, not ``array[i + 1]``) or if the
vector is an entry of a Taichi field; therefore the functions have many array arguments.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.point_effects import make_effect_stress_function
from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.energy import make_inverse_cube_root_function, make_softening_function
from tissue_sim.fem.history import RelaxationSofteningCoefficient
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import LANES
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS


class ElementAssemblyFunctions(NamedTuple):
    """Taichi functions that compute forces and stiffness of one element type and one family of laws."""

    compute_nodal_forces_and_least_jacobian: object
    add_weight_forces: object
    add_interior_node_inertial_force: object
    compute_condensed_stiffness_and_success: object
    add_stiffness_to_band_and_pull: object


@cache
def make_taichi_element_functions(element_name: str, energy: KernelEnergy,
                                  effects: tuple[FormulaClassAndConstants, ...] = ()) -> ElementAssemblyFunctions:
    """Return the Taichi functions of an element type and a law; a kernel calls them in this order for each batch b."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.node_count, element.boundary_nodes, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > nb, nodes - 1
    pairs = nb * (nb + 1) // 2
    vec = ti.types.vector(LANES, ti.f64)
    s = get_axisymmetric_scratch_field()
    with_tangent, without = point.make_stress_function(energy), point.make_stress_function(energy, tangents=False)
    inverse_cube_root = make_inverse_cube_root_function()
    add_pressure_terms = point.make_pressure_term_function()
    apply_softening, apply_relaxation = make_softening_function(5), point.make_relaxation_function()
    has_effects, add_effect_stresses = bool(effects), make_effect_stress_function(effects)
    variables = sum(len(formula.kind.rest) for formula in effects)
    UR, UZ, FR, FZ, SR, SZ = (AT[name] for name in ("UR", "UZ", "FR", "FZ", "SR", "SZ"))
    PRESSURE, GAP, VR, VZ, STRESS = (AT[name] for name in ("PRESSURE", "GAP", "VR", "VZ", "STRESS"))
    TANGENT, COFACTOR, MODE, RATE, CENTRE = (AT[name] for name in ("TANGENT", "COFACTOR", "MODE", "RATE", "CENTRE"))
    # Displacements along r have the components rR, rZ and hoop, displacements along z the components zR and zZ.
    row = point.PLACE

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def gather_lane_vector_by_index_row(values: ti.template(), places: ti.template(), i):
        """Return the vector with one entry of `values` for each SIMD lane, from the indices in row i of `places`."""
        return ti.Vector([values[places[i, l]] for l in ti.static(range(LANES))])

    @ti.func
    def evaluate_quadrature_point(b, q, F, J, p, remembers, tangents: ti.template(), elements: ti.template(),
                                  weights: ti.template(), moduli: ti.template(), coefficients: ti.template(),
                                  past: ti.template(), inherited: ti.template(), largest: ti.template(),
                                  stresses: ti.template(), energies: ti.template(), effect_settings: ti.template(),
                                  states: ti.template(), states_found: ti.template()):
        """Store stress, tangent and dJ/dF of quadrature point q, each times the weight of the point."""
        root = inverse_cube_root(ti.max(J, 1e-6))
        W, P, A = (with_tangent if ti.static(tangents) else without)(F, root, coefficients)
        if ti.static(tangents):
            if remembers == 1:
                f = past[RelaxationSofteningCoefficient.FACTOR]
                W = f * W
                for l in ti.static(range(LANES)):
                    energies[elements[b, l], q] = W[l]
                P1, A1 = [f * P[i] for i in ti.static(range(5))], [f * A[n] for n in ti.static(range(15))]
                if past[RelaxationSofteningCoefficient.LOSS] != 0.0:
                    most = ti.Vector([largest[elements[b, l], q] for l in ti.static(range(LANES))])
                    P2, A2 = apply_softening(W, most, past[RelaxationSofteningCoefficient.LOSS],
                                             past[RelaxationSofteningCoefficient.LOSS_MODULUS],
                                             past[RelaxationSofteningCoefficient.LOSS_SHARE], P1, A1)
                    for i in ti.static(range(5)):
                        P1[i] = P2[i]
                    for n in ti.static(range(15)):
                        A1[n] = A2[n]
                h = [ti.Vector([inherited[elements[b, l], q, i] for l in ti.static(range(LANES))])
                     for i in ti.static(range(4))]
                S, P3, A3 = apply_relaxation(F, past[RelaxationSofteningCoefficient.INSTANT], h, P1, A1)
                for i in ti.static(range(4)):
                    for l in ti.static(range(LANES)):
                        stresses[elements[b, l], q, i] = S[i][l]
                for i in ti.static(range(5)):
                    P[i] = P3[i]
                for n in ti.static(range(15)):
                    A[n] = A3[n]
                if ti.static(has_effects):
                    before = [ti.Vector([states[elements[b, l], q, i] for l in ti.static(range(LANES))])
                              for i in ti.static(range(variables))]
                    S5, P5, A5, found = add_effect_stresses(F, P, A, before, effect_settings)
                    for i in ti.static(range(variables)):
                        for l in ti.static(range(LANES)):
                            states_found[elements[b, l], q, i] = found[i][l]
                    for i in ti.static(range(4)):
                        for l in ti.static(range(LANES)):
                            states_found[elements[b, l], q, variables + i] = S5[i][l]
                    for i in ti.static(range(5)):
                        P[i] = P5[i]
                    for n in ti.static(range(15)):
                        A[n] = A5[n]
        modulus, w = moduli[b], weights[b * points + q]
        P4, A4 = add_pressure_terms(F, p, [modulus * P[i] for i in ti.static(range(5))],
                                    [modulus * A[n] for n in ti.static(range(15))])
        for i in ti.static(range(5)):
            s[STRESS + 5 * q + i] = w * P4[i]
        if ti.static(tangents):
            for n in ti.static(range(15)):
                s[TANGENT + 15 * q + n] = w * A4[n]
        wc = w * F[4]
        s[COFACTOR + 5 * q], s[COFACTOR + 5 * q + 1] = wc * F[3], -wc * F[2]
        s[COFACTOR + 5 * q + 2], s[COFACTOR + 5 * q + 3] = -wc * F[1], wc * F[0]
        s[COFACTOR + 5 * q + 4] = w * (F[0] * F[3] - F[1] * F[2])

    @ti.func
    def compute_nodal_forces_and_least_jacobian(b, tangent, kappa, remembers, x: ti.template(), pressures,
                                                elements: ti.template(),
                                                dofs: ti.template(), gradient_r: ti.template(),
                                                gradient_z: ti.template(),
                                                value_r: ti.template(), weights: ti.template(),
                                                mode_values: ti.template(),
                                                moduli: ti.template(), coefficients: ti.template(), past: ti.template(),
                                                inherited: ti.template(), largest: ti.template(),
                                                stresses: ti.template(),
                                                energies: ti.template(), effect_settings: ti.template(),
                                                states: ti.template(),
                                                states_found: ti.template(), volume_r: ti.template(),
                                                volume_z: ti.template(), gap: ti.template()):
        """Compute the nodal forces of batch b with the pressure increment of the volume residual; return the least J.

        For tissue with memory (`remembers`), `past` contains the parameters of the memory, `inherited` the inherited
        stresses and `largest` the largest energy of each point; the present stresses and energies are written to
        `stresses` and `energies`. `states` is the memory of the effects, `states_found` its new value.
        """
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a] = gather_lane_vector_by_index_row(x, dofs, i)
            s[UZ + a] = ti.Vector([x[dofs[i, l] + 1] for l in ti.static(range(LANES))])
        bulk = kappa * moduli[b]
        for m in range(modes):
            p = ti.Vector([x[pressures + modes * elements[b, l] + m] for l in ti.static(range(LANES))])
            s[PRESSURE + m], s[GAP + m] = p, -p / bulk
        least = vec(1e30)
        for q in range(points):
            h0, h1, h2, h3, h4 = vec(0.0), vec(0.0), vec(0.0), vec(0.0), vec(0.0)
            for a in range(nodes):
                g = (b * points + q) * nodes + a
                gr, gz, gh, ur, uz = gradient_r[g], gradient_z[g], value_r[g], s[UR + a], s[UZ + a]
                h0 = h0 + ur * gr
                h1 = h1 + ur * gz
                h2 = h2 + uz * gr
                h3 = h3 + uz * gz
                h4 = h4 + ur * gh
            # J - 1 is computed from the displacement gradient, without cancellation, because K/mu multiplies it.
            area = h0 + h3 + h0 * h3 - h1 * h2
            dilation = area + h4 + area * h4
            least = ti.min(least, ti.min(1.0 + dilation, 1.0 + h4))
            p = vec(0.0)
            for m in range(modes):
                phi = mode_values[(b * points + q) * modes + m]
                s[MODE + modes * q + m] = phi
                p = p + phi * s[PRESSURE + m]
                s[GAP + m] = s[GAP + m] + weights[b * points + q] * phi * dilation
            F = [1.0 + h0, h1, h2, 1.0 + h3, 1.0 + h4]
            # Tissue with memory always gets a tangent: a variant without it would double the compile time.
            if tangent == 1 or remembers == 1:
                evaluate_quadrature_point(b, q, F, 1.0 + dilation, p, remembers, True, elements, weights, moduli,
                                          coefficients, past, inherited, largest, stresses, energies, effect_settings,
                                          states, states_found)
            else:
                evaluate_quadrature_point(b, q, F, 1.0 + dilation, p, remembers, False, elements, weights, moduli,
                                          coefficients, past, inherited, largest, stresses, energies, effect_settings,
                                          states, states_found)
        for a in range(nodes):
            fr, fz = vec(0.0), vec(0.0)
            vr, vz = [vec(0.0) for _m in ti.static(range(modes))], [vec(0.0) for _m in ti.static(range(modes))]
            for q in range(points):
                g = (b * points + q) * nodes + a
                gr, gz, gh = gradient_r[g], gradient_z[g], value_r[g]
                at = STRESS + 5 * q
                fr = fr + s[at] * gr + s[at + 1] * gz + s[at + 4] * gh
                fz = fz + s[at + 2] * gr + s[at + 3] * gz
                c = COFACTOR + 5 * q
                jr = s[c] * gr + s[c + 1] * gz + s[c + 4] * gh
                jz = s[c + 2] * gr + s[c + 3] * gz
                for m in ti.static(range(modes)):
                    vr[m] = vr[m] + s[MODE + modes * q + m] * jr
                    vz[m] = vz[m] + s[MODE + modes * q + m] * jz
            for m in ti.static(range(modes)):
                missed = kappa * moduli[b] * s[GAP + m]
                fr = fr + missed * vr[m]
                fz = fz + missed * vz[m]
                s[VR + m * nodes + a], s[VZ + m * nodes + a] = vr[m], vz[m]
            s[FR + a], s[FZ + a] = fr, fz
        for i in range(modes * nodes):
            at = b * modes * nodes + i
            volume_r[at], volume_z[at] = s[VR + i], s[VZ + i]
        for m in range(modes):
            at = b * modes + m
            gap[at] = s[GAP + m]
        return least.min()

    @ti.func
    def add_weight_forces(b, weight, volumes: ti.template()):
        """Add the nodal forces of the weight, which acts towards -z, to the internal forces."""
        for a in range(nodes):
            i = b * nodes + a
            s[FZ + a] = s[FZ + a] + weight * volumes[i]

    @ti.func
    def add_interior_node_inertial_force(b, inertia, density, volumes: ti.template(), dofs: ti.template(),
                                         rest: ti.template()):
        """Add the inertial force of the interior node: mass times `inertia` (1/s2) times displacement from `rest`."""
        if ti.static(has_centre):
            i = b * nodes + centre
            mass = density * inertia * volumes[i]
            s[FR + centre] = s[FR + centre] + mass * (s[UR + centre] - gather_lane_vector_by_index_row(rest, dofs, i))
            s[FZ + centre] = s[FZ + centre] + mass * (
                s[UZ + centre] - ti.Vector([rest[dofs[i, l] + 1] for l in ti.static(range(LANES))]))

    @ti.func
    def store_stress_rates_per_node_displacement(c, b, gradient_r: ti.template(), gradient_z: ti.template(),
                                                 value_r: ti.template()):
        """Store the stress increments per displacement of node c, along r (0 to 4) and z (5 to 9), at all points."""
        for q in range(points):
            g = (b * points + q) * nodes + c
            x, y, h = gradient_r[g], gradient_z[g], value_r[g]
            t, at = TANGENT + 15 * q, RATE + 10 * q
            for i in ti.static(range(5)):
                s[at + i] = s[t + ti.static(row[i][0])] * x + s[t + ti.static(row[i][1])] * y + s[
                    t + ti.static(row[i][4])] * h
            for i in ti.static(range(4)):
                s[at + 5 + i] = s[t + ti.static(row[i][2])] * x + s[t + ti.static(row[i][3])] * y
            s[at + 9] = s[t + ti.static(row[4][2])] * x + s[t + ti.static(row[4][3])] * y

    @ti.func
    def compute_node_pair_stiffness(c, a, b, kappa, moduli: ti.template(), gradient_r: ti.template(),
                                    gradient_z: ti.template(), value_r: ti.template()):
        """Return the stiffness rr, zr, rz, zz of node a for displacements of node c, from the stress increments."""
        k0, k1, k2, k3 = vec(0.0), vec(0.0), vec(0.0), vec(0.0)
        for q in range(points):
            g = (b * points + q) * nodes + a
            x, y, h, at = gradient_r[g], gradient_z[g], value_r[g], RATE + 10 * q
            k0 = k0 + s[at] * x + s[at + 1] * y + s[at + 4] * h
            k1 = k1 + s[at + 2] * x + s[at + 3] * y
            k2 = k2 + s[at + 5] * x + s[at + 6] * y + s[at + 9] * h
            k3 = k3 + s[at + 7] * x + s[at + 8] * y
        for m in range(modes):
            cr, cz = kappa * moduli[b] * s[VR + m * nodes + c], kappa * moduli[b] * s[VZ + m * nodes + c]
            ar, az = s[VR + m * nodes + a], s[VZ + m * nodes + a]
            k0 = k0 + cr * ar
            k1 = k1 + cr * az
            k2 = k2 + cz * ar
            k3 = k3 + cz * az
        return k0, k1, k2, k3

    @ti.func
    def compute_condensed_stiffness_and_success(b, kappa, pending, mass, moduli: ti.template(),
                                                gradient_r: ti.template(),
                                                gradient_z: ti.template(), value_r: ti.template(), dofs: ti.template(),
                                                step: ti.template(), volumes: ti.template(), k_rr: ti.template(),
                                                k_zr: ti.template(), k_rz: ti.template(), k_zz: ti.template(),
                                                rows_rr: ti.template(), rows_rz: ti.template(), rows_zr: ti.template(),
                                                rows_zz: ti.template(), inverse_rr: ti.template(),
                                                inverse_rz: ti.template(), inverse_zz: ti.template()):
        """Compute the stiffness of all pairs of shared nodes with the interior node eliminated.

        If a motion `step` of the prescribed nodes is still to be made (`pending`), its forces are added. Returns 0 if
        the block of an interior node is not positive definite, otherwise 1.
        """
        good = 1
        if pending == 1:
            for a in range(nb):
                i = b * nodes + a
                s[SR + a] = gather_lane_vector_by_index_row(step, dofs, i)
                s[SZ + a] = ti.Vector([step[dofs[i, l] + 1] for l in ti.static(range(LANES))])
        # The interior node first, since it is eliminated from the others.
        for back in range(nodes):
            c = nodes - 1 - back
            store_stress_rates_per_node_displacement(c, b, gradient_r, gradient_z, value_r)
            for a in range(c + 1):
                k0, k1, k2, k3 = compute_node_pair_stiffness(c, a, b, kappa, moduli, gradient_r, gradient_z, value_r)
                if c >= nb:
                    s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1] = k0, k1
                    s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3] = k2, k3
                else:
                    if ti.static(has_centre):
                        at = b * nb + c
                        x0, x1, y0, y1 = rows_rr[at], rows_zr[at], rows_rz[at], rows_zz[at]
                        r0, r1 = s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1]
                        z0, z1 = s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3]
                        k0 = k0 - (x0 * r0 + x1 * z0)
                        k1 = k1 - (x0 * r1 + x1 * z1)
                        k2 = k2 - (y0 * r0 + y1 * z0)
                        k3 = k3 - (y0 * r1 + y1 * z1)
                    p = c * (c + 1) // 2 + a
                    k_rr[p], k_zr[p], k_rz[p], k_zz[p] = k0, k1, k2, k3
                    if pending == 1:
                        s[FR + a] = s[FR + a] + k0 * s[SR + c] + k2 * s[SZ + c]
                        s[FZ + a] = s[FZ + a] + k1 * s[SR + c] + k3 * s[SZ + c]
                        if a < c:
                            s[FR + c] = s[FR + c] + k0 * s[SR + a] + k1 * s[SZ + a]
                            s[FZ + c] = s[FZ + c] + k2 * s[SR + a] + k3 * s[SZ + a]
            if c >= nb:
                i = b * nodes + c
                inertia = mass * volumes[i]
                rr, rz = s[CENTRE + 4 * c] + inertia, s[CENTRE + 4 * c + 1]
                zz = s[CENTRE + 4 * c + 3] + inertia
                determinant = rr * zz - rz * rz
                if ti.min(rr, determinant).min() <= 0.0:
                    good = 0
                irr, irz, izz = zz / determinant, -rz / determinant, rr / determinant
                inverse_rr[b], inverse_rz[b], inverse_zz[b] = irr, irz, izz
                for a in range(nb):
                    k0, k1 = s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1]
                    k2, k3 = s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3]
                    at = b * nb + a
                    rows_rr[at], rows_rz[at] = irr * k0 + irz * k2, irr * k1 + irz * k3
                    rows_zr[at], rows_zz[at] = irz * k0 + izz * k2, irz * k1 + izz * k3
        return good

    @ti.func
    def add_stiffness_to_band_and_pull(b, places: ti.template(), stiffness: ti.template(), flat: ti.template(),
                                       starts: ti.template(), pulls: ti.template(), factors: ti.template(),
                                       pull: ti.template()):
        """Add the stiffness of batch b to the flattened band matrix, and the forces of moving nodes to `pull`."""
        for i in range(4 * pairs * LANES):
            at = places[b, i]
            flat[at] = flat[at] + stiffness[i]
        for i in range(starts[b], starts[b + 1]):
            at = pulls[i, 0]
            pull[at] = pull[at] + factors[i] * stiffness[pulls[i, 1]]

    return ElementAssemblyFunctions(compute_nodal_forces_and_least_jacobian, add_weight_forces,
                                    add_interior_node_inertial_force,
                                    compute_condensed_stiffness_and_success, add_stiffness_to_band_and_pull)
