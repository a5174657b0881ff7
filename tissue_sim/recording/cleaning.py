"""Remove outliers and saturated samples from a recording, with the reasons, and estimate its first values.

The value of a channel at the first sample is extrapolated if that sample is an outlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.measures import StrainOrStressMeasure, get_original_measures
from tissue_sim.recording.outliers import find_outliers_of_motion_and_load, make_left_out_samples_of_outliers
from tissue_sim.recording.recording import CHANNELS, LOADS, MIN_POINTS, MOTIONS, SECOND_MOTIONS, Recording
from tissue_sim.recording.saturation import find_last_digit_step_or_zero, find_saturated_runs
from tissue_sim.recording.screening import LeftOutSamples, Saturation, Screening
from tissue_sim.recording.segmentation import estimate_noise_deviation


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


#: Error of a product, in units of the floating-point spacing.
_PRODUCT_ERROR = 4.0
#: Quantity -> unit for sentences, and factor from SI to this unit.
_SHOWN = {"length": (" mm", 1e3), "force": (" N", 1.0), "stress": (" kPa", 1e-3), "ratio": ("", 1.0)}


def remove_outliers_and_saturation(recording: Recording, leave_out: Sequence[int] | None = None,
                                   zeroed: Sequence[str] = (), controlled: str | None = None
                                   ) -> tuple[Recording, Screening]:
    """Return a recording without outliers and saturated samples, and the findings.

    Args:
        recording: a recording without a motion or without a load is returned without a change. In a recording of two
            axes only the samples in `leave_out` are removed.
        leave_out: numbers of the samples to leave out, from 1; None: outliers are found.
        zeroed: channels that were counted from the first sample. If the first sample is an outlier, they are counted
            from the value that the other samples predict for it.
        controlled: ``"displacement"`` or ``"force"``, as the user states it: a controlled channel is not saturated, and
            the other one is not held.

    Raises:
        InputError: a number beyond the recording, too many outliers, too few samples that are kept, or a zero that the
            samples do not show.
    """
    motion, load = (next((name for name in names if name in recording), None) for names in (MOTIONS, LOADS))
    if motion is None or load is None:
        return recording, Screening()
    channels = {name: recording.channel(name) for name in (motion, load)}
    # With two axes, a load is no function of one motion.
    has_one_axis = not any(name in recording for name in SECOND_MOTIONS)
    found: tuple[LeftOutSamples, ...] = ()
    try:
        if has_one_axis:
            outliers = find_outliers_of_motion_and_load(channels[motion], channels[load], is_counted=motion in zeroed)
            found = make_left_out_samples_of_outliers(outliers, channels, format_channel_value)
    except InputError:
        # A list in the campaign states that all other samples are valid.
        if leave_out is None:
            raise
    suspected: tuple[LeftOutSamples, ...] = ()
    if leave_out is not None:
        found, suspected = _split_outliers_by_campaign_list(recording, leave_out, found)
    is_kept = np.ones(len(recording), bool)
    is_kept[np.array([number - 1 for each in found for number in each.samples], int)] = False
    kept = np.flatnonzero(is_kept)
    if kept.size < MIN_POINTS:
        raise InputError(f"only {kept.size} of {len(recording)} samples are kept; at least {MIN_POINTS} are needed",
                         field="leave_out")
    rest = recording if kept.size == len(recording) else recording.select(kept)
    saturation = () if controlled == "force" or not has_one_axis else \
        _list_load_saturations(rest, kept, load, motion, is_free=controlled == "displacement")
    if controlled != "displacement" and has_one_axis:
        saturation += _list_channel_saturations(rest, kept, motion, load, is_free=controlled == "force")
    if saturation:
        is_kept[[number - 1 for each in saturation for number in each.samples]] = False
        kept = np.flatnonzero(is_kept)
        if kept.size < MIN_POINTS:
            raise InputError(f"{saturation[0].sentence}, and {kept.size} samples remain; at least {MIN_POINTS} are "
                             "needed")
        rest = recording.select(kept)
    screening = Screening(found, saturation, suspected=suspected)
    if kept.size and kept[0] > 0:
        rest = rest.with_channels(**{name: rest.channel(name)
                                     - _get_required_first_sample_value(recording, screening, name)
                                     for name in zeroed if name in channels})
    return rest, screening


def find_first_sample_value_or_none(recording: Recording, screening: Screening, name: str) -> float | None:
    """Return the motion or load at the first sample, SI, also if this sample is left out; None if undetermined.

    Args:
        recording: recording with all samples.
        screening: findings of `remove_outliers_and_saturation`.
        name: name of the channel.
    """
    partners = LOADS if name in MOTIONS else MOTIONS
    partner = next((each for each in partners if each in recording), None)
    if partner is None:
        return float(recording.channel(name)[0])
    return get_or_extrapolate_first_value_of_channel(recording, screening, name, partner)


def _get_required_first_sample_value(recording: Recording, screening: Screening, name: str) -> float:
    """Return the value at the first sample for a channel that is counted from it.

    See `find_first_sample_value_or_none`.

    Raises:
        InputError: the samples that are kept do not determine the value.
    """
    found = find_first_sample_value_or_none(recording, screening, name)
    if found is None:
        reason = "sample 1 is left out, and the other channel does not show where the " + name + " started"
        if not any(1 in each.samples and each.channel in LOADS for each in screening.left_out) and name in MOTIONS:
            reason = "the load steps after sample 1, as before creep, and one sample may be an outlier"
        raise InputError(f"the zero of the {name} is not known: {reason}; give the column of the {name} an offset, 0 "
                         "if it is right as the file has it", field=f"columns.{name}.offset")
    return found


def subtract_start_values(recording: Recording, zeroed: Sequence[str]) -> Recording:
    """Return a recording whose channels count from their value at the first sample, even if that is an outlier.

    If the other samples do not determine this value, the channels count from the first sample that is kept.

    Args:
        recording: recording with all samples.
        zeroed: channels that count from the first sample.
    """
    named = [name for name in zeroed if name in recording]
    if not named:
        return recording
    rest, screening = remove_outliers_and_saturation(recording)
    starts = {name: find_first_sample_value_or_none(recording, screening, name) for name in named}
    return recording.with_channels(**{
        name: recording.channel(name) - (float(rest.channel(name)[0]) if start is None else start)
        for name, start in starts.items()})


def _split_outliers_by_campaign_list(recording: Recording, leave_out: Sequence[int], found: tuple[LeftOutSamples, ...]
                                     ) -> tuple[tuple[LeftOutSamples, ...], tuple[LeftOutSamples, ...]]:
    """Return the samples that the campaign lists, and those found outliers that it does not list, with reasons."""
    for number in leave_out:
        if not 1 <= number <= len(recording):
            raise InputError(f"leave_out must list samples from 1 to {len(recording)}; got {number}", field="leave_out")
    listed = set(leave_out)
    confirmed = tuple(each for each in found if listed.issuperset(each.samples))
    others = tuple(sorted(listed - {number for each in confirmed for number in each.samples}))
    stated = (LeftOutSamples(others, "", "the campaign lists it in leave_out"),) if others else ()
    return (*confirmed, *stated), tuple(each for each in found if not listed.issuperset(each.samples))


def _list_channel_saturations(recording: Recording, kept: np.ndarray, name: str, other: str,
                              values: np.ndarray | None = None, title: str = "", rounding: float = 0.0, *,
                              is_free: bool = False) -> tuple[Saturation, ...]:
    """Return the intervals in which a channel is saturated, with one sentence for each.

    Args:
        recording: recording without outliers.
        kept: positions of the samples in the file, from 0, shape (n,).
        name: name of the channel.
        other: name of the channel that continues.
        values: values of another measure of the channel, shape (n,); None: the values of the channel.
        title: name of the other measure.
        rounding: width of the interval of equal values; see `find_saturated_runs`.
        is_free: whether the channel is not controlled; see `find_saturated_runs`.
    """
    values = recording.channel(name) if values is None else values
    continuing = "motion" if other in MOTIONS else "load"
    found = []
    for run in find_saturated_runs(values, recording.channel(other), _get_time_if_varying(recording), rounding=rounding,
                                   is_free=is_free):
        level = float(values[run.first])
        samples = tuple((kept[run.first:run.last + 1] + 1).tolist())
        found.append(Saturation(name, level, samples,
                                f"the {title or name} stays at {format_channel_value(name, level)} over {run.count} "
                                f"samples while the {continuing} continues: a saturated sensor; samples {samples[0]} "
                                f"to {samples[-1]} are left out"))
    return tuple(found)


def _list_load_saturations(recording: Recording, kept: np.ndarray, load: str, motion: str, *, is_free: bool
                           ) -> tuple[Saturation, ...]:
    """Return the intervals in which the load is saturated, in the measure of the file, or in the nominal stress.

    A load cell at its limit gives a constant force, which is the nominal stress times the undeformed area. The true
    stress of such a test still follows the stretch, and the nominal stress is constant to the rounding of the columns.
    """
    measure = get_original_measures(recording).get(load)
    if measure is None or "stretch" not in recording:
        return _list_channel_saturations(recording, kept, load, motion, is_free=is_free)
    stretch = recording.channel("stretch")
    stated = measure.invert(recording.channel(load), stretch)
    # A product and its quotient differ in the last bits.
    bits = _PRODUCT_ERROR * np.finfo(float).eps * float(np.abs(stated).max())
    return (_list_channel_saturations(recording, kept, load, motion, stated, measure.title, bits, is_free=is_free)
            or _list_channel_saturations(recording, kept, load, motion, None,
                                         f"nominal stress that follows from the {measure.title}",
                                         _compute_nominal_stress_rounding(recording, measure), is_free=is_free))


def _compute_nominal_stress_rounding(recording: Recording, measure: StrainOrStressMeasure) -> float:
    """Return the width of the interval of nominal stresses, Pa, with the same digits in the columns of the file.

    The width is the last digit of each column times the derivative of the nominal stress, at large stresses.
    """
    stretch, nominal = recording.channel("stretch"), recording.channel("nominal stress")
    large = np.abs(nominal) >= 0.5 * float(np.abs(nominal).max())
    stretch, nominal = stretch[large], nominal[large]
    strain_measure = get_original_measures(recording).get("stretch")
    strain = recording.channel("stretch") if strain_measure is None else strain_measure.invert(
        recording.channel("stretch"))
    step = find_last_digit_step_or_zero(strain)
    strain = strain[large]
    moved = strain + step if strain_measure is None else strain_measure.convert(strain + step)
    stress = measure.invert(nominal, stretch)
    digit = find_last_digit_step_or_zero(measure.invert(recording.channel("nominal stress"),
                                                        recording.channel("stretch")))
    return float((np.abs(measure.convert(stress + digit, stretch) - nominal)
                  + np.abs(measure.convert(stress, moved) - nominal)).max())


def _get_time_if_varying(recording: Recording) -> np.ndarray | None:
    """Return the time of a recording, s, shape (n,); None without a channel ``time`` or if the time is constant."""
    return recording.time if "time" in recording and np.ptp(recording.time) > 0 else None


def format_channel_value(channel: str, value: float) -> str:
    """Format a value (SI) of a channel with its unit, for sentences: ``"2.35 mm"``."""
    unit, factor = _SHOWN[CHANNELS[channel]]
    return f"{factor * value:.4g}{unit}"
