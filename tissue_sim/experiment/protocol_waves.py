"""Sinusoids and chirps of a protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

#: Segment: sinusoid at one frequency.
SINE: Final = "sine"
#: Segment: sinusoid whose frequency changes continuously.
CHIRP: Final = "chirp"
#: Segments that oscillate about the present displacement or force.
WAVE_KINDS = (SINE, CHIRP)
#: Smallest number of samples of a cycle, a multiple of 4, so that the extreme values are sampled. With lines between 32
#: samples the amplitude of the sinusoid is 0.3 % too small.
SAMPLES_PER_CYCLE = 32
#: Change of the frequency of a chirp with time.
Spacing = Literal["logarithmic", "linear"]


@dataclass(frozen=True)
class Wave:
    """Sinusoid with a whole number of cycles, at one frequency or with a frequency that changes with time.

    Attributes:
        frequency: at the start, Hz.
        cycles: number of cycles.
        end_frequency: at the end, Hz; None: the frequency is constant.
        spacing: whether the logarithm of the frequency or the frequency itself is linear in time.
    """

    frequency: float
    cycles: int
    end_frequency: float | None = None
    spacing: Spacing = "logarithmic"

    @classmethod
    def make_chirp(cls, frequency: float, end_frequency: float, duration: float, spacing: Spacing) -> Wave:
        """Return a chirp whose duration, s, is the nearest one with a whole number of cycles, at least 1."""
        mean = _compute_mean_frequency(frequency, end_frequency, spacing)
        return cls(frequency, max(round(min(duration * mean, 1e15)), 1), end_frequency, spacing)

    @property
    def duration(self) -> float:
        """Duration, s."""
        if self.end_frequency is None:
            return self.cycles / self.frequency
        return self.cycles / _compute_mean_frequency(self.frequency, self.end_frequency, self.spacing)

    def compute_sample_count(self, points: int) -> int:
        """Return the number of samples without the first one; `points` is the number of samples of a straight leg."""
        return self.cycles * 4 * math.ceil(max(points - 1, SAMPLES_PER_CYCLE) / 4)

    def compute_samples(self, points: int) -> tuple[np.ndarray, np.ndarray]:
        """Return sin(phase) and the time since the start, s, at equal steps of the phase, without the start.

        Args:
            points: number of samples of a straight leg, see `compute_sample_count`.

        Returns:
            Two arrays of shape (`compute_sample_count`,).
        """
        count = self.compute_sample_count(points)
        number, per_cycle = np.arange(1, count + 1), count // self.cycles
        # The remainder makes the sine of a whole cycle exactly zero.
        sine = np.sin(2.0 * np.pi * (number % per_cycle) / per_cycle)
        sine[number % per_cycle == per_cycle // 2] = 0.0
        return sine, self._compute_time_of_phase(number / per_cycle)

    def _compute_time_of_phase(self, phase: np.ndarray) -> np.ndarray:
        """Return the time, s, at which a number of cycles `phase` is completed."""
        first, last = self.frequency, self.end_frequency
        if last is None or last == first:
            return phase / first
        if self.spacing == "linear":
            # phase = first t + (last - first) t^2 / (2 duration), solved without cancellation.
            return 2.0 * phase / (first + np.sqrt(first**2 + 2.0 * (last - first) / self.duration * phase))
        ratio = math.log(last / first)
        return self.duration / ratio * np.log1p(phase * ratio / (first * self.duration))


def _compute_mean_frequency(first: float, last: float, spacing: Spacing) -> float:
    """Return the mean frequency over time of a chirp, Hz."""
    if spacing == "linear":
        return 0.5 * (first + last)
    return first if last == first else (last - first) / math.log(last / first)


def make_sweep_values(first: float, last: float, count: int) -> list[float]:
    """Return `count` values from `first` to `last` with equal ratios."""
    return [first, *np.geomspace(first, last, count)[1:-1].tolist(), last]
