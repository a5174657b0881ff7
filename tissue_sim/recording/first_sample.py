"""Estimate the value of a channel at the first sample of a recording, also if that value is an outlier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.recording.control import estimate_noise_deviation
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import Screening

#: Channels of the load.
LOADS = ("force", "nominal stress")


@dataclass(frozen=True)
class FirstSampleExtrapolationSettings:
    """Settings of `get_or_extrapolate_first_value_of_channel`: extension of a curve to the first sample.

    Attributes:
        most: largest number of samples after the outlier that determine the curve.
        fewest: fewest samples after the outlier that determine the curve.
        residual_range: largest distance of these samples from the curve, as a fraction of the range.
        residual_noise: largest distance of these samples from the curve, in standard deviations of the noise.
        gap: distance of the first value of the partner from its curve that counts as zero, as a fraction of its change
            up to the first sample that is kept.
        known: largest standard error of the extended value, as a fraction of the range. The moduli err by about twice
            this fraction.
        gap_errors: distance of the first value of the partner from its curve that counts as zero, in standard errors.
    """

    most: int = 8
    fewest: int = 4
    residual_range: float = 1e-3
    residual_noise: float = 3.0
    gap: float = 0.3
    known: float = 0.02
    gap_errors: float = 3.0


#: Settings that the functions of this module use.
_SETTINGS = FirstSampleExtrapolationSettings()


class _ChannelExtrapolatedToTimeZero(NamedTuple):
    """Value of a channel extrapolated to time 0, with its standard error.

    Attributes:
        start: value at time 0.
        change: change from time 0 to the first sample that is kept.
        error: standard error of `start`.
        sample_count: number of samples that determine the curve.
    """

    start: float
    change: float
    error: float
    sample_count: int


def get_or_extrapolate_first_value_of_channel(recording: Recording, screening: Screening, name: str,
                                              partner: str) -> float | None:
    """Return the value of a channel at the first sample; None if the other samples do not determine it.

    A value that is an outlier is replaced by a line or a parabola in time through the samples that follow, extended to
    the first sample. The partner shows whether the test was running there: if its first value lies on its own curve
    too, the extension holds; if its change up to the first sample that is kept is only a fraction f of that of its
    curve, the test started late, and the channel changes by the same fraction f of its curve. A larger change is a
    sudden load, after which the curves do not determine the first sample. If the first load is an outlier too, the
    specimen is assumed unloaded at the first sample.

    Args:
        recording: recording with all samples.
        screening: findings of `tissue_sim.recording.cleaning.remove_outliers_and_saturation`.
        name: name of the channel.
        partner: name of the load for a motion, and of the motion for a load.
    """
    values, other = recording.channel(name), recording.channel(partner)
    usable = np.flatnonzero(~np.isin(np.arange(1, len(recording) + 1), screening.left_out_sample_numbers))
    if not _is_first_sample_excluded_by_screening(screening, name):
        # A sample that the campaign lists without a visible fault is left out of both channels.
        return float(values[usable[0] if _is_first_sample_excluded_by_screening(screening, "") else 0])
    if _is_first_sample_excluded_by_screening(screening, partner) and partner not in LOADS:
        return None
    clock = recording.time[usable] - recording.time[0] if "time" in recording else usable.astype(float)
    if not (clock[0] > 0 and np.all(np.diff(clock[:_SETTINGS.most]) > 0)):
        clock = usable.astype(float)
    digits = {each: _estimate_rounding_deviation_of_load(recording, usable, each, name if each == partner else partner)
              if each in LOADS else 0.0 for each in (name, partner)}
    load, motion = (name, partner) if name in LOADS else (partner, name)
    moved = _try_extrapolating_channel_to_time_zero(clock, recording.channel(motion)[usable], digits[motion],
                                                    _SETTINGS.most)
    # A load after a corner of the motion is not on the curve of the first samples, which noise can hide.
    loaded = None if moved is None else \
        _try_extrapolating_channel_to_time_zero(clock, recording.channel(load)[usable], digits[load],
                                                moved.sample_count)
    own, its = (loaded, moved) if name == load else (moved, loaded)
    if own is None or its is None or own.error > _SETTINGS.known * float(np.ptp(values[usable])):
        return None
    gap = its.start - (0.0 if _is_first_sample_excluded_by_screening(screening, partner) else float(other[0]))
    late, tolerance = -gap, max(_SETTINGS.gap * abs(its.change), _SETTINGS.gap_errors * its.error)
    if abs(gap) <= tolerance:
        return own.start
    # A test that started late has a smaller change, but none in the other direction.
    if late * its.change < 0 or abs(late) > abs(its.change) + tolerance:
        return None
    return own.start + own.change * min(late / its.change, 1.0)


def _is_first_sample_excluded_by_screening(screening: Screening, name: str) -> bool:
    """Return whether the screening left out the first sample because of the channel `name`.

    An empty name stands for the samples that the campaign lists.
    """
    return any(1 in each.samples and each.channel == name for each in screening.left_out)


def _try_extrapolating_channel_to_time_zero(clock: np.ndarray, values: np.ndarray, rounding: float,
                                            most: int) -> _ChannelExtrapolatedToTimeZero | None:
    """Extend a channel to time 0 by a line or a parabola through as many first samples as possible.

    Args:
        clock: time of the samples that are kept, from the first sample of the recording, s, shape (n,).
        values: values of the channel in these samples, shape (n,).
        rounding: standard deviation of the rounding of the values.
        most: largest number of samples that determine the curve.

    Returns:
        None: neither a line nor a parabola describes the first samples.
    """
    noise = max(estimate_noise_deviation(values), rounding)
    limit = max(_SETTINGS.residual_range * float(np.ptp(values)), _SETTINGS.residual_noise * noise)
    for count in range(min(most, values.size), _SETTINGS.fewest - 1, -1):
        for degree in (1, 2):
            design = np.vander(clock[:count] / clock[count - 1], degree + 1, increasing=True)
            coefficients = np.linalg.lstsq(design, values[:count], rcond=None)[0]
            if float(np.abs(values[:count] - design @ coefficients).max()) > limit:
                continue
            leverage = float(np.linalg.inv(design.T @ design)[0, 0])
            start = float(coefficients[0])
            return _ChannelExtrapolatedToTimeZero(start, float(design[0] @ coefficients) - start,
                                                  noise * np.sqrt(1.0 + leverage), count)
    return None


def _estimate_rounding_deviation_of_load(recording: Recording, usable: np.ndarray, load: str, motion: str) -> float:
    """Return the standard deviation of the rounding of a load; 0 if the load never keeps its value during motion."""
    steps, moves = (np.abs(np.diff(recording.channel(each)[usable])) for each in (load, motion))
    is_coarse = bool(np.any((steps == 0) & (moves > np.median(moves)))) and bool(np.any(steps > 0))
    return float(steps[steps > 0].min()) / np.sqrt(12.0) if is_coarse else 0.0
