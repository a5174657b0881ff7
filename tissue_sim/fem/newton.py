"""One converged step of the axisymmetric solid as one Taichi kernel.

Two-field potential of displacement u and element pressures p:

    Pi(u, p) = integral of W(F / J^(1/3)) + p (J - 1) - p^2 / (2 K)

(Sussman and Bathe, Computers & Structures 26 (1987) 357, for U(J) = K/2 (J - 1)^2). The pressure is a Newton unknown
of its own, eliminated element by element from the linearised equations: slaved to the volume, p = K (v/V - 1), it
makes the tangent indefinite at the first large step. The interior node is eliminated likewise.
"""

from enum import IntEnum
from functools import cache

from tissue_sim.fem import band as band_matrix
from tissue_sim.fem import contact
from tissue_sim.fem import energy as point
from tissue_sim.fem.elements import ELEMENTS
from tissue_sim.fem.runtime import initialise
from tissue_sim.laws import KernelEnergy


class StepStatus(IntEnum):
    """How a step ended."""

    CONVERGED = 1
    INVERTED = 2
    INDEFINITE = 3
    SLOW = 4
    DIVERGED = 5

    @property
    def message(self) -> str:
        return {
            StepStatus.CONVERGED: "converged",
            StepStatus.INVERTED: "an element turned inside out",
            StepStatus.INDEFINITE: "the tangent lost positive definiteness, so the equilibrium is no longer stable",
            StepStatus.SLOW: "Newton's iteration did not reach its tolerance",
            StepStatus.DIVERGED: "Newton's iteration diverged",
        }[self]


#: Places in the kernel's counts, settings and report.
PASSES, FREE, MAX_ITERATIONS, CONTACTS, SHAFT, STICK_FACE, STICK_SHAFT = range(7)
DEPTH, PREDICTED, KAPPA, WEIGHT, TOLERANCE, FLOOR, ROUNDING, TOUCH, EDGE_RADIUS, PENETRATION_TOLERANCE = range(10)
STATUS, ITERATIONS, RESIDUAL, FORCE, PENETRATION = range(5)


@cache
def step_kernel(element_name: str, energy: KernelEnergy):
    """The compiled step of one element and one family of laws; see `AxisymmetricSolver.step` for its arguments."""
    ti = initialise()
    element = ELEMENTS[element_name]
    nb, modes, points = element.boundary_nodes, element.pressure_modes, element.quadrature[1].size
    has_centre = element.nodes > nb
    centre = element.nodes - 1
    vec = ti.types.vector(nb, ti.f64)
    block = ti.types.vector(band_matrix.BLOCK, ti.f64)
    B = band_matrix.BLOCK
    real1, real2, real3, real4 = (ti.types.ndarray(dtype=ti.f64, ndim=n) for n in range(1, 5))
    int1, int2 = (ti.types.ndarray(dtype=ti.i32, ndim=n) for n in (1, 2))
    vector1, vector2, vector3 = (ti.types.ndarray(dtype=vec, ndim=n) for n in (1, 2, 3))
    block1, block3 = (ti.types.ndarray(dtype=block, ndim=n) for n in (1, 3))
    stress_and_tangent = point.function(energy)
    factorise, solve = band_matrix.functions()
    add_entry = band_matrix.add_entry_function()
    add_contact, augment, hold = contact.functions()
    converged, inverted, indefinite, slow, diverged = (float(status) for status in StepStatus)
    # The tangent's rows that meet an r freedom (rR, rZ, hoop) and a z freedom (zR, zZ).
    row = [[point._packed(i, k) for k in range(5)] for i in range(5)]

    # Throughout, `a = a + b` on arrays: `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def predict(x: ti.template(), history: ti.template(), slots: ti.template(), weights: ti.template()):
        """Extrapolate the state from up to three earlier ones."""
        for i in range(x.shape[0]):
            x[i] = (weights[0] * history[slots[0], i] + weights[1] * history[slots[1], i]
                    + weights[2] * history[slots[2], i])

    @ti.func
    def integrate(e, tangent, kappa, x: ti.template(), pressures, connectivity: ti.template(),
                  gradients: ti.template(), node_gradients: ti.template(), quadrature: ti.template(),
                  coefficients: ti.template(), force: ti.template(), rates: ti.template(), stiffness: ti.template(),
                  centre_stiffness: ti.template(), volume: ti.template(), centre_volume: ti.template(),
                  gap: ti.template()):
        """Element residual, stiffness and volume constraint by quadrature; returns the smallest J."""
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
                P, A = stress_and_tangent(F, p, coefficients)
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

    @ti.func
    def update(x: ti.template(), pressures, free, kappa, connectivity: ti.template(), equation: ti.template(),
               target: ti.template(), right: ti.template(), volume: ti.template(), centre_volume: ti.template(),
               gap: ti.template(), centre_rows: ti.template(), centre_force: ti.template()):
        """Move the state by the solution of the linear equations, eliminated unknowns included."""
        for e in range(connectivity.shape[0]):
            dr, dz = vec(0.0), vec(0.0)
            for a in ti.static(range(nb)):
                dof = 2 * connectivity[e, a]
                ir, iz = equation[dof], equation[dof + 1]
                if ir < free:
                    dr[a] = -right[ir // B][ir % B]
                else:
                    dr[a] = target[dof] - x[dof]
                if iz < free:
                    dz[a] = -right[iz // B][iz % B]
                else:
                    dz[a] = target[dof + 1] - x[dof + 1]
            cr, cz = 0.0, 0.0
            if ti.static(has_centre):
                cr = -(centre_force[e, 0] + centre_rows[e, 0, 0].dot(dr) + centre_rows[e, 0, 1].dot(dz))
                cz = -(centre_force[e, 1] + centre_rows[e, 1, 0].dot(dr) + centre_rows[e, 1, 1].dot(dz))
                x[2 * connectivity[e, centre]] = x[2 * connectivity[e, centre]] + cr
                x[2 * connectivity[e, centre] + 1] = x[2 * connectivity[e, centre] + 1] + cz
            for m in range(modes):
                change = volume[e, m, 0].dot(dr) + volume[e, m, 1].dot(dz)
                if ti.static(has_centre):
                    change += centre_volume[e, m, 0] * cr + centre_volume[e, m, 1] * cz
                x[pressures + modes * e + m] = x[pressures + modes * e + m] + kappa * (gap[e, m] + change)
        for dof in range(pressures):
            i = equation[dof]
            if i >= free:
                x[dof] = target[dof]
            elif i >= 0:
                x[dof] = x[dof] - right[i // B][i % B]

    @ti.kernel
    def step(counts: int1, settings: real1, connectivity: int2, equation: int1, direction: real1, start: real1,
             target: real1, gradients: vector3, node_gradients: real4, quadrature: real3, node_volumes: vector1,
             centre_volumes: real1, edges: int2, edge_shapes: real3, edge_places: real3, first_line: int1,
             vertices: real2, springs: real2, held: real3, met: real3, forces: real3,
             coefficients: real1, x: real1, history: real2, slots: int1,
             weights: real1, entries: real4, blocks: block3, inverse: real1, right: block1, residual: real1,
             force: vector1, rates: vector1, stiffness: vector2, centre_stiffness: real1, volume: vector3,
             centre_volume: real3, gap: real2, centre_rows: vector3, centre_inverse: real2,
             centre_force: real2, report: real1):
        # One pass of one serial task, started without waking a thread pool; the count is an argument so that the loop
        # is not unrolled into many tasks.
        ti.loop_config(serialize=True)
        for _ in range(counts[PASSES]):
            free, max_iterations = counts[FREE], counts[MAX_ITERATIONS]
            depth, kappa, tolerance = settings[DEPTH], settings[KAPPA], settings[TOLERANCE]
            floor, rounding, weight = settings[FLOOR], settings[ROUNDING], settings[WEIGHT]
            elements, width, rows = connectivity.shape[0], entries.shape[1], entries.shape[0]
            pressures = equation.shape[0]
            multipliers = pressures + modes * elements
            predict(x, history, slots, weights)
            pending = 0
            for dof in range(pressures):
                target[dof] = start[dof] + depth * direction[dof]
                if equation[dof] >= free:
                    if ti.abs(x[dof] - target[dof]) > 1e-10 * ti.abs(depth):
                        pending = 1
                    else:
                        x[dof] = target[dof]  # the rounding of the extrapolation
            report[STATUS] = 0.0
            iterations, tangent = 0, 1
            # Far from equilibrium the surface's curvature would make the tangent indefinite.
            bending = 1.0 if max_iterations == 0 else 0.0
            first_ratio, last_ratio, axial = 0.0, 0.0, 0.0
            # The status lives in the report: Taichi 1.7.4 loses a local variable that a branch of such a loop sets.
            # Each solve may need one more pass, for a tangent that was skipped.
            for _attempt in range(3 * max_iterations + 3):
                if report[STATUS] != 0.0:
                    break
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
                if tangent == 1:
                    for I in range(rows):
                        for w in range(width):
                            for c in range(B):
                                for r in ti.static(range(B)):
                                    entries[I, w, c, r] = 0.0
                interior, smallest, definite = 0.0, 1e30, 1
                for e in range(elements):
                    J = integrate(e, tangent, kappa, x, pressures, connectivity, gradients, node_gradients,
                                  quadrature, coefficients, force, rates, stiffness, centre_stiffness, volume,
                                  centre_volume, gap)
                    smallest = ti.min(smallest, J)
                    condense_pressure(e, tangent, kappa, force, stiffness, centre_stiffness, volume, centre_volume,
                                      gap)
                    if weight != 0.0:
                        add_weight(e, weight, node_volumes, centre_volumes, force)
                    if ti.static(has_centre):
                        interior += force[2][0] * force[2][0] + force[2][1] * force[2][1]
                        if tangent == 1:
                            definite = ti.min(definite, condense_centre(e, stiffness, centre_stiffness, centre_rows,
                                                                        centre_inverse))
                        condense_centre_force(e, force, centre_rows, centre_inverse, centre_force)
                    if pending == 1:
                        add_pending(e, x, free, connectivity, equation, target, force, stiffness)
                    scatter(e, tangent, free, width, connectivity, equation, force, stiffness, entries, residual)
                tool = settings[PREDICTED] if pending == 1 else depth
                axial, violation = add_contact(
                    counts[CONTACTS], tangent, pending, bending, depth - tool, tool - settings[TOUCH], free, width,
                    settings[EDGE_RADIUS], counts[SHAFT], counts[STICK_FACE], counts[STICK_SHAFT], multipliers, edges,
                    edge_shapes, edge_places, first_line, vertices, springs, held, met, forces, x, target,
                    equation, residual, entries)
                report[PENETRATION] = violation
                unbalanced, balanced = interior, 0.0
                for i in range(free):
                    unbalanced += residual[i] * residual[i]
                for i in range(free, residual.shape[0]):
                    balanced += residual[i] * residual[i]
                scale = ti.max(ti.sqrt(balanced), floor)
                ratio = ti.sqrt(unbalanced) / scale
                # Rounding is allowed for, within reason.
                goal = tolerance + ti.min(rounding / scale, 1e-5)
                if iterations == 1:
                    first_ratio = ratio
                report[RESIDUAL] = ratio
                if smallest <= 0.0 or smallest >= 1e30 or ti.math.isnan(smallest):
                    report[STATUS] = inverted
                elif ti.math.isnan(ratio) or ti.math.isinf(ratio):
                    report[STATUS] = diverged
                elif pending == 0 and ratio <= goal:
                    released = augment(counts[CONTACTS], multipliers, settings[EDGE_RADIUS], first_line, vertices,
                                       held, forces, x)
                    if released > 0:
                        tangent = 1
                    elif violation <= settings[PENETRATION_TOLERANCE]:
                        hold(counts[CONTACTS], held, met)
                        report[STATUS] = converged
                elif iterations >= max_iterations:
                    report[STATUS] = slow
                elif iterations > 3 and ratio > 1e3 * first_ratio:
                    report[STATUS] = diverged
                elif tangent == 0 and ratio > 1e-3 * last_ratio:
                    tangent = 1
                else:
                    if tangent == 1:
                        for i in range(free, rows * B):
                            entries[i // B, width - 1, i % B, i % B] = 1.0
                        if definite == 1:
                            definite = factorise(blocks, inverse, rows, width)
                    for I in range(rows):
                        for k in ti.static(range(B)):
                            right[I][k] = residual[I * B + k] if I * B + k < free else 0.0
                    if definite == 0 and bending > 0.0:
                        bending, last_ratio = 0.0, 0.0
                    elif definite == 0:
                        report[STATUS] = indefinite
                    else:
                        solve(blocks, inverse, right, rows, width)
                        update(x, pressures, free, kappa, connectivity, equation, target, right, volume,
                               centre_volume, gap, centre_rows, centre_force)
                        # The old factor serves again as long as it takes three digits off the residual, which near
                        # the solution it does; where that is likely, only the residual is computed first.
                        tangent = 1 if pending == 1 or ratio > 10.0 else 0
                        last_ratio = ratio
                        bending = 1.0 if ratio < 0.1 else 0.0
                        pending = 0
                        iterations += 1
            total = axial
            for dof in range(pressures):
                i = equation[dof]
                if i >= free:
                    total += direction[dof] * residual[i]
            report[FORCE] = total
            report[ITERATIONS] = iterations

    return step
