"""Value of a channel at the first sample of a recording, also where that value is an outlier."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.control import noise_deviation
from tissue_sim.recording.outliers import median_line
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import Screening

#: Channels of the load.
LOADS = ("force", "nominal stress")
#: Samples after the outlier through which the lines are drawn.
_NEAR = 8
#: Fewest samples of such a line.
_FEWEST = 4
#: Difference from an even motion that counts as none, as a fraction of the change up to the first sample that is kept,
#: and in standard errors of that fraction.
_EVEN = 0.3
_ERRORS = 3.0


def first_value(recording: Recording, screening: Screening, name: str, partner: str) -> float | None:
    """Value of a channel at the first sample; None where the other samples do not determine it.

    A value that is an outlier is replaced by the line in time through the samples that follow, extended to the first
    sample. The partner shows whether the test was running there: if its first value lies on its own line too, the
    extension holds; if its change up to the first sample that is kept is only a fraction f of that of its line, the
    test started late, and the channel changes by the same fraction f of its line. A larger change is a sudden load,
    after which the lines say nothing about the first sample. Where the first load is an outlier too, the specimen is
    taken as unloaded at the first sample.

    Args:
        recording: all of its samples. screening: of `tissue_sim.recording.cleaning.clean`.
        name: of the channel. partner: the load of a motion, the motion of a load.
    """
    values, other = recording.channel(name), recording.channel(partner)
    if not _is_wrong(screening, name):
        # A sample that the campaign lists without a visible fault is left out of both channels.
        return float(values[np.argmax(_kept(recording, screening))] if _is_wrong(screening, "") else values[0])
    usable = np.flatnonzero(_kept(recording, screening))
    kept = usable[:_NEAR]
    if kept.size < _FEWEST:
        return None
    clock = recording.time[kept] - recording.time[0] if "time" in recording else kept.astype(float)
    if not (clock[0] > 0 and np.all(np.diff(clock) > 0)):
        clock = kept.astype(float)
    start, slope = median_line(clock, values[kept])
    first = float(other[0])
    if _is_wrong(screening, partner):
        if partner not in LOADS:
            return None
        first = 0.0
    fraction, error = _fraction(clock, other[kept], first, _deviation(other[usable]))
    if abs(fraction - 1.0) <= max(_EVEN, _ERRORS * error):
        return start
    if fraction > 1.0 or fraction < -max(_EVEN, _ERRORS * error):
        return None
    return start + slope * float(clock[0]) * (1.0 - max(fraction, 0.0))


def _is_wrong(screening: Screening, name: str) -> bool:
    return any(1 in each.samples and each.channel == name for each in screening.left_out)


def _kept(recording: Recording, screening: Screening) -> np.ndarray:
    return ~np.isin(np.arange(1, len(recording) + 1), screening.samples)


def _fraction(clock: np.ndarray, values: np.ndarray, first: float, noise: float) -> tuple[float, float]:
    """Change of a channel from the first sample to the first one that is kept, over that of its line in time; and the
    standard error of this fraction, infinite for a line without slope.

    Args:
        clock: of the samples that are kept, from the first sample, s. values: at them.
        first: value at the first sample. noise: deviation of the channel.
    """
    start, slope = median_line(clock, values)
    change = slope * float(clock[0])
    deviation = max(noise, float(np.median(np.abs(values - start - slope * clock))) / 0.6745)
    if change == 0:
        return (np.inf if abs(start - first) > _ERRORS * deviation else 1.0), np.inf
    # Variance of a line at time 0 and that of the first value, in variances of the noise.
    leverage = 1.0 / clock.size + float(np.mean(clock))**2 / float(np.sum((clock - np.mean(clock))**2))
    return (start - first) / change + 1.0, np.sqrt(1.0 + leverage) * deviation / abs(change)


def _deviation(values: np.ndarray) -> float:
    """Standard deviation of the noise, or of the rounding to a step by which samples are equal to their neighbours."""
    steps = np.abs(np.diff(values))
    rounding = float(steps[steps > 0].min()) / np.sqrt(12.0) if np.any(steps > 0) and np.any(steps == 0) else 0.0
    return max(noise_deviation(values), rounding)
