"""One clock: when samples were taken, from their numbers and from when they came."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

#: By this share at most a device's clock goes wrong: a short run with late arrivals would say more.
_CLOCKS = 1e-3
#: So much of a drift over the whole run may be late arrivals, s.
_EXPLAINED = 0.1
#: The hull is sought among so many samples: the earliest, for its number, of each stretch.
_STRETCHES = 2000


@dataclass(frozen=True)
class SequenceLine:
    """When a sample was taken, up to a latency that is the same for all: first + number / rate.

    No sample can come before it was taken; some come at once, and many late. So the line is the one below all arrivals
    that is nearest to them in the mean: of the lower convex hull the edge over the middle of the numbers.

    Attributes:
        first: of number 0, s. period: s.
        jitter: median by which samples came late, s.
        fits: whether the device's own rate fits the arrivals; otherwise `period` is theirs.
    """

    first: float
    period: float
    jitter: float
    fits: bool

    @classmethod
    def of(cls, numbers: Sequence[int] | np.ndarray, received: Sequence[float] | np.ndarray,
           period: float) -> SequenceLine:
        """The line of some samples.

        Args:
            numbers: increasing, shape (n,). received: when they came, s, shape (n,).
            period: what the device says, s; it is believed to a thousandth, unless that is off by a tenth of a second
                in the end.
        """
        fits = True
        number, arrival = np.asarray(numbers, dtype=float), np.asarray(received, dtype=float)
        if number.size == 0:
            return cls(0.0, period, 0.0, True)
        hull: list[int] = []
        for index in _earliest(arrival - period * number):
            while len(hull) > 1 and _turns_up(number, arrival, hull[-2], hull[-1], index):
                hull.pop()
            hull.append(index)
        middle = number.mean()
        edges = [(a, b) for a, b in pairwise(hull) if number[a] <= middle <= number[b]]
        if edges:
            a, b = edges[0]
            slope = float((arrival[b] - arrival[a]) / (number[b] - number[a]))
            near = min(max(slope, (1 - _CLOCKS) * period), (1 + _CLOCKS) * period)
            # Late arrivals explain some of a difference, but not one that goes on.
            fits = abs(slope - near) * (number[-1] - number[0]) <= _EXPLAINED
            period = near if fits else slope
        first = float((arrival - period * number).min())
        return cls(first, period, float(np.median(arrival - first - period * number)), fits)

    def time(self, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """When samples were taken, s, shape (n,)."""
        return self.first + self.period * np.asarray(numbers, dtype=float)


def _earliest(lateness: np.ndarray) -> list[int]:
    """Samples that can be on the lower hull: one of each stretch; all where they are few. lateness: s, shape (n,)."""
    if lateness.size <= 2 * _STRETCHES:
        return list(range(lateness.size))
    edges = np.linspace(0, lateness.size, _STRETCHES + 1).astype(int)
    return [int(start + np.argmin(lateness[start:end])) for start, end in pairwise(edges)]


def _turns_up(x: np.ndarray, y: np.ndarray, a: int, b: int, c: int) -> bool:
    """Whether the middle one of three points is not below the line of the others."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
