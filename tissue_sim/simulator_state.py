"""What a simulator knows beside its solver, between two steps."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

from tissue_sim.fem.solver import Step
from tissue_sim.material.effect import ToolHistory
from tissue_sim.pose import Pose, Screw
from tissue_sim.tool_force import Matrix, ToolForce, axial_stiffness, axial_wrench


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """What the last equilibrium answers, and where; the stiffness holds mass where that was taken into account."""

    pose: Pose
    wrench: Screw
    stiffness: Matrix
    inertial: bool


#: Of a tool that touches nothing.
AT_REST = Equilibrium(Pose.at_depth(0.0), axial_wrench(0.0), axial_stiffness(0.0), inertial=False)


@dataclass(slots=True)
class Creep:
    """The tissue on its way to an equilibrium at a pose, a time step (s) later, and its last step there."""

    pose: Pose
    dt: float
    steps: Generator[Step]
    last: Step


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """Where a simulator stood; see `Simulator.save`."""

    solver: Any
    answer: ToolForce
    equilibrium: Equilibrium
    elastic: Matrix
    pose: Pose
    waiting: float
    lingers: float
    share: float
    touched: bool
    history: ToolHistory
