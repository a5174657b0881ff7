"""Derivatives of the equilibrium with respect to material parameters, by direct differentiation, as Taichi kernels.

The discrete equilibrium R(y, theta, h) = 0 of a step, with unknowns y, parameters theta and history h, is
differentiated:

    R_y dy/dtheta = -(R_theta + R_h dh/dtheta),

with the exact tangent R_y at the converged state. `sensitivity_points` computes R_theta + R_h dh/dtheta at fixed
displacements; dh/dtheta is updated in each step. Reference: Michaleris, Tortorelli and Vidal, Int. J. Numer. Methods
Eng. 37 (1994) 2471.
"""

from dataclasses import dataclass
from functools import cache

from tissue_sim.fem.axisymmetric.contact import (
    PENALTY,
    ContactLinearisationColumn,
    FactorisedRateColumn,
    OutlineSpanColumn,
)
from tissue_sim.fem.axisymmetric.contact_kernels import HELD, TOUCHED
from tissue_sim.fem.axisymmetric.newton_tables import SettingIndex, StepIntegerIndex
from tissue_sim.fem.axisymmetric.sensitivity_points import make_sensitivity_functions
from tissue_sim.fem.axisymmetric.sensitivity_product import make_tangent_product_functions
from tissue_sim.fem.axisymmetric.sensitivity_tables import SensitivityControlIndex
from tissue_sim.fem.linear import band as band_matrix
from tissue_sim.fem.linear.band import BandTableIndex
from tissue_sim.fem.linear.cholesky import make_cholesky_functions
from tissue_sim.fem.linear.lu import make_lu_functions
from tissue_sim.fem.taichi.origins import get_origin
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import LANES
from tissue_sim.laws import KernelEnergy


@dataclass(frozen=True)
class DerivativeIterationSettings:
    """Settings of the iteration for the derivatives of displacements and contact forces.

    The kernel contains the values as constants.

    Attributes:
        max_rounds: maximum number of rounds; each round reduces the error of the contact forces by about three digits.
        contact_tolerance: relative error of the derivatives of the contact forces at which the iteration stops.
        residual_tolerance: relative residual that the iteration with the factorisation of the step must reach;
            `contact_tolerance` where rounding prevents this.
        stall_ratio: the iteration with the factorisation of the step has stalled if two rounds reduce the residual to
            no less than this fraction.
    """

    max_rounds: int = 9
    contact_tolerance: float = 1e-10
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
    real1, real2, real3, real4 = (ti.types.ndarray(dtype=ti.f64, ndim=n) for n in range(1, 5))
    int1, int2 = (ti.types.ndarray(dtype=ti.i32, ndim=n) for n in (1, 2))
    vector1 = ti.types.ndarray(dtype=vec, ndim=1)
    vectors = get_origin().field
    fill_unused_diagonal = band_matrix.make_fill_diagonal_function()
    cholesky, lu = make_cholesky_functions(), make_lu_functions()

    @ti.func
    def compute_contact_force_rate(i, k, dr, dz, held: ti.template(), slip_signs: ti.template(), springs: ti.template(),
                                   contact_rates: ti.template(), known: ti.template(), multiplier_rates: ti.template(),
                                   anchor_rates: ti.template()):
        """Return the derivative of the force of point i with respect to parameter k for given (dr, dz)/dtheta_k.

        The residual of the constraint is multiplied by the derivatives that the matrix contains.
        """
        fr = contact_rates[i, ContactLinearisationColumn.RR] * dr + contact_rates[i, ContactLinearisationColumn.RZ] * dz
        fz = contact_rates[i, ContactLinearisationColumn.ZR] * dr + contact_rates[i, ContactLinearisationColumn.ZZ] * dz
        lr, lz = multiplier_rates[k, i, 0], multiplier_rates[k, i, 1]
        hr, hz = anchor_rates[k, i, 0], anchor_rates[k, i, 1]
        stiff, missed_r, missed_z = PENALTY.stick_factor * springs[i], 0.0, 0.0
        if held[i, 0] == HELD:
            missed_r, missed_z = dr - hr, dz - hz
            fr += lr - stiff * hr
            fz += lz - stiff * hz
        elif contact_rates[i, ContactLinearisationColumn.RR] != 0.0 or contact_rates[i, ContactLinearisationColumn.ZZ] \
            != 0.0:
            nr, nz = contact_rates[i,
                                   ContactLinearisationColumn.NORMAL_R], contact_rates[
                                       i, ContactLinearisationColumn.NORMAL_Z]
            mu = contact_rates[i, ContactLinearisationColumn.FRICTION]
            tr, tz = -nz, nr
            pressed, along = lr * nr + lz * nz, 0.0
            apart, slip = dr * nr + dz * nz, 0.0
            if mu > 0.0 and held[i, 0] == TOUCHED:
                sticks = lr * tr + lz * tz - stiff * (hr * tr + hz * tz)
                along = sticks if slip_signs[i] == 0.0 else -slip_signs[i] * mu * pressed
                slip = (dr - hr) * tr + (dz - hz) * tz if slip_signs[i] == 0.0 else 0.0
            missed_r, missed_z = apart * nr + slip * tr, apart * nz + slip * tz
            fr += pressed * nr + along * tr
            fz += pressed * nz + along * tz
        fr += ((known[i, FactorisedRateColumn.RR] - contact_rates[i, ContactLinearisationColumn.RR]) * missed_r
               + (known[i, FactorisedRateColumn.RZ] - contact_rates[i, ContactLinearisationColumn.RZ]) * missed_z)
        fz += ((known[i, FactorisedRateColumn.ZR] - contact_rates[i, ContactLinearisationColumn.ZR]) * missed_r
               + (known[i, FactorisedRateColumn.ZZ] - contact_rates[i, ContactLinearisationColumn.ZZ]) * missed_z)
        return fr, fz

    @ti.func
    def factorise_assembled_tangent(counts: ti.template(), band_table: ti.template()):
        """Factorise the assembled exact tangent; return 1, or 0 if the tangent is singular or not positive definite."""
        fill_unused_diagonal(band_table, counts[StepIntegerIndex.FREE])
        good = 1
        if ti.static(slips):
            if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                good = lu.factorise_band(band_table, 0, counts[StepIntegerIndex.SKEWED])
        if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
            good = cholesky.factorise_band(band_table, 0, band_table[BandTableIndex.ROWS])
        return good

    @ti.func
    def solve_one_parameter_derivative(k, kappa, batches, which: ti.template(), counts: ti.template(),
                                       equation: ti.template(), contact_nodes: ti.template(),
                                       contact_shapes: ti.template(), springs: ti.template(), held: ti.template(),
                                       slip_signs: ti.template(), contact_rates: ti.template(),
                                       known_rates: ti.template(),
                                       band_table: ti.template(), residual: ti.template(), forces: ti.template(),
                                       multiplier_rates: ti.template(), anchor_rates: ti.template(),
                                       point_rates: ti.template(), law: ti.template(), dx: ti.template(),
                                       motion: ti.template(), dofs: ti.template(), real: ti.template(),
                                       gradient_r: ti.template(), gradient_z: ti.template(), value_r: ti.template(),
                                       moduli: ti.template(), equations_r: ti.template(), equations_z: ti.template(),
                                       volume_r: ti.template(), volume_z: ti.template(), known_volume_r: ti.template(),
                                       known_volume_z: ti.template(), pressure_rates: ti.template(),
                                       swelling: ti.template(), rows_rr: ti.template(), rows_rz: ti.template(),
                                       rows_zr: ti.template(), rows_zz: ti.template(), inverse_rr: ti.template(),
                                       inverse_rz: ti.template(), inverse_zz: ti.template(), centre_r: ti.template(),
                                       centre_z: ti.template(), way_r: ti.template(), way_z: ti.template()):
        """Solve for the derivatives of displacements and contact forces with respect to parameter k.

        Each round solves with the factorisation and updates the derivatives of the contact forces. With the
        factorisation of a nearby tangent (`SensitivityControlIndex.REFINES`) the rounds are iterative refinement of the
        exact equations, and `SensitivityControlIndex.SETTLED` is 1 if they converged. `motion` contains the last
        displacement increment, followed by the residual before that increment.
        """
        free, rows, right = (counts[StepIntegerIndex.FREE], band_table[BandTableIndex.ROWS],
                             band_table[BandTableIndex.RIGHT])
        last, before_last = 0.0, 0.0
        refines = which[SensitivityControlIndex.REFINES]
        goes_on = float(refines)
        which[SensitivityControlIndex.SETTLED] = 0
        for i in range(dx.shape[1]):
            dx[k, i] = 0.0
        for c in range(counts[StepIntegerIndex.CONTACTS]):
            point_rates[k, c, 0], point_rates[k, c, 1] = 0.0, 0.0
        for b in range(way_r.shape[0]):
            at = k * batches + b
            way_r[b], way_z[b] = centre_r[at], centre_z[at]
        for i in range(swelling.shape[0]):
            swelling[i], pressure_rates[i] = vec(0.0), vec(0.0)
        for round in range(DIFFERENTIATION.max_rounds):
            missing, pushing, changed, largest_rate = 0.0, 0.0, 0.0, 0.0
            for i in range(residual.shape[0]):
                residual[i] = forces[k, i]
                pushing += ti.abs(forces[k, i])
            if ti.static(not remembers):
                if refines == 1 and round > 0:
                    for b in range(batches):
                        missed = tangent.add_tangent_product_to_residual(
                            b, k, kappa, batches, which[SensitivityControlIndex.ONE], law, dx, dofs, real, gradient_r,
                            gradient_z,
                                                     value_r,
                            moduli, equations_r, equations_z, volume_r, volume_z, known_volume_r, known_volume_z,
                            pressure_rates, swelling, rows_rr, rows_rz, rows_zr, rows_zz, inverse_rr, inverse_rz,
                            inverse_zz, centre_r, centre_z, way_r, way_z, residual)
                        missing += missed
            for i in range(free, residual.shape[0]):
                motion[equation.shape[0] + i] = residual[i]
            for c in range(counts[StepIntegerIndex.CONTACTS]):
                fr, fz = compute_contact_force_rate(c, k, goes_on * point_rates[k, c, 0],
                                                    goes_on * point_rates[k, c, 1], held, slip_signs, springs,
                                                    contact_rates, known_rates, multiplier_rates, anchor_rates)
                for a in range(contact_shapes.shape[1]):
                    ir, iz = equation[2 * contact_nodes[c, a]], equation[2 * contact_nodes[c, a] + 1]
                    residual[ir] = residual[ir] + contact_shapes[c, a] * fr
                    residual[iz] = residual[iz] + contact_shapes[c, a] * fz
            for i in range(free):
                missing += ti.abs(residual[i])
            slow = refines == 1 and round > 1 and not missing <= DIFFERENTIATION.stall_ratio * before_last
            if refines == 1 and (missing <= DIFFERENTIATION.residual_tolerance * pushing
                                 or (slow and missing <= DIFFERENTIATION.contact_tolerance * pushing)):
                for dof in range(equation.shape[0]):
                    motion[dof] = 0.0
                which[SensitivityControlIndex.SETTLED] = 1
                break
            if slow:
                break
            if refines == 1:
                before_last = last
                last = missing
            for I in range(rows):
                for i in ti.static(range(B)):
                    vectors[right + I][i] = residual[I * B + i] if I * B + i < free else 0.0
            if ti.static(slips):
                if counts[StepIntegerIndex.UNSYMMETRIC] == 1:
                    lu.solve_band(band_table)
            if counts[StepIntegerIndex.UNSYMMETRIC] == 0:
                cholesky.solve_band(band_table)
            for dof in range(equation.shape[0]):
                i = equation[dof]
                motion[dof] = 0.0
                if i >= 0 and i < free:
                    motion[dof] = -vectors[right + i // B][i % B]
                    dx[k, dof] = goes_on * dx[k, dof] + motion[dof]
            if ti.static(not remembers):
                if refines == 1:
                    for b in range(batches):
                        tangent.update_condensed_derivatives(b, k, kappa, motion, dofs, real, moduli, known_volume_r,
                                                             known_volume_z, rows_rr, rows_rz, rows_zr, rows_zz, way_r,
                                                             way_z, pressure_rates, swelling, dx)
            for c in range(counts[StepIntegerIndex.CONTACTS]):
                dr, dz = 0.0, 0.0
                for a in range(contact_shapes.shape[1]):
                    dr += contact_shapes[c, a] * dx[k, 2 * contact_nodes[c, a]]
                    dz += contact_shapes[c, a] * dx[k, 2 * contact_nodes[c, a] + 1]
                fr, fz = compute_contact_force_rate(c, k, dr, dz, held, slip_signs, springs, contact_rates, known_rates,
                                                    multiplier_rates, anchor_rates)
                changed += ti.abs(fr - multiplier_rates[k, c, 0]) + ti.abs(fz - multiplier_rates[k, c, 1])
                largest_rate += ti.abs(fr) + ti.abs(fz)
                multiplier_rates[k, c, 0], multiplier_rates[k, c, 1] = fr, fz
                point_rates[k, c, 0], point_rates[k, c, 1] = dr, dz
            if refines == 0:
                # Estimate of the change in the next round, from the convergence rate of the last rounds.
                if changed * ti.min(changed / ti.max(last, 1e-300),
                                    1.0) <= DIFFERENTIATION.contact_tolerance * largest_rate:
                    break
                last = changed

    @ti.kernel
    def differentiate_forces(which: int1, counts: int1, settings: real1, equation: int1, elements: int2, dofs: int2,
                             gradient_r: vector1, gradient_z: vector1, value_r: vector1, point_weights: vector1,
                             mode_values: vector1, moduli: vector1, equations_r: int2, equations_z: int2,
                             coefficients: real1, past: real1, inherited: real3, largest: real2, stresses: real3,
                             before: real3, internal: real4, recent: vector1, x: real1, band_table: int1,
                             residual: real1, volume_r: vector1, volume_z: vector1, rows_rr: vector1, rows_rz: vector1,
                             rows_zr: vector1, rows_zz: vector1, inverse_rr: vector1, inverse_rz: vector1,
                             inverse_zz: vector1, acts: int1, relaxes: int1, directions: real2, kappa_rates: real1,
                             moduli_rates: vector1, past_rates: real2, decay: real1, gain: real1, decay_rates: real2,
                             gain_rates: real2, largest_rates: vector1, energy_rates: vector1, stress_rates: vector1,
                             before_rates: vector1, internal_rates: vector1, centre_r: vector1, centre_z: vector1,
                             law: vector1, forces: real2):
        ti.loop_config(serialize=True)
        for _ in range(which[SensitivityControlIndex.PASSES]):
            batches, pressures, parameters = elements.shape[0], equation.shape[0], forces.shape[0]
            kappa = settings[SettingIndex.KAPPA]
            if which[SensitivityControlIndex.REFINES] == 1:
                which[SensitivityControlIndex.FACTORISES] = 0
            else:
                which[SensitivityControlIndex.FACTORISES] = 1 - factorise_assembled_tangent(counts, band_table)
            for k in range(parameters):
                for i in range(residual.shape[0]):
                    forces[k, i] = 0.0
            for b in range(batches):
                work.store_point_data(b, which, x, dofs, elements, gradient_r, gradient_z, value_r, coefficients, past,
                                      inherited, largest, pressures, mode_values, point_weights, moduli, law)
                if ti.static(remembers):
                    if which[SensitivityControlIndex.RELAXES] == 1:
                        work.copy_stress_history_to_buffers(b, which, elements, stresses, before, internal, recent)
                for k in range(parameters):
                    work.add_force_derivatives_at_fixed_displacement(b, k, kappa, parameters, batches, pressures, which,
                                                                     acts, directions, x,
                                                                     elements, gradient_r, gradient_z, value_r,
                                                                     point_weights, moduli,
                                                                     equations_r, equations_z, volume_r, volume_z,
                                                                     rows_rr, rows_rz, rows_zr,
                                                                     rows_zz, inverse_rr, inverse_rz, inverse_zz,
                                                                     kappa_rates, moduli_rates,
                                                                     past, past_rates, largest, largest_rates,
                                                                     energy_rates, stress_rates,
                                                                     before_rates, recent, internal_rates, decay, gain,
                                                                     decay_rates,
                                                                     gain_rates, relaxes, centre_r, centre_z, forces)

    @ti.kernel
    def solve_state_derivatives(which: int1, counts: int1, settings: real1, equation: int1, direction: real1,
                                elements: int2, dofs: int2, real: vector1, gradient_r: vector1, gradient_z: vector1,
                                value_r: vector1, moduli: vector1, equations_r: int2, equations_z: int2,
                                contact_nodes: int2, contact_shapes: real2, spans: int2, springs: real1, held: real2,
                                slip_signs: real1, contact_rates: real2, known_rates: real2, largest: real2,
                                stresses: real3, energies: real2, before: real3, internal: real4, recent: vector1,
                                band_table: int1, residual: real1,
                                pull: real1, volume_r: vector1, volume_z: vector1, known_volume_r: vector1,
                                known_volume_z: vector1, pressure_rates: vector1, swelling: vector1, rows_rr: vector1,
                                rows_rz: vector1, rows_zr: vector1, rows_zz: vector1, inverse_rr: vector1,
                                inverse_rz: vector1, inverse_zz: vector1, relaxes: int1, decay: real1, gain: real1,
                                decay_rates: real2, gain_rates: real2, largest_rates: vector1, energy_rates: vector1,
                                stress_rates: vector1, before_rates: vector1, internal_rates: vector1,
                                multiplier_rates: real3, anchor_rates: real3, point_rates: real3, centre_r: vector1,
                                centre_z: vector1, way_r: vector1, way_z: vector1, motion: real1, law: vector1,
                                forces: real2, dx: real2, force_rates: real1):
        ti.loop_config(serialize=True)
        for _ in range(which[SensitivityControlIndex.PASSES]):
            batches, pressures, parameters = elements.shape[0], equation.shape[0], force_rates.shape[0]
            free, kappa = counts[StepIntegerIndex.FREE], settings[SettingIndex.KAPPA]
            for k in range(parameters):
                if which[SensitivityControlIndex.FACTORISES] == 0 or which[SensitivityControlIndex.REFINES] == 0:
                    solve_one_parameter_derivative(k, kappa, batches, which, counts, equation, contact_nodes,
                                                   contact_shapes, springs, held, slip_signs, contact_rates,
                                                   known_rates, band_table, residual, forces,
                                                   multiplier_rates, anchor_rates, point_rates, law, dx, motion, dofs,
                                                   real, gradient_r, gradient_z, value_r, moduli, equations_r,
                                                   equations_z,
                                                   volume_r, volume_z, known_volume_r, known_volume_z, pressure_rates,
                                                   swelling, rows_rr, rows_rz, rows_zr, rows_zz, inverse_rr, inverse_rz,
                                                   inverse_zz, centre_r, centre_z, way_r, way_z)
                    if which[SensitivityControlIndex.REFINES] == 1 and which[SensitivityControlIndex.SETTLED] == 0:
                        which[SensitivityControlIndex.FACTORISES] = 1
                # Force on the tool: of contact points, and of tissue that is bonded to the tool.
                total = 0.0
                for c in range(counts[StepIntegerIndex.CONTACTS]):
                    total += float(spans[c, OutlineSpanColumn.MOVES]) * multiplier_rates[k, c, 1]
                for dof in range(pressures):
                    i = equation[dof]
                    if i >= free:
                        total += direction[dof] * motion[pressures + i]
                    elif i >= 0:
                        total += pull[i] * motion[dof]
                force_rates[k] = total
            if ti.static(remembers):
                for b in range(batches):
                    if which[SensitivityControlIndex.RELAXES] == 1:
                        work.copy_stress_history_to_buffers(b, which, elements, stresses, before, internal, recent)
                    for k in range(parameters):
                        work.update_memory_derivatives(b, k, parameters, batches, which, dx, dofs, elements, gradient_r,
                                                       gradient_z, value_r, rows_rr, rows_rz, rows_zr, rows_zz, law,
                                                       largest, energies, largest_rates, energy_rates, stress_rates,
                                                       before_rates, recent, internal_rates, decay, gain, decay_rates,
                                                       gain_rates, relaxes, centre_r, centre_z)

    return differentiate_forces, solve_state_derivatives
