"""Element work of the axisymmetric solid: quadrature, elimination inside the element, assembly.

Two-field potential of displacement u and element pressures p:

    Pi(u, p) = integral of W(F / J^(1/3)) + p (J - 1) - p^2 / (2 K)

(Sussman and Bathe, Computers & Structures 26 (1987) 357, for U(J) = K/2 (J - 1)^2). The pressure is a Newton unknown
of its own, eliminated element by element from the linearised equations: slaved to the volume, p = K (v/V - 1), it
makes the tangent indefinite at the first large step. The interior node is eliminated likewise.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem import band as band_matrix
from tissue_sim.fem import energy as point
from tissue_sim.fem.elements import ELEMENTS
from tissue_sim.fem.runtime import initialise
from tissue_sim.laws import KernelEnergy

#: Places in the settings of what happens to the tissue in time.
FACTOR, INSTANT, LOSS, LOSS_MODULUS, LOSS_SHARE = range(5)


class ElementFunctions(NamedTuple):
    """Taichi functions of one element and one family of laws; `vec` is the type of a number per shared node."""

    vec: object
    integrate: object
    condense_pressure: object
    condense_centre: object
    condense_centre_force: object
    add_weight: object
    add_pending: object
    scatter: object


@cache
def element_functions(element_name: str, energy: KernelEnergy) -> ElementFunctions:
    """See the functions themselves."""
    ti = initialise()
    element = ELEMENTS[element_name]
    nb, modes, points = element.boundary_nodes, element.pressure_modes, element.quadrature[1].size
    has_centre = element.nodes > nb
    centre = element.nodes - 1
    vec = ti.types.vector(nb, ti.f64)
    stress_and_tangent = point.function(energy)
    add_volume = point.volume_function()
    soften, relax = point.history_functions()
    add_entry = band_matrix.add_entry_function()
    # The tangent's rows that meet an r freedom (rR, rZ, hoop) and a z freedom (zR, zZ).
    row = [[point.packed(i, k) for k in range(5)] for i in range(5)]

    # Throughout, `a = a + b` on arrays: `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def integrate(e, tangent, kappa, modulus, remembers, x: ti.template(), pressures, connectivity: ti.template(),
                  gradients: ti.template(), node_gradients: ti.template(), quadrature: ti.template(),
                  coefficients: ti.template(), past: ti.template(), inherited: ti.template(), largest: ti.template(),
                  stresses: ti.template(), energies: ti.template(), force: ti.template(), rates: ti.template(),
                  stiffness: ti.template(), centre_stiffness: ti.template(), volume: ti.template(),
                  centre_volume: ti.template(), gap: ti.template()):
        """Element residual, stiffness and volume constraint by quadrature; returns the smallest J.

        `modulus` multiplies the law. Where the tissue `remembers`, `past` holds how it does, `inherited` what is left
        of earlier stresses and `largest` the largest energy of each point; its stress and energy now are written to
        `stresses` and `energies`.
        """
        smallest = 1e30
        ur, uz = vec(0.0), vec(0.0)
        for a in ti.static(range(nb)):
            node = connectivity[e, a]
            ur[a] = x[2 * node]
            uz[a] = x[2 * node + 1]
        cr, cz = 0.0, 0.0
        if ti.static(has_centre):
            cr = x[2 * connectivity[e, centre]]
            cz = x[2 * connectivity[e, centre] + 1]
        for b in range(element.nodes):
            for k in ti.static(range(4)):
                stiffness[b, k] = vec(0.0)
        for k in ti.static(range(3)):
            centre_stiffness[k] = 0.0
        for m in range(modes):
            volume[e, m, 0], volume[e, m, 1] = vec(0.0), vec(0.0)
            centre_volume[e, m, 0], centre_volume[e, m, 1] = 0.0, 0.0
            gap[e, m] = -x[pressures + modes * e + m] / kappa
        fr, fz = vec(0.0), vec(0.0)
        fcr, fcz = 0.0, 0.0
        for q in range(points):
            w = quadrature[e, q, 0]
            nx, ny, nr = gradients[e, q, 0], gradients[e, q, 1], gradients[e, q, 2]
            H = ti.Vector([ur.dot(nx), ur.dot(ny), uz.dot(nx), uz.dot(ny), ur.dot(nr)])
            cx, cy, ch = 0.0, 0.0, 0.0
            if ti.static(has_centre):
                cx, cy, ch = node_gradients[e, q, centre, 0], node_gradients[e, q, centre, 1], node_gradients[
                    e, q, centre, 2]
                H += ti.Vector([cr * cx, cr * cy, cz * cx, cz * cy, cr * ch])
            F = H + ti.Vector([1.0, 0.0, 0.0, 1.0, 1.0])
            # J - 1 from the displacement gradient: nothing is lost to the 1 when K/mu multiplies it.
            area = H[0] + H[3] + H[0] * H[3] - H[1] * H[2]
            dilation = area + H[4] + area * H[4]
            j, J = 1.0 + area, 1.0 + dilation
            smallest = ti.min(smallest, ti.min(J, F[4]))
            p = 0.0
            for m in ti.static(range(modes)):
                p += quadrature[e, q, 1 + m] * x[pressures + modes * e + m]
            if J > 0.0 and F[4] > 0.0:
                W, P, A = stress_and_tangent(F, coefficients)
                if remembers == 1:
                    W *= past[FACTOR]
                    P *= past[FACTOR]
                    A *= past[FACTOR]
                    energies[e, q] = W
                    soften(W, largest[e, q], past[LOSS], past[LOSS_MODULUS], past[LOSS_SHARE], P, A)
                    h = ti.Vector([inherited[e, q, 0], inherited[e, q, 1], inherited[e, q, 2], inherited[e, q, 3]])
                    S = relax(F, past[INSTANT], h, P, A)
                    for i in ti.static(range(4)):
                        stresses[e, q, i] = S[i]
                P *= modulus
                A *= modulus
                add_volume(F, p, P, A)
                P *= w
                fr += P[0] * nx + P[1] * ny + P[4] * nr
                fz += P[2] * nx + P[3] * ny
                # dJ/du of each freedom, for the constraint.
                c = F[4]
                gr = (c * F[3]) * nx - (c * F[2]) * ny + j * nr
                gz = (c * F[0]) * ny - (c * F[1]) * nx
                gcr, gcz = 0.0, 0.0
                if ti.static(has_centre):
                    fcr += P[0] * cx + P[1] * cy + P[4] * ch
                    fcz += P[2] * cx + P[3] * cy
                    gcr = c * (F[3] * cx - F[2] * cy) + j * ch
                    gcz = c * (F[0] * cy - F[1] * cx)
                for m in range(modes):
                    phi = w * quadrature[e, q, 1 + m]
                    gap[e, m] = gap[e, m] + phi * dilation
                    volume[e, m, 0] = volume[e, m, 0] + phi * gr
                    volume[e, m, 1] = volume[e, m, 1] + phi * gz
                    if ti.static(has_centre):
                        centre_volume[e, m, 0] = centre_volume[e, m, 0] + phi * gcr
                        centre_volume[e, m, 1] = centre_volume[e, m, 1] + phi * gcz
                if tangent == 1:
                    A *= w
                    # Stress rates of an r (0 to 4) and of a z motion (5 to 9) of every shared node at once.
                    for i in ti.static(range(5)):
                        rates[i] = (A[ti.static(row[i][0])] * nx + A[ti.static(row[i][1])] * ny
                                    + A[ti.static(row[i][4])] * nr)
                        rates[5 + i] = A[ti.static(row[i][2])] * nx + A[ti.static(row[i][3])] * ny
                    for b in range(nb):
                        stiffness[b, 0] = stiffness[b, 0] + rates[0][b] * nx + rates[1][b] * ny + rates[4][b] * nr
                        stiffness[b, 1] = stiffness[b, 1] + rates[2][b] * nx + rates[3][b] * ny
                        stiffness[b, 2] = stiffness[b, 2] + rates[5][b] * nx + rates[6][b] * ny + rates[9][b] * nr
                        stiffness[b, 3] = stiffness[b, 3] + rates[7][b] * nx + rates[8][b] * ny
                    if ti.static(has_centre):
                        r = ti.Vector([A[ti.static(row[i][0])] * cx + A[ti.static(row[i][1])] * cy
                                       + A[ti.static(row[i][4])] * ch for i in ti.static(range(5))])
                        z = ti.Vector([A[ti.static(row[i][2])] * cx + A[ti.static(row[i][3])] * cy
                                       for i in ti.static(range(5))])
                        stiffness[centre, 0] = stiffness[centre, 0] + r[0] * nx + r[1] * ny + r[4] * nr
                        stiffness[centre, 1] = stiffness[centre, 1] + r[2] * nx + r[3] * ny
                        stiffness[centre, 2] = stiffness[centre, 2] + z[0] * nx + z[1] * ny + z[4] * nr
                        stiffness[centre, 3] = stiffness[centre, 3] + z[2] * nx + z[3] * ny
                        centre_stiffness[0] = centre_stiffness[0] + r[0] * cx + r[1] * cy + r[4] * ch
                        centre_stiffness[1] = centre_stiffness[1] + r[2] * cx + r[3] * cy
                        centre_stiffness[2] = centre_stiffness[2] + z[2] * cx + z[3] * cy
        force[0], force[1] = fr, fz
        force[2] = vec(0.0)
        force[2][0], force[2][1] = fcr, fcz
        return smallest

    @ti.func
    def condense_pressure(e, tangent, kappa, force: ti.template(), stiffness: ti.template(),
                          centre_stiffness: ti.template(), volume: ti.template(), centre_volume: ti.template(),
                          gap: ti.template()):
        """Add K B^T B to the stiffness and K B^T gap to the residual (the pressure modes are orthonormal)."""
        for m in range(modes):
            br, bz = volume[e, m, 0], volume[e, m, 1]
            scaled = kappa * gap[e, m]
            force[0] = force[0] + scaled * br
            force[1] = force[1] + scaled * bz
            if ti.static(has_centre):
                bcr, bcz = centre_volume[e, m, 0], centre_volume[e, m, 1]
                force[2][0] = force[2][0] + scaled * bcr
                force[2][1] = force[2][1] + scaled * bcz
                stiffness[centre, 0] = stiffness[centre, 0] + (kappa * bcr) * br
                stiffness[centre, 1] = stiffness[centre, 1] + (kappa * bcr) * bz
                stiffness[centre, 2] = stiffness[centre, 2] + (kappa * bcz) * br
                stiffness[centre, 3] = stiffness[centre, 3] + (kappa * bcz) * bz
                centre_stiffness[0] = centre_stiffness[0] + kappa * bcr * bcr
                centre_stiffness[1] = centre_stiffness[1] + kappa * bcr * bcz
                centre_stiffness[2] = centre_stiffness[2] + kappa * bcz * bcz
            if tangent == 1:
                for b in range(nb):
                    kr, kz = kappa * volume[e, m, 0][b], kappa * volume[e, m, 1][b]
                    stiffness[b, 0] = stiffness[b, 0] + kr * br
                    stiffness[b, 1] = stiffness[b, 1] + kr * bz
                    stiffness[b, 2] = stiffness[b, 2] + kz * br
                    stiffness[b, 3] = stiffness[b, 3] + kz * bz

    @ti.func
    def condense_centre(e, stiffness: ti.template(), centre_stiffness: ti.template(), centre_rows: ti.template(),
                        centre_inverse: ti.template()):
        """Eliminate the interior node from the stiffness; returns 0 where its own block is not positive definite.

        Kept are the inverse of its block and centre_rows, its motion for one of the shared nodes, sign turned.
        """
        a, b, d = centre_stiffness[0], centre_stiffness[1], centre_stiffness[2]
        determinant = a * d - b * b
        centre_inverse[e, 0], centre_inverse[e, 1] = d / determinant, -b / determinant
        centre_inverse[e, 2] = a / determinant
        kr0, kr1, kz0, kz1 = stiffness[centre, 0], stiffness[centre, 1], stiffness[centre, 2], stiffness[centre, 3]
        centre_rows[e, 0, 0] = centre_inverse[e, 0] * kr0 + centre_inverse[e, 1] * kz0
        centre_rows[e, 0, 1] = centre_inverse[e, 0] * kr1 + centre_inverse[e, 1] * kz1
        centre_rows[e, 1, 0] = centre_inverse[e, 1] * kr0 + centre_inverse[e, 2] * kz0
        centre_rows[e, 1, 1] = centre_inverse[e, 1] * kr1 + centre_inverse[e, 2] * kz1
        for n in range(nb):
            x0, x1 = centre_rows[e, 0, 0][n], centre_rows[e, 1, 0][n]
            y0, y1 = centre_rows[e, 0, 1][n], centre_rows[e, 1, 1][n]
            stiffness[n, 0] = stiffness[n, 0] - (x0 * kr0 + x1 * kz0)
            stiffness[n, 1] = stiffness[n, 1] - (x0 * kr1 + x1 * kz1)
            stiffness[n, 2] = stiffness[n, 2] - (y0 * kr0 + y1 * kz0)
            stiffness[n, 3] = stiffness[n, 3] - (y0 * kr1 + y1 * kz1)
        good = 0
        if a > 0.0 and determinant > 0.0:
            good = 1
        return good

    @ti.func
    def condense_centre_force(e, force: ti.template(), centre_rows: ti.template(), centre_inverse: ti.template(),
                              centre_force: ti.template()):
        """Eliminate the interior node from the residual: its motion is -(centre_force + centre_rows . u_shared)."""
        f0, f1 = force[2][0], force[2][1]
        centre_force[e, 0] = centre_inverse[e, 0] * f0 + centre_inverse[e, 1] * f1
        centre_force[e, 1] = centre_inverse[e, 1] * f0 + centre_inverse[e, 2] * f1
        force[0] = force[0] - (f0 * centre_rows[e, 0, 0] + f1 * centre_rows[e, 1, 0])
        force[1] = force[1] - (f0 * centre_rows[e, 0, 1] + f1 * centre_rows[e, 1, 1])

    @ti.func
    def add_weight(e, weight, volumes: ti.template(), centre_volumes: ti.template(), force: ti.template()):
        """Subtract the nodal forces of self-weight, which pulls towards -z."""
        force[1] = force[1] + weight * volumes[e]
        if ti.static(has_centre):
            force[2][1] = force[2][1] + weight * centre_volumes[e]

    @ti.func
    def add_pending(e, x: ti.template(), free, connectivity: ti.template(), equation: ti.template(),
                    target: ti.template(), force: ti.template(), stiffness: ti.template()):
        """Residual of the motion that the tool still has to make in this step, so that the tissue follows it."""
        for b in range(nb):
            for k in ti.static(range(2)):
                dof = 2 * connectivity[e, b] + k
                if equation[dof] >= free:
                    step = target[dof] - x[dof]
                    force[0] = force[0] + step * stiffness[b, 2 * k]
                    force[1] = force[1] + step * stiffness[b, 2 * k + 1]

    @ti.func
    def scatter(e, tangent, free, width, connectivity: ti.template(), equation: ti.template(), force: ti.template(),
                stiffness: ti.template(), entries: ti.template(), residual: ti.template()):
        """Add an element to the band matrix and to the residual."""
        for a in range(nb):
            for i in ti.static(range(2)):
                ia = equation[2 * connectivity[e, a] + i]
                residual[ia] = residual[ia] + force[i][a]
                if tangent == 1:
                    for b in range(nb):
                        for k in ti.static(range(2)):
                            ib = equation[2 * connectivity[e, b] + k]
                            add_entry(ia, ib, stiffness[b, 2 * k + i][a], free, width, entries)

    return ElementFunctions(vec, integrate, condense_pressure, condense_centre, condense_centre_force, add_weight,
                            add_pending, scatter)
