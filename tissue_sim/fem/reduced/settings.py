"""Settings of the algorithms that train, verify and solve a reduced solid."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReducedNewtonSettings:
    """Settings of the modified Newton method of `ReducedSolver`.

    Attributes:
        min_reference_force: smallest reference force of the relative residual, as a fraction of the largest force since
            the last change of the material. A larger value tolerates larger residuals at small forces.
        sufficient_decrease: relative decrease of the residual that a Newton step must reach; else the step is halved.
        max_halvings: maximum number of halvings of a Newton step.
        contact_tolerance: tolerance of the contact problem on linear tissue, as a fraction of the tolerance.
        max_contact_solves: maximum number of linear solves of the contact problem on linear tissue.
        stiffness_groups: number of groups of elements whose stiffness is updated in turn. More groups make a step
            cheaper and the stiffness older.
        fast_convergence: ratio of successive residual norms up to which an iteration keeps the stiffness.
        groups_per_update: number of groups that an iteration with slow convergence updates.
        max_partial_updates: iteration number after which all groups are updated.
        residual_safety: safety factor of the estimated residual of a linear step that is accepted without evaluating
            the elements. In 5700 recorded steps the true residual was at most 8 times the estimate, and never above
            5 times in a step that the factor 5 accepts. The factor does not hold after a failed step or in later
            iterations of a step, where the ratio reached 17; these steps evaluate the elements.
        min_volume_ratio: smallest volume ratio J of an element; below it the step counts as inverted.
    """

    min_reference_force: float = 0.02
    sufficient_decrease: float = 0.1
    max_halvings: int = 5
    contact_tolerance: float = 0.3
    max_contact_solves: int = 12
    stiffness_groups: int = 8
    fast_convergence: float = 0.3
    groups_per_update: int = 2
    max_partial_updates: int = 4
    residual_safety: float = 5.0
    min_volume_ratio: float = 0.02


@dataclass(frozen=True)
class BondedPlacementLimits:
    """Poses of first contact that a reduced solid with a bonded tool accepts.

    Attributes:
        max_offset: largest distance from the first contact of the training, over the contact radius, 1.
        max_rotation: largest rotation relative to the first contact of the training, rad.
    """

    max_offset: float = 0.01
    max_rotation: float = 2e-3


@dataclass(frozen=True)
class TrainingPathDepthAndStepSettings:
    """Settings of the training and test paths.

    Attributes:
        min_depth: smallest depth of an indenting tool, as a fraction of the depth of the box, 1.
        step: largest distance between two poses of a path, as a fraction of the contact radius, 1. Smaller steps take
            more time and record more states.
    """

    min_depth: float = 0.15
    step: float = 1.0 / 16.0


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training of a reduced solid: snapshots, modes (POD) and sampled elements (ECSW).

    Attributes:
        max_iterations: maximum number of Newton iterations of a full-order step.
        max_subdivisions: maximum number of times that the remaining motion of a failed full-order step is
            tried again in 4 times as many steps.
        min_force: smallest force of a state used to choose elements, as a fraction of the largest force with the same
            material.
        sampling_states: maximum number of states used to choose elements. More states take more time and memory.
        min_sampling_bulk_ratio: smallest bulk modulus over mu0 for which elements are chosen. A smaller ratio chooses
            more elements (195 in place of 169) without a more accurate force.
        fine_fraction: largest fraction of the distance to the edge of the top with elements as fine as under the tool.
        singular_value_tolerance: smallest singular value of a mode over the largest one. Snapshots are solved to a
            relative residual of 1e-7; modes with smaller singular values are noise.
        error_modes: number of modes beyond the unknown modes that serve the error estimate only; an even number.
        sampling_error: relative error of the modal forces of the sampled elements, 1. A smaller value samples more
            elements and makes steps slower.
        softness: thickness of the contact layer over the contact radius, 1; see `ReducedModel`.
        first_boundary_path: number of the first boundary path in the file names; larger than the number of any path of
            the sequence.
    """

    max_iterations: int = 40
    max_subdivisions: int = 3
    min_force: float = 0.02
    sampling_states: int = 240
    min_sampling_bulk_ratio: float = 100.0
    fine_fraction: float = 0.9
    singular_value_tolerance: float = 1e-6
    error_modes: int = 4
    sampling_error: float = 6e-3
    softness: float = 1e-3
    first_boundary_path: int = 8000


@dataclass(frozen=True)
class VerificationSettings:
    """Settings of the comparison of a reduced solid with the full-order solid on test paths.

    Attributes:
        test_paths: number of test paths inside the box. More paths take more time and calibrate the error better.
        boundary_fraction: size of the box of the boundary test paths, as a fraction of the box of poses, 1.
        first_test_path: number of the first test path in the sequence of paths; training paths have smaller numbers.
        substeps: number of steps of the reduced solid per step of the full-order solid.
        modes_per_omitted_mode: number of unknown modes per mode that a second, coarser reduced solid omits; the
            coarser solid supplies larger errors for the calibration of the error estimate.
        coverage: fraction of the test states whose error must be within the estimate.
        negligible_error: error of the force over the rms force that the estimate need not cover.
        substantial_error: error of the force over the largest force with the same material; the estimate must cover
            all test states with a larger error. A larger value makes the estimate smaller and less safe.
        absent_lateral_factor: lateral factor (`calibrate_lateral_error_to_force_ratio`) that is used for files of older
            versions, which do not contain the factor. A ball of friction 0.3 has the factor 0.60 with 12 modes and 0.24
            with 24 modes.
    """

    test_paths: int = 3
    boundary_fraction: float = 0.93
    first_test_path: int = 5000
    substeps: int = 8
    modes_per_omitted_mode: int = 4
    coverage: float = 0.95
    negligible_error: float = 0.01
    substantial_error: float = 0.02
    absent_lateral_factor: float = 0.7


#: Relative residual of the modal forces at which a step has converged. The error of the reduction is far larger.
TOLERANCE = 5e-4
#: Settings of the modified Newton method.
SETTINGS = ReducedNewtonSettings()
#: Settings of every training.
TRAINING = TrainingSettings()
#: Settings of every verification.
VERIFICATION = VerificationSettings()
