"""What a simulator knows beside its solver, between two steps."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from numbers import Real
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.explicit_coupling import MotionCheck
from tissue_sim.fem.solver import Step
from tissue_sim.material.effect import ToolHistory
from tissue_sim.model import Model
from tissue_sim.pending_path import PendingPath
from tissue_sim.pose import Pose, Screw, scaled
from tissue_sim.tool_force import Matrix, ToolForce, axial_stiffness, axial_wrench, scaled_matrix
from tissue_sim.tool_track import ToolTrack

#: Age of a stiffness that was not found yet.
NEVER = 1 << 30


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """What the last equilibrium answers, and where.

    Attributes:
        stiffness: the tissue's own.
        stiffness_age: how many inertial equilibria ago that was found.
        step_stiffness: within the step, where the mass was taken into account.
        stiffness_time: time between the equilibrium whose stiffness it is and this one, s.
    """

    pose: Pose
    wrench: Screw
    stiffness: Matrix
    inertial: bool
    stiffness_age: int = 0
    step_stiffness: Matrix | None = None
    stiffness_time: float = 0.0

    def followed_by(self, step: Step, pose: Pose, share: float, inertial: bool, dt: float = 0.0) -> Equilibrium:
        """The next one, at a pose, of whose forces effects on the whole force leave a share; after an inertial step
        without the tissue's own stiffness with that of this one.

        Raises:
            TypeError: the solver breaks its contract.
        """
        own, within, wrench = step.stiffness_matrix, step.step_stiffness_matrix, step.wrench
        if own is None and within is None:
            raise TypeError("the solver was asked for stiffness, and its step has none; see Solver.ask_for_stiffness")
        if share != 1.0:
            wrench = scaled(share, wrench)
            own = None if own is None else scaled_matrix(share, own)
            within = None if within is None else scaled_matrix(share, within)
        if own is None:
            return Equilibrium(pose, wrench, self.stiffness, inertial, self.stiffness_age + 1, within,
                               self.stiffness_time + dt)
        return Equilibrium(pose, wrench, own, inertial, 0, within, step.stiffness_age)

    @classmethod
    def in_air(cls, pose: Pose) -> Equilibrium:
        """Of a tool at a pose that touches nothing."""
        return cls(pose, AT_REST.wrench, AT_REST.stiffness, False, NEVER)


#: Of a tool that touches nothing.
AT_REST = Equilibrium(Pose.at_depth(0.0), axial_wrench(0.0), axial_stiffness(0.0), False, NEVER)


@dataclass(frozen=True, slots=True)
class Attempt:
    """An iteration for the equilibrium at a pose, a time step (s) later, that the next step or part goes on with.

    Attributes:
        order: highest one of the extrapolation with which it began.
        limit: how many linear solves there may be; spent: so far.
    """

    pose: Pose
    dt: float
    order: int
    limit: int
    spent: int = 0


@dataclass(slots=True)
class Creep:
    """The tissue on its way to an equilibrium at a pose, a time step (s) later, and its last step there."""

    pose: Pose
    dt: float
    last: Step
    steps: Generator[Step] = field(init=False)
    _allowed: int = field(init=False, default=1)

    def may_take(self) -> int:
        """Linear solves until the next step is yielded, or what there is of it."""
        return self._allowed

    def go_on(self, allowed: int) -> Step | None:
        """The next step, or as much of it as so many linear solves bring; None: it was the last one."""
        self._allowed = allowed
        step = next(self.steps, None)
        self.last = step or self.last
        return step


@dataclass(frozen=True)
class StateOrigin:
    """Origin of a saved state. A simulator restores states whose origin equals that of its own states.

    Attributes:
        solver: name.
        mesh: digest of the undeformed mesh.
        experiment: specimen, tool, interfaces, approach and laws of contact, as text.
        material: law, effects and layers, without the values of parameters, as text.
    """

    solver: str
    mesh: str
    experiment: str
    material: str

    @classmethod
    def of(cls, solver: str, mesh: str, model: Model) -> StateOrigin:
        """Of a model in a solver whose mesh has this digest."""
        experiment = {each.name: getattr(model.experiment, each.name) for each in fields(model.experiment)
                      if each.name != "protocol"}
        return cls(solver, mesh, repr(experiment), structure(model.material))

    def require(self, other: StateOrigin) -> None:
        """Refuse the state of another origin.

        Raises:
            InputError: another solver, mesh, experiment or structure of the material.
        """
        for name, what in (("solver", "solver"), ("experiment", "specimen, tool or interface"),
                           ("material", "law or with other effects or layers"), ("mesh", "mesh")):
            if getattr(self, name) != getattr(other, name):
                raise InputError(f"must be of the same model and mesh; this state is of another {what}. Restore it in "
                                 "the simulator that saved it, or in a clone() of that one.", field="state")


def structure(value: Any) -> str:
    """Text of a material without the values of its numbers, its name and its bulk response."""
    if is_dataclass(value):
        inner = [f"{each.name}={structure(getattr(value, each.name))}" for each in fields(value)
                 if each.name not in ("name", "bulk", "parameters", "density", "source")]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {structure(entry)}" for key, entry in sorted(value.items())) + "}"
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(structure, value)) + "]"
    return "None" if value is None else "number" if isinstance(value, Real) else type(value).__name__


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """State of a simulator between two steps; see `Simulator.save`."""

    origin: StateOrigin
    solver: Any
    answer: ToolForce
    equilibrium: Equilibrium
    tool: ToolTrack
    pose: Pose
    leaps: bool
    pending: PendingPath
    lingers: float
    share: float
    begins: bool
    largest_force: float
    motion_check: MotionCheck
    history: ToolHistory
    error: float | None
