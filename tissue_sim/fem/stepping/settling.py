"""Equilibrium of a specimen under its own weight, before the tool touches."""

from __future__ import annotations

from typing import Any, Protocol

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.fem.stepping.increments import AdaptiveIncrements
from tissue_sim.specimen import Specimen

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
