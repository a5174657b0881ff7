"""One converged step of the axisymmetric solid as one Taichi kernel."""

from enum import IntEnum
from functools import cache

from tissue_sim.fem import band as band_matrix
from tissue_sim.fem import band_lu, contact_kernels
from tissue_sim.fem.assembly import element_functions
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


#: Friction of a point that is no friction, as a share of the least load that residuals are measured against.
FRICTION_FLOOR = 1e-9
#: A factor serves again as long as each solve with it takes the residual down to this share.
REUSE = 1e-3
#: All points of the surface may change between sticking and slipping at once, until so many iterations did not settle
#: it: then one point at a time (Murty's least-index rule).
ALL, CIRCLING = 1_000_000, 8
#: Places in the kernel's counts, settings and report.
PASSES, FREE, MAX_ITERATIONS, CONTACTS, REMEMBERS, UNSYMMETRIC, CHANGEABLE, KEEPS = range(8)
(DEPTH, PREDICTED, KAPPA, WEIGHT, TOLERANCE, FLOOR, ROUNDING, TOUCH, CONTACT_TOLERANCE, ADHESION,
 ADHESION_LENGTH) = range(11)
STATUS, ITERATIONS, RESIDUAL, FORCE, VIOLATION, SLIPPING = range(6)


@cache
def step_kernel(element_name: str, energy: KernelEnergy, slips: bool):
    """The compiled step of one element and one family of laws; see `AxisymmetricSolver.step` for its arguments.

    Only where something `slips` against friction it contains the solution of unsymmetric equations.
    """
    ti = initialise()
    element = ELEMENTS[element_name]
    modes, has_centre = element.pressure_modes, element.nodes > element.boundary_nodes
    work = element_functions(element_name, energy)
    vec = work.vec
    block = ti.types.vector(band_matrix.BLOCK, ti.f64)
    B = band_matrix.BLOCK
    real1, real2, real3, real4 = (ti.types.ndarray(dtype=ti.f64, ndim=n) for n in range(1, 5))
    int1, int2 = (ti.types.ndarray(dtype=ti.i32, ndim=n) for n in (1, 2))
    vector1, vector2, vector3 = (ti.types.ndarray(dtype=vec, ndim=n) for n in (1, 2, 3))
    block1, block3 = (ti.types.ndarray(dtype=block, ndim=n) for n in (1, 3))
    factorise, solve = band_matrix.functions()
    add_contact, add_rates, augment, hold = contact_kernels.functions(slips)
    mirror, _, factorise_lu, solve_lu = band_lu.functions()
    converged, inverted, indefinite, slow, diverged = (float(status) for status in StepStatus)
    nb, centre = element.boundary_nodes, element.nodes - 1

    # Throughout, `a = a + b` on arrays: `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def predict(x: ti.template(), history: ti.template(), slots: ti.template(), weights: ti.template()):
        """Extrapolate the state from up to three earlier ones."""
        for i in range(x.shape[0]):
            x[i] = (weights[0] * history[slots[0], i] + weights[1] * history[slots[1], i]
                    + weights[2] * history[slots[2], i])

    @ti.func
    def update(x: ti.template(), pressures, free, kappa, connectivity: ti.template(), equation: ti.template(),
               target: ti.template(), right: ti.template(), moduli: ti.template(), volume: ti.template(),
               centre_volume: ti.template(), gap: ti.template(), centre_rows: ti.template(),
               centre_force: ti.template()):
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
                at = pressures + modes * e + m
                x[at] = x[at] + kappa * moduli[e] * (gap[e, m] + change)
        for dof in range(pressures):
            i = equation[dof]
            if i >= free:
                x[dof] = target[dof]
            elif i >= 0:
                x[dof] = x[dof] - right[i // B][i % B]

    @ti.kernel
    def step(counts: int1, settings: real1, connectivity: int2, equation: int1, direction: real1, start: real1,
             target: real1, gradients: vector3, node_gradients: real4, quadrature: real3, node_volumes: vector1,
             centre_volumes: real1, edges: int2, spans: int2, edge_shapes: real3, edge_places: real3, areas: real2,
             vertices: real2, edge_rounding: real1, friction: real2, springs: real2, held: real3, ways: real2,
             met: real3, forces: real3, contact_rates: real3, coefficients: real1, moduli: real1, past: real1,
             inherited: real3, largest: real2, stresses: real3, energies: real2, x: real1, history: real2, slots: int1,
             weights: real1, entries: real4, blocks: block3, upper: real4, upper_blocks: block3, inverse: real1,
             right: block1, residual: real1, force: vector1, rates: vector1, stiffness: vector2,
             centre_stiffness: real1, volume: vector3, centre_volume: real3, gap: real2, centre_rows: vector3,
             centre_inverse: real2, centre_force: real2, report: real1):
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
            if counts[KEEPS] == 0:
                predict(x, history, slots, weights)
                counts[CHANGEABLE] = ALL
            adhesion, adhesion_length = settings[ADHESION], settings[ADHESION_LENGTH]
            pending = 0
            if counts[CONTACTS] > 0 and ti.abs(depth - settings[PREDICTED]) > 1e-10 * ti.abs(depth):
                pending = 1
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
                    bulk = kappa * moduli[e]
                    J = work.integrate(e, tangent, bulk, moduli[e], counts[REMEMBERS], x, pressures, connectivity,
                                       gradients, node_gradients, quadrature, coefficients, past, inherited, largest,
                                       stresses, energies, force, rates, stiffness, centre_stiffness, volume,
                                       centre_volume, gap)
                    smallest = ti.min(smallest, J)
                    work.condense_pressure(e, tangent, bulk, force, stiffness, centre_stiffness, volume,
                                           centre_volume, gap)
                    if weight != 0.0:
                        work.add_weight(e, weight, node_volumes, centre_volumes, force)
                    if ti.static(has_centre):
                        interior += force[2][0] * force[2][0] + force[2][1] * force[2][1]
                        if tangent == 1:
                            definite = ti.min(definite, work.condense_centre(e, stiffness, centre_stiffness,
                                                                             centre_rows, centre_inverse))
                        work.condense_centre_force(e, force, centre_rows, centre_inverse, centre_force)
                    if pending == 1:
                        work.add_pending(e, x, free, connectivity, equation, target, force, stiffness)
                    work.scatter(e, tangent, free, width, connectivity, equation, force, stiffness, entries, residual)
                tool = settings[PREDICTED] if pending == 1 else depth
                # At first what just touches counts as pressed: the tool is about to move, or adhesion pulls.
                slack = 1e-9 if pending == 1 or (adhesion > 0.0 and iterations == 0) else 0.0
                axial, balanced, violation, slipping = add_contact(
                    counts[CONTACTS], counts[CHANGEABLE], slack, pending, bending, depth - tool,
                    tool - settings[TOUCH], free, settings[CONTACT_TOLERANCE], FRICTION_FLOOR * floor, adhesion,
                    adhesion_length, multipliers, edges, spans, edge_shapes, edge_places, areas, vertices,
                    edge_rounding, friction, springs, held, ways, met, forces, contact_rates, x, target, equation,
                    residual)
                counts[CHANGEABLE] = 0
                report[VIOLATION], report[SLIPPING] = violation, slipping
                if tangent == 1:
                    counts[UNSYMMETRIC] = ti.min(slipping, 1)
                    if ti.static(slips):
                        if slipping > 0:
                            mirror(blocks, upper_blocks, rows, width)
                    add_rates(counts[CONTACTS], slipping, free, width, edges, edge_shapes, contact_rates, equation,
                              entries, upper)
                unbalanced = interior
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
                    released = augment(counts[CONTACTS], multipliers, adhesion, edge_places, areas, spans, vertices,
                                       edge_rounding, held, forces, x)
                    if released > 0:
                        tangent = 1
                    elif violation <= settings[CONTACT_TOLERANCE]:
                        hold(counts[CONTACTS], held, met)
                        report[STATUS] = converged
                elif iterations >= max_iterations:
                    report[STATUS] = slow
                elif iterations > 3 and ratio > 1e3 * first_ratio:
                    report[STATUS] = diverged
                elif tangent == 0 and ratio > REUSE * last_ratio:
                    tangent = 1
                else:
                    if tangent == 1:
                        for i in range(free, rows * B):
                            entries[i // B, width - 1, i % B, i % B] = 1.0
                        if definite == 1:
                            if ti.static(slips):
                                if slipping > 0:
                                    definite = factorise_lu(blocks, upper_blocks, inverse, rows, width)
                            if slipping == 0:
                                definite = factorise(blocks, inverse, rows, width)
                    for I in range(rows):
                        for k in ti.static(range(B)):
                            right[I][k] = residual[I * B + k] if I * B + k < free else 0.0
                    if definite == 0 and bending > 0.0:
                        bending, last_ratio = 0.0, 0.0
                    elif definite == 0:
                        report[STATUS] = indefinite
                    else:
                        if ti.static(slips):
                            if counts[UNSYMMETRIC] == 1:
                                solve_lu(blocks, upper_blocks, inverse, right, rows, width)
                        if counts[UNSYMMETRIC] == 0:
                            solve(blocks, inverse, right, rows, width)
                        update(x, pressures, free, kappa, connectivity, equation, target, right, moduli, volume,
                               centre_volume, gap, centre_rows, centre_force)
                        # Where the old factor is likely to serve again, only the residual is computed first.
                        tangent = 1 if pending == 1 or ratio > 10.0 else 0
                        last_ratio = ratio
                        counts[CHANGEABLE] = ALL if iterations < CIRCLING else 1
                        bending = 1.0 if ratio < 0.1 else 0.0
                        pending = 0
                        iterations += 1
            if report[STATUS] == 0.0:
                report[STATUS] = slow
            total = axial
            for dof in range(pressures):
                i = equation[dof]
                if i >= free:
                    total += direction[dof] * residual[i]
            report[FORCE] = total
            report[ITERATIONS] = iterations

    return step
