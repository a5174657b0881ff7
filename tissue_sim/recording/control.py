"""Recognise the controlled quantity and the pattern of a test: ramp, hold, staircase, creep or oscillation.

An oscillation has several periods of equal amplitude around an offset, and a loss factor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from tissue_sim.recording.saturation import find_last_digit_step_or_zero
from tissue_sim.recording.screening import SCREENING, ControlledQuantityFindings
from tissue_sim.recording.segmentation import (
    ReversalDetector,
    estimate_noise_deviation,
    label_samples_ramp_hold_unload,
)


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
_CYCLES = OscillationSettings()


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
    if motion.size < 3 * _CYCLES.fewest or not reach > 0:
        return None
    every = -(-motion.size // _CYCLES.most_samples)
    places = np.arange(0, motion.size, every)
    bend = motion[places][1:-1] - 0.5 * (motion[places][:-2] + motion[places][2:])
    noise = float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(1.5))
    reversals = ReversalDetector(min(max(_CYCLES.hysteresis_range * reach, _CYCLES.hysteresis_noise * noise),
                                     0.3 * reach))
    for index, value in zip(places.tolist(), motion[places].tolist(), strict=True):
        reversals.add_sample(index, value)
    window = _find_last_equal_half_periods_and_period(np.array([*reversals.starts, motion.size - 1]), motion, time)
    if window is None:
        return None
    first, last, period = window
    inside = motion[first:last + 1]
    low, high = float(np.quantile(inside, 0.02)), float(np.quantile(inside, 0.98))
    if float(motion[last:].max()) > high + _CYCLES.beyond * reach or float(motion[last:].min()) < low - reach:
        return None
    mean, amplitude = 0.5 * (low + high), 0.5 * (high - low)
    # A recording that leads to its oscillation by a ramp starts at rest.
    rest = float(motion[0]) if not low - 0.1 * amplitude <= motion[0] <= high + 0.1 * amplitude else 0.0
    near = 2 * _CYCLES.returns * amplitude
    returns = low - near <= rest <= high + near and abs(mean - rest) > _CYCLES.returns * amplitude
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
    if heights.size < _CYCLES.fewest + 2:
        return None
    heights, durations = heights[1:-1], durations[1:-1]
    height, duration = float(np.median(heights[-_CYCLES.fewest:])), float(np.median(durations[-_CYCLES.fewest:]))
    alike = ((np.abs(heights - height) <= _CYCLES.alike * height)
             & (np.abs(durations - duration) <= _CYCLES.alike * duration))
    different = np.flatnonzero(~alike)
    begin = int(different[-1]) + 1 if different.size else 0
    if heights.size - begin < _CYCLES.fewest:
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

    tried = (1 + np.linspace(-_CYCLES.frequency_width, _CYCLES.frequency_width, _CYCLES.frequencies)) / period
    frequency = float(min(tried, key=lambda each: fit_drift_and_two_harmonics(each, motion[inside])[1]))
    (of_motion, _), (of_load, squares) = (fit_drift_and_two_harmonics(frequency, values[inside])
                                          for values in (motion, load))
    ratio = complex(of_load[2], -of_load[3]) / complex(of_motion[2], -of_motion[3])
    error = np.sqrt(2 * squares / clock.size) / np.sqrt(clock.size)
    # The phase is unknown if the amplitude of the load is below the noise.
    if abs(complex(of_load[2], of_load[3])) < 10 * error:
        return frequency, None
    return frequency, float(ratio.imag / ratio.real) if ratio.real else None


@dataclass(frozen=True)
class ControlledQuantitySettings:
    """Settings of `detect_controlled_quantity_and_creep` and `find_creep_intervals`.

    Attributes:
        fewest: fewest samples of a hold.
        loaded: least load of a hold above the load at rest, as a fraction of the range.
        held_range: half width of the band in which a load is held, as a fraction of its range.
        held_noise: half width of the band in which a load is held, in standard deviations of its noise.
        slower: largest rate of a displacement that creeps, as a fraction of the rate of the loading.
        late: creep from the first sample on: largest displacement in the second half of the duration, as a fraction of
            the displacement in the first half.
        straight: largest deviation of a controlled channel from a line in time, as a fraction of the range.
        straighter: least ratio of the deviation of the other channel to the deviation of the controlled channel.
        rising: ratio of the loading rate in an apparent hold of the displacement to the mean loading rate, above which
            the apparent hold belongs to the loading.
        turn: decrease of a channel, as a fraction of its range, that marks the end of the first loading.
        undeformed: largest displacement of an undeformed specimen at the first sample, as a fraction of the range.
        fine_digit: last digit of a load, as a fraction of its level, below which a load without noise is not measured
            or is saturated: a fifth of the 1 % within which a creep test holds its load (ISO 899-1).
        equal: least fraction of the samples of a hold that are equal.
        most_samples: largest number of samples that are examined; a longer recording is thinned evenly.
        end_samples: samples at each end of a hold whose median is used.
        position_error: largest error of a position, as a fraction of the range of the motion: that of a stage whose
            answers come late. Positions with this error can seem to rest while the stage moves.
    """

    fewest: int = 5
    loaded: float = 0.1
    held_range: float = 0.015
    held_noise: float = 3.0
    slower: float = 0.3
    late: float = 0.5
    straight: float = 0.01
    straighter: float = 4.0
    rising: float = 0.25
    turn: float = 0.1
    undeformed: float = 0.05
    fine_digit: float = 0.002
    equal: float = 0.9
    most_samples: int = 20_000
    end_samples: int = 3
    position_error: float = 0.01


#: Settings that the functions of this module use.
_SETTINGS = ControlledQuantitySettings()


def detect_controlled_quantity_and_creep(motion: np.ndarray, load: np.ndarray,
                                         time: np.ndarray | None = None) -> ControlledQuantityFindings:
    """Recognise the controlled quantity, and the relaxation or creep of the material in holds.

    Args:
        motion: displacement or strain, positive under load, in the order of time, shape (n,).
        load: force or stress, positive under load, shape (n,).
        time: time, s, shape (n,); None: even steps.
    """
    if motion.size > _SETTINGS.most_samples:
        every = -(-motion.size // _SETTINGS.most_samples)
        clock = np.arange(motion.size, dtype=float) if time is None else time
        found = detect_controlled_quantity_and_creep(motion[::every], load[::every], clock[::every])
        return replace(found, loading=min(every * found.loading, motion.size),
                       equal_samples=every * found.equal_samples)
    clock = np.arange(motion.size, dtype=float) if time is None else time
    if motion.size < 2 * _SETTINGS.fewest or not np.ptp(motion) > 0 or not clock[-1] > clock[0]:
        return ControlledQuantityFindings(None, "ramp", loading=motion.size)
    if not np.ptp(load) > 0:
        return _make_findings_of_constant_load(motion, load, time)
    oscillation = find_final_oscillation_or_none(motion, load, time)
    if oscillation is not None and not oscillation.returns:
        return ControlledQuantityFindings(_find_channel_linear_in_time_or_none(motion, load, clock, oscillation.first),
                                          "oscillation",
                                          loss_factor=oscillation.loss_factor, frequency=oscillation.frequency,
                                          loading=_count_to_peak_before_oscillation(motion, oscillation))
    rest = min(_estimate_load_at_rest(motion, load), float(np.median(load[:_SETTINGS.end_samples])))
    holds = [each for each in _iterate_long_holds(label_samples_ramp_hold_unload(clock, motion))
             if not _does_loading_continue(load, clock, *each)]
    relaxation, first, last = _find_largest_relaxed_fraction_and_hold(motion, load, holds, rest)
    crept = [each for each in _iterate_holds_with_relative_creep(motion, load, clock) if each[2] > SCREENING.creep]
    if crept:
        begin, end, creep = max(crept, key=lambda each: each[2])
        start = crept[0][0]
        return ControlledQuantityFindings("force", "creep", 0.0, creep, loading=start,
                                          time_constant=_compute_time_constant(motion, clock, begin, end),
                                          loading_time=float(clock[start] - clock[0]),
                                          equal_samples=_count_loads_equal_to_median(load, begin, end))
    loaded = [begin for begin, end in holds if np.median(load[begin:end]) - rest > _SETTINGS.loaded * np.ptp(load)]
    steps = [begin for begin in loaded if motion[begin] >= 0.98 * motion[:begin + 1].max()]
    pattern = "staircase" if len(steps) > 1 else "ramp and hold" if loaded else "cycles" if oscillation else "ramp"
    peak = int(np.argmax(motion))
    turn = min(peak, *(_find_first_turn(values) for values in (motion, load)))
    quantity = _find_channel_linear_in_time_or_none(motion, load, clock, turn + 1)
    return ControlledQuantityFindings("displacement" if loaded else quantity, pattern, relaxation,
                                      loading=min([*loaded, peak + 1]),
                                      time_constant=_compute_time_constant(load, clock, first, last) if relaxation
                                      else None,
                                      loading_time=float(clock[_find_sample_near_maximum_motion(motion)] - clock[0]))


def _make_findings_of_constant_load(motion: np.ndarray, load: np.ndarray,
                                    time: np.ndarray | None) -> ControlledQuantityFindings:
    """Return the findings of a recording whose load has one value: creep from the first sample on, if it is loaded.

    A rheometer records the set stress. Without time the recording is a table, which shows no control.
    """
    gain = float(np.median(motion[-_SETTINGS.end_samples:]) - motion[0])
    if time is None or not load[0] > 0 or not gain > 0:
        return ControlledQuantityFindings(None, "ramp", loading=motion.size)
    start = max(float(motion[0]), _SETTINGS.undeformed * float(np.ptp(motion)))
    return ControlledQuantityFindings("force", "creep", creep=gain / start,
                                      time_constant=_compute_time_constant(motion, time, 0, motion.size))


def _count_loads_equal_to_median(load: np.ndarray, first: int, last: int) -> int:
    """Return how many loads of the samples `first` to `last` (not included) equal the median of these loads exactly.

    The number is 0 if the loads scatter, or if their last digit is coarse.
    """
    level = float(np.median(load[first:last]))
    count = int(np.count_nonzero(load[first:last] == level))
    if count < max(_SETTINGS.fewest, _SETTINGS.equal * (last - first)):
        return 0
    return count if 0.0 < find_last_digit_step_or_zero(load) <= _SETTINGS.fine_digit * abs(level) else 0


def find_creep_intervals(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None = None
                         ) -> tuple[tuple[int, int], ...]:
    """Return first sample (from 0) and end (not included) of each hold of the load in which the displacement creeps.

    Args:
        motion: displacement or strain, positive under load, in the order of time, shape (n,).
        load: force or stress, positive under load, shape (n,).
        time: time, s, shape (n,); None: even steps.
    """
    if motion.size > _SETTINGS.most_samples:
        every = -(-motion.size // _SETTINGS.most_samples)
        thinned = find_creep_intervals(motion[::every], load[::every], None if time is None else time[::every])
        return tuple((every * first, min(every * last, motion.size)) for first, last in thinned)
    clock = np.arange(motion.size, dtype=float) if time is None else time
    if motion.size < 2 * _SETTINGS.fewest or not np.ptp(motion) > 0 or not np.ptp(load) > 0 or not clock[-1] > clock[0]:
        return ()
    return tuple((first, last) for first, last, gain in _iterate_holds_with_relative_creep(motion, load, clock)
                 if gain > SCREENING.creep)


def _estimate_load_at_rest(motion: np.ndarray, load: np.ndarray) -> float:
    """Return the load, in the unit of the recording, at which the specimen is unloaded.

    The load of the first sample is the load at rest. A recording that begins in a deformed state, as after a first
    sample that is left out, has a load at rest of at most zero.
    """
    return float(load[0]) if abs(motion[0]) <= _SETTINGS.undeformed * np.ptp(motion) else min(float(load[0]), 0.0)


def _compute_time_constant(values: np.ndarray, clock: np.ndarray, first: int, last: int) -> float:
    """Return the time, s, after which 63 % of the change between samples `first` and `last` (excluded) has passed."""
    part = values[first:last]
    done = (part - part[0]) / ((float(np.median(part[-_SETTINGS.end_samples:])) - part[0]) or 1.0)
    reached = first + int(np.argmax(done >= 1.0 - np.exp(-1.0)))
    return float(max(clock[reached] - clock[first], clock[min(first + 1, last - 1)] - clock[first]))


def _find_sample_near_maximum_motion(motion: np.ndarray) -> int:
    """Return the sample at which the motion reaches 98 % of its maximum: the noise of a hold can shift the maximum."""
    return int(np.argmax(motion >= 0.98 * motion.max()))


def _does_loading_continue(load: np.ndarray, clock: np.ndarray, first: int, last: int) -> bool:
    """Return whether the load increases from sample `first` to `last` (not included) as fast as in the loading.

    Noise makes a slow motion under a controlled force look like short holds.
    """
    peak = int(np.argmax(load))
    duration = clock[peak] - clock[0]
    rate = (load[peak] - load[0]) / duration if duration > 0 else 0.0
    rise = float(np.median(load[max(last - _SETTINGS.end_samples, first):last])
                 - np.median(load[first:first + _SETTINGS.end_samples]))
    return bool(rise > _SETTINGS.rising * rate * (clock[last - 1] - clock[first]) > 0.0)


def _find_first_turn(values: np.ndarray) -> int:
    """Return the sample of the largest value before the first fall by `ControlledQuantitySettings.turn` of the range.

    In creep the largest displacement of several cycles of the force is in the last one.
    """
    fell = np.maximum.accumulate(values) - values > _SETTINGS.turn * np.ptp(values)
    return int(np.argmax(values[:int(np.argmax(fell)) + 1] if fell.any() else values))


def _count_to_peak_before_oscillation(motion: np.ndarray, oscillation: Oscillation) -> int:
    """Return the number of samples up to and including the largest displacement before the oscillation."""
    return int(np.argmax(motion[:oscillation.first + 1])) + 1


def _iterate_label_runs(labels: np.ndarray) -> Iterator[tuple[str, int, int]]:
    """Yield name, first sample and end (not included) of each run of labels."""
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    for first, last in pairwise(edges.tolist()):
        yield str(labels[first]), first, last


def _iterate_long_holds(labels: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield first sample and end (not included) of each long hold; the first sample is the last one of the motion."""
    yield from ((max(first - 1, 0), last) for name, first, last in _iterate_label_runs(labels)
                if name == "hold" and last - first >= _SETTINGS.fewest)


def _find_largest_relaxed_fraction_and_hold(motion: np.ndarray, load: np.ndarray, holds: Sequence[tuple[int, int]],
                                            rest: float) -> tuple[float, int, int]:
    """Return the largest relaxed fraction of the load, first sample and end of its hold; (0, 0, 0) without relaxation.

    The fraction is the load lost in a hold, or in a hold and the holds before it, over the load without this loss. In a
    staircase only the last step of the load relaxes in a hold, because the earlier steps are relaxed already. An
    unloading between two holds begins a new sum, because a material that rests recovers.

    A sum of n losses is significant above sqrt(n) times the noise, and above sqrt(n) times the loss that an error of
    the position at both ends of a hold explains.
    """
    found, reached, previous = (0.0, 0, 0), -np.inf, 0
    noise, span, lowest = estimate_noise_deviation(load), float(np.ptp(motion)), float(motion.min())
    losses: list[float] = []
    for first, last in holds:
        begin = float(np.median(load[first:first + _SETTINGS.end_samples])) - rest
        end = float(np.median(load[max(last - _SETTINGS.end_samples, first):last])) - rest
        if float(motion[previous:first + 1].min()) < reached - _SETTINGS.position_error * span:
            losses = []
        reached, previous = float(motion[first]), last
        if begin <= _SETTINGS.loaded * np.ptp(load) or motion[first] <= lowest:
            continue
        losses.append(begin - end)
        explained = 2.0 * _SETTINGS.position_error * span * begin / (reached - lowest)
        for count in {1, len(losses)}:
            lost = sum(losses[-count:])
            if lost >= 4 * noise * np.sqrt(count) and lost > explained * np.sqrt(count):
                found = max(found, (float(lost / (lost - losses[-1] + begin)), first, last))
    return found


def _iterate_holds_with_relative_creep(motion: np.ndarray, load: np.ndarray,
                                       clock: np.ndarray) -> Iterator[tuple[int, int, float]]:
    """Yield first sample, end and relative gain of the displacement for each hold of the load with creep."""
    rest = _estimate_load_at_rest(motion, load)
    span = max(float(load.max()), rest) - min(float(load.min()), rest)
    tolerance = max(_SETTINGS.held_range * span, _SETTINGS.held_noise * estimate_noise_deviation(load))
    if tolerance > 0.2 * span:
        return
    for first, last in _iterate_long_holds(label_samples_ramp_hold_unload(clock, load, tolerance)):
        level = float(np.median(load[first + 1:last]))
        first += 1
        if abs(level - rest) <= _SETTINGS.loaded * span or np.ptp(load[first:last]) > 4 * tolerance:
            continue
        gain = float(np.median(motion[last - _SETTINGS.end_samples:last]) - motion[first])
        duration = clock[last - 1] - clock[first]
        creep = gain - _compute_displacement_explained_by_load_increase(motion, load, first, last)
        if creep <= 0 or not duration > 0 or creep < 6 * estimate_noise_deviation(motion) or motion[first] <= 0:
            continue
        if _is_motion_slowing_as_in_creep(motion, clock, first, last, gain / duration):
            yield first, last, creep / float(motion[first])


def _compute_displacement_explained_by_load_increase(motion: np.ndarray, load: np.ndarray, first: int,
                                                     last: int) -> float:
    """Return the displacement that the increase of the load from sample `first` to `last` (not included) explains.

    The increase is divided by the stiffness of the loading in the samples before. Without a loading before, or if the
    load does not increase, the result is 0.
    """
    before = max(first - _SETTINGS.fewest, 0)
    moved, loaded = motion[first] - motion[before], load[first] - load[before]
    increase = float(np.median(load[max(last - _SETTINGS.end_samples, first):last])
                     - np.median(load[first:first + _SETTINGS.end_samples]))
    return max(increase, 0.0) * float(moved / loaded) if moved > 0 and loaded > 0 else 0.0


def _is_motion_slowing_as_in_creep(motion: np.ndarray, clock: np.ndarray, first: int, last: int, rate: float) -> bool:
    """Return whether a motion in samples `first` to `last` (not included) creeps.

    Creep slows down, and it is slower than the loading before. A recording that begins in a loaded state does not show
    the loading. There the motion must slow down clearly, because a motion in air has a constant rate.

    Args:
        motion: displacement or strain, shape (n,).
        clock: time, s, shape (n,).
        first: first sample, from 0.
        last: end of the samples, not included.
        rate: mean rate of the motion from sample `first` on, 1/s times the unit of the motion.
    """
    middle = first + int(np.argmax(clock[first:last] >= 0.5 * (clock[first] + clock[last - 1])))
    halves = motion[middle] - motion[first], motion[last - 1] - motion[middle]
    if first <= 1 and abs(motion[0]) > _SETTINGS.undeformed * np.ptp(motion):
        return bool(halves[1] < _SETTINGS.late * halves[0])
    before = max(first - _SETTINGS.fewest, 0)
    loading = clock[first] - clock[before]
    return bool(halves[1] <= halves[0] and loading > 0 and motion[first] > motion[before]
                and rate < _SETTINGS.slower * (motion[first] - motion[before]) / loading)


def _find_channel_linear_in_time_or_none(motion: np.ndarray, load: np.ndarray, clock: np.ndarray, end: int
                                         ) -> Literal["displacement", "force"] | None:
    """Return the channel that is linear in time up to sample `end` (not included); None if both or neither are."""
    if end < 2 * _SETTINGS.fewest or not clock[end - 1] > clock[0]:
        return None
    bends = []
    for values in (motion[:end], load[:end]):
        line = np.polynomial.polynomial.polyfit(clock[:end] - clock[0], values, 1)
        gaps = values - np.polynomial.polynomial.polyval(clock[:end] - clock[0], line)
        bends.append(float(np.sqrt(np.mean(gaps**2))) / (float(np.ptp(values)) or 1.0))
    if min(bends) > _SETTINGS.straight or max(bends) < _SETTINGS.straighter * min(bends):
        return None
    return "displacement" if bends[0] < bends[1] else "force"
