"""Derivatives of element forces and of the tissue's memory with respect to material parameters, as Taichi functions.

First, the derivatives of the nodal forces at fixed displacements; then, with the displacement derivatives known, the
derivatives of the memory (relaxation, softening). Each function works on a batch of `LANES` elements.
"""

from functools import cache
from typing import NamedTuple

import sympy as sp

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.array_layouts import (
    ScratchRecordOffset,
    SensitivityControlIndex,
    StoredPointRecordOffset,
)
from tissue_sim.fem.axisymmetric.assembly import make_condensation_functions
from tissue_sim.fem.axisymmetric.energy import AT, get_axisymmetric_scratch_field, make_kinematic_functions
from tissue_sim.fem.elements.energy import make_inverse_cube_root_function
from tissue_sim.fem.elements.softening import make_softening_function, make_softening_shape_function
from tissue_sim.fem.history import RelaxationSofteningCoefficient
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS


class SensitivityFunctions(NamedTuple):
    """Taichi functions that differentiate forces and memory of one element type and one family of laws."""

    store_point_stresses_and_tangents: object
    copy_stress_history_to_buffers: object
    add_force_derivatives_at_fixed_displacement: object
    update_memory_derivatives: object


def build_directional_derivative_energy(energy: KernelEnergy) -> KernelEnergy:
    """Return a `KernelEnergy`: the directional derivative of a strain energy with respect to its coefficients.

    The coefficients of the result are those of the energy, followed by the components of the direction.
    """
    along = tuple(sp.Symbol(f"{symbol.name}_rate", real=True) for symbol in energy.coefficients)
    rate = sum((component * sp.diff(energy.energy, symbol)
                for component, symbol in zip(along, energy.coefficients, strict=True)), sp.Integer(0))
    return KernelEnergy(f"{energy.key} rate", energy.family, energy.variables, energy.coefficients + along, rate)


@cache
def make_sensitivity_functions(element_name: str, energy: KernelEnergy, remembers: bool) -> SensitivityFunctions:
    """Return the Taichi functions of an element type and a law.

    Tissue without memory uses `store_point_stresses_and_tangents` and `add_force_derivatives_at_fixed_displacement`
    only.

    Rows of arrays of vectors are numbered by batch, point, parameter, term and component, the last fastest.
    """
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.node_count, element.boundary_nodes, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > nb, nodes - 1
    coefficients_of_both = 2 * len(energy.coefficients)
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    condensation = make_condensation_functions(element_name)
    law_of = point.make_stress_function(energy)
    add_pressure_terms = point.make_pressure_term_function()
    stress_rate = point.make_stress_function(build_directional_derivative_energy(energy), tangents=False)
    inverse_cube_root = make_inverse_cube_root_function()
    apply_softening, evaluate_softening_shape = make_softening_function(5), make_softening_shape_function()
    UR, UZ, FR, FZ, RATE = AT["UR"], AT["UZ"], AT["FR"], AT["FZ"], AT["STRESS"]
    LAW, ENERGY_RATE, PAST, BEFORE, CHANGE = (AT[name] for name in ("LAW", "ENERGY_RATE", "PAST", "BEFORE", "CHANGE"))
    row = point.PLACE

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi. Results of branches are
    # stored in the scratch field.

    @ti.func
    def gather_point_value_per_lane(values: ti.template(), numbers: ti.template(), b, q):
        """Return `values` at quadrature point q of the elements of batch b, one in each SIMD lane."""
        return ti.Vector([values[numbers[b][l], q] for l in ti.static(range(LANES))])

    @ti.func
    def gather_point_component_per_lane(values: ti.template(), numbers: ti.template(), b, q, i: ti.template()):
        """Return component i of `values` at quadrature point q of the elements of batch b, one in each SIMD lane."""
        return ti.Vector([values[numbers[b][l], q, i] for l in ti.static(range(LANES))])

    @ti.func
    def compute_second_piola_from_first_piola(F, P):
        """Return the second Piola stress F^-1 P (RR, RZ, ZZ, hoop) of a first Piola stress P."""
        over_j = 1.0 / (F[0] * F[3] - F[1] * F[2])
        return [(F[3] * P[0] - F[1] * P[2]) * over_j, (F[3] * P[1] - F[1] * P[3]) * over_j,
                (F[0] * P[3] - F[2] * P[1]) * over_j, P[4] / F[4]]

    @ti.func
    def compute_first_piola_from_second_piola(F, S):
        """Return the first Piola stress F S (5 components) of a second Piola stress S (RR, RZ, ZZ, hoop)."""
        return [F[0] * S[0] + F[1] * S[1], F[0] * S[1] + F[1] * S[2], F[2] * S[0] + F[3] * S[1],
                F[2] * S[1] + F[3] * S[2], F[4] * S[3]]

    @ti.func
    def store_point_stresses_and_tangents(b, which: ti.template(), pressures, elements: ti.template(),
                                          tissue: ti.template(),
                                          state: ti.template(), rates: ti.template()):
        """Store strains, stresses and tangents at the quadrature points of batch b, equal for all parameters."""
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a], s[UZ + a] = kinematics.gather_node_vector(state.x, elements, i)
        for q in range(points):
            h0, h1, h2, h3, h4 = kinematics.compute_gradient_of_stored_displacements(b, q, elements)
            area = h0 + h3 + h0 * h3 - h1 * h2
            F = [1.0 + h0, h1, h2, 1.0 + h3, 1.0 + h4]
            root = inverse_cube_root(ti.max(1.0 + area + h4 + area * h4, 1e-6))
            at = LAW + ScratchRecordOffset.SIZE * q
            for i in ti.static(range(5)):
                s[at + ScratchRecordOffset.GRADIENT + i] = F[i]
            s[at + ScratchRecordOffset.ROOT] = root
            if ti.static(remembers):
                kept, f = (b * points
                           + q) * StoredPointRecordOffset.SIZE, tissue.past[RelaxationSofteningCoefficient.FACTOR]
                W, P, A, _margin = law_of(F, root, tissue.coefficients)
                s[at + ScratchRecordOffset.ENERGY] = f * W
                for i in ti.static(range(5)):
                    s[at + ScratchRecordOffset.STRESS + i] = f * P[i]
                    s[at + ScratchRecordOffset.SOFT_STRESS + i] = f * P[i]
                for n in ti.static(range(15)):
                    to = kept + StoredPointRecordOffset.SOFT_TANGENT + n
                    rates.law[to] = f * A[n]
                if tissue.past[RelaxationSofteningCoefficient.LOSS] != 0.0:
                    P1, A1 = apply_softening(
                        f * W, gather_point_value_per_lane(tissue.largest, elements.numbers, b, q),
                        tissue.past[RelaxationSofteningCoefficient.LOSS],
                        tissue.past[RelaxationSofteningCoefficient.LOSS_MODULUS],
                        tissue.past[RelaxationSofteningCoefficient.LOSS_SHARE],
                        tissue.past[RelaxationSofteningCoefficient.FORM], [f * P[i] for i in ti.static(range(5))],
                        [f * A[n] for n in ti.static(range(15))])
                    for i in ti.static(range(5)):
                        s[at + ScratchRecordOffset.SOFT_STRESS + i] = P1[i]
                    for n in ti.static(range(15)):
                        to = kept + StoredPointRecordOffset.SOFT_TANGENT + n
                        rates.law[to] = A1[n]
                left = compute_first_piola_from_second_piola(
                    F, [gather_point_component_per_lane(tissue.inherited, elements.numbers, b, q, i)
                        for i in ti.static(range(4))])
                for i in ti.static(range(5)):
                    s[at + ScratchRecordOffset.RELAXED_STRESS + i] = (
                        tissue.past[RelaxationSofteningCoefficient.INSTANT]
                        * s[at + ScratchRecordOffset.SOFT_STRESS + i] + left[i])
                    to = kept + StoredPointRecordOffset.GRADIENT + i
                    rates.law[to] = F[i]
                    to1 = kept + StoredPointRecordOffset.STRESS + i
                    rates.law[to1] = s[at + ScratchRecordOffset.STRESS + i]
                S = compute_second_piola_from_first_piola(F, [s[at + ScratchRecordOffset.SOFT_STRESS + i]
                                                              for i in ti.static(range(5))])
                for i in ti.static(range(4)):
                    to2 = kept + StoredPointRecordOffset.SECOND + i
                    rates.law[to2] = S[i]
            elif which[SensitivityControlIndex.LAYERED] + which[SensitivityControlIndex.REFINES] > 0:
                W, P, A, _margin = law_of(F, root, tissue.coefficients)
                for i in ti.static(range(5)):
                    s[at + ScratchRecordOffset.RELAXED_STRESS + i] = P[i]
                p = vec(0.0)
                for m in range(modes):
                    amplitude = ti.Vector([state.x[pressures + modes * elements.numbers[b][l] + m]
                                           for l in ti.static(range(LANES))])
                    p = p + elements.mode_values[(b * points + q) * modes + m] * amplitude
                w, modulus = elements.point_weights[b * points + q], elements.moduli[b]
                P1, A1 = add_pressure_terms(F, p, [modulus * P[i] for i in ti.static(range(5))],
                                            [modulus * A[n] for n in ti.static(range(15))])
                for n in ti.static(range(15)):
                    to = (b * points + q) * 15 + n
                    rates.law[to] = w * A1[n]

    @ti.func
    def copy_stress_history_to_buffers(b, which: ti.template(), elements: ti.template(), tissue: ti.template(),
                                       rates: ti.template()):
        """Copy internal stresses to `recent`, and the last stress and its change to the scratch field, for batch b."""
        terms = which[SensitivityControlIndex.TERMS]
        for q in range(points):
            for i in ti.static(range(4)):
                s[BEFORE + 4 * q + i] = gather_point_component_per_lane(tissue.before, elements.numbers, b, q, i)
                stress = gather_point_component_per_lane(tissue.stresses, elements.numbers, b, q, i)
                s[CHANGE + 4 * q + i] = stress - s[BEFORE + 4 * q + i]
                for t in range(terms):
                    at_term = (q * terms + t) * 4 + i
                    rates.recent[at_term] = ti.Vector([tissue.internal[t, elements.numbers[b][l], q, i]
                                                       for l in ti.static(range(LANES))])

    @ti.func
    def apply_memory_to_stress_derivative(b, q, k, parameters, which: ti.template(), elements: ti.template(),
                                          tissue: ti.template(), rates: ti.template()):
        """Convert, in place, the law's stress derivative by parameter k to that of the softened and relaxed stress.

        The derivatives of energy and softened stress are stored for the memory.
        The modulus ratio of the element is not included.
        """
        at, noted = RATE + 5 * q, LAW + ScratchRecordOffset.SIZE * q
        terms = which[SensitivityControlIndex.TERMS]
        f = tissue.past[RelaxationSofteningCoefficient.FACTOR]
        df = rates.past_rates[k, RelaxationSofteningCoefficient.FACTOR] / f
        F = [s[noted + ScratchRecordOffset.GRADIENT + i] for i in ti.static(range(5))]
        W = s[noted + ScratchRecordOffset.ENERGY]
        dW = f * s[ENERGY_RATE + q] + df * W
        for i in ti.static(range(5)):
            s[at + i] = f * s[at + i] + df * s[noted + ScratchRecordOffset.STRESS + i]
        own = (b * points + q) * parameters + k
        if which[SensitivityControlIndex.SOFTENS] == 1:
            L, dL = gather_point_value_per_lane(tissue.largest, elements.numbers, b, q), rates.largest_rates[own]
            width = ti.max(tissue.past[RelaxationSofteningCoefficient.LOSS_MODULUS]
                           + tissue.past[RelaxationSofteningCoefficient.LOSS_SHARE] * L, 1e-300)
            width_rate = (rates.past_rates[k, RelaxationSofteningCoefficient.LOSS_MODULUS]
                          + rates.past_rates[k, RelaxationSofteningCoefficient.LOSS_SHARE] * L
                          + tissue.past[RelaxationSofteningCoefficient.LOSS_SHARE] * dL)
            bend, bend_slope = evaluate_softening_shape(ti.max(L - W, 0.0) / width,
                                                        tissue.past[RelaxationSofteningCoefficient.FORM])
            argument_rate = (dL - dW - (L - W) * width_rate / width) / width
            loss, loss_rate = tissue.past[RelaxationSofteningCoefficient.LOSS], rates.past_rates[
                k, RelaxationSofteningCoefficient.LOSS]
            eta_rate = ti.select(W < L, -loss_rate * bend - loss * bend_slope * argument_rate, 0.0 * W)
            for i in ti.static(range(5)):
                s[at + i] = ((1.0 - tissue.past[RelaxationSofteningCoefficient.LOSS] * bend) * s[at + i]
                             + eta_rate * s[noted + ScratchRecordOffset.STRESS + i])
        rates.energy_rates[own] = dW
        S = compute_second_piola_from_first_piola(F, [s[at + i] for i in ti.static(range(5))])
        for i in ti.static(range(4)):
            to = 4 * own + i
            rates.stress_rates[to] = S[i]
            s[PAST + i] = vec(0.0)
            for t in range(terms):
                of = (own * terms + t) * 4 + i
                s[PAST + i] = (s[PAST + i] + rates.decay[t] * rates.internal_rates[of]
                               - rates.gain[t] * rates.before_rates[to])
                if rates.relaxes[k] == 1:
                    at_term = (q * terms + t) * 4 + i
                    s[PAST + i] = (s[PAST + i] + rates.decay_rates[k, t] * rates.recent[at_term]
                                   - rates.gain_rates[k, t] * s[BEFORE + 4 * q + i])
        left = compute_first_piola_from_second_piola(F, [s[PAST + i] for i in ti.static(range(4))])
        for i in ti.static(range(5)):
            s[at + i] = (tissue.past[RelaxationSofteningCoefficient.INSTANT] * s[at + i]
                         + rates.past_rates[k, RelaxationSofteningCoefficient.INSTANT]
                         * s[noted + ScratchRecordOffset.SOFT_STRESS + i] + left[i])

    @ti.func
    def add_force_derivatives_at_fixed_displacement(b, k, kappa, parameters, batches, pressures, which: ti.template(),
                                                    elements: ti.template(), tissue: ti.template(),
                                                    state: ti.template(), rates: ti.template()):
        """Add the derivatives of the nodal forces of batch b with parameter k at fixed displacements to `forces`."""
        direction = ti.Vector([rates.directions[k, i] for i in ti.static(range(coefficients_of_both))])
        own = k * batches + b
        modulus, modulus_rate = elements.moduli[b], rates.moduli_rates[own]
        for q in range(points):
            at, noted = RATE + 5 * q, LAW + ScratchRecordOffset.SIZE * q
            if rates.acts[k] == 1:
                F = [s[noted + ScratchRecordOffset.GRADIENT + i] for i in ti.static(range(5))]
                W, P, _A, _margin = stress_rate(F, s[noted + ScratchRecordOffset.ROOT], direction)
                s[ENERGY_RATE + q] = W
                for i in ti.static(range(5)):
                    s[at + i] = P[i]
            else:
                s[ENERGY_RATE + q] = vec(0.0)
                for i in ti.static(range(5)):
                    s[at + i] = vec(0.0)
            if ti.static(remembers):
                apply_memory_to_stress_derivative(b, q, k, parameters, which, elements, tissue, rates)
            w = elements.point_weights[b * points + q]
            for i in ti.static(range(5)):
                s[at + i] = (w * modulus) * s[at + i]
            if which[SensitivityControlIndex.LAYERED] == 1:
                for i in ti.static(range(5)):
                    s[at + i] = s[at + i] + (w * modulus_rate) * s[noted + ScratchRecordOffset.RELAXED_STRESS + i]
        # Relative derivative of the pressure p = K (v - V) at fixed volume.
        share = (rates.kappa_rates[k] * modulus + kappa * modulus_rate) / (kappa * modulus)
        for a in range(nodes):
            fr, fz = kinematics.compute_node_force_from_stresses(a, b, RATE, elements)
            for m in range(modes):
                v = (b * modes + m) * nodes + a
                p = ti.Vector([state.x[pressures + modes * elements.numbers[b][l] + m]
                               for l in ti.static(range(LANES))])
                fr = fr + share * p * elements.volume_r[v]
                fz = fz + share * p * elements.volume_z[v]
            s[FR + a], s[FZ + a] = fr, fz
        condensation.condense_interior_force_and_get_square(b, own, elements, rates.centre_r, rates.centre_z)
        for a in range(nb):
            at = b * nb + a
            fr, fz = s[FR + a], s[FZ + a]
            for l in ti.static(range(LANES)):
                rates.forces[k, elements.equations_r[at][l]] = rates.forces[k, elements.equations_r[at][l]] + fr[l]
                rates.forces[k, elements.equations_z[at][l]] = rates.forces[k, elements.equations_z[at][l]] + fz[l]

    @ti.func
    def update_memory_derivatives(b, k, parameters, batches, which: ti.template(), elements: ti.template(),
                                  tissue: ti.template(), rates: ti.template()):
        """Update the derivatives of the material history of batch b with parameter k, from the derivatives `dx`."""
        in_batch, terms = k * batches + b, which[SensitivityControlIndex.TERMS]
        for a in range(nb):
            i = b * nodes + a
            s[UR + a], s[UZ + a] = kinematics.gather_node_vector_of_row(rates.dx, k, elements, i)
        if ti.static(has_centre):
            cr, cz = -rates.centre_r[in_batch], -rates.centre_z[in_batch]
            for a in range(nb):
                at = b * nb + a
                cr = cr - (elements.rows_rr[at] * s[UR + a] + elements.rows_rz[at] * s[UZ + a])
                cz = cz - (elements.rows_zr[at] * s[UR + a] + elements.rows_zz[at] * s[UZ + a])
            s[UR + centre], s[UZ + centre] = cr, cz
        for q in range(points):
            own, kept = (b * points + q) * parameters + k, (b * points + q) * StoredPointRecordOffset.SIZE
            h0, h1, h2, h3, h4 = kinematics.compute_gradient_of_stored_displacements(b, q, elements)
            H = [h0, h1, h2, h3, h4]
            F = [1.0 * h0 for _i in ti.static(range(5))]
            second = [1.0 * h0 for _i in ti.static(range(4))]
            dW = rates.energy_rates[own]
            for i in ti.static(range(5)):
                of = kept + StoredPointRecordOffset.GRADIENT + i
                F[i] = rates.law[of]
                of1 = kept + StoredPointRecordOffset.STRESS + i
                dW = dW + rates.law[of1] * H[i]
            for i in ti.static(range(4)):
                of2 = kept + StoredPointRecordOffset.SECOND + i
                second[i] = rates.law[of2]
            # d(F S) = F dS + dF S.
            lost = compute_first_piola_from_second_piola(H, second)
            rate = [-1.0 * lost[i] for i in ti.static(range(5))]
            for i in ti.static(range(5)):
                for n in ti.static(range(5)):
                    of = kept + ti.static(StoredPointRecordOffset.SOFT_TANGENT + row[i][n])
                    rate[i] = rate[i] + rates.law[of] * H[n]
            S_rate = compute_second_piola_from_first_piola(F, rate)
            most = gather_point_value_per_lane(tissue.largest, elements.numbers, b, q)
            energy = gather_point_value_per_lane(tissue.energies, elements.numbers, b, q)
            rates.largest_rates[own] = ti.select(energy > most, dW, rates.largest_rates[own])
            for i in ti.static(range(4)):
                to = 4 * own + i
                S = rates.stress_rates[to] + S_rate[i]
                change = S - rates.before_rates[to]
                rates.before_rates[to] = S
                for t in range(terms):
                    of = (own * terms + t) * 4 + i
                    rates.internal_rates[of] = rates.decay[t] * rates.internal_rates[of] + rates.gain[t] * change
                    if rates.relaxes[k] == 1:
                        at_term = (q * terms + t) * 4 + i
                        rates.internal_rates[of] = (rates.internal_rates[of]
                                                    + rates.decay_rates[k, t] * rates.recent[at_term]
                                                    + rates.gain_rates[k, t] * s[CHANGE + 4 * q + i])

    return SensitivityFunctions(store_point_stresses_and_tangents, copy_stress_history_to_buffers,
                                add_force_derivatives_at_fixed_displacement, update_memory_derivatives)
