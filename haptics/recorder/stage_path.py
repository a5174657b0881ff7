"""Path of the stage between its polls, with a bound on the error of the interpolated position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StagePositionTolerances:
    """Tolerances of the stage position: a force sample is recorded only if the error bound of its position is smaller.

    Attributes:
        tolerance: largest bound on the position error, as a fraction of the largest depth of the motion, 1. A larger
            value keeps samples whose position is wrong after a late answer of the stage; a smaller one leaves out
            samples at the reversals of fast motions.
        least_tolerance: smallest permitted bound, m: resolution and rounding of common stages.
    """

    tolerance: float = 0.01
    least_tolerance: float = 5e-6


#: Settings of every recording.
SETTINGS = StagePositionTolerances()


@dataclass(frozen=True)
class StagePoll:
    """Position of the stage from one poll, and the time interval in which the position was read.

    Attributes:
        earliest: earliest time at which the position can have been read, s.
        latest: latest time at which the position can have been read, s.
        position: m.
    """

    earliest: float
    latest: float
    position: float

    @property
    def middle_time(self) -> float:
        """Mean of the earliest and the latest time, s; the best estimate of the time of reading."""
        return 0.5 * (self.earliest + self.latest)


class StagePath:
    """Linear interpolation between the polls of a motion, and a bound on its error.

    The stage moves at most at the commanded speed v(t). With the travel s(t) = integral of v dt, a position p that was
    read between the times a and b bounds the position x(t) of a stage by

        |x(t) - p| <= s(t) - s(a)  for t >= b,    |x(t) - p| <= s(b) - s(t)  for t <= a.

    The intersection of these intervals over all polls contains x(t). The bound on the error is the larger distance of
    the interpolated position from the ends of the intersection. It is zero in uniform motion with exact times, and it
    is large where the stage may have rested or reversed between two polls, or where an answer was late.

    Args:
        polls: polls in the order of their times, at least one.
        changes: times at which the commanded speed changes, s, increasing, shape (n,).
        speeds: commanded speed before the first change and after each change, m/s, shape (n + 1,); 0 at rest.
    """

    def __init__(self, polls: Sequence[StagePoll], changes: Sequence[float], speeds: Sequence[float]):
        self._earliest = np.array([poll.earliest for poll in polls])
        self._latest = np.array([poll.latest for poll in polls])
        self._times = np.array([poll.middle_time for poll in polls])
        self._positions = np.array([poll.position for poll in polls])
        self._changes = np.array(changes, dtype=float)
        self._speeds = np.array(speeds, dtype=float)
        begun, ended = self._integrate_commanded_speed(self._earliest), self._integrate_commanded_speed(self._latest)
        position = self._positions
        # Row i holds the bounds of the first i polls (before), and of the polls from i on (after), without s(t).
        none = np.array([np.inf])
        self._upper_before = np.minimum.accumulate(np.concatenate([none, position - begun]))
        self._lower_before = np.maximum.accumulate(np.concatenate([-none, position + begun]))
        self._upper_after = np.minimum.accumulate(np.concatenate([none, (position + ended)[::-1]]))[::-1]
        self._lower_after = np.maximum.accumulate(np.concatenate([-none, (position - ended)[::-1]]))[::-1]

    def _integrate_commanded_speed(self, times: np.ndarray) -> np.ndarray:
        """Return the integral of the commanded speed from its first change to each time, m; negative before it."""
        if self._changes.size == 0:
            return self._speeds[0] * times
        knots = np.concatenate([[0.0], np.cumsum(self._speeds[1:-1] * np.diff(self._changes))])
        index = np.searchsorted(self._changes, times, side="right")
        start = np.maximum(index - 1, 0)
        return knots[start] + self._speeds[index] * (times - self._changes[start])

    def interpolate_position(self, times: np.ndarray) -> np.ndarray:
        """Return the position of the stage, m, shape (n,).

        Args:
            times: s, shape (n,); before the first and after the last poll the nearest position is returned.
        """
        return np.interp(times, self._times, self._positions)

    def compute_position_error_bound(self, times: np.ndarray) -> np.ndarray:
        """Return a bound on the error of `interpolate_position`, m, shape (n,); infinite before and after all polls.

        Args:
            times: s, shape (n,).
        """
        travel, position = self._integrate_commanded_speed(times), self.interpolate_position(times)
        before = np.searchsorted(self._latest, times, side="right")
        after = np.searchsorted(self._earliest, times, side="left")
        upper = np.minimum(self._upper_before[before] + travel, self._upper_after[after] - travel)
        lower = np.maximum(self._lower_before[before] - travel, self._lower_after[after] + travel)
        outside = (times < self._times[0]) | (times > self._times[-1])
        return np.where(outside, np.inf, np.maximum(np.abs(upper - position), np.abs(position - lower)))

    def find_known_position_mask(self, times: np.ndarray, depth: float) -> np.ndarray:
        """Return for each time whether the error bound of the position is within the tolerance, bool, shape (n,).

        Args:
            times: s, shape (n,).
            depth: largest depth of the motion, m.
        """
        return self.compute_position_error_bound(times) <= compute_position_tolerance_for_depth(depth)


def compute_position_tolerance_for_depth(depth: float) -> float:
    """Return the largest permitted bound on the position error, m, for a motion with the largest depth `depth`, m."""
    return max(SETTINGS.tolerance * abs(depth), SETTINGS.least_tolerance)
