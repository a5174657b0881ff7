"""Newton's method with line search and reused factorisations for a step of the axisymmetric solid (Taichi kernel).

Each iteration solves K du = -R for the displacements of the shared nodes; pressures, interior nodes and contact forces
follow by back substitution. The factorisation of K is reused while the residual decreases fast enough (modified Newton
method) and is updated where only contact points change. A step that inverts an element or leaves the domain of the law
is halved. After each linear solve the active set of the contact iterates on the linearised elements
(`EvaluatedEquations.CONTACT`).
"""

from functools import cache

from tissue_sim.fem.axisymmetric import contact_kernels
from tissue_sim.fem.axisymmetric.array_layouts import (
    ELEMENT_ARRAYS,
    NEWTON,
    STATE_ARRAYS,
    SURFACE_ARRAYS,
    TISSUE_ARRAYS,
    EvaluatedEquations,
    StartMode,
    StepIntegerIndex,
    StepReportIndex,
    StepSettingIndex,
)
from tissue_sim.fem.axisymmetric.assembly import make_condensation_functions, make_element_assembly_functions
from tissue_sim.fem.axisymmetric.contact_kernels import make_contact_stiffness_functions
from tissue_sim.fem.linear import band as band_matrix
from tissue_sim.fem.linear.band import BandTableIndex, make_cholesky_functions, make_lu_functions
from tissue_sim.fem.solver import StepStatus
from tissue_sim.fem.taichi.origins import get_address_origin
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS


@cache
def make_step_kernel(element_name: str, energy: KernelEnergy, slips: bool,
                     effects: tuple[FormulaClassAndConstants, ...] = (),
                     laws: tuple[FormulaClassAndConstants, ...] = ()):
    """Return the kernel of a step for an element type and a law; see `AxisymmetricSolver.step`.

    Args:
        element_name: key of `tissue_sim.mesh.elements.ELEMENTS`.
        energy: energy of the law.
        slips: whether points may slip against friction; only then the kernel contains an unsymmetric solver.
        effects: additional stresses at the quadrature points.
        laws: contact laws (adhesion).
    """
    ti = get_initialised_taichi()
    work, own = make_element_assembly_functions(element_name, energy,
                                                effects), make_condensation_functions(element_name)
    vec = ti.types.vector(LANES, ti.f64)
    block = ti.types.vector(band_matrix.BLOCK, ti.f64)
    B = band_matrix.BLOCK
    int1, real1 = ti.types.ndarray(dtype=ti.i32, ndim=1), ti.types.ndarray(dtype=ti.f64, ndim=1)
    modes = ELEMENTS[element_name].pressure_modes
    vectors = get_address_origin().field
    fill_unused_diagonal = band_matrix.make_fill_unused_diagonal_function()
    symmetrise_diagonal_blocks = band_matrix.make_symmetrise_diagonal_blocks_function()
    copy_lower_band_to_upper_band = band_matrix.make_copy_lower_to_upper_band_function()
    cholesky, lu = make_cholesky_functions(), make_lu_functions()
    contact, rates = contact_kernels.make_contact_force_functions(laws), make_contact_stiffness_functions(slips)
    # Contact laws act at a distance, so that the contact cannot iterate on the linearised elements.
    has_contact_rounds = not laws
    converged, inverted, indefinite, slow, diverged = (float(status) for status in (
        StepStatus.CONVERGED, StepStatus.INVERTED, StepStatus.INDEFINITE, StepStatus.SLOW, StepStatus.DIVERGED))

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def extrapolate_state(state: ti.template()):
        """Set x to the weighted sum of the last three states (`history`), the initial state of the step."""
        for i in range(state.x.shape[0]):
            state.x[i] = (state.weights[0] * state.history[state.slots[0], i]
                          + state.weights[1] * state.history[state.slots[1], i]
                          + state.weights[2] * state.history[state.slots[2], i])

    @ti.kernel
    def solve_step_into_report_array(counts: int1, settings: real1, report: real1, element_table: int1,
                                     tissue_table: int1, surface_table: int1, state_table: int1, band_table: int1):
        # One serial task, which starts without a thread pool; the number of passes is an argument, so that the compiler
        # does not unroll the loop into many tasks.
        ti.loop_config(serialize=True)
        for _ in range(counts[StepIntegerIndex.PASSES]):
            elements, tissue = ELEMENT_ARRAYS.open_table(element_table), TISSUE_ARRAYS.open_table(tissue_table)
            surface, state = SURFACE_ARRAYS.open_table(surface_table), STATE_ARRAYS.open_table(state_table)
            free, max_iterations = counts[StepIntegerIndex.FREE], counts[StepIntegerIndex.MAX_ITERATIONS]
            contacts = counts[StepIntegerIndex.CONTACTS]
            depth, kappa = settings[StepSettingIndex.DEPTH], settings[StepSettingIndex.KAPPA]
            tolerance, inertia = settings[StepSettingIndex.TOLERANCE], settings[StepSettingIndex.INERTIA]
            floor, rounding = settings[StepSettingIndex.FLOOR], settings[StepSettingIndex.ROUNDING]
            weight = settings[StepSettingIndex.WEIGHT]
            width, rows = band_table[BandTableIndex.WIDTH], band_table[BandTableIndex.ROWS]
            right, matrix = band_table[BandTableIndex.RIGHT], band_table[BandTableIndex.MATRIX]
            batches = counts[StepIntegerIndex.BATCHES]
            equations = state.residual.shape[0] - 1
            pressures = state.equation.shape[0]
            if counts[StepIntegerIndex.START_MODE] == StartMode.PREDICT:
                extrapolate_state(state)
            # A resumed iteration has already evaluated the contact.
            if counts[StepIntegerIndex.START_MODE] != StartMode.RESUME:
                counts[StepIntegerIndex.CHANGEABLE] = (
                    contact_kernels.ALL_POINTS if counts[StepIntegerIndex.START_MODE] == StartMode.PREDICT else 0)
            strength, reach = settings[StepSettingIndex.STRENGTH], settings[StepSettingIndex.REACH]
            pending = 0
            if contacts > 0 and ti.abs(depth - settings[StepSettingIndex.PREDICTED]) > 1e-10 * ti.abs(depth):
                pending = 1
            for dof in range(pressures):
                state.target[dof] = state.start[dof] + depth * state.direction[dof]
                state.motion[dof] = 0.0
                if state.equation[dof] >= free:
                    if ti.abs(state.x[dof] - state.target[dof]) > 1e-10 * ti.abs(depth):
                        pending = 1
                        state.motion[dof] = state.target[dof] - state.x[dof]
                    else:
                        state.x[dof] = state.target[dof]  # removes the rounding error of the extrapolation
            report[StepReportIndex.STATUS], report[StepReportIndex.STIFFNESS] = 0.0, 0.0
            iterations, halvings = 0, NEWTON.max_halvings
            tangent = 0 if counts[StepIntegerIndex.START_MODE] == StartMode.RESIDUAL_ONLY else 1
            # Mode of the pass, and first block row that must be factorised again.
            part, settled, cycles, waits, begin = EvaluatedEquations.FULL, 0, 0, 0, 0
            # Far from equilibrium the curvature of the contact surfaces would make the tangent indefinite.
            bending = 1.0 if max_iterations == 0 else 0.0
            if counts[StepIntegerIndex.START_MODE] == StartMode.RESUME:
                bending = float(counts[StepIntegerIndex.BENDING])
            first, first_ratio, last_ratio, axial = 1, 0.0, 0.0, 0.0
            gain, more = NEWTON.reuse_ratio, NEWTON.reuse_solves
            if counts[StepIntegerIndex.STIFFNESS_ASKED] == 1:
                gain, more = NEWTON.reuse_ratio_realtime, NEWTON.reuse_solves_realtime
            # The status is stored in the report: Taichi 1.7.4 loses a local variable that a branch of such a loop sets.
            # Each linear solve may need more passes: halvings, a skipped tangent, changed points, contact rounds.
            for _attempt in range((NEWTON.max_halvings + NEWTON.max_contact_rounds + 4) * max_iterations + 4):
                if report[StepReportIndex.STATUS] != 0.0:
                    break
                for i in range(state.residual.shape[0]):
                    state.residual[i] = 0.0
                fresh = tangent if part == EvaluatedEquations.FULL else 0
                if fresh == 1:
                    for i in range(rows * width * B):
                        vectors[matrix + i] = block(0.0)
                    for i in range(state.pull.shape[0]):
                        state.pull[i] = 0.0
                interior, smallest, definite = 0.0, 1e30, 1
                for b in range(batches if part == EvaluatedEquations.FULL else 0):
                    J = work.compute_nodal_forces_and_least_jacobian(
                        b, tangent, kappa, counts[StepIntegerIndex.REMEMBERS], state.x, pressures, elements, tissue)
                    smallest = ti.min(smallest, J)
                    if weight != 0.0:
                        work.add_weight_forces(b, weight, elements)
                    if inertia != 0.0:
                        work.add_interior_node_inertial_force(b, inertia, settings[StepSettingIndex.DENSITY], elements,
                                                              state.rest)
                    if tangent == 1:
                        own.copy_volume_derivatives_to_factorised(b, elements)
                        definite = ti.min(definite, work.compute_condensed_stiffness_and_success(
                            b, kappa, pending, inertia * settings[StepSettingIndex.DENSITY], state.motion, elements))
                        work.scatter_stiffness_and_force_per_depth(b, elements, state.scattered, state.pull)
                    interior += own.condense_interior_force_and_get_square(b, b, elements, elements.force_r,
                                                                           elements.force_z)
                    own.add_forces_to_residual(b, elements, state.residual)
                if smallest <= 0.0 and halvings < NEWTON.max_halvings:
                    halvings += 1
                    for i in range(state.x.shape[0]):
                        state.x[i] = 0.5 * (state.x[i] + state.before[i])
                    continue
                if part == EvaluatedEquations.CONTACT:
                    contact.subtract_contact_forces(contacts, surface, state)
                elif inertia != 0.0 and part == EvaluatedEquations.FULL:
                    for dof in range(pressures):
                        i = state.equation[dof]
                        if i >= 0:
                            push = inertia * state.masses[dof] * (state.x[dof] - state.rest[dof])
                            state.residual[i] = state.residual[i] + push
                            if tangent == 1 and i < free:
                                at = matrix + ((i // B + 1) * width - 1) * B + i % B
                                vectors[at][i % B] = vectors[at][i % B] + inertia * state.masses[dof]
                tool = settings[StepSettingIndex.PREDICTED] if pending == 1 else depth
                # Initially points that just touch are active: the tool is about to move, or a law attracts.
                slack = 1e-9 if pending == 1 or (strength > 0.0 and iterations == 0) else 0.0
                (axial, balanced, violation, slipping, switched,
                 wanting) = contact.add_contact_forces_and_update_active_set(
                    contacts, counts[StepIntegerIndex.CHANGEABLE], slack, pending, bending, tool, free, settings,
                    surface, state)
                counts[StepIntegerIndex.CHANGEABLE], counts[StepIntegerIndex.BENDING] = 0, int(bending)
                if part == EvaluatedEquations.CONTACT and (switched == 0 or settled == NEWTON.max_contact_rounds):
                    # The elements are evaluated next. If the active set still changes, their tangent is evaluated as
                    # well, and no more contact rounds follow.
                    part, waits = EvaluatedEquations.FULL, wanting
                    if switched > 0:
                        tangent, cycles = 1, 1
                    continue
                if part == EvaluatedEquations.FULL:
                    wanting, waits = ti.max(wanting, waits), 0
                report[StepReportIndex.VIOLATION], report[StepReportIndex.SLIPPING] = violation, slipping
                if fresh == 1:
                    rates.clear_factorised_contact_stiffness(contacts, surface)
                    counts[StepIntegerIndex.UNSYMMETRIC], counts[StepIntegerIndex.SKEWED], begin = 0, rows, 0
                if fresh == 1 or part != EvaluatedEquations.FULL:
                    changed, skewed = rates.find_first_changed_and_slipping_rows(contacts, fresh, free, rows, surface,
                                                                                 state)
                    begin = ti.min(begin, changed)
                    if ti.static(slips):
                        if slipping > 0:
                            if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
                                # A Cholesky factorisation cannot be updated to an unsymmetric one.
                                counts[StepIntegerIndex.UNSYMMETRIC], begin = 1, 0
                                symmetrise_diagonal_blocks(band_table)
                            if skewed < counts[StepIntegerIndex.SKEWED]:
                                copy_lower_band_to_upper_band(band_table, skewed, counts[StepIntegerIndex.SKEWED])
                                counts[StepIntegerIndex.SKEWED] = skewed
                    rates.add_contact_stiffness_to_matrix(contacts, fresh, counts[StepIntegerIndex.UNSYMMETRIC], free,
                                                          band_table, surface, state)
                    if begin < rows:
                        counts[StepIntegerIndex.FACTORISED] = 0
                unbalanced, total = interior, axial
                for i in range(free):
                    unbalanced += state.residual[i] * state.residual[i]
                for i in range(free, equations):
                    balanced += state.residual[i] * state.residual[i]
                for dof in range(pressures):
                    if state.equation[dof] >= free:
                        total += state.direction[dof] * state.residual[state.equation[dof]]
                scale = ti.max(ti.sqrt(balanced), floor)
                ratio = ti.sqrt(unbalanced) / scale
                # The tolerance includes a bounded allowance for rounding errors.
                goal = tolerance + ti.min(rounding / scale, 1e-5)
                if part == EvaluatedEquations.FULL:
                    report[StepReportIndex.RESIDUAL], report[StepReportIndex.FORCE] = ratio, total
                    if iterations == first:
                        first_ratio = ratio
                solves = 0
                if part == EvaluatedEquations.CONTACT:
                    settled, solves = settled + 1, 1
                elif part == EvaluatedEquations.STIFFNESS:
                    report[StepReportIndex.STATUS] = converged
                elif smallest <= 0.0 or smallest >= 1e30 or ti.math.isnan(smallest):
                    report[StepReportIndex.STATUS] = inverted
                elif ti.math.isnan(ratio) or ti.math.isinf(ratio):
                    report[StepReportIndex.STATUS] = diverged
                elif pending == 0 and ratio <= goal:
                    released = 0
                    if violation <= settings[StepSettingIndex.CONTACT_TOLERANCE]:
                        released = contact.release_points_under_tension(
                            contacts, NEWTON.friction_floor * floor, strength, reach, surface)
                    if released > 0:
                        # The problem has changed: the iteration starts again.
                        tangent, first = 1, iterations + 1
                        counts[StepIntegerIndex.CHANGEABLE] = contact_kernels.ALL_POINTS
                    elif wanting > 0 and iterations < max_iterations:
                        counts[StepIntegerIndex.CHANGEABLE], tangent = contact_kernels.ALL_POINTS, 1
                    elif violation <= settings[StepSettingIndex.CONTACT_TOLERANCE] and wanting == 0:
                        bound = contact.commit_contact_bonds_and_count_changes(contacts, surface)
                        if counts[StepIntegerIndex.STIFFNESS_ASKED] == 1 \
                            and (bound > 0 or rates.has_contact_stiffness_changed(contacts, surface) == 1):
                            # The stiffness is computed with the new bonds.
                            part = EvaluatedEquations.STIFFNESS
                        else:
                            report[StepReportIndex.STATUS] = converged
                    elif iterations >= max_iterations:
                        report[StepReportIndex.STATUS] = slow
                        if wanting > 0:
                            counts[StepIntegerIndex.CHANGEABLE] = contact_kernels.ALL_POINTS
                    elif tangent == 0:
                        tangent = 1
                    else:
                        solves = 1
                elif iterations >= max_iterations:
                    report[StepReportIndex.STATUS] = slow
                elif iterations > first + 2 and ratio > 1e3 * ti.max(first_ratio, 1.0):
                    report[StepReportIndex.STATUS] = diverged
                elif tangent == 0 and (switched > 0 or (
                        ratio > gain * last_ratio and ratio * (ratio / last_ratio)**more > goal)):
                    tangent = 1
                else:
                    solves = 1
                asked = 0
                if counts[StepIntegerIndex.STIFFNESS_ASKED] == 1 and (
                        report[StepReportIndex.STATUS] == converged
                        or counts[StepIntegerIndex.START_MODE] == StartMode.STIFFNESS_ONLY):
                    asked = 1
                if solves + asked > 0:
                    stiff = 0.0
                    if asked == 1:
                        # Derivatives of nodal forces and tool force with respect to the depth, at fixed tissue.
                        for i in range(free):
                            state.residual[i], state.reaction[i] = state.pull[i], state.pull[i]
                        stiff = state.pull[free]
                        stiff += rates.add_depth_derivatives_and_get_stiffness(contacts, free, surface, state)
                        if inertia != 0.0:
                            for dof in range(pressures):
                                if state.equation[dof] >= free:
                                    stiff += inertia * state.masses[dof] * state.direction[dof] * state.direction[dof]
                    if solves == 1:
                        for b in range(batches if part == EvaluatedEquations.FULL and fresh == 0 else 0):
                            own.correct_residual_for_reused_factorisation(b, kappa, elements, state.residual)
                        contact.add_constraint_residual_forces(contacts, surface, state)
                    for I in range(rows):
                        for k in ti.static(range(B)):
                            vectors[right + I][k] = state.residual[I * B + k] if I * B + k < free else 0.0
                    if begin < rows and definite == 1:
                        fill_unused_diagonal(band_table, free)
                        if ti.static(slips):
                            if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                                definite = lu.try_factorising_band(band_table, begin, counts[StepIntegerIndex.SKEWED])
                        if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
                            definite = cholesky.try_factorising_band(band_table, begin, rows)
                        counts[StepIntegerIndex.FACTORISED] = definite
                        begin = rows if definite == 1 else 0
                    if definite == 1:
                        if ti.static(slips):
                            if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                                lu.solve_band(band_table)
                        if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
                            cholesky.solve_band(band_table)
                    if asked == 1 and definite == 1:
                        for i in range(free):
                            stiff -= state.reaction[i] * vectors[right + i // B][i % B]
                        report[StepReportIndex.STIFFNESS] = stiff
                    elif part == EvaluatedEquations.CONTACT and definite == 0:
                        part, tangent = EvaluatedEquations.FULL, 1
                    elif solves == 1 and definite == 0 and bending > 0.0:
                        bending, last_ratio = 0.0, 0.0
                    elif solves == 1 and definite == 0:
                        report[StepReportIndex.STATUS] = indefinite
                    elif solves == 1:
                        if part == EvaluatedEquations.FULL:
                            for i in range(state.x.shape[0]):
                                state.before[i] = state.x[i]
                            # A step that contains the motion of the tool is not halved.
                            halvings = NEWTON.max_halvings if pending == 1 else 0
                        else:
                            # The condensed unknowns have no residual on the linearised elements.
                            for b in range(batches):
                                elements.force_r[b], elements.force_z[b] = vec(0.0), vec(0.0)
                            for i in range(batches * modes):
                                elements.gap[i] = vec(0.0)
                        for dof in range(pressures):
                            i = state.equation[dof]
                            if i >= free:
                                state.motion[dof] = state.target[dof] - state.x[dof]
                                state.x[dof] = state.target[dof]
                            elif i >= 0:
                                state.motion[dof] = -vectors[right + i // B][i % B]
                                state.x[dof] = state.x[dof] + state.motion[dof]
                        for b in range(batches):
                            own.update_condensed_unknowns(b, kappa, state.x, pressures, state.motion, elements)
                        contact.update_contact_forces_after_linear_solve(contacts, depth - tool, surface, state)
                        if part == EvaluatedEquations.FULL:
                            # If the factorisation is likely to be reused, the next pass computes the residual only.
                            tangent = 1 if pending == 1 or ratio > NEWTON.new_tangent_residual else 0
                            last_ratio = ratio
                            bending = 1.0 if ratio < 0.1 else 0.0
                            pending, settled = 0, 0
                            iterations += 1
                            if ti.static(has_contact_rounds):
                                if contacts > 0 and cycles == 0:
                                    part = EvaluatedEquations.CONTACT
                        made = iterations + counts[StepIntegerIndex.ITERATED]
                        counts[StepIntegerIndex.CHANGEABLE] = contact_kernels.ALL_POINTS
                        if made > NEWTON.all_points_iterations:
                            counts[StepIntegerIndex.CHANGEABLE] = made + settled
            if report[StepReportIndex.STATUS] == 0.0:
                report[StepReportIndex.STATUS] = slow
            report[StepReportIndex.ITERATIONS] = iterations

    return solve_step_into_report_array
