"""Index enumerations of the packed arrays of a step, modes of Newton's iteration, and its settings."""

from dataclasses import dataclass
from enum import IntEnum


class StepIntegerIndex(IntEnum):
    """Indices of `EquilibriumEquations.counts`, the integers that a step reads and writes.

    Attributes:
        PASSES: number of times that the kernel solves the step; 1 except in benchmarks.
        FREE: number of free equations.
        MAX_ITERATIONS: maximum number of linear solves.
        CONTACTS: number of contact points; 0 removes the contact.
        REMEMBERS: 1 if the tissue has a memory (relaxation, softening, effects at the points).
        UNSYMMETRIC: output, 1 if the matrix is unsymmetric because points slip.
        CHANGEABLE: which points may change their contact state, see `tissue_sim.fem.contact.settings.ALL_POINTS`.
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
    """

    PREDICT = 0
    FIXED_CONTACT = 1
    RESUME = 2
    STIFFNESS_ONLY = 3


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
