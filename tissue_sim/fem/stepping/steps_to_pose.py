"""Steps of a solver to a pose of the tool, as long as they converge."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tissue_sim.fem.solver import Solver, Step, StepStatus
from tissue_sim.fem.stepping.increments import AdaptiveIncrements
from tissue_sim.pose import Pose, interpolate_pose


@dataclass(frozen=True)
class StepToPoseSettings:
    """Settings of the steps to a pose.

    Attributes:
        smallest_cut: smallest step, over the motion to the pose, 1. A smaller value tries shorter steps before the
            motion is abandoned.
        damped_from: largest step, over the motion to the pose, that is repeated with artificial viscous damping
            (`Solver.iterate_steps_with_damping`) after a failure without extrapolation, 1.
        max_solves: largest number of linear solves of a step.
        max_damped_solves: the same for a damped step.
    """

    smallest_cut: float = 2.0**-10
    damped_from: float = 2.0**-3
    max_solves: int = 40
    max_damped_solves: int = 24


#: Settings of every simulation of a whole test.
STEPS_TO_POSE = StepToPoseSettings()


def iterate_adaptive_steps_to_pose(solver: Solver, target: Pose, dt: float = 0.0, **options: Any) -> Iterator[Step]:
    """Yield steps of a solver to a pose along a rigid motion of `dt` s at constant speed; `options` are of each step.

    A step that fails is repeated without extrapolation, then with damping if it is short, and then halved. The motion
    ends with a step that has not converged if the smallest step fails.
    """
    start, highest = solver.pose, min(2, solver.highest_order)
    increments, order = AdaptiveIncrements(STEPS_TO_POSE.smallest_cut), highest
    while not increments.is_complete:
        end, length = increments.end, increments.end - increments.done
        # Extrapolation is inaccurate across a change of contact; the linear solution for the tool's motion is not.
        goal = target if end == 1.0 else interpolate_pose(start, target, end)
        step = solver.step(goal, length * dt, max_iterations=STEPS_TO_POSE.max_solves, predictor_order=order, **options)
        yield step
        if (step.status is not StepStatus.CONVERGED and not order
                and increments.length <= STEPS_TO_POSE.damped_from):
            for step in solver.iterate_steps_with_damping(goal, length * dt,
                                                          max_iterations=STEPS_TO_POSE.max_damped_solves,
                                                          **options):
                yield step
        if step.status is StepStatus.CONVERGED:
            increments.advance()
            order = highest
        elif order:
            order = 0
        else:
            order = highest
            if not increments.halve_and_check_size():
                return
