"""Contract of solvers: a boundary-value problem of a specimen and a tool, solved step by step from pose to pose.

`simulate`, `Simulator`, `sensitivities` and the viewer use this contract only. `SOLVERS` contains the solvers by name.
A package adds a solver by an entry point of the group ``tissue_sim.solvers``, a program by ``SOLVERS.register(MySolver,
"my_solver")``.

`ToolInAirInterface` is the contract for a tool in the air, before the first touch and after lift-off. Its defaults are
valid for every solver: the tool first touches where its deepest point reaches z = 0, and after that every motion is
stepped.
"""

from __future__ import annotations

import hashlib
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from tissue_sim.fem.result_views import Fields as Fields
from tissue_sim.fem.result_views import SharedFields as SharedFields
from tissue_sim.fem.result_views import Surface as Surface
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw
from tissue_sim.public_names import make_getattr_for_old_names, rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry
from tissue_sim.tool_force import Matrix, PredictedForceOfNextStep, make_axial_stiffness_matrix, make_axial_wrench

#: Tissue that has moved by less than this fraction of the tolerance of the contact is at rest.
AT_REST = 0.1


class ToolInAirInterface:
    """Interface of a `tissue_sim.fem.solver.Solver` for a tool in the air, before and after contact."""

    mesh: Any = None
    #: Whether the rotation of the tool about its own axis at the touch has no influence, as for a body of revolution.
    #: It is then removed from the poses that the solver gets.
    ignores_twist: ClassVar[bool] = False

    @property
    def is_time_dependent(self) -> bool:
        """Whether the tissue changes with time while the tool rests, so that steps are needed without contact too."""
        return True

    def mesh_digest(self) -> str:
        """Return a digest of the undeformed mesh; a saved state can be restored on a mesh with the same digest."""
        return digest_arrays(getattr(self.mesh, "nodes", None), getattr(self.mesh, "connectivity", None))

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must move down from a pose to touch the undeformed tissue.

        Called before the first touch.

        Returns:
            Distance, m, or a positive lower bound of the distance; zero or negative if the tool touches.
        """
        return pose.position[2]

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """Place the tool at the pose of its first touch on undeformed tissue; return whether the tool was placed.

        A solver whose mesh, contact or reference belongs to one position of the tool moves them to `pose`, so that the
        tool drags no tissue there.

        Returns:
            True if the tool was placed; False if the solver cannot place the tool at this pose and has changed nothing.
        """
        return True

    def clearance(self, pose: Pose) -> float | None:
        """Return the distance between the tool at a pose and the tissue at the last committed state.

        Returns:
            Distance, m, negative if the tool is inside the tissue; or another number with the same sign. None if the
            tool touches, holds or attracts tissue at the last committed state, or if the solver cannot compute the
            distance: then every motion is stepped.
        """
        return None

    def move_in_air(self, pose: Pose) -> None:
        """Set the pose of the tool without solving a step; `clearance` must be positive there and on the path."""

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Prepare the next touch of a lifted tool at a pose in the air; return whether it is like a first touch.

        Elastic tissue that is at rest again is touched as at the first touch: the solver returns to the state in which
        the tool just touches, so that the whole face sticks from the touch on. Otherwise the tool moves to the pose in
        the air. A solver whose mesh belongs to one position of the tool may move it here.

        Returns:
            Whether the touch begins as a first touch: the solver is in the state in which the tool just touches.
        """
        self.move_in_air(pose)
        return False

    def bind_points_on_path(self, pose: Pose) -> None:
        """Bind the surface points that the tool touches on its path to a pose, so that stick or friction acts on them.

        Called before the first increment of a touch that does not begin as a first touch (`move_to_next_touch`);
        without this call the tissue that touches within an increment slides without friction until its end.
        """

    def stop_tissue_motion(self) -> None:
        """Set the velocity of the tissue to zero."""


def digest_arrays(*arrays: np.ndarray | None) -> str:
    """Return a hexadecimal BLAKE2 digest of shapes, types and contents of arrays; "" if all are None."""
    known = [array for array in arrays if array is not None]
    found = hashlib.blake2b(digest_size=16)
    for array in known:
        found.update(f"{array.shape}{array.dtype}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest() if known else ""


#: Members of `Solver` that plug-ins may still define by their old names: old name -> new name.
_OLD_MEMBERS = {"doubts": "warnings", "follow": "project_pose", "takes": "accepts_pose",
                "realtime_rungs": "realtime_levels", "comparison": "error_estimation_rule", "sample": "field_sample",
                "surface": "deformed_surface", "approach": "move_to_next_touch", "meet": "bind_points_on_path",
                "creep": "iterate_steps_with_damping", "follow_motion": "enable_inertia", "ahead": "predict_next_force",
                "unchanged": "equilibria_since_contact_change", "relaxes": "is_time_dependent",
                "identity": "mesh_digest", "height_above": "height_above_tissue",
                "place_tool": "place_tool_at_first_touch", "stand_still": "stop_tissue_motion",
                "error_estimate": "error_estimation_rule", "lift_off": "reset_to_first_touch",
                "ask_for_stiffness": "enable_stiffness_output", "report": "get_recording_metadata",
                "step_with_damping": "iterate_steps_with_damping", "differentiate": "enable_force_derivatives"}
__getattr__ = make_getattr_for_old_names(__name__, {
    "Rung": "ResolutionLevel", "Comparison": "ErrorEstimationRule", "ErrorEstimate": "ErrorEstimationRule",
    "OwnStiffness": "StaticStiffnessRequest", "Derivatives": "ForceDerivatives",
    "SpatialDerivatives": "ForceVectorDerivatives", "FreeTool": "ToolInAirInterface"})


class StepStatus(IntEnum):
    """Status with which a step of a solver ends.

    Only CONVERGED commits a new state. `message` states the cause.
    """

    CONVERGED = 1
    INVERTED = 2
    INDEFINITE = 3
    SLOW = 4
    DIVERGED = 5
    OUTSIDE = 6

    @property
    def message(self) -> str:
        """Cause of the status in one phrase, for messages and recordings."""
        return {
            StepStatus.CONVERGED: "converged",
            StepStatus.INVERTED: "an element turned inside out or left the domain of the law",
            StepStatus.INDEFINITE: "the tangent lost positive definiteness, so the equilibrium is no longer stable",
            StepStatus.SLOW: "Newton's iteration did not reach its tolerance",
            StepStatus.DIVERGED: "Newton's iteration diverged",
            StepStatus.OUTSIDE: "the tool left the box of poses for which the reduced model was made",
        }[self]


class StaticStiffnessRequest(IntEnum):
    """Request for the static stiffness of the tissue, without its mass, after an inertial step; True is `IF_LEFT`."""

    #: The stiffness is not computed.
    OMITTED = 0
    #: The stiffness is computed if the step converged with fewer linear solves than its limit.
    IF_LEFT = 1
    #: The stiffness is computed if the step converged; one linear solve is reserved for the stiffness.
    RESERVED = 2

    @staticmethod
    def needs_stiffness_given_spare_solve(request: int, has_left: bool) -> bool:
        """Return whether a converged step computes the stiffness; `has_left`: one of its linear solves is unused."""
        return request == StaticStiffnessRequest.RESERVED or (bool(request) and has_left)


@with_old_names(axial="from_axial_force")
@dataclass(frozen=True, slots=True)
class Step:
    """Result of one step of a solver.

    Attributes:
        status: how the step ended.
        iterations: number of linear solves.
        residual: relative residual at the end, norm of the unbalanced forces over norm of the balanced forces.
        wrench: force, then torque about the tool's deepest point, on the tool, N and N m, shape (6,); valid only if
            converged.
        stiffness_matrix: static stiffness of the tissue, without its mass: minus the derivative of the wrench with
            respect to (position, rotation vector), 6 x 6, N/m, N, N m; None if it was not requested.
        violation: largest violation of a contact condition (penetration, or slip of points that must stick), m.
        slipping: number of surface points that slip against friction.
        dissipated: energy dissipated by the artificial viscous damping of `Solver.iterate_steps_with_damping`, J.
        step_stiffness_matrix: the same derivative within an inertial step, which includes the inertia of the tissue;
            None: no other than `stiffness_matrix`.
        force_error: estimated error of the force, N; None if the solver has no estimate.
        stiffness_age: time between the oldest state from which a part of `stiffness_matrix` was computed and this
            state, s; 0 if the whole matrix belongs to this state.
    """

    status: StepStatus
    iterations: int
    residual: float
    wrench: Screw
    stiffness_matrix: Matrix | None = None
    violation: float = 0.0
    slipping: int = 0
    dissipated: float = 0.0
    step_stiffness_matrix: Matrix | None = None
    force_error: float | None = None
    stiffness_age: float = 0.0

    @classmethod
    def from_axial_force(cls, status: StepStatus, iterations: int, residual: float, force: float,
                         violation: float = 0.0,
                         slipping: int = 0, stiffness: float | None = None,
                         step_stiffness: float | None = None) -> Step:
        """Make the result of a step with axial motion only, from the force along z, N, and the stiffnesses, N/m."""
        return cls(status, iterations, residual, make_axial_wrench(force),
                   None if stiffness is None else make_axial_stiffness_matrix(stiffness), violation, slipping, 0.0,
                   None if step_stiffness is None else make_axial_stiffness_matrix(step_stiffness))

    @property
    def force(self) -> float:
        """Force on the tool along z, N, positive if the tissue pushes the tool out."""
        return self.wrench[2]

    @property
    def has_static_and_step_stiffness(self) -> bool:
        """Whether the result contains two stiffnesses: that of the inertial step, and the static one without mass."""
        return self.step_stiffness_matrix is not None and self.stiffness_matrix is not None

    @property
    def stiffness(self) -> float:
        """Derivative of the force along z with respect to depth, N/m; 0 if the stiffness was not requested."""
        return 0.0 if self.stiffness_matrix is None else self.stiffness_matrix[2][2]


@dataclass(frozen=True, slots=True)
class ResolutionLevel:
    """Resolution of a real-time mesh, with its largest known force error.

    Attributes:
        resolution: name of the resolution.
        force_error: largest known relative error of the force, 1.
    """

    resolution: str
    force_error: float


@dataclass(frozen=True, slots=True)
class ErrorEstimationRule:
    """Rule that estimates the error of the force of a resolution from a second solution.

    Attributes:
        resolution: name of the resolution of the second solution.
        fraction: error over the difference between the two solutions, where this one has twice as many samples.
    """

    resolution: str
    fraction: float


class ForceDerivatives(Protocol):
    """Derivatives of the force along z with respect to parameters, updated by each step of a solver.

    Attributes:
        force: dF/dtheta at the last committed step, N per unit of the parameter, shape (parameters,).
    """

    force: np.ndarray

    def pop_contact_changed_flag(self) -> bool:
        """Return whether the contact changed since the last call, which is a kink of the force; then reset the flag."""


@runtime_checkable
class ForceVectorDerivatives(ForceDerivatives, Protocol):
    """Derivatives of a solver that computes the force vector.

    Attributes:
        vector: derivatives of the force on the tool in the frame of the scene, N per unit of the parameter, shape
            (parameters, 3).
    """

    vector: np.ndarray


#: For each parameter: material with the parameter increased, material with it decreased, and the difference.
Neighbours = Sequence[tuple[Material, Material, float]]


class ExperimentDerivatives(NamedTuple):
    """Derivatives of inputs from the experiment with respect to a parameter, 1 per unit of the parameter.

    Attributes:
        face: derivative of the coefficient of friction of the tool's face.
        shaft: derivative of the coefficient of friction of the tool's shaft.
        base: derivative of the coefficient of friction of the base.
        neighbour_solvers: for a parameter of the geometry, the solvers of the models with the parameter increased and
            decreased, before their first step, on the same elements with moved nodes; None: the geometry is constant.
            The difference of the two values is that of `Neighbours`.
    """

    face: float = 0.0
    shaft: float = 0.0
    base: float = 0.0
    neighbour_solvers: tuple[Any, Any] | None = None


#: Paths of the coefficients of friction.
FRICTION_PATHS = frozenset(f"experiment.{name}" for name in ("friction", "friction_base", "friction_wall"))


def _has_argument(function: Callable, name: str) -> bool:
    """Return whether a function has an argument of a name, or any number of positional arguments."""
    arguments = inspect.signature(function).parameters
    return name in arguments or any(each.kind is each.VAR_POSITIONAL for each in arguments.values())


@with_old_names(**_OLD_MEMBERS)
class Solver(ToolInAirInterface, ABC):
    """Solver of one boundary-value problem; it holds the state of the tissue.

    Attributes:
        mesh: undeformed mesh, of a type of the solver; None if it has none.
        datum: height of the tool's deepest point at its first touch, in the frame of the mesh, m.
    """

    mesh: Any = None
    datum: float = 0.0
    #: Largest known relative error of the force on the mesh of the solver, 1; None if unknown.
    stated_force_error: float | None = None
    #: Highest order of extrapolation that `step` implements.
    highest_order: ClassVar[int] = 2
    #: Paths of the parameters of the experiment with exact derivatives, for which `enable_force_derivatives` has the
    #: argument `experiments`. A subclass whose method lacks this argument inherits none.
    exact_experiment_parameters: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, _OLD_MEMBERS)
        if not _has_argument(cls.enable_force_derivatives, "experiments"):
            if "exact_experiment_parameters" not in vars(cls):
                cls.exact_experiment_parameters = frozenset()
            # A property of the class is replaced by a constant of the subclass.
            cls.differentiates_geometry = False  # type: ignore[method-assign, assignment]

    @property
    def differentiates_geometry(self) -> bool:
        """Whether `enable_force_derivatives` has derivatives with respect to parameters of the geometry.

        The solver then uses `ExperimentDerivatives.neighbour_solvers`.
        """
        return False

    @property
    @abstractmethod
    def pose(self) -> Pose:
        """Pose of the tool at the last committed state."""

    @property
    def equilibria_since_contact_change(self) -> int:
        """Number of converged steps since the set of touching, sticking or slipping points last changed.

        A predictor of higher order than this number would extrapolate across the change.
        """
        return self.highest_order

    def project_pose(self, pose: Pose) -> Pose:
        """Return the part of a pose that this solver uses; an axisymmetric solver uses the depth only."""
        return pose

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the solver computes an accurate force at a pose; callers check this before a step."""
        return True

    def describe_domain(self) -> str:
        """Return a phrase that describes the poses at which the solver computes a force."""
        return "an unspecified range of poses"

    @abstractmethod
    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Move the tool to a pose and solve for equilibrium; the state is committed only if the step converges.

        Args:
            pose: result of `project_pose`.
            dt: time since the last step, s; used by materials that relax, and by inertia.
            tolerance: largest relative residual, 1.
            max_iterations: largest number of linear solves.
            predictor_order: highest order of extrapolation from earlier steps (0: none).
            inertial: whether the mass of the tissue acts; requires `enable_inertia` before, and dt > 0.
            resumes: continue Newton's iteration of the last step, which did not converge; dt counts from the last
                converged step.
            own_stiffness: whether an inertial step also computes the static stiffness; see `StaticStiffnessRequest`.
        """

    def iterate_steps_with_damping(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9,
                                   max_iterations: int = 20, allowed: Callable[[], int] | None = None
                                   ) -> Generator[Step]:
        """Find the equilibrium at a pose that `step` does not reach, with artificial viscous damping.

        Where an equilibrium is lost the tissue snaps through to another one. The damping is reduced to zero on the
        way, so that the last step has converged without damping; if it has not, the state is restored, also if the
        generator is closed early. A solver without this method yields nothing.

        Args:
            pose: as in `step`.
            dt: as in `step`.
            tolerance: as in `step`.
            max_iterations: largest number of linear solves of one step.
            allowed: returns the number of linear solves, at least one, that may be used until the next yield; a step
                that uses them up is yielded as SLOW and continues afterwards. None: no limit.

        Yields:
            Each step.
        """
        return
        yield

    @classmethod
    def realtime_levels(cls, model: Model) -> Sequence[ResolutionLevel]:
        """Return the resolutions of a model for real time, the finest first; empty if the solver has only one.

        `Simulator` uses the finest resolution that the computer can step in time.
        """
        return ()

    @classmethod
    def error_estimation_rule(cls, resolution: str) -> ErrorEstimationRule | None:
        """Return the rule that estimates the force error of a resolution; None if the solver has none."""
        return None

    @abstractmethod
    def save(self) -> Any:
        """Return the committed state for `restore`: a frozen dataclass."""

    @abstractmethod
    def restore(self, saved: Any) -> None:
        """Restore a state of `save` of this solver, or of a solver of the same model and mesh."""

    @abstractmethod
    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept.

        Raises:
            InputError: the solver does not support the material; nothing is changed.
        """

    @abstractmethod
    def reset_to_first_touch(self) -> None:
        """Remove the tool at once: the tissue returns to its state before the first touch, with its material history.

        Used for a tool outside of the tissue if no path of equilibria was found.
        """

    @abstractmethod
    def enable_stiffness_output(self) -> None:
        """Make every step from now on compute its stiffness matrix, `Step.stiffness_matrix`."""

    def enable_inertia(self, density: float) -> bool:
        """Give the tissue a mass, so that steps may be inertial; return whether the solver supports inertia.

        Args:
            density: kg/m3.

        Returns:
            Whether the solver supports inertia.
        """
        return False

    def predict_next_force(self, dt: float) -> PredictedForceOfNextStep | None:
        """Predict the force of the next step, directly after an inertial step that converged.

        Args:
            dt: length of the next step, s.

        Returns:
            None if the solver cannot predict the force; a virtual coupling is then unstable on heavy tissue.
        """
        return None

    def enable_force_derivatives(self, neighbours: Neighbours,
                                 experiments: Sequence[ExperimentDerivatives] | None = None) -> ForceDerivatives | None:
        """Make every step compute exact derivatives of the force; None if not supported. Call before the first step.

        Args:
            neighbours: materials around each parameter.
            experiments: derivatives of the inputs from the experiment with respect to each parameter; None: zero. Given
                only for parameters of `exact_experiment_parameters`, and of the geometry if `differentiates_geometry`.
        """
        return None

    @abstractmethod
    def field_sample(self) -> Any:
        """Return the data of the last committed state that `fields` needs."""

    @abstractmethod
    def fields(self, samples: Sequence[Any]) -> Fields | None:
        """Return the fields of several states, one result of `field_sample` each; None if the solver has no fields."""

    @abstractmethod
    def deformed_surface(self) -> Surface:
        """Return the deformed surface of the tissue at the last committed state."""

    def warnings(self) -> Sequence[str]:
        """Return reasons, as sentences, why the force of the last committed step may be wrong; usually none."""
        return ()

    @abstractmethod
    def get_recording_metadata(self) -> dict[str, Any]:
        """Return the metadata of the solver for a recording.

        Keys: ``element``, ``mesh``; with contact ``penetration_mm`` and ``penetration_tolerance_mm``; with friction
        ``slipping_points``; under self-weight ``self_weight`` {sag_mm, moulded_height_mm}. Some are maxima of steps.
        """


class SolverMaker(Protocol):
    """Entry of `SOLVERS`: a class or a function that makes a solver."""

    def __call__(self, model: Model, *, resolution: str, mesh: Any = None, topology: Model | None = None) -> Solver:
        """Return the solver of a model, its tool at the first touch of the specimen.

        Args:
            model: experiment and material; the rig is not used.
            resolution: name of a resolution of the solver, among them ``"fast"``, ``"accurate"`` and ``"realtime"``.
            mesh: mesh to use instead, of the solver's type.
            topology: model whose mesh (or `mesh`, which belongs to it) is moved to the geometry of `model`; None: the
                mesh of `model`.

        Raises:
            InputError: an unknown resolution, or a model that the solver does not support.
            ConvergenceError: the specimen has no equilibrium under its own weight.
            MissingBackendError: Taichi is not installed.
        """


#: Name -> class or function that makes a solver.
SOLVERS: Registry[SolverMaker] = Registry(
    "solver", "tissue_sim.solvers", {"axisymmetric": "tissue_sim.fem.axisymmetric.discretisation:make_solver",
                                     "solid": "tissue_sim.fem.solid.discretisation:make_solver",
                                     "reduced": "tissue_sim.fem.reduced.solver:make_solver"})
