"""Layouts of the arrays of the axisymmetric kernels, see `tissue_sim.fem.taichi.array_tables`."""

from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.taichi.array_tables import (
    LANE_INTEGERS,
    LANE_REALS,
    ArrayLayout,
    integer_array_type,
    real_array_type,
)

#: Elements, see `tissue_sim.fem.axisymmetric.batches.ElementBatches`.
ELEMENT_ARRAYS = ArrayLayout(
    numbers=LANE_INTEGERS, real=LANE_REALS, moduli=LANE_REALS, dofs=LANE_INTEGERS, equations_r=LANE_INTEGERS,
    equations_z=LANE_INTEGERS, gradient_r=LANE_REALS, gradient_z=LANE_REALS, value_r=LANE_REALS,
    point_weights=LANE_REALS, mode_values=LANE_REALS, volumes=LANE_REALS, places=LANE_INTEGERS,
    pull_starts=integer_array_type(), pulls=integer_array_type(2), pull_factors=real_array_type(), stiffness=LANE_REALS,
    stiffness_numbers=real_array_type(), volume_r=LANE_REALS, volume_z=LANE_REALS, gap=LANE_REALS,
    known_volume_r=LANE_REALS, known_volume_z=LANE_REALS, rows_rr=LANE_REALS, rows_rz=LANE_REALS, rows_zr=LANE_REALS,
    rows_zz=LANE_REALS, inverse_rr=LANE_REALS, inverse_rz=LANE_REALS, inverse_zz=LANE_REALS, force_r=LANE_REALS,
    force_z=LANE_REALS)

#: Law, material history and effects at the quadrature points, see `tissue_sim.fem.history.MaterialMemory` and
#: `tissue_sim.fem.elements.point_effects.PointEffects`.
TISSUE_ARRAYS = ArrayLayout(
    **MATERIAL_ARRAYS.types, effect_settings=real_array_type(), effect_states=real_array_type(3),
    effect_states_found=real_array_type(3))

#: Contact points, see `tissue_sim.fem.axisymmetric.contact.ContactPoints`; `known_rates` are the derivatives that the
#: factorised matrix contains.
SURFACE_ARRAYS = ArrayLayout(
    nodes=integer_array_type(2), shapes=real_array_type(2), spans=integer_array_type(2), places=real_array_type(2),
    areas=real_array_type(),
    lines=real_array_type(2), rounding=real_array_type(), friction=real_array_type(2), springs=real_array_type(),
    held=real_array_type(2),
    pressed=real_array_type(), slip_signs=real_array_type(), met=real_array_type(2), forces=real_array_type(2),
    rates=real_array_type(2),
    known_rates=real_array_type(2), law_settings=real_array_type())

#: Equations, unknowns and right-hand sides, see `tissue_sim.fem.axisymmetric.equations.EquilibriumEquations`.
STATE_ARRAYS = ArrayLayout(
    equation=integer_array_type(), direction=real_array_type(), start=real_array_type(), target=real_array_type(),
    masses=real_array_type(),
    rest=real_array_type(), x=real_array_type(), before=real_array_type(), motion=real_array_type(),
    history=real_array_type(2),
    slots=integer_array_type(), weights=real_array_type(), scattered=real_array_type(), residual=real_array_type(),
    pull=real_array_type(),
    reaction=real_array_type())

#: Derivatives with respect to the parameters of the material, and the data from which they are computed, see
#: `tissue_sim.fem.axisymmetric.sensitivity.MaterialSensitivity`.
RATE_ARRAYS = ArrayLayout(
    acts=integer_array_type(), relaxes=integer_array_type(), directions=real_array_type(2),
    kappa_rates=real_array_type(),
    moduli_rates=LANE_REALS, past_rates=real_array_type(2), decay=real_array_type(), gain=real_array_type(),
    decay_rates=real_array_type(2), gain_rates=real_array_type(2), largest_rates=LANE_REALS, energy_rates=LANE_REALS,
    stress_rates=LANE_REALS, before_rates=LANE_REALS, internal_rates=LANE_REALS, recent=LANE_REALS, law=LANE_REALS,
    centre_r=LANE_REALS, centre_z=LANE_REALS, way_r=LANE_REALS, way_z=LANE_REALS, pressure_rates=LANE_REALS,
    swelling=LANE_REALS, multiplier_rates=real_array_type(3), anchor_rates=real_array_type(3),
    point_rates=real_array_type(3),
    motion=real_array_type(), forces=real_array_type(2), dx=real_array_type(2), force_rates=real_array_type())
