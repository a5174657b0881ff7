"""One clock: when samples were taken, from their numbers and from when they came."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: By this share at most a device's clock goes wrong: a short run with late arrivals would say more.
_CLOCKS = 1e-3


@dataclass(frozen=True)
class SequenceLine:
    """When a sample was taken, up to a latency that is the same for all: first + number / rate.

    No sample can come before it was taken; some come at once, and many late. So the line is the one below all arrivals
    that is nearest to them in the mean: of the lower convex hull the edge over the middle of the numbers.

    Attributes:
        first: of number 0, s. period: s.
        jitter: median by which samples came late, s.
    """

    first: float
    period: float
    jitter: float

    @classmethod
    def of(cls, numbers: Sequence[int] | np.ndarray, received: Sequence[float] | np.ndarray,
           period: float) -> SequenceLine:
        """The line of some samples.

        Args:
            numbers: increasing, shape (n,). received: when they came, s, shape (n,).
            period: what the device says, s; it is believed to a thousandth.
        """
        number, arrival = np.asarray(numbers, dtype=float), np.asarray(received, dtype=float)
        if number.size == 0:
            return cls(0.0, period, 0.0)
        hull: list[int] = []
        for index in range(number.size):
            while len(hull) > 1 and _turns_up(number, arrival, hull[-2], hull[-1], index):
                hull.pop()
            hull.append(index)
        middle = number.mean()
        edges = [(a, b) for a, b in itertools.pairwise(hull) if number[a] <= middle <= number[b]]
        if edges:
            a, b = edges[0]
            slope = float((arrival[b] - arrival[a]) / (number[b] - number[a]))
            period = min(max(slope, (1 - _CLOCKS) * period), (1 + _CLOCKS) * period)
        first = float((arrival - period * number).min())
        return cls(first, period, float(np.median(arrival - first - period * number)))

    def time(self, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """When samples were taken, s, shape (n,)."""
        return self.first + self.period * np.asarray(numbers, dtype=float)


def _turns_up(x: np.ndarray, y: np.ndarray, a: int, b: int, c: int) -> bool:
    """Whether the middle one of three points is not below the line of the others."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
