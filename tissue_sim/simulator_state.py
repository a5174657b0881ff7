"""What a simulator knows beside its solver, between two steps."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any

from tissue_sim.fem.solver import Step
from tissue_sim.material.effect import ToolHistory
from tissue_sim.pose import Pose, Screw, scaled
from tissue_sim.tool_force import Matrix, ToolForce, axial_stiffness, axial_wrench, scaled_matrix

#: Age of a stiffness that was not found yet.
NEVER = 1 << 30


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """What the last equilibrium answers, and where.

    Attributes:
        stiffness: the tissue's own.
        stiffness_age: how many inertial equilibria ago that was found.
        step_stiffness: within the step, where the mass was taken into account.
    """

    pose: Pose
    wrench: Screw
    stiffness: Matrix
    inertial: bool
    stiffness_age: int = 0
    step_stiffness: Matrix | None = None

    def followed_by(self, step: Step, pose: Pose, share: float, inertial: bool) -> Equilibrium:
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
        own, age = (self.stiffness, self.stiffness_age + 1) if own is None else (own, 0)
        return Equilibrium(pose, wrench, own, inertial, age, within)


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


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """Where a simulator stood; see `Simulator.save`."""

    solver: Any
    answer: ToolForce
    equilibrium: Equilibrium
    pose: Pose
    leaps: bool
    waiting: float
    lingers: float
    share: float
    touched: bool
    history: ToolHistory
