"""Find outliers: up to three adjacent samples far from the values that their neighbours predict.

Candidates of `tissue_sim.recording.outlier_candidates` are outliers unless they belong to the test: a peak of the load
where the motion steps, a start from rest, a last step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.outlier_candidates import SETTINGS, ChannelOutlierSearch, OutlierSettings
from tissue_sim.recording.screening import LeftOutSamples, format_sample_numbers


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
