"""State of a simulator between two steps, without that of its solver."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from numbers import Real
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.fem.solver import Step
from tissue_sim.material.effect import ToolHistory
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw, scale_screw
from tissue_sim.realtime.inertia_limits import ToolReversalDetector
from tissue_sim.realtime.pending_path import PendingPath
from tissue_sim.realtime.tool_track import ToolTrack
from tissue_sim.tool_force import Matrix, ToolForce, make_axial_stiffness_matrix, make_axial_wrench, scale_matrix

#: Age of a stiffness that has not been computed yet.
NEVER = 1 << 30


@dataclass(frozen=True, slots=True)
class LastEquilibrium:
    """Result of the last equilibrium, and the pose of the tool.

    Attributes:
        stiffness: static stiffness of the tissue.
        stiffness_age: number of inertial equilibria since that stiffness was computed.
        step_stiffness: stiffness within an inertial step; None after a static one.
        stiffness_time: time between the equilibrium whose stiffness it is and this one, s.
    """

    pose: Pose
    wrench: Screw
    stiffness: Matrix
    inertial: bool
    stiffness_age: int = 0
    step_stiffness: Matrix | None = None
    stiffness_time: float = 0.0

    def make_next_equilibrium(self, step: Step, pose: Pose, share: float, inertial: bool,
                              dt: float = 0.0) -> LastEquilibrium:
        """Return the equilibrium after a converged step; the stiffness of this one is kept if the step has none.

        Args:
            step: result of the solver.
            pose: pose of the tool.
            share: factor of effects in reduced form on the force.
            inertial: whether the step was inertial. If it has no static stiffness, that of this equilibrium is kept.
            dt: length of the step, s.

        Raises:
            TypeError: the solver returned no stiffness.
        """
        own, within, wrench = step.stiffness_matrix, step.step_stiffness_matrix, step.wrench
        if own is None and within is None:
            raise TypeError("step() must return a stiffness after enable_stiffness_output(); see "
                            "Solver.enable_stiffness_output")
        if share != 1.0:
            wrench = scale_screw(share, wrench)
            own = None if own is None else scale_matrix(share, own)
            within = None if within is None else scale_matrix(share, within)
        if own is None:
            return LastEquilibrium(pose, wrench, self.stiffness, inertial, self.stiffness_age + 1, within,
                                   self.stiffness_time + dt)
        return LastEquilibrium(pose, wrench, own, inertial, 0, within, step.stiffness_age)

    @classmethod
    def make_in_air(cls, pose: Pose) -> LastEquilibrium:
        """Return the equilibrium of a tool at a pose without contact."""
        return cls(pose, AT_REST.wrench, AT_REST.stiffness, False, NEVER)


#: Equilibrium without contact.
AT_REST = LastEquilibrium(Pose.at_depth(0.0), make_axial_wrench(0.0), make_axial_stiffness_matrix(0.0), False, NEVER)


@dataclass(frozen=True, slots=True)
class NewtonAttempt:
    """Unfinished Newton iteration for the equilibrium at a pose, dt seconds later, which the next step continues.

    Attributes:
        order: order of the extrapolation with which the iteration began.
        limit: largest number of linear solves.
        spent: number of linear solves so far.
    """

    pose: Pose
    dt: float
    order: int
    limit: int
    spent: int = 0


@dataclass(slots=True)
class DampedPathState:
    """Unfinished path of `Solver.iterate_steps_with_damping` to a pose, dt seconds later, and its last step."""

    pose: Pose
    dt: float
    last: Step
    steps: Generator[Step] = field(init=False)
    _allowed: int = field(init=False, default=1)

    def get_allowed_solves_until_yield(self) -> int:
        """Return the number of linear solves that the damped path may make until its next yield."""
        return self._allowed

    def compute_next_step_within_solves_or_none(self, allowed: int) -> Step | None:
        """Continue the damped path with at most `allowed` linear solves.

        Returns:
            The next step, which is also stored as `last`; None if the path is complete.
        """
        self._allowed = allowed
        step = next(self.steps, None)
        self.last = step or self.last
        return step


@dataclass(frozen=True)
class StateOrigin:
    """Origin of a saved state. A simulator restores states whose origin equals the origin of the states that it saves.

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
    def from_model(cls, solver: str, mesh: str, model: Model) -> StateOrigin:
        """Make the origin of saved states from solver name, digest of the mesh, and model."""
        experiment = {each.name: getattr(model.experiment, each.name) for each in fields(model.experiment)
                      if each.name != "protocol"}
        return cls(solver, mesh, repr(experiment), format_material_structure_as_text(model.material))

    def require_equal_origin(self, other: StateOrigin) -> None:
        """Raise an error unless a state has the same solver, mesh, experiment and material structure.

        Raises:
            InputError: another solver, mesh, experiment or structure of the material.
        """
        for name, what in (("solver", "solver"), ("experiment", "specimen, tool or interface"),
                           ("material", "law or with other effects or layers"), ("mesh", "mesh")):
            if getattr(self, name) != getattr(other, name):
                raise InputError(f"must be of the same model and mesh; this state is of another {what}. Restore the "
                                 "state in the simulator that saved it, or in a clone() of that simulator.",
                                 field="state")


def format_material_structure_as_text(value: Any) -> str:
    """Return law, effects and layers of a material as text, without numbers and names, to compare two structures."""
    if is_dataclass(value):
        inner = [f"{each.name}={format_material_structure_as_text(getattr(value, each.name))}" for each in fields(value)
                 if each.name not in ("name", "bulk", "parameters", "density", "source")]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {format_material_structure_as_text(entry)}" for key,
                               entry in sorted(value.items())) + "}"
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(format_material_structure_as_text, value)) + "]"
    return "None" if value is None else "number" if isinstance(value, Real) else type(value).__name__


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """State of a simulator between two steps; see `Simulator.save`."""

    origin: StateOrigin
    solver: Any
    answer: ToolForce
    equilibrium: LastEquilibrium
    tool: ToolTrack
    pose: Pose
    leaps: bool
    pending: PendingPath
    lingers: float
    share: float
    begins: bool
    largest_force: float
    motion_check: ToolReversalDetector
    history: ToolHistory
    error: float | None
