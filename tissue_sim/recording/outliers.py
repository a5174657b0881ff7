"""Find outliers: up to three adjacent samples far from the values that their neighbours predict.

A running median of seven samples and a median of short linear predictions mark candidates. A candidate is contradicted
if a polynomial through its neighbours on both sides (a line on one side at the ends, and on each side of a step)
describes these neighbours, and the candidate lies many deviations of that fit, of the noise and of the resolution away
from it.

Candidates are outliers unless they belong to the test: a peak of the load where the motion steps, a start from rest, a
last step.

Source: Hampel, J. Am. Stat. Assoc. 69 (1974) 383, for the running median.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.screening import LeftOutSamples, format_sample_numbers


@dataclass(frozen=True)
class OutlierSettings:
    """Thresholds of `find_outliers_of_motion_and_load`.

    Attributes:
        fewest: samples of a recording that is examined. longest: samples of a group.
        neighbours: on each side of a group inside. one_sided: neighbours of a group at an end.
        of_fit: distance from the prediction in deviations of the neighbours from their fit; at an end more.
        of_noise: distance in deviations of the noise. of_steps: distance from the running median in steps between
            neighbouring samples. of_resolution: distance in last digits.
        core: distance of the samples of a group from the running median, over that of the farthest one.
        of_range: distance as a fraction of the range of the channel.
        event: change of the motion across a group, in the largest step of its neighbours, above which a peak of the
            load belongs to the motion.
        rest: fraction of the largest value below which a first or last sample is at rest.
        like: largest first step of a motion that counts from its first sample, in the largest of the following ones.
        correlated: correlation of motion and load above which their signs are known.
        plausible: largest motion at rest over that of the test, where a machine does not start at zero.
        overshoot: largest load in a step of the motion over the range of the load: 10 where a material loses 90 % of
            its load between two samples.
        stiffness: largest ratio of the stiffness of the first step from rest to that of the test.
        most: largest fraction of outliers; more are an error.
    """

    fewest: int = 12
    longest: int = 3
    neighbours: int = 6
    one_sided: int = 8
    of_fit: float = 8.0
    of_fit_at_end: float = 10.0
    of_noise: float = 8.0
    of_steps: float = 3.0
    core: float = 0.25
    of_resolution: float = 3.5
    of_range: float = 0.01
    event: float = 2.0
    rest: float = 0.03
    like: float = 3.0
    correlated: float = 0.5
    plausible: float = 1.5
    overshoot: float = 10.0
    stiffness: float = 5.0
    most: float = 0.1


SETTINGS = OutlierSettings()


@dataclass(frozen=True)
class RobustScaleSettings:
    """Settings of the running median and of the scale estimates.

    Attributes:
        window: samples of the running median.
        block: samples of a block in which the noise and the steps are estimated.
        median_distance: median of the distances from a running median of seven, in standard deviations of Gaussian
            noise.
    """

    window: int = 7
    block: int = 32
    median_distance: float = 0.52


#: Settings that the functions of this module use.
_SCALE = RobustScaleSettings()


class ChannelOutlierSearch:
    """Search for outliers in one channel: its noise, its steps and its candidate samples, each of shape (n,)."""

    def __init__(self, values: np.ndarray, settings: OutlierSettings, *, is_counted: bool = False):
        self.values, self.settings, self.is_counted = values, settings, is_counted
        padded = np.concatenate([_evaluate_robust_line(values[:9], np.arange(-3, 0)), values,
                                 _evaluate_robust_line(values[:-10:-1], np.arange(-3, 0))[::-1]])
        self.smooth = _compute_median_of_seven_from_padded(padded)
        self.away = away = np.abs(values - self.smooth)
        local = np.abs(values - _predict_each_sample_from_padded_values(padded))
        steps = np.abs(np.diff(values))
        self.range = float(np.ptp(self.smooth))
        least = 1e-9 * float(np.abs(self.smooth).max() or 1.0)
        positive = steps[steps > least]
        if positive.size <= 2 * settings.longest:
            # The steps may be those to an outlier and back.
            positive = np.abs(np.diff(self.smooth))
            positive = positive[positive > least]
        self.resolution = float(positive.min()) if positive.size else 0.0
        self.noise = _compute_largest_nearby_block_median(away) / _SCALE.median_distance
        self.steps = _compute_largest_nearby_block_median(np.append(steps, steps[-1]))
        least = np.maximum(settings.of_range * self.range, settings.of_resolution * self.resolution)
        self.least = np.maximum(least, settings.of_noise * self.noise)
        noise = np.maximum(self.noise, _compute_largest_nearby_block_median(local) / _SCALE.median_distance)
        self.groups = (away > np.maximum(self.least, settings.of_steps * self.steps)) & (self.range > 0)
        # Predictions that use a group of outliers are wrong: they find only single samples far from groups.
        near = np.convolve(self.groups, np.ones(_SCALE.window), "same") > 0
        self.singles = (local > np.maximum(least, settings.of_noise * noise)) & ~near & (self.range > 0)

    def iterate_outlier_groups_and_predictions(self) -> Iterator[tuple[tuple[int, ...], float]]:
        """Yield groups of samples that contradict their neighbours, with the value predicted for the first sample."""
        for candidates in (self.groups, self.singles):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], candidates, [False]]).astype(int)))
            runs = [self._find_core_of_run(*run) for run in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
            bad = np.zeros(self.values.size, bool)
            for first, last in runs:
                bad[first:last] = True
            good = np.flatnonzero(~bad)
            for first, last in runs:
                if last - first > self.settings.longest:
                    continue
                predicted = self._predict_first_value_if_outliers(first, last, good)
                if predicted is None and last - first > 1:
                    # Next to an outlier a step comes early in the running median: one sample of the run may be right.
                    farthest = first + int(np.argmax(self.away[first:last]))
                    others = np.setdiff1d(np.arange(first, last), farthest)
                    first, last = farthest, farthest + 1
                    predicted = self._predict_first_value_if_outliers(first, last, np.union1d(good, others))
                if predicted is not None:
                    yield tuple(range(first, last)), predicted

    def _find_core_of_run(self, first: int, last: int) -> tuple[int, int]:
        """Return first sample and end of the part of a run that is far from the running median.

        Next to three outliers the running median is wrong by several steps.
        """
        far = first + np.flatnonzero(self.away[first:last] >= self.settings.core * self.away[first:last].max())
        return int(far[0]), int(far[-1]) + 1

    def _predict_first_value_if_outliers(self, first: int, last: int, good: np.ndarray) -> float | None:
        """Return the prediction for sample `first` if samples `first` to `last` (not included) are outliers; else None.

        Args:
            first: first sample of the group, from 0.
            last: end of the group, not included.
            good: samples that are not candidates, sorted, shape (k,).
        """
        setting, place = self.settings, int(np.searchsorted(good, first))
        before, after = good[max(place - setting.one_sided, 0):place], good[place:place + setting.one_sided]
        one_sided = min(before.size, after.size) < setting.longest
        if one_sided:
            around = after[:setting.one_sided] if after.size > before.size else before[-setting.one_sided:]
        else:
            around = np.concatenate([before[-setting.neighbours:], after[:setting.neighbours]])
        degree = 1 if one_sided else 2
        if around.size < degree + 3:
            return None
        middle, group = 0.5 * (first + last - 1), np.arange(first, last)
        coefficients = np.polynomial.polynomial.polyfit(around - middle, self.values[around], degree)
        gaps = self.values[around] - np.polynomial.polynomial.polyval(around - middle, coefficients)
        deviation = float(np.sqrt(np.sum(gaps**2) / (around.size - degree - 1)))
        predicted = np.polynomial.polynomial.polyval(group - middle, coefficients)
        limit = max(float(self.least[first]), (setting.of_fit_at_end if one_sided else setting.of_fit) * deviation,
                    float(np.ptp(self.values[around])) if one_sided else 0.0)
        if not np.all(np.abs(self.values[group] - predicted) > limit):
            beyond = None if one_sided else self._predict_first_value_if_outlying_near_step(group, around)
            if beyond is None:
                return None
            predicted = np.array([beyond])
        # Rounding errors of the fit are zero.
        return float(predicted[0]) if abs(predicted[0]) > 1e-9 * self.range else 0.0

    def _predict_first_value_if_outlying_near_step(self, group: np.ndarray, around: np.ndarray) -> float | None:
        """Return the prediction for a group of outliers near a step; None if the group belongs to the step.

        A line is fitted to the neighbours before, and one to the neighbours after their largest jump. A group on one
        side is an outlier far from the line of its side. A group between the sides is an outlier far outside of the
        interval between both lines.
        """
        split = int(np.argmax(np.abs(np.diff(self.values[around])))) + 1
        sides = [side for side in (around[:split], around[split:])
                 if not (side[-1] < group[0] and around[split] < group[0])
                 and not (side[0] > group[-1] and around[split - 1] > group[-1])]
        limits, ends = [float(self.least[group[0]])], []
        for side in sides:
            if side.size < self.settings.longest + 1:
                return None
            line = np.polynomial.polynomial.polyfit(side - group[0], self.values[side], 1)
            gaps = self.values[side] - np.polynomial.polynomial.polyval(side - group[0], line)
            limits.append(self.settings.of_fit_at_end * float(np.sqrt(np.sum(gaps**2) / (side.size - 2))))
            limits.append(float(np.ptp(self.values[side])))
            ends.append(np.polynomial.polynomial.polyval(group - group[0], line))
        low, high, values = np.min(ends, axis=0), np.max(ends, axis=0), self.values[group]
        if np.all(values < low - max(limits)):
            return float(low[0])
        return float(high[0]) if np.all(values > high + max(limits)) else None

    def compute_change_across_group(self, first: int, last: int) -> float:
        """Return the change across samples `first` to `last` (not included); at an end the step next to them."""
        before, after = first - 1, last
        if first == 0:
            before = last - 1
        elif last == self.values.size:
            after = first
        return float(self.values[after] - self.values[before])

    def compute_largest_step_near_group(self, first: int, last: int) -> float:
        """Return the largest step between neighbours on one side of samples `first` to `last` (not included)."""
        count = self.settings.neighbours
        sides = self.values[max(first - count, 0):first], self.values[last:last + count]
        return max((float(np.abs(np.diff(side)).max()) for side in sides if side.size > 1), default=0.0)


def _evaluate_robust_line(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Evaluate a robust line through the samples at positions `at`; up to half of the samples may be wrong.

    Source: Siegel, Biometrika 69 (1982) 242, repeated medians.
    """
    places = np.arange(values.size)
    gaps = places[:, None] - places[None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = np.where(gaps == 0, np.nan, (values[:, None] - values[None]) / gaps)
    slope = float(np.median(np.nanmedian(slopes, axis=1)))
    return float(np.median(values - slope * places)) + slope * at


def _compute_median_of_seven_from_padded(padded: np.ndarray) -> np.ndarray:
    """Return the median of seven samples around each sample; `padded` has three more samples at each end."""
    rows = [padded[k:padded.size - _SCALE.window + 1 + k] for k in range(_SCALE.window)]
    # Exchanges that move the median of seven to the fourth position: Devillard, Fast median search (1998).
    for low, high in ((0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3),
                      (3, 4)):
        rows[low], rows[high] = np.minimum(rows[low], rows[high]), np.maximum(rows[low], rows[high])
    return rows[3]


def _predict_each_sample_from_padded_values(padded: np.ndarray) -> np.ndarray:
    """Return the median of five linear predictions of each sample; `padded` has three more samples at each end."""
    size = padded.size - _SCALE.window + 1
    by = [padded[k:k + size] for k in range(_SCALE.window)]
    rows = [0.5 * (by[2] + by[4]), 0.5 * (by[1] + by[5]), 0.5 * (by[0] + by[6]), 2 * by[2] - by[1], 2 * by[4] - by[5]]
    for low, high in ((0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)):
        rows[low], rows[high] = np.minimum(rows[low], rows[high]), np.maximum(rows[low], rows[high])
    return rows[2]


def _compute_largest_nearby_block_median(values: np.ndarray) -> np.ndarray:
    """Return at each sample the larger of the medians of neighbouring blocks and of all values, shape (n,)."""
    blocks = max(values.size // _SCALE.block, 1)
    whole = values[:blocks * _SCALE.block].reshape(blocks, -1) if values.size >= _SCALE.block else values[None]
    scale = np.median(whole, axis=1)
    near = np.max([np.append(scale[:1], scale[:-1]), scale, np.append(scale[1:], scale[-1:])], axis=0)
    everywhere = float(np.median(values))
    return np.maximum(near, everywhere)[np.minimum(np.arange(values.size) // _SCALE.block, blocks - 1)]


def find_outliers_of_motion_and_load(motion: np.ndarray, load: np.ndarray, settings: OutlierSettings = SETTINGS, *,
                                     is_counted: bool = False) -> tuple[tuple[str, tuple[int, ...], float], ...]:
    """Find the outliers of motion and load, in the order of the samples.

    Args:
        motion: displacement or strain in the order of time, any unit and sign, shape (n,).
        load: force or stress, any unit and sign, shape (n,).
        settings: thresholds.
        is_counted: whether the motion counts from the first sample. The first value is then zero by definition, and
            does not show that the test starts from rest.

    Returns:
        (``"motion"`` or ``"load"``, numbers of the samples from 0, value that the neighbours predict for the first).
    """
    found: dict[tuple[str, tuple[int, ...]], float] = {}
    kept = np.arange(motion.size)
    # A second search finds outliers that are close to other outliers.
    for _ in range(2):
        if kept.size < settings.fewest:
            break
        channels = {"motion": ChannelOutlierSearch(motion[kept], settings, is_counted=is_counted),
                    "load": ChannelOutlierSearch(load[kept], settings)}
        candidates = {name: tuple(one.iterate_outlier_groups_and_predictions()) for name, one in channels.items()}
        lost = kept[0] > 0 and not any(name == "motion" and 0 in group for name, group in found)
        start = _LoadingFromRestAtStart(motion[:1] if lost else None,
                                        any(0 in group for group, _ in candidates["load"]))
        new = {}
        for name in channels:
            for group, predicted in candidates[name]:
                if _belongs_to_test(name, group, channels, settings):
                    continue
                is_loading = start.is_group_loading_from_rest(group, channels, settings)
                wrong = start.list_wrong_first_load_sample(name) if is_loading else group
                if wrong and (wrong == group or not _belongs_to_test(name, wrong, channels, settings)):
                    new[name, tuple(kept[list(wrong)].tolist())] = predicted
        if not new:
            break
        found |= new
        kept = kept[~np.isin(kept, [sample for _, group in new for sample in group])]
    return tuple((name, group, found[name, group]) for name, group in sorted(found, key=lambda each: each[1]))


def make_left_out_samples_of_outliers(outliers: tuple[tuple[str, tuple[int, ...], float], ...],
                                      channels: Mapping[str, np.ndarray],
                                      words: Callable[[str, float], str]) -> tuple[LeftOutSamples, ...]:
    """Describe outliers, one entry for each channel and group of samples.

    Args:
        outliers: result of `find_outliers_of_motion_and_load`.
        channels: name of the motion and of the load, in this order -> values, shape (n,).
        words: function that formats a value (SI) of a channel.

    Raises:
        InputError: more than a tenth of the samples are outliers.
    """
    names = dict(zip(("motion", "load"), channels, strict=True))
    total = next(iter(channels.values())).size
    found: list[LeftOutSamples] = []
    seen: set[int] = set()
    for which, group, predicted in outliers:
        seen.update(group)
        name = names[which]
        values = channels[name][list(group)]
        shown = " and ".join(dict.fromkeys(words(name, value) for value in values.tolist()))
        where = "its neighbours point to" if group[0] > 0 and group[-1] < total - 1 else (
            "the samples that follow point to" if group[0] == 0 else "the samples before point to")
        found.append(LeftOutSamples(tuple(sample + 1 for sample in group), name,
                                    f"the {name} reads {shown}, and {where} {words(name, predicted)}"
                                    f"{_explain_final_load_drop_or_empty(which, group, total, values, predicted)}"))
    if len(seen) > SETTINGS.most * total and len(seen) > SETTINGS.longest:
        samples = format_sample_numbers(tuple(sample + 1 for sample in sorted(seen)))
        raise InputError(f"{len(seen)} of {total} samples are outliers ({samples}): the sensor or the reading of the "
                         "columns is at fault; correct the file, or state leave_out in its test")
    return tuple(found)


def _explain_final_load_drop_or_empty(which: str, group: tuple[int, ...], total: int, values: np.ndarray,
                                      predicted: float) -> str:
    """Return the possible reason of a load that falls at the end of a recording; else an empty text."""
    falls = which == "load" and group[-1] == total - 1 and bool(np.all(np.abs(values) < 0.5 * abs(predicted)))
    return " (a rupture at the end, or lost values)" if falls else ""


@dataclass(frozen=True, eq=False)
class _LoadingFromRestAtStart:
    """Loading from rest at the start of a recording, which outlier detection must not remove; the first load is wrong.

    Attributes:
        motion: value of the motion in the first sample, where that sample is already left out for its load, shape (1,).
        is_candidate: whether the load of the first sample is a candidate.
    """

    motion: np.ndarray | None
    is_candidate: bool

    def is_group_loading_from_rest(self, group: tuple[int, ...], channels: Mapping[str, ChannelOutlierSearch],
                                   settings: OutlierSettings) -> bool:
        """Return whether a group at the start is the loading from rest.

        The motion rises from rest through all samples of the group, and the load grows from the second sample on.
        """
        if group[0] != 0 or (self.motion is None and not self.is_candidate):
            return False
        end = group[-1] + 2
        motion, load = (channels[name].values[:end] for name in ("motion", "load"))
        if self.motion is None:
            load = load[1:]
        else:
            motion = np.concatenate([self.motion, motion])
        return bool(np.all(np.diff(load) * load[0] > 0)) and _do_samples_rise_from_rest(
            motion, settings, is_counted=channels["motion"].is_counted)

    def list_wrong_first_load_sample(self, name: str) -> tuple[int, ...]:
        """Return the wrong samples of a channel at the start: (0,) for a load that is not left out yet; else ()."""
        return (0,) if name == "load" and self.motion is None else ()


def _belongs_to_test(name: str, group: tuple[int, ...], channels: Mapping[str, ChannelOutlierSearch],
                     settings: OutlierSettings) -> bool:
    """Return whether a candidate belongs to the test: a peak of the load at a motion step, or a start from rest."""
    first, last = group[0], group[-1] + 1
    motion, load = channels["motion"], channels["load"]
    at_end = first == 0 or last == motion.values.size
    if not at_end:
        step = abs(motion.compute_change_across_group(first, last))
        if name != "load":
            return False
        largest = motion.compute_largest_step_near_group(first, last)
        return step > max(settings.event * (last - first + 1) * largest, 0.02 * motion.range) \
            and _does_load_follow_motion_step(group, channels, settings)
    if first == 0 and last > 1 and all(_do_samples_rise_from_rest(one.values[:last + 1], settings,
                                                                  is_counted=one.is_counted)
                                       for one in (motion, load)):
        return True
    if name == "motion" and first == 0 and (
            motion.is_counted or abs(motion.values[0]) > settings.rest * float(np.abs(motion.smooth).max())):
        # A single sample before a step does not decide the zero of the motion.
        return False
    if name == "load" and first == 0 \
        and _are_first_loads_up_to_twice_following(load.values[:last], float(load.values[last])):
        return True
    if first == 0:
        return any(_do_channels_step_together(sample, sample + 1, motion, load, settings) for sample in group)
    return any(_do_channels_step_together(sample, sample - 1, motion, load, settings) for sample in group)


def _does_load_follow_motion_step(group: tuple[int, ...], channels: Mapping[str, ChannelOutlierSearch],
                                  settings: OutlierSettings) -> bool:
    """Return whether the load of a group inside the recording follows a step of the motion.

    The load overshoots in a step of the motion, and relaxes afterwards. A load on the other side of both neighbours is
    not a response of the specimen, and neither is an overshoot beyond `OutlierSettings.overshoot`. The direction is
    unknown if motion and load are hardly correlated.
    """
    correlation = _compute_correlation_without_outliers(channels)
    motion, load = channels["motion"], channels["load"].values
    first, last = group[0], group[-1] + 1
    if np.any(np.abs(load[first:last] - channels["load"].smooth[first:last]) > settings.overshoot *
              channels["load"].range):
        return False
    if abs(correlation) < settings.correlated:
        return True
    direction = float(np.sign(motion.compute_change_across_group(first, last) * correlation))
    neighbours = direction * load[[first - 1, last]]
    return bool(np.all(direction * load[first:last] >= neighbours.min() - channels["load"].least[first]))


def _compute_correlation_without_outliers(channels: Mapping[str, ChannelOutlierSearch]) -> float:
    """Return the correlation of motion and load without their outliers."""
    away = [channels[name].smooth - channels[name].smooth.mean() for name in ("motion", "load")]
    return float(np.sum(away[0] * away[1])) / (float(np.sqrt(np.sum(away[0]**2) * np.sum(away[1]**2))) or 1.0)


def _do_channels_step_together(sample: int, next_one: int, motion: ChannelOutlierSearch, load: ChannelOutlierSearch,
                               settings: OutlierSettings) -> bool:
    """Return whether motion and load step together: from rest, as under a dead weight, or in the last step.

    Args:
        sample: sample at an end of the recording.
        next_one: neighbour of this sample.
        motion: channel of the motion.
        load: channel of the load.
        settings: thresholds.
    """
    jumps = []
    for one in (motion, load):
        jump = float(one.values[next_one] - one.values[sample])
        if abs(jump) <= 0.05 * one.range:
            return False
        jumps.append(jump)
    correlation = _compute_correlation_without_outliers({"motion": motion, "load": load})
    together = jumps[0] * jumps[1] * correlation >= 0 or abs(correlation) < settings.correlated
    largest = [float(np.abs(one.smooth).max()) for one in (motion, load)]
    rests = [abs(one.values[sample]) <= settings.rest * most for one, most in zip((motion, load), largest, strict=True)]
    is_plausible = abs(motion.values[sample]) <= settings.plausible * largest[0] and (
        rests[1] or sample > next_one or abs(load.values[sample]) <= abs(load.values[next_one]))
    # If motion and load continue, the stiffness of the step is similar to that of the whole test.
    comparable = all(one.range > 0.3 * abs(jump) for one, jump in zip((motion, load), jumps, strict=True))
    if comparable:
        stiffness = abs(jumps[1] / jumps[0]) * motion.range / load.range
        is_plausible &= 1 / settings.stiffness <= stiffness <= settings.stiffness
        if sample > next_one:
            return together and is_plausible
    return together and any(rests) and is_plausible


def _do_samples_rise_from_rest(values: np.ndarray, settings: OutlierSettings, *, is_counted: bool) -> bool:
    """Return whether the first samples rise steadily to one side from rest, as in the loading before creep.

    In a channel that counts from the first sample, the first step must be similar to the following ones.
    """
    steps = np.diff(values)
    if not np.all(steps * steps[0] > 0):
        return False
    if is_counted:
        return steps.size > 1 and bool(abs(steps[0]) <= settings.like * np.abs(steps[1:]).max())
    return bool(abs(values[0]) <= settings.rest * np.abs(values).max())


def _are_first_loads_up_to_twice_following(values: np.ndarray, following: float) -> bool:
    """Return whether each load has the sign of the load `following` them, and 1 to 2 times its magnitude."""
    return bool(np.all(values * following > 0) and np.all(np.abs(values) > abs(following))
                and np.all(np.abs(values) < 2.0 * abs(following)))
