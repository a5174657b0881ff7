"""Value of a channel at the first sample of a recording, also where that value is an outlier."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.recording.control import noise_deviation
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import Screening

#: Channels of the load.
LOADS = ("force", "nominal stress")
#: Most and fewest samples after the outlier through which a curve is drawn.
_MOST = 8
_FEWEST = 4
#: Largest distance of these samples from the curve, as a fraction of the range and in deviations of the noise.
_STRAIGHT = 1e-3
_NOISY = 3.0
#: Distance of the partner from its curve in the first sample that counts as none, as a fraction of its change up to the
#: first sample that is kept, and in standard errors.
_EVEN = 0.3
#: Largest standard error of the extended value, as a fraction of the range; moduli err by about twice this fraction.
_KNOWN = 0.02
_ERRORS = 3.0


class _Extension(NamedTuple):
    """A channel extended to time 0: its value there, its change from there to the first sample that is kept, and the
    standard error of the value."""

    start: float
    change: float
    error: float


def first_value(recording: Recording, screening: Screening, name: str, partner: str) -> float | None:
    """Value of a channel at the first sample; None where the other samples do not determine it.

    A value that is an outlier is replaced by a line or a parabola in time through the samples that follow, extended to
    the first sample. The partner shows whether the test was running there: if its first value lies on its own curve
    too, the extension holds; if its change up to the first sample that is kept is only a fraction f of that of its
    curve, the test started late, and the channel changes by the same fraction f of its curve. A larger change is a
    sudden load, after which the curves say nothing about the first sample. Where the first load is an outlier too, the
    specimen is taken as unloaded at the first sample.

    Args:
        recording: all of its samples. screening: of `tissue_sim.recording.cleaning.clean`.
        name: of the channel. partner: the load of a motion, the motion of a load.
    """
    values, other = recording.channel(name), recording.channel(partner)
    usable = np.flatnonzero(~np.isin(np.arange(1, len(recording) + 1), screening.samples))
    if not _is_wrong(screening, name):
        # A sample that the campaign lists without a visible fault is left out of both channels.
        return float(values[usable[0] if _is_wrong(screening, "") else 0])
    if _is_wrong(screening, partner) and partner not in LOADS:
        return None
    clock = recording.time[usable] - recording.time[0] if "time" in recording else usable.astype(float)
    if not (clock[0] > 0 and np.all(np.diff(clock[:_MOST]) > 0)):
        clock = usable.astype(float)
    digits = {each: _rounding(recording, usable, each, name if each == partner else partner) if each in LOADS else 0.0
              for each in (name, partner)}
    own, its = (_extended(clock, recording.channel(each)[usable], digits[each]) for each in (name, partner))
    if own is None or its is None or own.error > _KNOWN * float(np.ptp(values[usable])):
        return None
    gap = its.start - (0.0 if _is_wrong(screening, partner) else float(other[0]))
    late, tolerance = -gap, max(_EVEN * abs(its.change), _ERRORS * its.error)
    if abs(gap) <= tolerance:
        return own.start
    # A test that started late has a smaller change, but none in the other direction.
    if late * its.change < 0 or abs(late) > abs(its.change) + tolerance:
        return None
    return own.start + own.change * min(late / its.change, 1.0)


def _is_wrong(screening: Screening, name: str) -> bool:
    return any(1 in each.samples and each.channel == name for each in screening.left_out)


def _extended(clock: np.ndarray, values: np.ndarray, rounding: float) -> _Extension | None:
    """A channel extended to time 0 by a line, or by a parabola, through as many of its first samples as lie on it.

    Args:
        clock: of the samples that are kept, from the first sample of the recording, s. values: at them.
        rounding: standard deviation of the rounding of the values.

    Returns:
        None where no curve describes the first samples.
    """
    noise = max(noise_deviation(values), rounding)
    limit = max(_STRAIGHT * float(np.ptp(values)), _NOISY * noise)
    for count in range(min(_MOST, values.size), _FEWEST - 1, -1):
        for degree in (1, 2):
            design = np.vander(clock[:count] / clock[count - 1], degree + 1, increasing=True)
            coefficients = np.linalg.lstsq(design, values[:count], rcond=None)[0]
            if float(np.abs(values[:count] - design @ coefficients).max()) > limit:
                continue
            leverage = float(np.linalg.inv(design.T @ design)[0, 0])
            start = float(coefficients[0])
            return _Extension(start, float(design[0] @ coefficients) - start, noise * np.sqrt(1.0 + leverage))
    return None


def _rounding(recording: Recording, usable: np.ndarray, load: str, motion: str) -> float:
    """Standard deviation of the rounding of a load that stays equal while the motion continues."""
    steps, moves = (np.abs(np.diff(recording.channel(each)[usable])) for each in (load, motion))
    is_coarse = bool(np.any((steps == 0) & (moves > np.median(moves)))) and bool(np.any(steps > 0))
    return float(steps[steps > 0].min()) / np.sqrt(12.0) if is_coarse else 0.0
