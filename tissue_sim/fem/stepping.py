"""Load increments of a path, steps of a tool to a pose, and equilibrium under self-weight.

Increments are halved after a failure and doubled after a success.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solver import Solver, Step, StepStatus
from tissue_sim.pose import Pose, interpolate_pose
from tissue_sim.specimen import Specimen

#: Remaining fraction of a path up to which the last increment is extended to the end of the path, 1.
ROUNDING = 1e-9


class AdaptiveIncrements:
    """Increments of a path from 0 to 1: the next one is twice as long after a success and half as long after a failure.

    Args:
        smallest: smallest increment, 1.
        largest: largest increment, which is the first one, 1.

    Attributes:
        done: completed fraction of the path, 1.
        length: length of the next increment, 1; it may exceed the remaining fraction.
    """

    def __init__(self, smallest: float, largest: float = 1.0):
        self._smallest, self._largest = smallest, largest
        self.done, self.length = 0.0, largest

    @property
    def end(self) -> float:
        """Fraction of the path at the end of the next increment, 1; exactly 1 for the last one."""
        end = self.done + self.length
        return 1.0 if end >= 1.0 - ROUNDING else end

    @property
    def is_complete(self) -> bool:
        """Whether the end of the path is reached."""
        return self.done == 1.0

    def advance(self) -> None:
        """Complete the next increment, and double the length of the one after it."""
        self.done, self.length = self.end, min(2.0 * self.length, self._largest)

    def halve_and_check_size(self) -> bool:
        """Halve the next increment; return False if it is then smaller than the smallest one."""
        self.length /= 2.0
        return self.length >= self._smallest


#: Largest number of Newton steps for the undeformed height.
MAX_HEIGHT_STEPS = 50
#: Relative error of the settled height at which the search for the undeformed height ends, 1.
HEIGHT_TOLERANCE = 1e-10


class SelfWeightProblem(Protocol):
    """Specimen on its base without a tool, to which the weight is applied."""

    @property
    def smallest_increment(self) -> float:
        """Smallest fraction of the weight that is applied in one step, 1, before the specimen counts as unstable."""

    def make_solver(self, stretch: float) -> Any:
        """Make the solver of the unloaded specimen whose height is `stretch` times the stated height."""

    def solve_equilibrium_under_weight(self, solver: Any, specific_weight: float) -> Step:
        """Solve for equilibrium under a specific weight, N/m3, with all relaxation ended."""

    def store_resting_state(self, solver: Any) -> None:
        """Make the equilibrium under the whole weight the state in which the tool touches first."""


def solve_self_weight_equilibrium(problem: SelfWeightProblem, specimen: Specimen, height: float) -> Any:
    """Compute the equilibrium of a specimen under its weight, without a tool.

    If the stated height is that of the settled specimen, Newton's method determines the undeformed height. The weight
    is applied in as few increments as converge: an increment is halved after a failure and doubled after a success.

    Args:
        problem: solver and load steps.
        specimen: specimen with its weight; `height_is` states whether its height is that before settling.
        height: stated height, m.

    Returns:
        The solver of `problem`, in equilibrium under the weight.

    Raises:
        ConvergenceError: the specimen has no equilibrium under its weight.
    """
    stretch = 1.0
    for _ in range(MAX_HEIGHT_STEPS):
        solver = problem.make_solver(stretch)
        _apply_weight_in_increments(problem, solver, specimen.specific_weight)
        settled_height = stretch * height - solver.sag
        if specimen.height_is == "moulded" or abs(settled_height / height - 1) < HEIGHT_TOLERANCE:
            return solver
        # The sag grows with the square of the height: one Newton step on stretch - c stretch^2 = 1.
        loss = (stretch * height - settled_height) / (stretch**2 * height)
        stretch -= (stretch - loss * stretch**2 - 1) / (1 - 2 * loss * stretch) if 2 * loss * stretch < 1 else -0.1
    raise ConvergenceError(f"no undeformed height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3. Check density and moduli.")


def _apply_weight_in_increments(problem: SelfWeightProblem, solver: Any, specific_weight: float) -> None:
    increments = AdaptiveIncrements(problem.smallest_increment)
    while not increments.is_complete:
        step = problem.solve_equilibrium_under_weight(solver, increments.end * specific_weight)
        if step.status is StepStatus.CONVERGED:
            increments.advance()
        elif not increments.halve_and_check_size():
            raise ConvergenceError(
                "the specimen has no equilibrium under its own weight: the solver stopped at "
                f"{increments.done:.0%} of the weight ({step.status.message}). Check density and moduli.")
    problem.store_resting_state(solver)


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
