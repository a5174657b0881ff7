"""Mixed displacement-pressure elements as Taichi functions: forces, stiffness, assembly, static condensation.

The potential of an element is the integral of W(F J^(-1/3)) + p (J - 1) - p^2 / (2 K) with a discontinuous pressure
p = sum of p_m phi_m. Its stationarity gives the nodal forces f = integral of P : grad N with P = dW/dF + p dJ/dF, and
J - 1 = p / K in the mean over each mode (one mode: mean dilatation; Simo, Taylor and Pister, Comput. Methods Appl.
Mech. Eng. 51 (1985) 177, for U(J) = K/2 (J - 1)^2). The pressure is an unknown of Newton's method that is eliminated
element by element from the linearised equations (static condensation); with p = K (v/V - 1) inserted before the
linearisation, the tangent becomes indefinite at the first large step. The interior node is eliminated likewise.

A batch of `LANES` elements is evaluated at once, one element in each lane of SIMD vectors.

With the volume residual g = v(u) - p / K (per pressure mode) and its derivative B = dv/du, the linearised equations of
an element, A du + B^T dp = -R and B du - dp / K = -g, give dp = K (g + B du) and the condensed stiffness A + K B^T B
(mixed displacement-pressure formulation). The interior node is eliminated by its Schur complement.

If a factorisation is reused, the pressure is eliminated with the B of the factorised matrix. The iteration is then a
modified Newton method for displacements and pressures, whose convergence does not depend on K/mu. With the present B,
the change of B would be multiplied by K without being in the matrix.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.energy import (
    AT,
    get_axisymmetric_scratch_field,
    make_effect_stress_function,
    make_kinematic_functions,
)
from tissue_sim.fem.elements.energy import make_inverse_cube_root_function
from tissue_sim.fem.elements.history import make_history_function
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS


class CondensationFunctions(NamedTuple):
    """Taichi functions of the static condensation for one element type."""

    condense_interior_force_and_get_square: object
    add_forces_to_residual: object
    copy_volume_derivatives_to_factorised: object
    correct_residual_for_reused_factorisation: object
    store_increments_of_all_nodes: object
    compute_volume_increment_of_mode: object
    update_condensed_unknowns: object


@cache
def make_condensation_functions(element_name: str) -> CondensationFunctions:
    """Return the Taichi functions of the static condensation of an element type."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.node_count, element.boundary_nodes, element.pressure_modes
    has_centre, centre = nodes > nb, nodes - 1
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    FR, FZ, SR, SZ = (AT[name] for name in ("FR", "FZ", "SR", "SZ"))

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def condense_interior_force_and_get_square(b, to, elements: ti.template(), force_r: ti.template(),
                                               force_z: ti.template()):
        """Condense the force on the interior node into the forces of the shared nodes; return its summed square, N2.

        Entry `to` of `force_r` and `force_z` gets the inverse stiffness of the interior node times its force.
        """
        squares = 0.0
        if ti.static(has_centre):
            f0, f1 = s[FR + centre], s[FZ + centre]
            squares = (elements.real[b] * (f0 * f0 + f1 * f1)).sum()
            force_r[to] = elements.inverse_rr[b] * f0 + elements.inverse_rz[b] * f1
            force_z[to] = elements.inverse_rz[b] * f0 + elements.inverse_zz[b] * f1
            for a in range(nb):
                at = b * nb + a
                s[FR + a] = s[FR + a] - (f0 * elements.rows_rr[at] + f1 * elements.rows_zr[at])
                s[FZ + a] = s[FZ + a] - (f0 * elements.rows_rz[at] + f1 * elements.rows_zz[at])
        return squares

    @ti.func
    def add_forces_to_residual(b, elements: ti.template(), residual: ti.template()):
        """Add the forces of the shared nodes to the global residual."""
        for a in range(nb):
            at = b * nb + a
            fr, fz = s[FR + a], s[FZ + a]
            for l in ti.static(range(LANES)):
                residual[elements.equations_r[at][l]] = residual[elements.equations_r[at][l]] + fr[l]
                residual[elements.equations_z[at][l]] = residual[elements.equations_z[at][l]] + fz[l]

    @ti.func
    def copy_volume_derivatives_to_factorised(b, elements: ti.template()):
        """Copy the present volume derivatives to those of the tangent that is about to be factorised."""
        for i in range(modes * nodes):
            at = b * modes * nodes + i
            elements.known_volume_r[at], elements.known_volume_z[at] = elements.volume_r[at], elements.volume_z[at]

    @ti.func
    def correct_residual_for_reused_factorisation(b, kappa, elements: ti.template(), residual: ti.template()):
        """Correct the residual: eliminate the pressure with the volume derivatives of the factorised matrix."""
        for a in range(nodes):
            s[FR + a], s[FZ + a] = vec(0.0), vec(0.0)
        for m in range(modes):
            at = b * modes + m
            missed = kappa * elements.moduli[b] * elements.gap[at]
            for a in range(nodes):
                i = at * nodes + a
                s[FR + a] = s[FR + a] + missed * (elements.known_volume_r[i] - elements.volume_r[i])
                s[FZ + a] = s[FZ + a] + missed * (elements.known_volume_z[i] - elements.volume_z[i])
        if ti.static(has_centre):
            before_r, before_z = elements.force_r[b], elements.force_z[b]
            condense_interior_force_and_get_square(b, b, elements, elements.force_r, elements.force_z)
            elements.force_r[b], elements.force_z[b] = elements.force_r[b] + before_r, elements.force_z[b] + before_z
        add_forces_to_residual(b, elements, residual)

    @ti.func
    def store_increments_of_all_nodes(b, step: ti.template(), elements: ti.template(), force_r: ti.template(),
                                      force_z: ti.template()):
        """Store the displacement increments of all nodes; that of the interior node follows from the shared nodes."""
        for a in range(nb):
            i = b * nodes + a
            s[SR + a], s[SZ + a] = kinematics.gather_node_vector(step, elements, i)
        if ti.static(has_centre):
            cr, cz = -force_r[b], -force_z[b]
            for a in range(nb):
                at = b * nb + a
                cr = cr - (elements.rows_rr[at] * s[SR + a] + elements.rows_rz[at] * s[SZ + a])
                cz = cz - (elements.rows_zr[at] * s[SR + a] + elements.rows_zz[at] * s[SZ + a])
            s[SR + centre], s[SZ + centre] = cr, cz

    @ti.func
    def compute_volume_increment_of_mode(mode, elements: ti.template()):
        """Return the volume increment of a pressure mode, with the volume derivatives of the factorised matrix."""
        swelling = vec(0.0)
        for a in range(nodes):
            v = mode * nodes + a
            swelling = swelling + elements.known_volume_r[v] * s[SR + a] + elements.known_volume_z[v] * s[SZ + a]
        return swelling

    @ti.func
    def update_condensed_unknowns(b, kappa, x: ti.template(), pressures, step: ti.template(), elements: ti.template()):
        """Update interior nodes and pressures in `x` from the increment `step` of shared nodes (substitution)."""
        store_increments_of_all_nodes(b, step, elements, elements.force_r, elements.force_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    x[elements.dofs[i][l]] = x[elements.dofs[i][l]] + cr[l]
                    x[elements.dofs[i][l] + 1] = x[elements.dofs[i][l] + 1] + cz[l]
        for m in range(modes):
            at = b * modes + m
            change = kappa * elements.moduli[b] * (elements.gap[at] + compute_volume_increment_of_mode(at, elements))
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    i = pressures + modes * elements.numbers[b][l] + m
                    x[i] = x[i] + change[l]

    return CondensationFunctions(condense_interior_force_and_get_square, add_forces_to_residual,
                                 copy_volume_derivatives_to_factorised,
                                 correct_residual_for_reused_factorisation, store_increments_of_all_nodes,
                                 compute_volume_increment_of_mode, update_condensed_unknowns)


class ElementAssemblyFunctions(NamedTuple):
    """Taichi functions that compute forces and stiffness of one element type and one family of laws."""

    compute_nodal_forces_and_least_jacobian: object
    add_weight_forces: object
    add_interior_node_inertial_force: object
    compute_condensed_stiffness_and_success: object
    scatter_stiffness_and_force_per_depth: object


@cache
def make_element_assembly_functions(element_name: str, energy: KernelEnergy,
                                    effects: tuple[FormulaClassAndConstants, ...] = ()) -> ElementAssemblyFunctions:
    """Return the Taichi functions of an element type and a law; a kernel calls them in this order for each batch b."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.node_count, element.boundary_nodes, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > nb, nodes - 1
    pairs = nb * (nb + 1) // 2
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    with_tangent, without = point.make_stress_function(energy), point.make_stress_function(energy, tangents=False)
    inverse_cube_root = make_inverse_cube_root_function()
    add_pressure_terms = point.make_pressure_term_function()
    apply_history = make_history_function(5, 4, point.make_relaxation_function)
    is_limited = bool(energy.domain_conditions)
    has_effects, add_effect_stresses = bool(effects), make_effect_stress_function(effects)
    variables = sum(len(formula.kind.rest) for formula in effects)
    UR, UZ, FR, FZ, SR, SZ = (AT[name] for name in ("UR", "UZ", "FR", "FZ", "SR", "SZ"))
    PRESSURE, GAP, VR, VZ, STRESS = (AT[name] for name in ("PRESSURE", "GAP", "VR", "VZ", "STRESS"))
    TANGENT, COFACTOR, MODE, RATE, CENTRE = (AT[name] for name in ("TANGENT", "COFACTOR", "MODE", "RATE", "CENTRE"))
    # Displacements along r have the components rR, rZ and hoop, displacements along z the components zR and zZ.
    row = point.PLACE

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def store_weighted_stress_and_tangent(b, q, F, J, p, remembers, tangents: ti.template(), elements: ti.template(),
                                          tissue: ti.template()):
        """Store stress, tangent and dJ/dF of point q, each times its weight; return the margin of the law's domain."""
        root = inverse_cube_root(ti.max(J, 1e-6))
        W, P, A, margin = (with_tangent if ti.static(tangents) else without)(F, root, tissue.coefficients)
        if ti.static(tangents):
            if remembers == 1:
                apply_history(b, q, [F], W, P, A, elements, tissue)
                if ti.static(has_effects):
                    before = [ti.Vector([tissue.effect_states[elements.numbers[b][l], q, i]
                                         for l in ti.static(range(LANES))]) for i in ti.static(range(variables))]
                    S5, P5, A5, found = add_effect_stresses(F, P, A, before, tissue.effect_settings)
                    for i in ti.static(range(variables)):
                        for l in ti.static(range(LANES)):
                            tissue.effect_states_found[elements.numbers[b][l], q, i] = found[i][l]
                    for i in ti.static(range(4)):
                        for l in ti.static(range(LANES)):
                            tissue.effect_states_found[elements.numbers[b][l], q, variables + i] = S5[i][l]
                    for i in ti.static(range(5)):
                        P[i] = P5[i]
                    for n in ti.static(range(15)):
                        A[n] = A5[n]
        modulus, w = elements.moduli[b], elements.point_weights[b * points + q]
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
        return margin

    @ti.func
    def compute_nodal_forces_and_least_jacobian(b, tangent, kappa, remembers, x: ti.template(), pressures,
                                                elements: ti.template(), tissue: ti.template()):
        """Compute the nodal forces of batch b with the pressure increment of the volume residual.

        Return the smallest J, or the smallest margin of the domain of the law if it is smaller.

        For tissue with memory (`remembers`), the present stresses and energies are written to `tissue`.
        """
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a], s[UZ + a] = kinematics.gather_node_vector(x, elements, i)
        bulk = kappa * elements.moduli[b]
        for m in range(modes):
            p = ti.Vector([x[pressures + modes * elements.numbers[b][l] + m] for l in ti.static(range(LANES))])
            s[PRESSURE + m], s[GAP + m] = p, -p / bulk
        least = vec(1e30)
        for q in range(points):
            h0, h1, h2, h3, h4 = kinematics.compute_gradient_of_stored_displacements(b, q, elements)
            # J - 1 is computed from the displacement gradient, without cancellation, because K/mu multiplies it.
            area = h0 + h3 + h0 * h3 - h1 * h2
            dilation = area + h4 + area * h4
            least = ti.min(least, ti.min(1.0 + dilation, 1.0 + h4))
            p = vec(0.0)
            for m in range(modes):
                phi = elements.mode_values[(b * points + q) * modes + m]
                s[MODE + modes * q + m] = phi
                p = p + phi * s[PRESSURE + m]
                s[GAP + m] = s[GAP + m] + elements.point_weights[b * points + q] * phi * dilation
            F = [1.0 + h0, h1, h2, 1.0 + h3, 1.0 + h4]
            # Tissue with memory always gets a tangent: a variant without it would double the compile time.
            if tangent == 1 or remembers == 1:
                margin = store_weighted_stress_and_tangent(b, q, F, 1.0 + dilation, p, remembers, True, elements,
                                                           tissue)
                if ti.static(is_limited):
                    least = ti.min(least, margin)
            else:
                margin = store_weighted_stress_and_tangent(b, q, F, 1.0 + dilation, p, remembers, False, elements,
                                                           tissue)
                if ti.static(is_limited):
                    least = ti.min(least, margin)
        for a in range(nodes):
            fr, fz = vec(0.0), vec(0.0)
            vr, vz = [vec(0.0) for _m in ti.static(range(modes))], [vec(0.0) for _m in ti.static(range(modes))]
            for q in range(points):
                g = (b * points + q) * nodes + a
                gr, gz, gh = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
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
                missed = kappa * elements.moduli[b] * s[GAP + m]
                fr = fr + missed * vr[m]
                fz = fz + missed * vz[m]
                s[VR + m * nodes + a], s[VZ + m * nodes + a] = vr[m], vz[m]
            s[FR + a], s[FZ + a] = fr, fz
        for i in range(modes * nodes):
            at = b * modes * nodes + i
            elements.volume_r[at], elements.volume_z[at] = s[VR + i], s[VZ + i]
        for m in range(modes):
            at = b * modes + m
            elements.gap[at] = s[GAP + m]
        return least.min()

    @ti.func
    def add_weight_forces(b, weight, elements: ti.template()):
        """Add the nodal forces of the weight, which acts towards -z, to the internal forces."""
        for a in range(nodes):
            i = b * nodes + a
            s[FZ + a] = s[FZ + a] + weight * elements.volumes[i]

    @ti.func
    def add_interior_node_inertial_force(b, inertia, density, elements: ti.template(), rest: ti.template()):
        """Add the inertial force of the interior node: mass times `inertia` (1/s2) times displacement from `rest`."""
        if ti.static(has_centre):
            i = b * nodes + centre
            mass = density * inertia * elements.volumes[i]
            rest_r, rest_z = kinematics.gather_node_vector(rest, elements, i)
            s[FR + centre] = s[FR + centre] + mass * (s[UR + centre] - rest_r)
            s[FZ + centre] = s[FZ + centre] + mass * (s[UZ + centre] - rest_z)

    @ti.func
    def store_stress_rates_per_node_displacement(c, b, elements: ti.template()):
        """Store the stress increments per displacement of node c, along r (0 to 4) and z (5 to 9), at all points."""
        for q in range(points):
            g = (b * points + q) * nodes + c
            x, y, h = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
            t, at = TANGENT + 15 * q, RATE + 10 * q
            for i in ti.static(range(5)):
                s[at + i] = s[t + ti.static(row[i][0])] * x + s[t + ti.static(row[i][1])] * y + s[
                    t + ti.static(row[i][4])] * h
            for i in ti.static(range(4)):
                s[at + 5 + i] = s[t + ti.static(row[i][2])] * x + s[t + ti.static(row[i][3])] * y
            s[at + 9] = s[t + ti.static(row[4][2])] * x + s[t + ti.static(row[4][3])] * y

    @ti.func
    def compute_node_pair_stiffness(c, a, b, kappa, elements: ti.template()):
        """Return the stiffness rr, zr, rz, zz of node a for displacements of node c, from the stress increments."""
        k0, k1, k2, k3 = vec(0.0), vec(0.0), vec(0.0), vec(0.0)
        for q in range(points):
            g = (b * points + q) * nodes + a
            x, y, h, at = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g], RATE + 10 * q
            k0 = k0 + s[at] * x + s[at + 1] * y + s[at + 4] * h
            k1 = k1 + s[at + 2] * x + s[at + 3] * y
            k2 = k2 + s[at + 5] * x + s[at + 6] * y + s[at + 9] * h
            k3 = k3 + s[at + 7] * x + s[at + 8] * y
        for m in range(modes):
            bulk = kappa * elements.moduli[b]
            cr, cz = bulk * s[VR + m * nodes + c], bulk * s[VZ + m * nodes + c]
            ar, az = s[VR + m * nodes + a], s[VZ + m * nodes + a]
            k0 = k0 + cr * ar
            k1 = k1 + cr * az
            k2 = k2 + cz * ar
            k3 = k3 + cz * az
        return k0, k1, k2, k3

    @ti.func
    def compute_condensed_stiffness_and_success(b, kappa, pending, mass, step: ti.template(), elements: ti.template()):
        """Compute the stiffness of all pairs of shared nodes with the interior node eliminated.

        If a motion `step` of the prescribed nodes is still to be made (`pending`), its forces are added. Returns 0 if
        the block of an interior node is not positive definite, otherwise 1.
        """
        good = 1
        if pending == 1:
            for a in range(nb):
                i = b * nodes + a
                s[SR + a], s[SZ + a] = kinematics.gather_node_vector(step, elements, i)
        # The interior node first, since it is eliminated from the others.
        for back in range(nodes):
            c = nodes - 1 - back
            store_stress_rates_per_node_displacement(c, b, elements)
            for a in range(c + 1):
                k0, k1, k2, k3 = compute_node_pair_stiffness(c, a, b, kappa, elements)
                if c >= nb:
                    s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1] = k0, k1
                    s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3] = k2, k3
                else:
                    if ti.static(has_centre):
                        at = b * nb + c
                        x0, x1 = elements.rows_rr[at], elements.rows_zr[at]
                        y0, y1 = elements.rows_rz[at], elements.rows_zz[at]
                        r0, r1 = s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1]
                        z0, z1 = s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3]
                        k0 = k0 - (x0 * r0 + x1 * z0)
                        k1 = k1 - (x0 * r1 + x1 * z1)
                        k2 = k2 - (y0 * r0 + y1 * z0)
                        k3 = k3 - (y0 * r1 + y1 * z1)
                    p = c * (c + 1) // 2 + a
                    elements.stiffness[p], elements.stiffness[pairs + p] = k0, k1
                    elements.stiffness[2 * pairs + p], elements.stiffness[3 * pairs + p] = k2, k3
                    if pending == 1:
                        s[FR + a] = s[FR + a] + k0 * s[SR + c] + k2 * s[SZ + c]
                        s[FZ + a] = s[FZ + a] + k1 * s[SR + c] + k3 * s[SZ + c]
                        if a < c:
                            s[FR + c] = s[FR + c] + k0 * s[SR + a] + k1 * s[SZ + a]
                            s[FZ + c] = s[FZ + c] + k2 * s[SR + a] + k3 * s[SZ + a]
            if c >= nb:
                i = b * nodes + c
                inertia = mass * elements.volumes[i]
                rr, rz = s[CENTRE + 4 * c] + inertia, s[CENTRE + 4 * c + 1]
                zz = s[CENTRE + 4 * c + 3] + inertia
                determinant = rr * zz - rz * rz
                if ti.min(rr, determinant).min() <= 0.0:
                    good = 0
                irr, irz, izz = zz / determinant, -rz / determinant, rr / determinant
                elements.inverse_rr[b], elements.inverse_rz[b], elements.inverse_zz[b] = irr, irz, izz
                for a in range(nb):
                    k0, k1 = s[CENTRE + 4 * a], s[CENTRE + 4 * a + 1]
                    k2, k3 = s[CENTRE + 4 * a + 2], s[CENTRE + 4 * a + 3]
                    at = b * nb + a
                    elements.rows_rr[at], elements.rows_rz[at] = irr * k0 + irz * k2, irr * k1 + irz * k3
                    elements.rows_zr[at], elements.rows_zz[at] = irz * k0 + izz * k2, irz * k1 + izz * k3
        return good

    @ti.func
    def scatter_stiffness_and_force_per_depth(b, elements: ti.template(), scattered: ti.template(),
                                              pull: ti.template()):
        """Add the stiffness of batch b to the band matrix, and the forces of moving nodes to `pull`."""
        for i in range(4 * pairs):
            at, stiffness = elements.places[b * 4 * pairs + i], elements.stiffness[i]
            for l in ti.static(range(LANES)):
                scattered[at[l]] = scattered[at[l]] + stiffness[l]
        for i in range(elements.pull_starts[b], elements.pull_starts[b + 1]):
            at = elements.pulls[i, 0]
            pull[at] = pull[at] + elements.pull_factors[i] * elements.stiffness_numbers[elements.pulls[i, 1]]

    return ElementAssemblyFunctions(compute_nodal_forces_and_least_jacobian, add_weight_forces,
                                    add_interior_node_inertial_force,
                                    compute_condensed_stiffness_and_success, scatter_stiffness_and_force_per_depth)
