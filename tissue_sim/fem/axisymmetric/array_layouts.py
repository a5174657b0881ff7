"""Layouts and index enumerations of the packed arrays of the axisymmetric kernels, and their settings.

Layouts are those of `tissue_sim.fem.taichi.array_tables`.
"""

from dataclasses import dataclass
from enum import IntEnum

from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.taichi.array_tables import (
    LANE_INTEGERS,
    LANE_REALS,
    ArrayLayout,
    integer_array_type,
    real_array_type,
)


class StepIntegerIndex(IntEnum):
    """Indices of `EquilibriumEquations.counts`, the integers that a step reads and writes.

    Attributes:
        PASSES: number of times that the kernel solves the step; 1 except in benchmarks.
        FREE: number of free equations.
        MAX_ITERATIONS: maximum number of linear solves.
        CONTACTS: number of contact points; 0 removes the contact.
        REMEMBERS: 1 if the tissue has a memory (relaxation, softening, effects at the points).
        UNSYMMETRIC: output, 1 if the matrix is unsymmetric because points slip.
        CHANGEABLE: which points may change their contact state, see `tissue_sim.fem.contact.pairs.ALL_POINTS`.
        START_MODE: a `StartMode`.
        STIFFNESS_ASKED: 1 if a converged step computes the stiffness of the tool.
        FACTORISED: output, 1 if the matrix is factorised at the end of the step.
        BENDING: output, 1 if the matrix contains the curvature of the contact surfaces.
        ITERATED: number of linear solves before this start, in mode `StartMode.RESUME`.
        SKEWED: output, the first block row in which the matrix is unsymmetric.
        BATCHES: number of batches of elements.
    """

    PASSES = 0
    FREE = 1
    MAX_ITERATIONS = 2
    CONTACTS = 3
    REMEMBERS = 4
    UNSYMMETRIC = 5
    CHANGEABLE = 6
    START_MODE = 7
    STIFFNESS_ASKED = 8
    FACTORISED = 9
    BENDING = 10
    ITERATED = 11
    SKEWED = 12
    BATCHES = 13


class StepSettingIndex(IntEnum):
    """Indices of `EquilibriumEquations.settings`, the numbers that a step reads.

    Attributes:
        DEPTH: depth of the tool at the end of the step, m.
        PREDICTED: depth of the tool to which the initial state belongs, m.
        KAPPA: bulk modulus, Pa.
        WEIGHT: specific weight, N/m3.
        TOLERANCE: largest relative residual of a converged step.
        FLOOR: smallest force against which the residual is measured, N.
        ROUNDING: force of rounding errors, N.
        TOUCH: z of the tool's deepest point at the first touch, m.
        CONTACT_TOLERANCE: largest violation of a contact condition, m.
        STRENGTH: largest traction of the contact laws, Pa.
        REACH: largest gap at which a contact law acts, m.
        INERTIA: factor between the mass and the dynamic stiffness, 1/s2; 0 in a quasi-static step.
        DENSITY: mass density, kg/m3.
    """

    DEPTH = 0
    PREDICTED = 1
    KAPPA = 2
    WEIGHT = 3
    TOLERANCE = 4
    FLOOR = 5
    ROUNDING = 6
    TOUCH = 7
    CONTACT_TOLERANCE = 8
    STRENGTH = 9
    REACH = 10
    INERTIA = 11
    DENSITY = 12


class StepReportIndex(IntEnum):
    """Indices of `EquilibriumEquations.report`, the results of a step.

    Attributes:
        STATUS: a `tissue_sim.fem.solver.StepStatus`.
        ITERATIONS: number of linear solves.
        RESIDUAL: norm of the unbalanced forces over the norm of the balanced forces.
        FORCE: axial force on the tool, N.
        VIOLATION: largest violation of a contact condition, m.
        SLIPPING: number of slipping points.
        STIFFNESS: derivative of the axial force with respect to the depth, N/m.
    """

    STATUS = 0
    ITERATIONS = 1
    RESIDUAL = 2
    FORCE = 3
    VIOLATION = 4
    SLIPPING = 5
    STIFFNESS = 6


class EvaluatedEquations(IntEnum):
    """Equations that a pass of the loop in Newton's iteration evaluates.

    Attributes:
        FULL: the elements and the contact.
        CONTACT: the contact only, with the linearised elements, until the active set does not change.
        STIFFNESS: the contact only, for the stiffness of the tool with the final bonds.
    """

    FULL = 0
    CONTACT = 1
    STIFFNESS = 2


class StartMode(IntEnum):
    """State from which a call of the step kernel begins.

    Attributes:
        PREDICT: an extrapolation of earlier states.
        FIXED_CONTACT: the present state; no point may change its contact state.
        RESUME: the state at which the last call ended.
        STIFFNESS_ONLY: as `FIXED_CONTACT`; only the stiffness of the tool is computed.
        RESIDUAL_ONLY: as `FIXED_CONTACT`, without the tangent; interior nodes are condensed with the stored matrices.
    """

    PREDICT = 0
    FIXED_CONTACT = 1
    RESUME = 2
    STIFFNESS_ONLY = 3
    RESIDUAL_ONLY = 4


@dataclass(frozen=True)
class NewtonKernelConstants:
    """Settings of Newton's iteration with reused factorisations.

    The kernel contains the values as constants.

    Attributes:
        friction_floor: friction below this fraction of `StepSettingIndex.FLOOR` is neglected.
        reuse_ratio: the factorisation is reused if a linear solve reduces the residual to this fraction or less.
        reuse_solves: the factorisation is also reused if this number of additional solves, each with the last
            reduction, reaches the tolerance.
        reuse_ratio_realtime: `reuse_ratio` if the step computes a stiffness; small real-time meshes have cheap
            factorisations.
        reuse_solves_realtime: `reuse_solves` if the step computes a stiffness.
        new_tangent_residual: relative residual above which the next iteration assembles a new tangent.
        max_contact_rounds: maximum number of contact iterations on the linearised elements after each linear solve
            (the factorisation is updated for the points that change).
        all_points_iterations: number of iterations in which all points may change their contact state at once; after
            that a part of the points may change, so that the active set does not cycle.
        max_halvings: maximum number of halvings of a Newton step that inverts an element.
    """

    friction_floor: float = 1e-9
    reuse_ratio: float = 1e-2
    reuse_solves: int = 3
    reuse_ratio_realtime: float = 1e-3
    reuse_solves_realtime: int = 2
    new_tangent_residual: float = 100.0
    max_contact_rounds: int = 8
    all_points_iterations: int = 8
    max_halvings: int = 6


#: Settings of the compiled kernels.
NEWTON = NewtonKernelConstants()


class ScratchRecordOffset(IntEnum):
    """Offsets in the scratch record of one quadrature point, for the batch that is evaluated.

    Attributes:
        GRADIENT: deformation gradient, 5 numbers.
        ROOT: J^(-1/3).
        ENERGY: isochoric energy density, Pa.
        STRESS: isochoric first Piola stress of the law, 5 numbers, Pa.
        SOFT_STRESS: `STRESS` with softening, 5 numbers, Pa.
        RELAXED_STRESS: `SOFT_STRESS` with relaxation, 5 numbers, Pa.
        SIZE: numbers in a record.
    """

    GRADIENT = 0
    ROOT = 5
    ENERGY = 6
    STRESS = 7
    SOFT_STRESS = 12
    RELAXED_STRESS = 17
    SIZE = 22


class StoredPointRecordOffset(IntEnum):
    """Offsets in the stored record of one quadrature point, which both sensitivity kernels use.

    Attributes:
        GRADIENT: deformation gradient, 5 numbers.
        STRESS: isochoric first Piola stress of the law, 5 numbers, Pa.
        SECOND: second Piola stress with softening (RR, RZ, ZZ, hoop), 4 numbers, Pa.
        SOFT_TANGENT: tangent with softening, 15 numbers, packed as `energy.PACKED`, Pa.
        SIZE: numbers in a record.
    """

    GRADIENT = 0
    STRESS = 5
    SECOND = 10
    SOFT_TANGENT = 14
    SIZE = 29


class SensitivityControlIndex(IntEnum):
    """Indices of `which`, the integers that control the kernels of the sensitivities.

    Attributes:
        FACTORISES: 1 if the matrix must be factorised; still 1 afterwards if the matrix is singular.
        LAYERED: 1 if a parameter changes the moduli of elements.
        SOFTENS: 1 if the material or a derivative of the material softens.
        TERMS: number of relaxation terms.
        RELAXES: 1 if a parameter changes the relaxation.
        REFINES: 1 if the iteration uses the factorisation of the step instead of one of the exact tangent.
        SETTLED: output, 1 if the iteration of `REFINES` converged.
        PASSES: number of passes of the loop in a kernel, 1.
    """

    FACTORISES = 0
    LAYERED = 1
    SOFTENS = 2
    TERMS = 3
    RELAXES = 4
    REFINES = 5
    SETTLED = 6
    PASSES = 7


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
#: `tissue_sim.fem.history.PointEffects`.
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

#: Derivatives with respect to the parameters, and the data from which they are computed, see
#: `tissue_sim.fem.axisymmetric.sensitivity.MaterialSensitivity`.
RATE_ARRAYS = ArrayLayout(
    acts=integer_array_type(), relaxes=integer_array_type(), directions=real_array_type(2),
    kappa_rates=real_array_type(),
    moduli_rates=LANE_REALS, past_rates=real_array_type(2), decay=real_array_type(), gain=real_array_type(),
    decay_rates=real_array_type(2), gain_rates=real_array_type(2), largest_rates=LANE_REALS, energy_rates=LANE_REALS,
    stress_rates=LANE_REALS, before_rates=LANE_REALS, internal_rates=LANE_REALS, recent=LANE_REALS, law=LANE_REALS,
    centre_r=LANE_REALS, centre_z=LANE_REALS, way_r=LANE_REALS, way_z=LANE_REALS, pressure_rates=LANE_REALS,
    swelling=LANE_REALS, multiplier_rates=real_array_type(3), anchor_rates=real_array_type(3),
    point_rates=real_array_type(3), fixed_force_rates=real_array_type(3), constraint_rates=real_array_type(3),
    motion=real_array_type(), forces=real_array_type(2), dx=real_array_type(2), force_rates=real_array_type())
