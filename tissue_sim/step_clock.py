"""How long a step takes: what a budget in wall time means in linear solves, and what a step may still take of it."""

from __future__ import annotations

import time
from numbers import Integral

from tissue_sim.errors import InputError

#: How fast the guess of what a step costs beside its solves follows one that took longer, or shorter.
_LEARNS, _FORGETS = 0.5, 0.1
#: A step that took this many times as long as it was thought to counts no more than that: it met the computer in a bad
#: moment.
_SPIKE = 2.0
#: Weight of a step in the means, and variance of the number of solves from which on their own cost is seen.
_WEIGHT, _SEEN = 0.02, 0.1
#: Least cost of a solve, as a share of that of a step with none.
_LEAST = 0.25
#: A step that is bounded may make one linear solution, answer, and find the stiffness of tissue that has a mass.
LEAST_SOLVES = 3
#: Without any bound.
_UNBOUNDED = 1 << 30


class StepClock:
    """Follows the wall time of steps: `fixed` s whatever they are, and `solve` s for each linear solve.

    A step without a solve assembles, factorises and answers; each solve goes over the tissue once more. The two are
    told apart by the regression of time on solves, old steps forgotten.

    Attributes:
        fixed, solve: s.
    """

    def __init__(self):
        self.begin(1e-9)

    def begin(self, solve: float) -> None:
        """From a solve's time, s, with all that belongs to it."""
        self.fixed = self.solve = solve
        self._solves, self._time, self._variance, self._covariance = 1.0, 2.0 * solve, 0.0, 0.0

    def fitting(self, time: float, first: bool = False) -> int:
        """How many solves fit into a time, s, with the rest of the step; below zero where not even that does. Of the
        first part of a step one does where the rest fits: an answer a little late is better than none."""
        return max(int((time - self.fixed) / self.solve), int(first)) if time >= self.fixed else -1

    def follow(self, time: float, solves: int) -> None:
        """Take note of a step: its time, s, and its solves."""
        expected = self.fixed + solves * self.solve
        time = min(time, _SPIKE * expected)
        more = time - expected
        self.fixed = max(self.fixed + (_LEARNS if more > 0.0 else _FORGETS) * more, 1e-9)
        a, b = solves - self._solves, time - self._time
        self._solves += _WEIGHT * a
        self._time += _WEIGHT * b
        self._variance += _WEIGHT * ((1.0 - _WEIGHT) * a * a - self._variance)
        self._covariance += _WEIGHT * ((1.0 - _WEIGHT) * a * b - self._covariance)
        if self._variance > _SEEN:
            even = self._time / (1.0 + self._solves)
            self.solve = min(max(self._covariance / self._variance, _LEAST * even), even)

    def doubt(self) -> None:
        """Where nothing was tried because of the guess: it may be from a bad moment."""
        self.fixed *= 0.5


def require_solves(most: int | None) -> None:
    """Refuse a bound within which no step can end.

    Raises:
        InputError: no whole number, or fewer than `LEAST_SOLVES`.
    """
    if most is not None and not (isinstance(most, Integral) and most >= LEAST_SOLVES):
        raise InputError(f"no step comes to an end in {most!r} linear solutions; give a whole number of at least "
                         f"{LEAST_SOLVES}, or None",
                         field="max_solves")


def solves_in(budget: float | None, solve: float | None) -> int | None:
    """How many linear solutions of so many s there are in a budget, s, and no less than `LEAST_SOLVES`; None: no
    budget, or nobody knows."""
    if budget is None or solve is None:
        return None
    return max(LEAST_SOLVES, int(min(budget / solve, _UNBOUNDED)))


class Allowance:
    """What a step may still take: a number of linear solutions, and time.

    Each part of a step is a call of the solver, which answers a stiffness by a linear solution beside those that its
    iteration takes; the bound is on all of them.

    Args:
        clock: knows what they take.
        most: linear solutions of the step; None: as many as it takes.
        ends: when its time ends, on `time.perf_counter`; None: never.

    Attributes:
        is_bounded: whether the number of solutions or the time is limited.
    """

    def __init__(self, clock: StepClock, most: int | None, ends: float | None):
        self._clock, self._ends, self._left = clock, ends, _UNBOUNDED if most is None else most
        self._begins, self.is_bounded = True, most is not None or ends is not None

    def fitting(self, answers: int = 1) -> int:
        """How many solves the next part may take beside its answers; below one: it may not begin."""
        fits = self._left - answers
        if self._ends is not None:
            left = self._ends - time.perf_counter() - (answers - 1) * self._clock.fixed
            fits = min(fits, self._clock.fitting(left, first=self._begins))
        return fits

    def has_time(self, solves: int, answers: int) -> bool:
        """Whether the time, without the bound on solves, is enough for these solves and answers."""
        if self._ends is None:
            return True
        left = self._ends - time.perf_counter() - (answers - 1) * self._clock.fixed
        return self._clock.fitting(left) >= solves

    def take(self, solves: int, answers: int = 1) -> None:
        """Take note of a part."""
        self._left -= solves + answers
        self._begins = self._begins and solves == 0

    def end(self) -> None:
        """No part fits any more; where none was begun the clock may be wrong."""
        if self._begins and self._left > 1:
            self._clock.doubt()
