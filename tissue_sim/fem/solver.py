"""What a solver of the tissue is to the rest of the program: a specimen and a tool, stepped from pose to pose.

`simulate`, `Simulator`, `sensitivities` and what shows the tissue speak to `Solver` only. Solvers stand by name in
`SOLVERS`; a package adds its own with an entry point of the group ``tissue_sim.solvers``, a program with
``SOLVERS.register(MySolver, "my_solver")``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from tissue_sim.fem.free_tool import FreeTool
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw
from tissue_sim.registry import Registry
from tissue_sim.tool_force import Matrix, NextForce, axial_stiffness, axial_wrench


class StepStatus(IntEnum):
    """How a step ended."""

    CONVERGED = 1
    INVERTED = 2
    INDEFINITE = 3
    SLOW = 4
    DIVERGED = 5
    OUTSIDE = 6

    @property
    def message(self) -> str:
        return {
            StepStatus.CONVERGED: "converged",
            StepStatus.INVERTED: "an element turned inside out",
            StepStatus.INDEFINITE: "the tangent lost positive definiteness, so the equilibrium is no longer stable",
            StepStatus.SLOW: "Newton's iteration did not reach its tolerance",
            StepStatus.DIVERGED: "Newton's iteration diverged",
            StepStatus.OUTSIDE: "the tool left the box of poses for which the reduced model was made",
        }[self]


class OwnStiffness(IntEnum):
    """Request for the stiffness of the tissue without its mass, after an inertial step; True is `IF_LEFT`."""

    #: It is not computed.
    OMITTED = 0
    #: It is computed if the step converged with fewer linear solves than it may take.
    IF_LEFT = 1
    #: It is computed if the step converged; a linear solve is reserved for it.
    RESERVED = 2

    @staticmethod
    def is_due(request: int, has_left: bool) -> bool:
        """Whether a step that converged computes it, given whether the step has a linear solve left."""
        return request == OwnStiffness.RESERVED or (bool(request) and has_left)


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a solver.

    Attributes:
        status: how it ended.
        iterations: linear solves.
        residual: norm of unbalanced over balanced forces at the end.
        wrench: force, then torque about the tool's deepest point, on the tool, N and N m; only meaningful when
            converged.
        stiffness_matrix: the tissue's own, without the mass: minus the derivative of the wrench with (position,
            rotation vector), 6 x 6, where it is asked for; else None.
        violation: the largest of a contact condition (penetration, or slip of what must not slip), m.
        slipping: how many points of the surface slip against friction.
        dissipated: by the drag of a step that crept, J.
        step_stiffness_matrix: the same within an inertial step, which its mass resists; None: no other.
        force_error: estimate of how far the force may be off, N; None: the solver has none.
        stiffness_age: time between the oldest state from which a part of `stiffness_matrix` was computed and this one,
            s; 0 if all of it belongs to this state.
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
    def axial(cls, status: StepStatus, iterations: int, residual: float, force: float, violation: float = 0.0,
              slipping: int = 0, stiffness: float | None = None) -> Step:
        """Of a solver that knows the motion along z only: force, N, and stiffness, N/m."""
        return cls(status, iterations, residual, axial_wrench(force),
                   None if stiffness is None else axial_stiffness(stiffness), violation, slipping)

    @property
    def force(self) -> float:
        """On the tool along z, N, positive when the tissue pushes back."""
        return self.wrench[2]

    @property
    def found_own_stiffness(self) -> bool:
        """Whether this is an inertial step that was looked at without its mass, too."""
        return self.step_stiffness_matrix is not None and self.stiffness_matrix is not None

    @property
    def stiffness(self) -> float:
        """How the force along z grows with depth, N/m; 0 where nobody asked."""
        return 0.0 if self.stiffness_matrix is None else self.stiffness_matrix[2][2]


@dataclass(frozen=True, slots=True)
class Rung:
    """One of a ladder of resolutions for real time.

    Attributes:
        resolution: its name.
        force_error: largest known error of the force, over the force.
    """

    resolution: str
    force_error: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """What tells how far the force of a resolution errs.

    Attributes:
        resolution: another one.
        share: of the difference between the two, this one with twice as many samples, that is the error of this one.
    """

    resolution: str
    share: float


class Fields(Protocol):
    """Fields of the samples of a simulation, computed when asked for."""

    @property
    def mesh(self) -> Any:
        """Undeformed, in the solver's own terms."""

    @property
    def material(self) -> Material:
        """What the tissue is made of."""

    @property
    def names(self) -> Collection[str]:
        """Of the fields that are known; see `tissue_sim.fem.fields.FIELD_UNITS`."""

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Of the nodes, m, shape (nodes, as many as a node has coordinates)."""

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """A field at the quadrature points, shape (elements, q)."""

    def at_nodes(self, name: str, sample: int = -1) -> np.ndarray:
        """A field at the nodes, shape (nodes,)."""

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Smallest and largest principal stretch in the tissue, but for a hundredth of its volume at either end."""


@runtime_checkable
class SharedFields(Fields, Protocol):
    """Fields that a loop publishes for viewers in other processes."""

    def arrays(self) -> tuple[np.ndarray, ...]:
        """What differs from sample to sample; all else is sent once."""

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> SharedFields:
        """The fields of another sample."""

    def of_the_material(self) -> dict[str, Any]:
        """What another material of the same make changes beside the arrays."""

    def with_material(self, changed: Mapping[str, Any]) -> SharedFields:
        """The fields with what `of_the_material` of another material gave."""


class Surface(Protocol):
    """The deformed surface of the tissue, in the frame of the scene."""

    @property
    def outline(self) -> np.ndarray | None:
        """(r, z) of an axisymmetric specimen, m, shape (n, 2); None of another one."""

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Vertices, m, shape (v, 3), and triangles, shape (t, 3), their normals out of the tissue; `segments` around
        the axis where there is one."""


class Derivatives(Protocol):
    """Rates of the wrench's force along z with parameters of the material, carried along with a solver's steps.

    Attributes:
        force: dF/dtheta at the last committed step, N per unit, shape (parameters,).
    """

    force: np.ndarray

    def pop_changed(self) -> bool:
        """Whether since the last call the contact changed, so that the force has a kink in the parameters."""


@runtime_checkable
class SpatialDerivatives(Derivatives, Protocol):
    """Those of a solver that knows the force in space.

    Attributes:
        vector: of the force on the tool in the frame of the scene, N per unit, shape (parameters, 3).
    """

    vector: np.ndarray


#: For each parameter the material with a little more and with a little less of it, and the difference.
Neighbours = Sequence[tuple[Material, Material, float]]


class Solver(FreeTool, ABC):
    """A stateful solver of one boundary-value problem.

    Attributes:
        mesh: undeformed, in the solver's own terms; None where it has none.
        datum: height of the tool's deepest point where it first touches, in the frame of the mesh, m.
    """

    mesh: Any = None
    datum: float = 0.0
    #: Highest order of extrapolation that `step` knows.
    highest_order: ClassVar[int] = 2

    @property
    @abstractmethod
    def pose(self) -> Pose:
        """Of the tool at the last committed state."""

    @property
    def unchanged(self) -> int:
        """Equilibria since what touches, sticks or slips last changed; a predictor of higher order than that would lead
        astray."""
        return self.highest_order

    def follow(self, pose: Pose) -> Pose:
        """What this solver takes of a pose: an axisymmetric one the depth only."""
        return pose

    def takes(self, pose: Pose) -> bool:
        """Whether the tool may be there; a step to anywhere else is `StepStatus.OUTSIDE`."""
        return True

    @abstractmethod
    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """Move the tool to a pose and find equilibrium; commits the state only when it converges.

        Args:
            pose: as `follow` returns it.
            dt: time since the step before, s; it matters where the material relaxes, and with inertia.
            tolerance: unbalanced over balanced forces.
            max_iterations: linear solves before giving up.
            predictor_order: highest order of extrapolation from earlier steps (0: none).
            inertial: whether the mass of the tissue counts; `follow_motion` must have been called, and dt be positive.
            resumes: go on from where the step before, which did not converge, ended; dt counts from the last one that
                did.
            own_stiffness: whether an inertial step also answers the stiffness of the tissue without its mass; see
                `OwnStiffness`.
        """

    def creep(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
              allowed: Callable[[], int] | None = None) -> Generator[Step]:
        """Steps to a pose that `step` does not reach, against a drag that is let go: where equilibrium is lost the
        tissue snaps to another one. The last one has converged without drag; if it has not, the state is as it was.
        Closed on the way, too. A solver that cannot creep yields none.

        Args:
            pose, dt, tolerance: as of `step`.
            max_iterations: linear solves of a step before it is given up.
            allowed: asked how many linear solves there may be until something is yielded, at least one; a step that
                ends so yields itself as slow and goes on. None: as many as it takes.
        """
        return
        yield

    @classmethod
    def realtime_rungs(cls, model: Model) -> Sequence[Rung]:
        """Resolutions of a model for real time, the finest first, of which `Simulator` takes what the computer can do;
        empty of a solver that has none to choose from."""
        return ()

    @classmethod
    def comparison(cls, resolution: str) -> Comparison | None:
        """With which resolution a test is compared to tell its error; None of a solver, or a mesh, that knows none."""
        return None

    @abstractmethod
    def save(self) -> Any:
        """All that a committed step leaves behind, for `restore`: a frozen dataclass."""

    @abstractmethod
    def restore(self, saved: Any) -> None:
        """Go back to where `save` was called, in this solver or in one of the same model and mesh."""

    @abstractmethod
    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept.

        Raises:
            InputError: a material that the solver cannot take; nothing is changed.
        """

    @abstractmethod
    def lift_off(self) -> None:
        """Take the tool away at once: the tissue is where it was before the touch, but remembers what it went
        through. For a tool that is out of the tissue when no way there was found."""

    @abstractmethod
    def ask_for_stiffness(self) -> None:
        """Let every step answer its stiffness matrix from now on."""

    def follow_motion(self, density: float) -> bool:
        """Let the tissue have a mass (kg/m3) from now on, for steps that are inertial; whether the solver knows of
        mass."""
        return False

    def ahead(self, dt: float) -> NextForce | None:
        """What a next step of dt (s) would answer, just after an inertial one that converged; None where the solver
        does not know: then a virtual coupling is not stable on tissue that is heavy."""
        return None

    def differentiate(self, neighbours: Neighbours) -> Derivatives | None:
        """Carry exact derivatives along from now on, before the first step; None where the solver has none."""
        return None

    @abstractmethod
    def sample(self) -> Any:
        """What `fields` needs of the last committed state."""

    @abstractmethod
    def fields(self, samples: Sequence[Any]) -> Fields | None:
        """Fields of states that `sample` gave; None of a solver that has none."""

    @abstractmethod
    def surface(self) -> Surface:
        """The surface at the last committed state."""

    def doubts(self) -> Sequence[str]:
        """Why the force at the last committed state may be wrong, though it is an equilibrium: sentences, mostly
        none."""
        return ()

    @abstractmethod
    def report(self) -> dict[str, Any]:
        """What a recording's metadata say of the solver: ``element``, ``mesh``; with contact ``penetration_mm`` and
        ``penetration_tolerance_mm``, with friction ``slipping_points``, which grow with the steps; of a specimen that
        weighs ``self_weight`` {sag_mm, moulded_height_mm}."""


class SolverMaker(Protocol):
    """What stands in `SOLVERS`: a class or a function."""

    def __call__(self, model: Model, *, resolution: str, mesh: Any = None, topology: Model | None = None) -> Solver:
        """The solver of a model, its tool where it first touches the specimen.

        Args:
            model: experiment and material; the rig is not its business.
            resolution: one of the solver's own names, ``"fast"``, ``"accurate"`` and ``"realtime"`` among them.
            mesh: of the solver's own kind, instead.
            topology: a model whose mesh is taken, or of which `mesh` is one, and moved to the geometry of this one;
                None: this one's own.

        Raises:
            InputError: an unknown resolution, or a model that the solver cannot take.
            ConvergenceError: the specimen does not stand under its own weight.
            MissingBackendError: Taichi is not there.
        """


SOLVERS: Registry[SolverMaker] = Registry(
    "solver", "tissue_sim.solvers", {"axisymmetric": "tissue_sim.fem.axisymmetric.discretisation:make_solver",
                                   "solid": "tissue_sim.fem.solid.discretisation:make_solver",
                                   "reduced": "tissue_sim.fem.reduced.solver:make_solver"})

