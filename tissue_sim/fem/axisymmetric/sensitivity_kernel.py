"""How an equilibrium moves with the parameters of the material, as one Taichi kernel.

The equilibrium R(y; theta, past) = 0 of a step is differentiated as it stands: R_y dy = -(R_theta + R_past dpast), with
the exact tangent at the converged state. What a parameter does at a quadrature point with the deformation held comes
from the law, differentiated as a formula; what it did to the past is carried along.
"""

from functools import cache

import sympy as sp

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.batches import LANES
from tissue_sim.fem.axisymmetric.contact import FRICTION, HOLD, MOVES, NORMAL_R, NORMAL_Z, RR, RZ, ZR, ZZ
from tissue_sim.fem.axisymmetric.contact_kernels import HELD, TOUCHED
from tissue_sim.fem.axisymmetric.newton import CONTACTS, KAPPA, REMEMBERS, UNSYMMETRIC
from tissue_sim.fem.axisymmetric.newton import FREE as FREE_EQUATIONS
from tissue_sim.fem.history import FACTOR, INSTANT, LOSS, LOSS_MODULUS, LOSS_SHARE
from tissue_sim.fem.linear import band as band_matrix
from tissue_sim.fem.linear.cholesky import cholesky_functions
from tissue_sim.fem.linear.lu import lu_functions
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS

#: Places in `which`: the parameter; whether the matrix has still to be factorised (what stays 1 is singular); whether
#: the law is needed at all points, not only where the tool pulls at what it holds.
PARAMETER, FRESH, ALL_POINTS = range(3)
#: Places of what is noted of a quadrature point.
ENERGY, STRESS, SOFT_STRESS, RELAXED_STRESS, SOFT_TANGENT, TANGENT, GRADIENT, NOTED = 0, 1, 6, 11, 16, 31, 46, 51
#: Most rounds in which the rates of the contact forces settle, each of which takes about three digits off what is
#: left, and the share of them that may still change.
ROUNDS, SETTLED = 8, 1e-10


def directional(energy: KernelEnergy) -> KernelEnergy:
    """The energy's derivative with respect to its coefficients along a direction; coefficients, then the direction."""
    along = tuple(sp.Symbol(f"{symbol.name}_rate", real=True) for symbol in energy.coefficients)
    rate = sum((way * sp.diff(energy.energy, symbol) for way, symbol in zip(along, energy.coefficients, strict=True)),
               sp.Integer(0))
    return KernelEnergy(f"{energy.key} rate", energy.family, energy.variables, energy.coefficients + along, rate)


@cache
def respond_kernel(element_name: str, energy: KernelEnergy):
    """The compiled response of one element and one family of laws; see `tissue_sim.fem.axisymmetric.sensitivity`."""
    ti = initialise()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.nodes, element.boundary_nodes, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > nb, nodes - 1
    block = ti.types.vector(band_matrix.BLOCK, ti.f64)
    B = band_matrix.BLOCK
    real1, real2, real3, real4 = (ti.types.ndarray(dtype=ti.f64, ndim=n) for n in range(1, 5))
    int1, int2 = (ti.types.ndarray(dtype=ti.i32, ndim=n) for n in (1, 2))
    block1, block3 = (ti.types.ndarray(dtype=block, ndim=n) for n in (1, 3))
    stress_and_tangent = point.function(energy)
    stress_rate = point.function(directional(energy), tangents=False)
    add_volume = point.volume_function()
    soften, relax = point.history_functions()
    cholesky, lu = cholesky_functions(), lu_functions()
    row = point.PLACE

    @ti.func
    def pulled_back(F, P):
        """F^-1 P: RR, RZ, ZR, ZZ, hoop."""
        j = F[0] * F[3] - F[1] * F[2]
        return ti.Vector([(F[3] * P[0] - F[1] * P[2]) / j, (F[3] * P[1] - F[1] * P[3]) / j,
                          (F[0] * P[2] - F[2] * P[0]) / j, (F[0] * P[3] - F[2] * P[1]) / j, P[4] / F[4]])

    @ti.func
    def pushed(F, S):
        """F S of a symmetric S (RR, RZ, ZZ, hoop)."""
        return ti.Vector([F[0] * S[0] + F[1] * S[1], F[0] * S[1] + F[1] * S[2],
                          F[2] * S[0] + F[3] * S[1], F[2] * S[1] + F[3] * S[2], F[4] * S[3]])

    @ti.func
    def gradient(e, q, x: ti.template(), connectivity: ti.template(), node_gradients: ti.template()):
        H = ti.Vector.zero(ti.f64, 5)
        for a in range(element.nodes):
            ur, uz = x[2 * connectivity[e, a]], x[2 * connectivity[e, a] + 1]
            nx, ny, nr = node_gradients[e, q, a, 0], node_gradients[e, q, a, 1], node_gradients[e, q, a, 2]
            H += ti.Vector([ur * nx, ur * ny, uz * nx, uz * ny, ur * nr])
        return H

    @ti.func
    def root_of(F):
        return ti.pow((F[0] * F[3] - F[1] * F[2]) * F[4], -1.0 / 3.0)

    @ti.func
    def look(e, q, F, p, modulus, remembers, coefficients: ti.template(), past: ti.template(),
             inherited: ti.template(), largest: ti.template(), law: ti.template()):
        """Note what does not depend on the parameter, in the places that start at `ENERGY` and so on."""
        W, P, A = stress_and_tangent(F, root_of(F), coefficients)
        if remembers == 1:
            W = past[FACTOR] * W
            for i in ti.static(range(5)):
                P[i] = past[FACTOR] * P[i]
            for i in ti.static(range(15)):
                A[i] = past[FACTOR] * A[i]
        law[e, q, ENERGY] = W
        for i in ti.static(range(5)):
            law[e, q, STRESS + i] = P[i]
        if remembers == 1:
            P1, A1 = soften(W, largest[e, q], past[LOSS], past[LOSS_MODULUS], past[LOSS_SHARE], P, A)
            for i in ti.static(range(5)):
                law[e, q, SOFT_STRESS + i] = P1[i]
            for i in ti.static(range(15)):
                law[e, q, SOFT_TANGENT + i] = A1[i]
            h = [inherited[e, q, i] for i in ti.static(range(4))]
            _S, P2, A2 = relax(F, past[INSTANT], h, P1, A1)
            for i in ti.static(range(5)):
                P[i] = P2[i]
            for i in ti.static(range(15)):
                A[i] = A2[i]
        for i in ti.static(range(5)):
            law[e, q, RELAXED_STRESS + i] = P[i]
        _P, A3 = add_volume(F, p, [modulus * P[i] for i in ti.static(range(5))],
                            [modulus * A[i] for i in ti.static(range(15))])
        for i in ti.static(range(15)):
            law[e, q, TANGENT + i] = A3[i]

    @ti.func
    def noted(e, q, first, law: ti.template()):
        return ti.Vector([law[e, q, first], law[e, q, first + 1], law[e, q, first + 2], law[e, q, first + 3],
                          law[e, q, first + 4]])

    @ti.func
    def times(e, q, first, H, law: ti.template()):
        """A noted tangent times a rate of the deformation gradient."""
        rate = ti.Vector.zero(ti.f64, 5)
        for i in ti.static(range(5)):
            for k in ti.static(range(5)):
                rate[i] += law[e, q, first + ti.static(row[i][k])] * H[k]
        return rate

    @ti.func
    def at_point(k, e, q, F, direction: ti.template(), modulus, modulus_rate, remembers, past: ti.template(),
                 past_rates: ti.template(), inherited_rates: ti.template(), largest: ti.template(),
                 largest_rates: ti.template(), law: ti.template()):
        """Rates with F held: of the energy, of the softened stress, of the whole stress but for the pressure."""
        dW, rate, _unused = stress_rate(F, root_of(F), direction)
        dP = ti.Vector([rate[i] for i in ti.static(range(5))])
        soft = ti.Vector.zero(ti.f64, 5)
        if remembers == 1:
            f, df = past[FACTOR], past_rates[k, FACTOR] / past[FACTOR]
            W, L = law[e, q, ENERGY], largest[e, q]
            dW = f * dW + df * W
            dP = f * dP + df * noted(e, q, STRESS, law)
            if W < L:
                dL = largest_rates[k, e, q]
                width = past[LOSS_MODULUS] + past[LOSS_SHARE] * L
                width_rate = past_rates[k, LOSS_MODULUS] + past_rates[k, LOSS_SHARE] * L + past[LOSS_SHARE] * dL
                bend = ti.tanh((L - W) / width)
                argument_rate = (dL - dW) / width - (L - W) * width_rate / (width * width)
                eta_rate = -past_rates[k, LOSS] * bend - past[LOSS] * (1.0 - bend * bend) * argument_rate
                dP = (1.0 - past[LOSS] * bend) * dP + eta_rate * noted(e, q, STRESS, law)
            soft = 1.0 * dP
            dh = ti.Vector([inherited_rates[k, e, q, 0], inherited_rates[k, e, q, 1], inherited_rates[k, e, q, 2],
                            inherited_rates[k, e, q, 3]])
            dP = past[INSTANT] * dP + past_rates[k, INSTANT] * noted(e, q, SOFT_STRESS, law) + pushed(F, dh)
        dP = modulus * dP + modulus_rate * noted(e, q, RELAXED_STRESS, law)
        return dW, soft, dP

    @ti.func
    def contact_rate(i, k, dr, dz, held: ti.template(), ways: ti.template(), springs: ti.template(),
                     contact_rates: ti.template(), multiplier_rates: ti.template(), anchor_rates: ti.template()):
        """Rate of the force of point i with parameter k when it moves by (dr, dz)."""
        fr = contact_rates[i, RR] * dr + contact_rates[i, RZ] * dz
        fz = contact_rates[i, ZR] * dr + contact_rates[i, ZZ] * dz
        lr, lz = multiplier_rates[k, i, 0], multiplier_rates[k, i, 1]
        hr, hz = anchor_rates[k, i, 0], anchor_rates[k, i, 1]
        stiff = HOLD * springs[i]
        if held[i, 0] == HELD:
            fr += lr - stiff * hr
            fz += lz - stiff * hz
        elif contact_rates[i, RR] != 0.0 or contact_rates[i, ZZ] != 0.0:
            nr, nz, mu = contact_rates[i, NORMAL_R], contact_rates[i, NORMAL_Z], contact_rates[i, FRICTION]
            tr, tz = -nz, nr
            pressed, along = lr * nr + lz * nz, 0.0
            if mu > 0.0 and held[i, 0] == TOUCHED:
                sticks = lr * tr + lz * tz - stiff * (hr * tr + hz * tz)
                along = sticks if ways[i] == 0.0 else -ways[i] * mu * pressed
            fr += pressed * nr + along * tr
            fz += pressed * nz + along * tz
        return fr, fz

    @ti.kernel
    def respond(which: int1, counts: int1, settings: real1, connectivity: int2, equation: int1, node_gradients: real4,
                quadrature: real3, along: real3, contact_nodes: int2, contact_shapes: real2, spans: int2, springs:
                real1, held: real2, ways: real1, contact_rates: real2, coefficients: real1, element_moduli: real1, past:
                real1, inherited: real3, largest: real2, x: real1, entries: real4, blocks: block3, upper_blocks: block3,
                inverse: real1, right: block1, residual: real1, volume_r: real2, volume_z: real2, rows_rr: real2,
                rows_rz: real2, rows_zr: real2, rows_zz: real2, inverse_rr: real2, inverse_rz: real2, inverse_zz: real2,
                gap_rates: real2, node_forces: real2, centre_force: real2, kappa_rates: real1, moduli_rates: real2,
                past_rates: real2, inherited_rates: real4, largest_rates: real3, multiplier_rates: real3, anchor_rates:
                real3, direction: real1, law: real3, base: real1, dx: real1, stress_rates: real4, energy_rates: real3,
                point_rates: real3, force_rates: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            free, width, rows = counts[FREE_EQUATIONS], entries.shape[1], entries.shape[0]
            elements, pressures = connectivity.shape[0], equation.shape[0]
            k = which[PARAMETER]
            if which[FRESH] == 1:
                for i in range(free, rows * B):
                    entries[i // B, width - 1, i % B, i % B] = 1.0
                good = 1
                if counts[UNSYMMETRIC] == 1:
                    good = lu.init(blocks, upper_blocks, inverse, rows, width)
                else:
                    good = cholesky.init(blocks, upper_blocks, inverse, rows, width)
                which[FRESH] = 1 - good
                for e in range(elements):
                    for q in range(points):
                        F = gradient(e, q, x, connectivity, node_gradients) + ti.Vector([1.0, 0.0, 0.0, 1.0, 1.0])
                        for i in ti.static(range(5)):
                            law[e, q, GRADIENT + i] = F[i]
                        if which[ALL_POINTS] == 1 or along[e, q, 0] != 0.0 or along[e, q, 1] != 0.0:
                            p = 0.0
                            for m in range(modes):
                                p += quadrature[e, q, 1 + m] * x[pressures + modes * e + m]
                            look(e, q, F, p, element_moduli[e], counts[REMEMBERS], coefficients, past, inherited,
                                 largest, law)
            for i in range(base.shape[0]):
                base[i] = 0.0
            for e in range(elements):
                bulk = settings[KAPPA] * element_moduli[e]
                bulk_rate = kappa_rates[k] * element_moduli[e] + settings[KAPPA] * moduli_rates[k, e]
                b, l = e // LANES, e % LANES
                for m in range(modes):
                    gap_rates[e, m] = x[pressures + modes * e + m] / (bulk * bulk) * bulk_rate
                for a in range(nodes):
                    node_forces[a, 0], node_forces[a, 1] = 0.0, 0.0
                    for m in range(modes):
                        v, scaled = (b * modes + m) * nodes + a, bulk * gap_rates[e, m]
                        node_forces[a, 0] = node_forces[a, 0] + scaled * volume_r[v, l]
                        node_forces[a, 1] = node_forces[a, 1] + scaled * volume_z[v, l]
                for q in range(points):
                    w = quadrature[e, q, 0]
                    F = noted(e, q, GRADIENT, law)
                    _dW, _soft, dP = at_point(k, e, q, F, direction, element_moduli[e], moduli_rates[k, e],
                                              counts[REMEMBERS], past, past_rates, inherited_rates, largest,
                                              largest_rates, law)
                    for a in range(nodes):
                        nx, ny, nr = node_gradients[e, q, a, 0], node_gradients[e, q, a, 1], node_gradients[e, q, a, 2]
                        node_forces[a, 0] = node_forces[a, 0] + w * (dP[0] * nx + dP[1] * ny + dP[4] * nr)
                        node_forces[a, 1] = node_forces[a, 1] + w * (dP[2] * nx + dP[3] * ny)
                f0, f1 = 0.0, 0.0
                if ti.static(has_centre):
                    for a in range(nb, nodes):
                        f0, f1 = node_forces[a, 0], node_forces[a, 1]
                    centre_force[e, 0] = inverse_rr[b, l] * f0 + inverse_rz[b, l] * f1
                    centre_force[e, 1] = inverse_rz[b, l] * f0 + inverse_zz[b, l] * f1
                for a in range(nb):
                    fr, fz = node_forces[a, 0], node_forces[a, 1]
                    if ti.static(has_centre):
                        at = b * nb + a
                        fr -= f0 * rows_rr[at, l] + f1 * rows_zr[at, l]
                        fz -= f0 * rows_rz[at, l] + f1 * rows_zz[at, l]
                    ir, iz = equation[2 * connectivity[e, a]], equation[2 * connectivity[e, a] + 1]
                    base[ir] = base[ir] + fr
                    base[iz] = base[iz] + fz
            for _round in range(ROUNDS):
                changed, largest_rate = 0.0, 0.0
                for i in range(residual.shape[0]):
                    residual[i] = base[i]
                for c in range(counts[CONTACTS]):
                    fr, fz = contact_rate(c, k, 0.0, 0.0, held, ways, springs, contact_rates, multiplier_rates,
                                          anchor_rates)
                    for a in range(contact_shapes.shape[1]):
                        ir, iz = equation[2 * contact_nodes[c, a]], equation[2 * contact_nodes[c, a] + 1]
                        residual[ir] = residual[ir] + contact_shapes[c, a] * fr
                        residual[iz] = residual[iz] + contact_shapes[c, a] * fz
                for I in range(rows):
                    for i in ti.static(range(B)):
                        right[I][i] = residual[I * B + i] if I * B + i < free else 0.0
                if counts[UNSYMMETRIC] == 1:
                    lu.solve(blocks, upper_blocks, inverse, right, rows, width)
                else:
                    cholesky.solve(blocks, upper_blocks, inverse, right, rows, width)
                for dof in range(pressures):
                    i = equation[dof]
                    if i >= free:
                        dx[dof] = 0.0
                    elif i >= 0:
                        dx[dof] = -right[i // B][i % B]
                for c in range(counts[CONTACTS]):
                    dr, dz = 0.0, 0.0
                    for a in range(contact_shapes.shape[1]):
                        dr += contact_shapes[c, a] * dx[2 * contact_nodes[c, a]]
                        dz += contact_shapes[c, a] * dx[2 * contact_nodes[c, a] + 1]
                    fr, fz = contact_rate(c, k, dr, dz, held, ways, springs, contact_rates, multiplier_rates,
                                          anchor_rates)
                    changed += ti.abs(fr - multiplier_rates[k, c, 0]) + ti.abs(fz - multiplier_rates[k, c, 1])
                    largest_rate += ti.abs(fr) + ti.abs(fz)
                    multiplier_rates[k, c, 0], multiplier_rates[k, c, 1] = fr, fz
                    point_rates[k, c, 0], point_rates[k, c, 1] = dr, dz
                if changed <= SETTLED * largest_rate:
                    break
            total = 0.0
            for c in range(counts[CONTACTS]):
                total += float(spans[c, MOVES]) * multiplier_rates[k, c, 1]
            for e in range(elements):
                bulk = settings[KAPPA] * element_moduli[e]
                b, l = e // LANES, e % LANES
                if ti.static(has_centre):
                    cr, cz = centre_force[e, 0], centre_force[e, 1]
                    for a in range(nb):
                        ur, uz = dx[2 * connectivity[e, a]], dx[2 * connectivity[e, a] + 1]
                        at = b * nb + a
                        cr += rows_rr[at, l] * ur + rows_rz[at, l] * uz
                        cz += rows_zr[at, l] * ur + rows_zz[at, l] * uz
                    dx[2 * connectivity[e, centre]], dx[2 * connectivity[e, centre] + 1] = -cr, -cz
                for m in range(modes):
                    change = gap_rates[e, m]
                    for a in range(nodes):
                        v = (b * modes + m) * nodes + a
                        change += (volume_r[v, l] * dx[2 * connectivity[e, a]]
                                   + volume_z[v, l] * dx[2 * connectivity[e, a] + 1])
                    dx[pressures + modes * e + m] = bulk * change
                for q in range(points):
                    loaded = along[e, q, 0] != 0.0 or along[e, q, 1] != 0.0
                    if counts[REMEMBERS] == 1 or loaded:
                        F = noted(e, q, GRADIENT, law)
                        H = gradient(e, q, dx, connectivity, node_gradients)
                        dp = 0.0
                        for m in range(modes):
                            dp += quadrature[e, q, 1 + m] * dx[pressures + modes * e + m]
                        dW, soft, dP = at_point(k, e, q, F, direction, element_moduli[e], moduli_rates[k, e],
                                                counts[REMEMBERS], past, past_rates, inherited_rates, largest,
                                                largest_rates, law)
                        c, j = F[4], F[0] * F[3] - F[1] * F[2]
                        cofactor = ti.Vector([c * F[3], -c * F[2], -c * F[1], c * F[0], j])
                        rate = dP + times(e, q, TANGENT, H, law) + dp * cofactor
                        total += quadrature[e, q, 0] * (rate[2] * along[e, q, 0] + rate[3] * along[e, q, 1])
                        if counts[REMEMBERS] == 1:
                            energy_rates[k, e, q] = dW + noted(e, q, STRESS, law).dot(H)
                            S = pulled_back(F, noted(e, q, SOFT_STRESS, law))
                            lost = pushed(H, ti.Vector([S[0], S[1], S[3], S[4]]))
                            S_rate = pulled_back(F, soft + times(e, q, SOFT_TANGENT, H, law) - lost)
                            stress_rates[k, e, q, 0], stress_rates[k, e, q, 1] = S_rate[0], S_rate[1]
                            stress_rates[k, e, q, 2], stress_rates[k, e, q, 3] = S_rate[3], S_rate[4]
            force_rates[k] = total

    return respond
