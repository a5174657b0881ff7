"""Wall time of a step: how many linear solves fit into a budget, and how much of it a step has left."""

from __future__ import annotations

import time
from dataclasses import dataclass
from numbers import Integral

from tissue_sim.errors import InputError

#: Smallest bound on the linear solves of a step: one for the iteration, one for the contact stiffness, and one for the
#: stiffness of tissue with mass.
LEAST_SOLVES = 3
#: Number of solves that stands for no bound.
_UNBOUNDED = 1 << 30


@dataclass(frozen=True)
class StepTimeEstimateSettings:
    """Settings of a `StepTimeEstimator`; all dimensionless.

    Attributes:
        gain_up: fraction by which the estimate of the fixed time approaches a step that took longer.
        gain_down: the same for a step that took less time.
        outlier_factor: a step longer than this many times its estimate counts as that long: the operating system may
            have interrupted it.
        step_weight: weight of one step in the moving means of the regression.
        least_variance: variance of the number of solves from which the regression determines the time of a solve.
        least_solve_fraction: smallest time of a solve as a fraction of the mean time per solve, where the fixed part
            counts as one solve.
    """

    gain_up: float = 0.5
    gain_down: float = 0.1
    outlier_factor: float = 2.0
    step_weight: float = 0.02
    least_variance: float = 0.1
    least_solve_fraction: float = 0.25


_SETTINGS = StepTimeEstimateSettings()


class StepTimeEstimator:
    """Estimates the wall time of a step, t = fixed + solve n, with n the number of its linear solves.

    The fixed part assembles, factorises and computes the force; each solve is one more pass over the tissue. The slope
    is a linear regression of the times on n with exponentially decaying weights.

    Attributes:
        fixed: time of a step without solves, s.
        solve: time of a linear solve, s.
    """

    def __init__(self):
        self.restart_estimate_from_solve_time(1e-9)

    def restart_estimate_from_solve_time(self, solve: float) -> None:
        """Restart the estimate from the measured time of one linear solve with its assembly, s."""
        self.fixed = self.solve = solve
        self._solves, self._time, self._variance, self._covariance = 1.0, 2.0 * solve, 0.0, 0.0

    def count_fitting_solves(self, time: float, first: bool = False) -> int:
        """Return the number of linear solves that fit, with the fixed time of a step, into a time.

        Args:
            time: s.
            first: whether this is the first part of a step. One solve is then allowed if the fixed part fits: a force
                that is a little late is better than none.

        Returns:
            The number; -1 if not even the fixed part fits.
        """
        return max(int((time - self.fixed) / self.solve), int(first)) if time >= self.fixed else -1

    def update_estimate(self, time: float, solves: int) -> None:
        """Update the estimate with a step that took this time, s, and made this number of solves."""
        expected = self.fixed + solves * self.solve
        time = min(time, _SETTINGS.outlier_factor * expected)
        excess, weight = time - expected, _SETTINGS.step_weight
        gain = _SETTINGS.gain_up if excess > 0.0 else _SETTINGS.gain_down
        self.fixed = max(self.fixed + gain * excess, 1e-9)
        a, b = solves - self._solves, time - self._time
        self._solves += weight * a
        self._time += weight * b
        self._variance += weight * ((1.0 - weight) * a * a - self._variance)
        self._covariance += weight * ((1.0 - weight) * a * b - self._covariance)
        if self._variance > _SETTINGS.least_variance:
            mean = self._time / (1.0 + self._solves)
            least = _SETTINGS.least_solve_fraction * mean
            self.solve = min(max(self._covariance / self._variance, least), mean)

    def halve_fixed_time(self) -> None:
        """Halve the estimated fixed time, which may come from one slow step, after a step without any solve."""
        self.fixed *= 0.5


def require_valid_max_solves(most: int | None) -> None:
    """Raise an error if the largest number of linear solves of a step is too small for any step.

    Raises:
        InputError: `most` is not an integer, or less than `LEAST_SOLVES`.
    """
    if most is not None and not (isinstance(most, Integral) and most >= LEAST_SOLVES):
        raise InputError(f"must be an integer of at least {LEAST_SOLVES}, or None; got {most!r}.", field="max_solves")


def count_solves_in_budget_or_none(budget: float | None, solve: float | None) -> int | None:
    """Return the number of linear solves that fit into a time budget, at least `LEAST_SOLVES`.

    Args:
        budget: wall time, s; None: no limit.
        solve: wall time of a linear solve, s; None: not known.

    Returns:
        The number; None if there is no budget or the time of a solve is not known.
    """
    if budget is None or solve is None:
        return None
    return max(LEAST_SOLVES, int(min(budget / solve, _UNBOUNDED)))


class StepBudget:
    """Number of linear solves and wall time that a step may still use.

    A step consists of parts; each part is a call of the solver, which makes one linear solve for the contact stiffness
    in addition to those of its iteration. All of them count.

    Args:
        clock: estimates the time of solves.
        most: largest number of linear solves of the step; None: no limit.
        ends: value of `time.perf_counter` at which the budget ends, s; None: no limit.
    """

    def __init__(self, clock: StepTimeEstimator, most: int | None, ends: float | None):
        self._clock, self._ends, self._left = clock, ends, _UNBOUNDED if most is None else most
        self._begins = True

    def count_fitting_solves(self, answers: int = 1) -> int:
        """Return the number of solves that the next substep may make besides its stiffnesses; below 1: do not begin.

        Args:
            answers: number of stiffnesses of the part, one solve each.
        """
        return min(self._left - answers, self._count_solves_in_time(answers, first=self._begins))

    def has_time_for_solves(self, solves: int, answers: int) -> bool:
        """Return whether the remaining time suffices for these solves and stiffnesses (`answers`)."""
        return self._count_solves_in_time(answers, first=False) >= solves

    def _count_solves_in_time(self, answers: int, first: bool) -> int:
        """Return the number of solves, besides stiffnesses (`answers`), that fit into the remaining time."""
        if self._ends is None:
            return _UNBOUNDED
        left = self._ends - time.perf_counter() - (answers - 1) * self._clock.fixed
        return self._clock.count_fitting_solves(left, first)

    def subtract_solves(self, solves: int, answers: int = 1) -> None:
        """Subtract the solves and stiffnesses (`answers`) of a completed substep from the budget."""
        self._left -= solves + answers
        self._begins = self._begins and solves == 0

    def lower_time_estimate_if_nothing_begun(self) -> None:
        """End the step: no further substep fits; if no substep was begun, lower the time estimate of the clock."""
        if self._begins and self._left > 1:
            self._clock.halve_fixed_time()
