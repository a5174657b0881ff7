"""Derivatives of the equilibrium with respect to material parameters, by direct differentiation, as Taichi kernels.

The discrete equilibrium R(y, theta, h) = 0 of a step, with unknowns y, parameters theta and history h, is
differentiated:

    R_y dy/dtheta = -(R_theta + R_h dh/dtheta),

with the exact tangent R_y at the converged state. `sensitivity_points` computes R_theta + R_h dh/dtheta at fixed
displacements; dh/dtheta is updated in each step. Reference: Michaleris, Tortorelli and Vidal, Int. J. Numer. Methods
Eng. 37 (1994) 2471.

The exact tangent is only multiplied by displacements, element by element. With this product, the factorisation of the
last step, which belongs to a nearby tangent, solves the equations of the exact tangent iteratively (modified Newton
method, iterative refinement). The equations are those of displacements and pressures, so that the convergence does not
depend on K/mu.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.array_layouts import (
    ELEMENT_ARRAYS,
    RATE_ARRAYS,
    STATE_ARRAYS,
    SURFACE_ARRAYS,
    TISSUE_ARRAYS,
    SensitivityControlIndex,
    StepIntegerIndex,
    StepSettingIndex,
)
from tissue_sim.fem.axisymmetric.assembly import make_condensation_functions
from tissue_sim.fem.axisymmetric.contact import (
    PENALTY,
    ContactLinearisationColumn,
    OutlineSpanColumn,
)
from tissue_sim.fem.axisymmetric.contact_kernels import HELD, TOUCHED
from tissue_sim.fem.axisymmetric.energy import AT, get_axisymmetric_scratch_field, make_kinematic_functions
from tissue_sim.fem.axisymmetric.sensitivity_points import make_sensitivity_functions
from tissue_sim.fem.linear import band as band_matrix
from tissue_sim.fem.linear.band import BandTableIndex, make_cholesky_functions, make_lu_functions
from tissue_sim.fem.taichi.origins import get_address_origin
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS


class TangentProductFunctions(NamedTuple):
    """Taichi functions of the tangent product for one element type."""

    add_tangent_product_to_residual: object
    update_condensed_derivatives: object


@cache
def make_tangent_product_functions(element_name: str) -> TangentProductFunctions:
    """Return the Taichi functions of the tangent product for an element type."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, modes = element.node_count, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > element.boundary_nodes, nodes - 1
    own = make_condensation_functions(element_name)
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    UR, UZ, FR, FZ, SR, SZ, RATE = (AT[name] for name in ("UR", "UZ", "FR", "FZ", "SR", "SZ", "STRESS"))
    row = point.PLACE

    @ti.func
    def add_tangent_product_to_residual(b, k, kappa, batches, elements: ti.template(), rates: ti.template(),
                                        residual: ti.template()):
        """Add the forces of the displacement derivatives (row k of `dx`) and pressure derivatives to the residual.

        `way_r` and `way_z` get the displacement derivatives of the interior nodes, including those at fixed shared
        nodes (`centre_r`, `centre_z`). `swelling` gets the residual of the volume constraint, which is eliminated with
        the volume derivatives of the factorised matrix. `rates.law` contains the tangents of the quadrature points
        times their weight. Returns the sum of the force differences caused by the difference between
        these volume derivatives and the present ones.
        """
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a], s[UZ + a] = kinematics.gather_node_vector_of_row(rates.dx, k, elements, i)
        for q in range(points):
            h0, h1, h2, h3, h4 = kinematics.compute_gradient_of_stored_displacements(b, q, elements)
            H, at = [h0, h1, h2, h3, h4], RATE + 5 * q
            A = [1.0 * h0 for _n in ti.static(range(15))]
            for n in ti.static(range(15)):
                of = (b * points + q) * 15 + n
                A[n] = rates.law[of]
            for i in ti.static(range(5)):
                s[at + i] = (A[ti.static(row[i][0])] * H[0] + A[ti.static(row[i][1])] * H[1]
                             + A[ti.static(row[i][2])] * H[2] + A[ti.static(row[i][3])] * H[3]
                             + A[ti.static(row[i][4])] * H[4])
        for a in range(nodes):
            s[FR + a], s[FZ + a] = kinematics.compute_node_force_from_stresses(a, b, RATE, elements)
        aside = vec(0.0)
        for m in range(modes):
            mode = b * modes + m
            p, bulk = rates.pressure_rates[mode], kappa * elements.moduli[b]
            missed = -p / bulk
            for a in range(nodes):
                v = mode * nodes + a
                missed = missed + elements.volume_r[v] * s[UR + a] + elements.volume_z[v] * s[UZ + a]
            rates.swelling[mode] = missed
            missed = bulk * missed
            for a in range(nodes):
                v = mode * nodes + a
                s[FR + a] = s[FR + a] + p * elements.volume_r[v] + missed * elements.known_volume_r[v]
                s[FZ + a] = s[FZ + a] + p * elements.volume_z[v] + missed * elements.known_volume_z[v]
                aside = aside + ti.abs(missed * (elements.known_volume_r[v] - elements.volume_r[v])) + ti.abs(
                    missed * (elements.known_volume_z[v] - elements.volume_z[v]))
        own.condense_interior_force_and_get_square(b, b, elements, rates.way_r, rates.way_z)
        if ti.static(has_centre):
            at = k * batches + b
            rates.way_r[b], rates.way_z[b] = rates.way_r[b] + rates.centre_r[at], rates.way_z[b] + rates.centre_z[at]
        own.add_forces_to_residual(b, elements, residual)
        return (elements.real[b] * aside).sum()

    @ti.func
    def update_condensed_derivatives(b, k, kappa, motion: ti.template(), elements: ti.template(),
                                     rates: ti.template()):
        """Update the derivatives of interior nodes (row k of `dx`) and pressures after the `motion` of shared nodes."""
        own.store_increments_of_all_nodes(b, motion, elements, rates.way_r, rates.way_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    rates.dx[k, elements.dofs[i][l]] = rates.dx[k, elements.dofs[i][l]] + cr[l]
                    rates.dx[k, elements.dofs[i][l] + 1] = rates.dx[k, elements.dofs[i][l] + 1] + cz[l]
        for m in range(modes):
            mode = b * modes + m
            rates.pressure_rates[mode] = rates.pressure_rates[mode] + kappa * elements.moduli[b] * (
                rates.swelling[mode] + own.compute_volume_increment_of_mode(mode, elements))

    return TangentProductFunctions(add_tangent_product_to_residual, update_condensed_derivatives)


@dataclass(frozen=True)
class DerivativeIterationSettings:
    """Settings of the iteration for the derivatives of displacements and contact forces.

    The kernel contains the values as constants.

    Attributes:
        max_rounds: maximum number of rounds; each round reduces the error of the contact forces by about three digits.
        contact_tolerance: relative error of the derivatives of the contact forces at which the iteration stops.
        residual_tolerance: relative residual that the iteration with the factorisation of the step must reach;
            `contact_tolerance` where rounding prevents this.
        friction_tolerance: the same for coefficients of friction. Only surface forces depend on them, whose rounding
            errors are larger relative to their sum.
        stall_ratio: the iteration with the factorisation of the step has stalled if two rounds reduce the residual to
            no less than this fraction.
    """

    max_rounds: int = 9
    contact_tolerance: float = 1e-10
    friction_tolerance: float = 1e-9
    residual_tolerance: float = 1e-11
    stall_ratio: float = 1e-2


#: Settings of the compiled kernels.
DIFFERENTIATION = DerivativeIterationSettings()


@cache
def make_force_and_state_sensitivity_kernels(element_name: str, energy: KernelEnergy, remembers: bool, slips: bool):
    """Return the two kernels that differentiate a step; see `MaterialSensitivity` in `sensitivity`.

    Args:
        element_name: key of `tissue_sim.mesh.elements.ELEMENTS`.
        energy: energy of the law.
        remembers: whether the tissue has a memory; only then the kernels differentiate the memory.
        slips: whether points may slip against friction; only then the kernels contain an unsymmetric solver.

    Returns:
        Kernel of the force derivatives at fixed displacements, and kernel of all other derivatives.
    """
    ti = get_initialised_taichi()
    work, tangent = make_sensitivity_functions(element_name, energy,
                                               remembers), make_tangent_product_functions(element_name)
    vec = ti.types.vector(LANES, ti.f64)
    B = band_matrix.BLOCK
    int1, real1 = ti.types.ndarray(dtype=ti.i32, ndim=1), ti.types.ndarray(dtype=ti.f64, ndim=1)
    modes = ELEMENTS[element_name].pressure_modes
    vectors = get_address_origin().field
    fill_unused_diagonal = band_matrix.make_fill_unused_diagonal_function()
    cholesky, lu = make_cholesky_functions(), make_lu_functions()

    @ti.func
    def compute_contact_force_derivative(i, k, dr, dz, surface: ti.template(), rates: ti.template()):
        """Return the derivative of the force of point i with respect to parameter k for given (dr, dz)/dtheta_k.

        The residual of the constraint is multiplied by the derivatives that the matrix contains. `constraint_rates` and
        `fixed_force_rates` are the derivatives of this residual and of the force at constant displacements and
        multipliers.
        """
        cr, cz = rates.constraint_rates[k, i, 0], rates.constraint_rates[k, i, 1]
        fr = (surface.rates[i, ContactLinearisationColumn.RR] * (dr + cr)
              + surface.rates[i, ContactLinearisationColumn.RZ] * (dz + cz) + rates.fixed_force_rates[k, i, 0])
        fz = (surface.rates[i, ContactLinearisationColumn.ZR] * (dr + cr)
              + surface.rates[i, ContactLinearisationColumn.ZZ] * (dz + cz) + rates.fixed_force_rates[k, i, 1])
        lr, lz = rates.multiplier_rates[k, i, 0], rates.multiplier_rates[k, i, 1]
        hr, hz = rates.anchor_rates[k, i, 0], rates.anchor_rates[k, i, 1]
        stiff, missed_r, missed_z = PENALTY.stick_factor * surface.springs[i], 0.0, 0.0
        if surface.held[i, 0] == HELD:
            missed_r, missed_z = dr - hr, dz - hz
            fr += lr - stiff * hr
            fz += lz - stiff * hz
        elif surface.rates[i, ContactLinearisationColumn.RR] != 0.0 or surface.rates[i, ContactLinearisationColumn.ZZ] \
            != 0.0:
            nr = surface.rates[i, ContactLinearisationColumn.NORMAL_R]
            nz = surface.rates[i, ContactLinearisationColumn.NORMAL_Z]
            mu = surface.rates[i, ContactLinearisationColumn.FRICTION]
            tr, tz = -nz, nr
            pressed, along = lr * nr + lz * nz, 0.0
            apart, slip = (dr + cr) * nr + (dz + cz) * nz, 0.0
            if mu > 0.0 and surface.held[i, 0] == TOUCHED:
                sticks = lr * tr + lz * tz - stiff * (hr * tr + hz * tz)
                slides = -surface.slip_signs[i] * mu * pressed
                along = sticks if surface.slip_signs[i] == 0.0 else slides
                slip = (dr - hr) * tr + (dz - hz) * tz if surface.slip_signs[i] == 0.0 else 0.0
            missed_r, missed_z = apart * nr + slip * tr, apart * nz + slip * tz
            fr += pressed * nr + along * tr
            fz += pressed * nz + along * tz
        # Columns RR, RZ, ZR and ZZ of both tables.
        change = [surface.known_rates[i, k] - surface.rates[i, k] for k in ti.static(range(4))]
        fr += change[0] * missed_r + change[1] * missed_z
        fz += change[2] * missed_r + change[3] * missed_z
        return fr, fz

    @ti.func
    def factorise_assembled_tangent(counts: ti.template(), band_table: ti.template()):
        """Factorise the assembled exact tangent; return 1, or 0 if the tangent is singular or not positive definite."""
        fill_unused_diagonal(band_table, counts[StepIntegerIndex.FREE])
        good = 1
        if ti.static(slips):
            if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                good = lu.try_factorising_band(band_table, 0, counts[StepIntegerIndex.SKEWED])
        if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
            good = cholesky.try_factorising_band(band_table, 0, band_table[BandTableIndex.ROWS])
        return good

    @ti.func
    def solve_derivatives_by_one_parameter(k, kappa, which: ti.template(), counts: ti.template(),
                                           band_table: ti.template(), elements: ti.template(), surface: ti.template(),
                                           state: ti.template(), rates: ti.template()):
        """Solve for the derivatives of displacements and contact forces with respect to parameter k.

        Each round solves with the factorisation and updates the derivatives of the contact forces. With the
        factorisation of a nearby tangent (`SensitivityControlIndex.REFINES`) the rounds are iterative refinement of the
        exact equations, and `SensitivityControlIndex.SETTLED` is 1 if they converged. `motion` contains the last
        displacement increment, followed by the residual before that increment.
        """
        batches = counts[StepIntegerIndex.BATCHES]
        free, rows, right = (counts[StepIntegerIndex.FREE], band_table[BandTableIndex.ROWS],
                             band_table[BandTableIndex.RIGHT])
        last, before_last = 0.0, 0.0
        refines = which[SensitivityControlIndex.REFINES]
        goes_on = float(refines)
        which[SensitivityControlIndex.SETTLED] = 0
        for i in range(rates.dx.shape[1]):
            rates.dx[k, i] = 0.0
        for c in range(counts[StepIntegerIndex.CONTACTS]):
            rates.point_rates[k, c, 0], rates.point_rates[k, c, 1] = 0.0, 0.0
        for b in range(batches):
            at = k * batches + b
            rates.way_r[b], rates.way_z[b] = rates.centre_r[at], rates.centre_z[at]
        for i in range(batches * modes):
            rates.swelling[i], rates.pressure_rates[i] = vec(0.0), vec(0.0)
        for round in range(DIFFERENTIATION.max_rounds):
            missing, pushing, changed, largest_rate = 0.0, 0.0, 0.0, 0.0
            for i in range(state.residual.shape[0]):
                state.residual[i] = rates.forces[k, i]
                pushing += ti.abs(rates.forces[k, i])
            friction_force_sum = 0.0
            for c in range(counts[StepIntegerIndex.CONTACTS]):
                friction_force_sum += (ti.abs(rates.fixed_force_rates[k, c, 0])
                                       + ti.abs(rates.fixed_force_rates[k, c, 1]))
            pushing += friction_force_sum
            if ti.static(not remembers):
                if refines == 1 and round > 0:
                    for b in range(batches):
                        missed = tangent.add_tangent_product_to_residual(
                            b, k, kappa, batches, elements, rates, state.residual)
                        missing += missed
            for i in range(free, state.residual.shape[0]):
                rates.motion[state.equation.shape[0] + i] = state.residual[i]
            for c in range(counts[StepIntegerIndex.CONTACTS]):
                fr, fz = compute_contact_force_derivative(c, k, goes_on * rates.point_rates[k, c, 0],
                                                          goes_on * rates.point_rates[k, c, 1], surface, rates)
                if friction_force_sum > 0.0:
                    # Forces that balance friction are larger than the friction, and so are their rounding errors.
                    pushing += ti.abs(fr) + ti.abs(fz)
                for a in range(surface.shapes.shape[1]):
                    ir, iz = state.equation[2 * surface.nodes[c, a]], state.equation[2 * surface.nodes[c, a] + 1]
                    state.residual[ir] = state.residual[ir] + surface.shapes[c, a] * fr
                    state.residual[iz] = state.residual[iz] + surface.shapes[c, a] * fz
            for i in range(free):
                missing += ti.abs(state.residual[i])
            slow = refines == 1 and round > 1 and not missing <= DIFFERENTIATION.stall_ratio * before_last
            stall_tolerance = (DIFFERENTIATION.friction_tolerance if friction_force_sum > 0.0 else
                               DIFFERENTIATION.contact_tolerance)
            if refines == 1 and (missing <= DIFFERENTIATION.residual_tolerance * pushing
                                 or (slow and missing <= stall_tolerance * pushing)):
                for dof in range(state.equation.shape[0]):
                    rates.motion[dof] = 0.0
                which[SensitivityControlIndex.SETTLED] = 1
                break
            if slow:
                break
            if refines == 1:
                before_last = last
                last = missing
            for I in range(rows):
                for i in ti.static(range(B)):
                    vectors[right + I][i] = state.residual[I * B + i] if I * B + i < free else 0.0
            if ti.static(slips):
                if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                    lu.solve_band(band_table)
            if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
                cholesky.solve_band(band_table)
            for dof in range(state.equation.shape[0]):
                i = state.equation[dof]
                rates.motion[dof] = 0.0
                if i >= 0 and i < free:
                    rates.motion[dof] = -vectors[right + i // B][i % B]
                    rates.dx[k, dof] = goes_on * rates.dx[k, dof] + rates.motion[dof]
            if ti.static(not remembers):
                if refines == 1:
                    for b in range(batches):
                        tangent.update_condensed_derivatives(b, k, kappa, rates.motion, elements, rates)
            for c in range(counts[StepIntegerIndex.CONTACTS]):
                dr, dz = 0.0, 0.0
                for a in range(surface.shapes.shape[1]):
                    dr += surface.shapes[c, a] * rates.dx[k, 2 * surface.nodes[c, a]]
                    dz += surface.shapes[c, a] * rates.dx[k, 2 * surface.nodes[c, a] + 1]
                fr, fz = compute_contact_force_derivative(c, k, dr, dz, surface, rates)
                changed += ti.abs(fr - rates.multiplier_rates[k, c, 0]) + ti.abs(fz - rates.multiplier_rates[k, c, 1])
                largest_rate += ti.abs(fr) + ti.abs(fz)
                rates.multiplier_rates[k, c, 0], rates.multiplier_rates[k, c, 1] = fr, fz
                rates.point_rates[k, c, 0], rates.point_rates[k, c, 1] = dr, dz
            if refines == 0:
                # Estimate of the change in the next round, from the convergence rate of the last rounds.
                if changed * ti.min(changed / ti.max(last, 1e-300),
                                    1.0) <= DIFFERENTIATION.contact_tolerance * largest_rate:
                    break
                last = changed

    @ti.kernel
    def factorise_and_differentiate_forces(which: int1, counts: int1, settings: real1, element_table: int1,
                                           tissue_table: int1,
                                           state_table: int1, rate_table: int1, band_table: int1):
        ti.loop_config(serialize=True)
        for _ in range(which[SensitivityControlIndex.PASSES]):
            elements, tissue = ELEMENT_ARRAYS.open_table(element_table), TISSUE_ARRAYS.open_table(tissue_table)
            state, rates = STATE_ARRAYS.open_table(state_table), RATE_ARRAYS.open_table(rate_table)
            batches, pressures = counts[StepIntegerIndex.BATCHES], state.equation.shape[0]
            parameters = rates.forces.shape[0]
            kappa = settings[StepSettingIndex.KAPPA]
            if which[SensitivityControlIndex.REFINES] == 1:
                which[SensitivityControlIndex.FACTORISES] = 0
            else:
                which[SensitivityControlIndex.FACTORISES] = 1 - factorise_assembled_tangent(counts, band_table)
            for k in range(parameters):
                for i in range(state.residual.shape[0]):
                    rates.forces[k, i] = 0.0
            for b in range(batches):
                work.store_point_stresses_and_tangents(b, which, pressures, elements, tissue, state, rates)
                if ti.static(remembers):
                    if which[SensitivityControlIndex.RELAXES] == 1:
                        work.copy_stress_history_to_buffers(b, which, elements, tissue, rates)
                for k in range(parameters):
                    work.add_force_derivatives_at_fixed_displacement(b, k, kappa, parameters, batches, pressures,
                                                                     which, elements, tissue, state, rates)

    @ti.kernel
    def solve_state_derivatives(which: int1, counts: int1, settings: real1, element_table: int1, tissue_table: int1,
                                surface_table: int1, state_table: int1, rate_table: int1, band_table: int1):
        ti.loop_config(serialize=True)
        for _ in range(which[SensitivityControlIndex.PASSES]):
            elements, tissue = ELEMENT_ARRAYS.open_table(element_table), TISSUE_ARRAYS.open_table(tissue_table)
            state, rates = STATE_ARRAYS.open_table(state_table), RATE_ARRAYS.open_table(rate_table)
            surface = SURFACE_ARRAYS.open_table(surface_table)
            batches, pressures = counts[StepIntegerIndex.BATCHES], state.equation.shape[0]
            parameters = rates.force_rates.shape[0]
            free, kappa = counts[StepIntegerIndex.FREE], settings[StepSettingIndex.KAPPA]
            for k in range(parameters):
                if which[SensitivityControlIndex.FACTORISES] == 0 or which[SensitivityControlIndex.REFINES] == 0:
                    solve_derivatives_by_one_parameter(k, kappa, which, counts, band_table, elements, surface, state,
                                                       rates)
                    if which[SensitivityControlIndex.REFINES] == 1 and which[SensitivityControlIndex.SETTLED] == 0:
                        which[SensitivityControlIndex.FACTORISES] = 1
                # Force on the tool: of contact points, and of tissue that is bonded to the tool.
                total = 0.0
                for c in range(counts[StepIntegerIndex.CONTACTS]):
                    total += float(surface.spans[c, OutlineSpanColumn.MOVES]) * rates.multiplier_rates[k, c, 1]
                for dof in range(pressures):
                    i = state.equation[dof]
                    if i >= free:
                        total += state.direction[dof] * rates.motion[pressures + i]
                    elif i >= 0:
                        total += state.pull[i] * rates.motion[dof]
                rates.force_rates[k] = total
            if ti.static(remembers):
                for b in range(batches):
                    if which[SensitivityControlIndex.RELAXES] == 1:
                        work.copy_stress_history_to_buffers(b, which, elements, tissue, rates)
                    for k in range(parameters):
                        work.update_memory_derivatives(b, k, parameters, batches, which, elements, tissue, rates)

    return factorise_and_differentiate_forces, solve_state_derivatives
