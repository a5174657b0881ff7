"""The controlled quantity of a test, recognised by the signals: ramps, holds, staircases, creep, oscillation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from tissue_sim.recording.oscillation import Oscillation, find_oscillation
from tissue_sim.recording.saturation import last_digit
from tissue_sim.recording.screening import CREEPS, Control
from tissue_sim.recording.segmentation import label_motion

#: Fewest samples of a hold.
_FEWEST = 5
#: Load of a hold over that at rest, as a fraction of the range.
_LOADED = 0.1
#: Half width of a load that is held, as a fraction of its range and in deviations of its noise.
_HELD_RANGE = 0.015
_HELD_NOISE = 3.0
#: A displacement creeps where its rate is less than this fraction of the rate at which the specimen was loaded.
_SLOWER = 0.3
#: A displacement creeps from the first sample on where its second half adds less than this fraction of its first half.
_LATE = 0.5
#: A line in time: largest deviation from it as a fraction of the range; and how many times more the other channel has.
_STRAIGHT = 0.01
_STRAIGHTER = 4.0
#: Displacement of the first sample, as a fraction of the range, up to which the specimen is undeformed there.
_UNDEFORMED = 0.05
#: Last digit of a load, as a fraction of its level, below which a load without noise is not measured or is saturated: a
#: fifth of the 1 % within which a creep test holds its load (ISO 899-1).
_FINE_DIGIT = 0.002
#: Fraction of the samples of a hold that are equal.
_EQUAL = 0.9
#: Most samples that are examined; others are skipped evenly.
_MOST = 20_000
#: Samples at each end of a hold whose median counts.
_AT_ENDS = 3


def find_control(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None = None) -> Control:
    """Recognise what the machine controls and what the material does in holds.

    Args:
        motion, load: positive under load, in the order of time, shape (n,). time: s, shape (n,); None: even steps.
    """
    if motion.size > _MOST:
        every = -(-motion.size // _MOST)
        clock = np.arange(motion.size, dtype=float) if time is None else time
        found = find_control(motion[::every], load[::every], clock[::every])
        return replace(found, loading=min(every * found.loading, motion.size))
    clock = np.arange(motion.size, dtype=float) if time is None else time
    if motion.size < 2 * _FEWEST or not np.ptp(motion) > 0 or not np.ptp(load) > 0 or not clock[-1] > clock[0]:
        return Control(None, "ramp", loading=motion.size)
    oscillation = find_oscillation(motion, load, time)
    if oscillation is not None and not oscillation.returns:
        return Control(_straighter(motion, load, clock, oscillation.first), "oscillation",
                       loss_factor=oscillation.loss_factor, frequency=oscillation.frequency,
                       loading=_first_turn(motion, oscillation))
    rest = min(_load_at_rest(motion, load), float(np.median(load[:_AT_ENDS])))
    holds = list(_holds(label_motion(clock, motion)))
    lost = max(((_lost(load, first, last, rest), first, last) for first, last in holds), default=(0.0, 0, 0))
    crept = [each for each in _creep(motion, load, clock) if each[2] > CREEPS]
    if crept:
        first, last, creep = max(crept, key=lambda each: each[2])
        start = crept[0][0]
        return Control("force", "creep", 0.0, creep, loading=start, time_constant=_time_constant(motion, clock, first,
                       last), loading_time=float(clock[start] - clock[0]), equal_samples=_equal(load, first, last))
    loaded = [first for first, last in holds if np.median(load[first:last]) - rest > _LOADED * np.ptp(load)]
    steps = [first for first in loaded if motion[first] >= 0.98 * motion[:first + 1].max()]
    pattern = "staircase" if len(steps) > 1 else "ramp and hold" if loaded else "cycles" if oscillation else "ramp"
    peak = int(np.argmax(motion))
    quantity = _straighter(motion, load, clock, peak + 1)
    relaxation, first, last = lost
    return Control("displacement" if loaded else quantity, pattern, relaxation, loading=min([*loaded, peak + 1]),
                   time_constant=_time_constant(load, clock, first, last) if relaxation else None,
                   loading_time=float(clock[_arrival(motion)] - clock[0]))


def _equal(load: np.ndarray, first: int, last: int) -> int:
    """Number of samples from `first` to `last` (not included) whose load is equal to the last digit; 0: they scatter,
    or the digit is coarse."""
    level = float(np.median(load[first:last]))
    count = int(np.count_nonzero(load[first:last] == level))
    if count < max(_FEWEST, _EQUAL * (last - first)):
        return 0
    return count if 0.0 < last_digit(load) <= _FINE_DIGIT * abs(level) else 0


def creep_holds(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None = None) -> tuple[tuple[int, int], ...]:
    """First sample (from 0) and end of each part in which the displacement creeps under a held load."""
    if motion.size > _MOST:
        every = -(-motion.size // _MOST)
        thinned = creep_holds(motion[::every], load[::every], None if time is None else time[::every])
        return tuple((every * first, min(every * last, motion.size)) for first, last in thinned)
    clock = np.arange(motion.size, dtype=float) if time is None else time
    if motion.size < 2 * _FEWEST or not np.ptp(motion) > 0 or not np.ptp(load) > 0 or not clock[-1] > clock[0]:
        return ()
    return tuple((first, last) for first, last, gain in _creep(motion, load, clock) if gain > CREEPS)


def _load_at_rest(motion: np.ndarray, load: np.ndarray) -> float:
    """Load of the unloaded specimen: that of the first sample, or zero where the recording begins in a deformed state,
    as after a first sample that is left out."""
    return float(load[0]) if abs(motion[0]) <= _UNDEFORMED * np.ptp(motion) else min(float(load[0]), 0.0)


def _time_constant(values: np.ndarray, clock: np.ndarray, first: int, last: int) -> float:
    """Time in which 63 % of the change from sample `first` to `last` (not included) takes place, s."""
    part = values[first:last]
    done = (part - part[0]) / ((float(np.median(part[-_AT_ENDS:])) - part[0]) or 1.0)
    reached = first + int(np.argmax(done >= 1.0 - np.exp(-1.0)))
    return float(max(clock[reached] - clock[first], clock[min(first + 1, last - 1)] - clock[first]))


def _arrival(motion: np.ndarray) -> int:
    """Sample at which the largest motion is reached; a hold trembles and may be larger anywhere in it."""
    return int(np.argmax(motion >= 0.98 * motion.max()))


def _first_turn(motion: np.ndarray, oscillation: Oscillation) -> int:
    return int(np.argmax(motion[:oscillation.first + 1])) + 1


def _runs(labels: np.ndarray) -> Iterator[tuple[str, int, int]]:
    """Name, first sample and end (not included) of each run of labels."""
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    for first, last in pairwise(edges.tolist()):
        yield str(labels[first]), first, last


def _holds(labels: np.ndarray) -> Iterator[tuple[int, int]]:
    """First sample and end of each hold that is long enough and follows a motion."""
    yield from ((max(first - 1, 0), last) for name, first, last in _runs(labels)
                if name == "hold" and last - first >= _FEWEST)


def _lost(load: np.ndarray, first: int, last: int, rest: float) -> float:
    """Fraction of the load at the start of a hold that is lost in it; 0 where it is not significant."""
    noise = noise_deviation(load)
    begin = float(np.median(load[first:first + _AT_ENDS]))
    end = float(np.median(load[max(last - _AT_ENDS, first):last]))
    if begin - rest <= _LOADED * np.ptp(load) or begin - end < 4 * noise:
        return 0.0
    return (begin - end) / (begin - rest)


def _creep(motion: np.ndarray, load: np.ndarray, clock: np.ndarray) -> Iterator[tuple[int, int, float]]:
    """First sample, end and gain of the displacement (as a fraction) of each hold of the load in which it creeps."""
    rest = _load_at_rest(motion, load)
    span = max(float(load.max()), rest) - min(float(load.min()), rest)
    tolerance = max(_HELD_RANGE * span, _HELD_NOISE * noise_deviation(load))
    if tolerance > 0.2 * span:
        return
    for first, last in _holds(label_motion(clock, load, tolerance)):
        level = float(np.median(load[first + 1:last]))
        first += 1
        if abs(level - rest) <= _LOADED * span or np.ptp(load[first:last]) > 4 * tolerance:
            continue
        gain = float(np.median(motion[last - _AT_ENDS:last]) - motion[first])
        duration = clock[last - 1] - clock[first]
        if gain <= 0 or not duration > 0 or gain < 6 * noise_deviation(motion) or motion[first] <= 0:
            continue
        if _slows_down(motion, clock, first, last, gain / duration):
            yield first, last, gain / float(motion[first])


def _slows_down(motion: np.ndarray, clock: np.ndarray, first: int, last: int, rate: float) -> bool:
    """Whether a motion in samples `first` to `last` (not included) creeps: it slows down, and it is slower than the
    loading before. Where the recording begins in a loaded state, the loading before is not known, and the motion must
    slow down clearly, as a motion in air is even.

    Args:
        rate: mean rate of the motion from sample `first` on.
    """
    middle = first + int(np.argmax(clock[first:last] >= 0.5 * (clock[first] + clock[last - 1])))
    halves = motion[middle] - motion[first], motion[last - 1] - motion[middle]
    if first <= 1 and abs(motion[0]) > _UNDEFORMED * np.ptp(motion):
        return bool(halves[1] < _LATE * halves[0])
    before = max(first - _FEWEST, 0)
    loading = clock[first] - clock[before]
    return bool(halves[1] <= halves[0] and loading > 0 and motion[first] > motion[before]
                and rate < _SLOWER * (motion[first] - motion[before]) / loading)


def _straighter(motion: np.ndarray, load: np.ndarray, clock: np.ndarray, end: int
                ) -> Literal["displacement", "force"] | None:
    """The channel that is a line in time up to sample `end` (not included), if the other one is not."""
    if end < 2 * _FEWEST or not clock[end - 1] > clock[0]:
        return None
    bends = []
    for values in (motion[:end], load[:end]):
        line = np.polynomial.polynomial.polyfit(clock[:end] - clock[0], values, 1)
        gaps = values - np.polynomial.polynomial.polyval(clock[:end] - clock[0], line)
        bends.append(float(np.sqrt(np.mean(gaps**2))) / (float(np.ptp(values)) or 1.0))
    if min(bends) > _STRAIGHT or max(bends) < _STRAIGHTER * min(bends):
        return None
    return "displacement" if bends[0] < bends[1] else "force"


def noise_deviation(values: np.ndarray) -> float:
    """Standard deviation of the noise of a smooth channel, from its second differences."""
    bend = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    return float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(1.5))
