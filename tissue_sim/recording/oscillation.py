"""Detect oscillations in a recording: several periods of equal amplitude around an offset, with the loss factor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.recording.segmentation import ReversalDetector


@dataclass(frozen=True)
class OscillationSettings:
    """Settings of `find_final_oscillation_or_none`.

    Attributes:
        hysteresis_range: least hysteresis of a reversal, as a fraction of the range of the motion.
        hysteresis_noise: least hysteresis of a reversal, in standard deviations of the noise.
        fewest: fewest half periods of an oscillation.
        alike: largest relative difference of the amplitude and of the duration of a half period from the median.
        returns: largest distance of the lowest point of a cycle from rest, as a fraction of the height of the cycle,
            for a cycle that returns to rest.
        beyond: largest motion beyond the oscillation after its end, as a fraction of the range.
        most_samples: largest number of samples that are examined; a longer recording is thinned evenly.
        frequency_width: half width of the interval of trial frequencies, relative to the mean frequency.
        frequencies: number of trial frequencies.
    """

    hysteresis_range: float = 0.004
    hysteresis_noise: float = 6.0
    fewest: int = 4
    alike: float = 0.25
    returns: float = 0.25
    beyond: float = 0.05
    most_samples: int = 20_000
    frequency_width: float = 0.05
    frequencies: int = 41


#: Settings that the functions of this module use.
_SETTINGS = OscillationSettings()


@dataclass(frozen=True)
class Oscillation:
    """Oscillation of the motion with constant amplitude.

    Attributes:
        first: first sample, from 0.
        last: last sample, included.
        frequency: frequency, Hz (cycles per sample without a time).
        mean: mean of the motion, in the unit of the motion.
        amplitude: amplitude of the motion, in the unit of the motion.
        returns: whether each cycle returns to rest.
        loss_factor: tangent of the phase lead of the load; None: the amplitude of the load is below the noise.
    """

    first: int
    last: int
    frequency: float
    mean: float
    amplitude: float
    returns: bool
    loss_factor: float | None


def find_final_oscillation_or_none(motion: np.ndarray, load: np.ndarray,
                                   time: np.ndarray | None = None) -> Oscillation | None:
    """Find the oscillation at the end of a recording; None without an oscillation.

    Args:
        motion: displacement or strain in the order of time, any unit and sign, shape (n,).
        load: force or stress, any unit and sign, shape (n,).
        time: time, s, shape (n,); None: even steps.
    """
    reach = float(np.ptp(motion))
    if motion.size < 3 * _SETTINGS.fewest or not reach > 0:
        return None
    every = -(-motion.size // _SETTINGS.most_samples)
    places = np.arange(0, motion.size, every)
    bend = motion[places][1:-1] - 0.5 * (motion[places][:-2] + motion[places][2:])
    noise = float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(1.5))
    reversals = ReversalDetector(min(max(_SETTINGS.hysteresis_range * reach, _SETTINGS.hysteresis_noise * noise),
                                     0.3 * reach))
    for index, value in zip(places.tolist(), motion[places].tolist(), strict=True):
        reversals.add_sample(index, value)
    window = _find_last_equal_half_periods_and_period(np.array([*reversals.starts, motion.size - 1]), motion, time)
    if window is None:
        return None
    first, last, period = window
    inside = motion[first:last + 1]
    low, high = float(np.quantile(inside, 0.02)), float(np.quantile(inside, 0.98))
    if float(motion[last:].max()) > high + _SETTINGS.beyond * reach or float(motion[last:].min()) < low - reach:
        return None
    mean, amplitude = 0.5 * (low + high), 0.5 * (high - low)
    # A recording that leads to its oscillation by a ramp starts at rest.
    rest = float(motion[0]) if not low - 0.1 * amplitude <= motion[0] <= high + 0.1 * amplitude else 0.0
    near = 2 * _SETTINGS.returns * amplitude
    returns = low - near <= rest <= high + near and abs(mean - rest) > _SETTINGS.returns * amplitude
    frequency, loss = _fit_frequency_and_loss_factor(motion, load, time, first, last, period)
    return Oscillation(first, last, frequency, mean, amplitude, returns, loss)


def _find_last_equal_half_periods_and_period(turns: np.ndarray, motion: np.ndarray, time: np.ndarray | None
                                             ) -> tuple[int, int, float] | None:
    """Return the first and last sample of the last equal half periods, and the period; None: too few half periods.

    Args:
        turns: samples at which the motion reverses; the last one is the end of the recording, shape (k,).
        motion: displacement or strain, shape (n,).
        time: time, s, shape (n,); None: even steps.
    """
    clock = np.arange(motion.size, dtype=float) if time is None else time
    heights, durations = np.abs(np.diff(motion[turns])), np.diff(clock[turns])
    # The first and the last branch may be incomplete.
    if heights.size < _SETTINGS.fewest + 2:
        return None
    heights, durations = heights[1:-1], durations[1:-1]
    height, duration = float(np.median(heights[-_SETTINGS.fewest:])), float(np.median(durations[-_SETTINGS.fewest:]))
    alike = ((np.abs(heights - height) <= _SETTINGS.alike * height)
             & (np.abs(durations - duration) <= _SETTINGS.alike * duration))
    different = np.flatnonzero(~alike)
    begin = int(different[-1]) + 1 if different.size else 0
    if heights.size - begin < _SETTINGS.fewest:
        return None
    return int(turns[begin + 1]), int(turns[-2]), 2.0 * float(np.mean(durations[begin:]))


def _fit_frequency_and_loss_factor(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None, first: int, last: int,
                                   period: float) -> tuple[float, float | None]:
    """Return the frequency and the tangent of the phase angle, by least squares of two harmonics and a drift."""
    every = -(-(last - first) // 4000)
    inside = slice(first, last + 1, every)
    clock = (np.arange(motion.size, dtype=float) if time is None else time)[inside]
    clock = clock - clock[0]

    def fit_drift_and_two_harmonics(frequency: float, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the coefficients of drift and two harmonics, shape (6,), and the sum of squared residuals."""
        angle = 2 * np.pi * frequency * clock
        design = np.column_stack([np.ones(clock.size), clock, np.cos(angle), np.sin(angle), np.cos(2 * angle),
                                  np.sin(2 * angle)])
        coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
        return coefficients, float(np.sum((values - design @ coefficients)**2))

    tried = (1 + np.linspace(-_SETTINGS.frequency_width, _SETTINGS.frequency_width, _SETTINGS.frequencies)) / period
    frequency = float(min(tried, key=lambda each: fit_drift_and_two_harmonics(each, motion[inside])[1]))
    (of_motion, _), (of_load, squares) = (fit_drift_and_two_harmonics(frequency, values[inside])
                                          for values in (motion, load))
    ratio = complex(of_load[2], -of_load[3]) / complex(of_motion[2], -of_motion[3])
    error = np.sqrt(2 * squares / clock.size) / np.sqrt(clock.size)
    # The phase is unknown if the amplitude of the load is below the noise.
    if abs(complex(of_load[2], of_load[3])) < 10 * error:
        return frequency, None
    return frequency, float(ratio.imag / ratio.real) if ratio.real else None
