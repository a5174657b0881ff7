"""Reconstruct the sampling times of a sensor from sequence numbers and arrival times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class SampleClockSettings:
    """Tolerances of the fit of a `SampleClock`, and number of intervals of a long run.

    Attributes:
        rate_tolerance: largest relative error that is assumed for the clock of a device, 1. A larger value lets late
            arrivals at the ends of a short run change the period.
        late_arrival: largest difference over a whole run that late arrivals explain, s. Above this value the rate that
            the device states is rejected and the rate of the arrivals is used.
        stretches: number of intervals that a long run is divided into; the convex hull uses the earliest sample of
            each. A larger value costs time and changes the line little.
    """

    rate_tolerance: float = 1e-3
    late_arrival: float = 0.1
    stretches: int = 2000


#: Settings of every fit.
_SETTINGS = SampleClockSettings()


@dataclass(frozen=True)
class SampleClock:
    """Linear model of the sampling times: time = first + period * number, up to a latency common to all samples.

    A sample arrives after its sampling time: some samples arrive at once, many arrive late. The line is therefore a
    lower bound of the arrivals, and among the lower bounds the one with the smallest mean distance: the edge of the
    lower convex hull over the mean sample number.

    Attributes:
        first: time of sample number 0, s.
        period: time between two samples, s.
        jitter: median delay of the arrivals behind the line, s.
        fits: whether the rate stated by the device agrees with the arrivals. If not, `period` is measured from the
            arrivals.
    """

    first: float
    period: float
    jitter: float
    fits: bool

    @classmethod
    def fit_to_arrivals(cls, numbers: Sequence[int] | np.ndarray, received: Sequence[float] | np.ndarray,
                        period: float) -> SampleClock:
        """Fit the line to the arrivals of a run.

        Args:
            numbers: increasing sequence numbers of the samples, shape (n,).
            received: arrival times, s, shape (n,).
            period: sampling period that the device states, s. The fit changes this period by at most 0.1 %, unless the
                difference adds up to more than 0.1 s over the run; then the period of the arrivals is used.

        Returns:
            The fitted line. Without samples: first = 0 and the stated period.
        """
        fits = True
        number, arrival = np.asarray(numbers, dtype=float), np.asarray(received, dtype=float)
        if number.size == 0:
            return cls(0.0, period, 0.0, True)
        hull: list[int] = []
        for index in _preselect_hull_candidates(arrival - period * number):
            while len(hull) > 1 and _is_above_chord(number, arrival, hull[-2], hull[-1], index):
                hull.pop()
            hull.append(index)
        middle = number.mean()
        edges = [(a, b) for a, b in pairwise(hull) if number[a] <= middle <= number[b]]
        if edges:
            a, b = edges[0]
            slope = float((arrival[b] - arrival[a]) / (number[b] - number[a]))
            tolerance = _SETTINGS.rate_tolerance
            nearest = min(max(slope, (1 - tolerance) * period), (1 + tolerance) * period)
            # Late arrivals explain a bounded difference; a wrong rate gives a difference that grows with the run.
            fits = abs(slope - nearest) * (number[-1] - number[0]) <= _SETTINGS.late_arrival
            period = nearest if fits else slope
        first = float((arrival - period * number).min())
        return cls(first, period, float(np.median(arrival - first - period * number)), fits)

    def compute_times(self, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the sampling times, s, shape (n,), of samples by their sequence numbers.

        Args:
            numbers: sequence numbers, shape (n,).
        """
        return self.first + self.period * np.asarray(numbers, dtype=float)


def _preselect_hull_candidates(delay: np.ndarray) -> list[int]:
    """Return increasing indices of the samples from which the lower convex hull is made; thins out a long run.

    Args:
        delay: arrival time less period * number, s, shape (n,).

    Returns:
        All indices of a short run; of a long run the earliest sample of each stretch.
    """
    stretches = _SETTINGS.stretches
    if delay.size <= 2 * stretches:
        return list(range(delay.size))
    edges = np.linspace(0, delay.size, stretches + 1).astype(int)
    return [int(start + np.argmin(delay[start:end])) for start, end in pairwise(edges)]


def _is_above_chord(x: np.ndarray, y: np.ndarray, a: int, b: int, c: int) -> bool:
    """Return whether point b lies on or above the chord from point a to point c."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
