"""Detect saturated sensors, and estimate the step of a coarse sensor.

A saturated channel keeps its extreme value to the last digit while the other channel continues.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SaturationSettings:
    """Thresholds of `find_saturated_runs`.

    Attributes:
        fewest: samples at the extreme value.
        before: samples before the first one, from which the rates of both channels are taken.
        missing_range: change that the channel would have made without saturation, as a fraction of its range.
        missing_noise: the same in deviations of the noise.
        travel: progress of the other channel, as a fraction of its range.
        speed: rate of the other channel over its rate before; a creeping displacement is slower.
        at_rest: distance of the extreme value from the first ones, as a fraction of the range.
        gap: largest number of samples between two at the extreme value that are counted as saturated.
        coarse: progress of the other channel, in its last digits.
        noisy: deviation of the noise before a run, in last digits, above which equal values are no measurement: with 2
            digits the next value is equal with a probability of 0.2, and four more are with one of 0.002.
        noise_from: samples before a run from which that noise is known.
    """

    fewest: int = 5
    before: int = 8
    missing_range: float = 0.02
    missing_noise: float = 4.0
    travel: float = 0.02
    speed: float = 0.5
    gap: int = 3
    at_rest: float = 0.1
    coarse: float = 4.0
    noisy: float = 2.0
    noise_from: int = 12


SETTINGS = SaturationSettings()


@dataclass(frozen=True)
class LastDigitSettings:
    """Settings of `find_last_digit_step_or_zero`.

    Attributes:
        exact: error of a difference, in units of the floating-point spacing of the largest value.
        finest: step below which values have no last digit, as a fraction of the largest value.
        sure: least remainder that counts as nonzero, in units of its error.
    """

    exact: float = 4.0
    finest: float = 1e-9
    sure: float = 4.0


#: Settings that the functions of this module use.
_DIGITS = LastDigitSettings()


@dataclass(frozen=True)
class SaturatedRun:
    """Samples `first` to `last` (from 0, both included) of a saturated channel, `count` of them at its extreme."""

    first: int
    last: int
    count: int


def find_saturated_runs(values: np.ndarray, other: np.ndarray, time: np.ndarray | None = None, *, rounding: float = 0.0,
                        is_free: bool = False, settings: SaturationSettings = SETTINGS) -> tuple[SaturatedRun, ...]:
    """Find the samples at which a channel is cut off at its largest or smallest value.

    A run of equal extreme values is saturation if the other channel continues in its direction at no less than half of
    its rate before, and the channel would have changed clearly at its rate before. Holds, coarse sensors, air, creep at
    a constant force and ruptures are not saturation. If the channel has a noise of several digits before the run, equal
    values are not a measurement, and it is sufficient that the other channel continues.

    Args:
        values: values of the channel in the order of time, any unit and sign, shape (n,).
        other: values of the other channel, shape (n,): the motion for a load, and the load for a motion.
        time: time, s, shape (n,); None: even steps.
        rounding: width of the interval of equal values, for values that were computed from rounded numbers.
        is_free: whether the channel is known not to be controlled, so that a hold cannot keep it constant.
        settings: thresholds.
    """
    clock = np.arange(values.size, dtype=float) if time is None else time
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * float(np.abs(values).max() or 1.0)]
    if not steps.size or not np.ptp(other) > 0:
        return ()
    missing = max(settings.missing_range * float(np.ptp(values)),
                  settings.missing_noise * _estimate_noise_deviation(values))
    digit = max(float(steps.min()), rounding)
    steps = np.abs(np.diff(other))
    travel = max(settings.travel * float(np.ptp(other)), settings.coarse * float(steps[steps > 0].min()),
                 settings.missing_noise * _estimate_noise_deviation(other))
    found = []
    for side in (1.0, -1.0):
        extreme = side * float((side * values).max())
        # The value at rest is no limit of a sensor.
        if abs(extreme - np.median(values[:3])) <= settings.at_rest * np.ptp(values):
            continue
        for run in _group_extreme_samples_into_runs(np.flatnonzero(side * values >= side * extreme - rounding),
                                                    settings):
            least = max(missing, digit * _compute_change_missing_at_smooth_peak(run.count, settings))
            is_equal = is_free or _is_noisy_before_run(run, values, rounding, settings)
            if (is_equal and _does_other_channel_continue(run, other, travel)) or _is_expected_change_missing_in_run(
                    run, side * values, other, clock, least, travel, settings):
                found.append(run)
    return tuple(sorted(found, key=lambda run: run.first))


def _is_noisy_before_run(run: SaturatedRun, values: np.ndarray, rounding: float, settings: SaturationSettings) -> bool:
    """Return whether the samples before a run scatter by several of their last digits, or widths of the rounding."""
    if run.first < settings.noise_from:
        return False
    before = values[:run.first]
    digit = max(find_last_digit_step_or_zero(values), rounding)
    # The third differences of a smooth curve are small, so that they show the noise alone.
    noise = float(np.median(np.abs(np.diff(before, 3)))) / (0.6745 * np.sqrt(20.0))
    return 0.0 < settings.noisy * digit <= noise


def _does_other_channel_continue(run: SaturatedRun, other: np.ndarray, travel: float) -> bool:
    """Return whether the other channel changes by more than `travel` along a run, away from its start."""
    along = other[run.first:run.last + 1] - other[run.first]
    return bool(abs(along[-1]) > travel and abs(along[-1]) >= 0.5 * float(np.ptp(along)))


def _compute_change_missing_at_smooth_peak(count: int, settings: SaturationSettings) -> float:
    """Return the apparent missing change of a channel with a smooth maximum, in its last digits.

    Around the maximum P - c x^2, with samples at the distance h, `count` samples within one digit d of P span
    2 x0 = 2 sqrt(d / c) >= (count - 1) h. Along that span the mean rate of the `before` samples in front of it,
    2 c (x0 + (before + 1) h / 2), gives 4 d + 2 d (before + 1) h / x0. A sensor that is cut off lacks more.
    """
    return 4.0 + 4.0 * (settings.before + 1) / (count - 1)


def find_last_digit_step_or_zero(values: np.ndarray) -> float:
    """Return the largest step of which all differences of the values are whole multiples, in double precision.

    The method is Euclid's algorithm for the greatest common divisor of the differences of neighbours. Values that were
    printed with a fixed number of decimals have such a step in any unit. Values without a last digit give a step far
    below their range, or 0; equal values give 0.

    Args:
        values: shape (n,).
    """
    largest = float(np.abs(values).max())
    differences = np.abs(np.diff(values))
    exact = _DIGITS.exact * float(np.finfo(float).eps) * largest
    if not np.any(differences > exact):
        return 0.0
    step, error = float(differences[differences > exact].min()), exact
    while step > max(_DIGITS.finest * largest, _DIGITS.sure * error):
        multiples = np.rint(differences / step)
        left, errors = np.abs(differences - step * multiples), exact + error * multiples
        if not np.any(left > _DIGITS.sure * errors):
            return step
        place = int(np.argmin(np.where(left > _DIGITS.sure * errors, left, np.inf)))
        step, error = float(left[place]), float(errors[place])
    return 0.0


def _estimate_noise_deviation(values: np.ndarray) -> float:
    """Return the standard deviation of the noise, without the equal values of a saturated sensor."""
    bend = np.abs(np.diff(values, 2))
    return float(np.median(bend[bend > 0])) / (0.6745 * np.sqrt(6.0)) if np.any(bend > 0) else 0.0


def _group_extreme_samples_into_runs(places: np.ndarray, settings: SaturationSettings) -> list[SaturatedRun]:
    """Return runs of at least `SaturationSettings.fewest` samples at the extreme value."""
    if places.size < settings.fewest:
        return []
    parts = np.split(places, np.flatnonzero(np.diff(places) > settings.gap + 1) + 1)
    return [SaturatedRun(int(part[0]), int(part[-1]), part.size) for part in parts if part.size >= settings.fewest]


def _is_expected_change_missing_in_run(run: SaturatedRun, values: np.ndarray, other: np.ndarray, clock: np.ndarray,
                                       missing: float, travel: float, settings: SaturationSettings) -> bool:
    """Return whether the channel, positive towards its extreme value, would have continued to change.

    Args:
        run: samples at the extreme value.
        values: values of the channel, positive towards the extreme value, shape (n,).
        other: values of the other channel, shape (n,).
        clock: time, s, shape (n,).
        missing: least change that the channel would have made.
        travel: least progress of the other channel.
        settings: thresholds.
    """
    first = max(run.first - settings.before, 0)
    if run.first - first < 3 or not clock[run.first - 1] > clock[first]:
        return False
    before = slice(first, run.first)
    rate, rate_of_other = (float(np.polyfit(clock[before] - clock[first], each[before], 1)[0])
                           for each in (values, other))
    if rate <= 0 or rate_of_other == 0:
        return False
    along = np.sign(rate_of_other) * (other[run.first:run.last + 1] - other[run.first])
    farthest = int(np.argmax(along))
    duration = clock[run.first + farthest] - clock[run.first]
    if farthest < settings.fewest - 1 or not duration > 0 or along[farthest] <= travel:
        return False
    is_fast = along[farthest] / duration >= settings.speed * abs(rate_of_other)
    # At the peak of a cycle the other channel may lead, so that its rate alone is not sufficient evidence.
    expected = min(rate * duration, rate / abs(rate_of_other) * along[farthest])
    return bool(is_fast and expected > missing)


@dataclass(frozen=True)
class ResolutionSettings:
    """Settings of `find_rounding_step_or_zero`.

    Attributes:
        whole: largest difference of a step from a whole multiple of the step of the sensor, as a fraction of that step.
        fine_digit: largest last digit of the numbers in the file, in steps of the sensor, by which the steps may
            differ.
    """

    whole: float = 1e-3
    fine_digit: float = 0.1


#: Settings that the functions of this module use.
_SETTINGS = ResolutionSettings()


def find_rounding_step_or_zero(values: np.ndarray) -> float:
    """Return the step of a sensor with few different values; 0 for a fine sensor.

    The numbers of a file are rounded, too: steps may differ from whole multiples by the last digit of the numbers.

    Args:
        values: in any unit, shape (n,).
    """
    levels = np.unique(values)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.abs(levels).max()]
    if not steps.size or levels.size > 0.5 * values.size:
        return 0.0
    counts = np.round(steps / steps.min())
    step = float(steps.sum() / counts.sum())
    digit = find_last_digit_step_or_zero(values)
    allowed = max(_SETTINGS.whole * step, 1.5 * digit if digit < _SETTINGS.fine_digit * step else 0.0)
    return step if np.abs(steps - counts * step).max() <= allowed else 0.0
