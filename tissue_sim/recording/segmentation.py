"""Divide a measured or simulated motion into loading, hold and unloading.

A displacement of no more than the hysteresis is ignored. A motion reverses when it returns by more than the hysteresis
(`ReversalDetector`, sample by sample). Between reversals the motion is a polyline within half of the hysteresis
(`find_motion_corners`), and a line with no displacement beyond the hysteresis is a hold
(`label_samples_ramp_hold_unload`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class MotionSegmentationSettings:
    """Settings of the division of a motion into segments.

    Attributes:
        hysteresis: hysteresis of a motion by hand, m; larger than the tremor of a hand. A larger value ignores more
            reversals.
        hold_time: least duration of a hold of a motion by hand, s. A larger value finds fewer holds.
        straightness: largest distance of the motion of a machine from its polyline, as a fraction of the travel. A
            larger value finds fewer segments.
        noise_deviations: smallest distance of a controlled force from its polyline, in standard deviations of its
            noise. A smaller value finds segments in the noise; a larger one finds no small steps of the force.
        hysteresis_fraction: hysteresis of a motion of unknown origin, as a fraction of the travel, if the result is
            larger than `hysteresis`.
    """

    hysteresis: float = 0.05e-3
    hold_time: float = 1.0
    straightness: float = 3e-3
    noise_deviations: float = 5.0
    hysteresis_fraction: float = 0.01


#: Settings that the functions of this module use.
MOTION_SETTINGS = MotionSegmentationSettings()
#: Labels of segments that load.
_LOADING_LABELS = ("approach", "ramp", "load")
#: Labels of segments that unload.
_UNLOADING_LABELS = ("unload", "retract")


class ReversalDetector:
    """Find the reversals of a motion sample by sample; a return of no more than `hysteresis` (m) is ignored.

    Attributes:
        starts: index of the first point of each branch, in order. Each branch ends at the first point of the next one.
        direction: direction of the last branch: 1 loads, -1 unloads, 0 before the first motion.
    """

    def __init__(self, hysteresis: float = MOTION_SETTINGS.hysteresis):
        self._hysteresis = hysteresis
        self.starts: list[int] = []
        self.direction = 0
        self._low = self._high = (np.nan, 0)

    def add_sample(self, index: int, depth: float) -> None:
        """Add the next sample of the motion: its index and its depth, m."""
        # The first comparison with NaN is false: the first point is both extremes.
        if not depth >= self._low[0]:
            self._low = (depth, index)
        if not depth <= self._high[0]:
            self._high = (depth, index)
        if self.direction < 1 and depth - self._low[0] > self._hysteresis:
            self._begin_branch(1, self._low[1], (depth, index))
        elif self.direction > -1 and self._high[0] - depth > self._hysteresis:
            self._begin_branch(-1, self._high[1], (depth, index))

    def _begin_branch(self, direction: int, start: int, here: tuple[float, int]) -> None:
        """Begin a branch at the reversal `start`; `here` is the newest sample (depth in m, index)."""
        self.direction = direction
        self.starts.append(start)
        self._low = self._high = here

    def discard_reversals_before_sample(self, first: int) -> None:
        """Discard the stored reversals before sample `first`, to limit the memory."""
        while len(self.starts) > 1 and self.starts[1] <= first:
            del self.starts[0]
        if self.starts:
            self.starts[0] = max(self.starts[0], first)

    def list_branch_directions_and_ranges(self, end: int) -> list[tuple[int, int, int]]:
        """Return (direction, first, last) of each branch up to index `end`, both ends included."""
        edges = [*self.starts, end]
        newest = len(self.starts) - 1
        return [(self.direction * (-1) ** (newest - i), edges[i], edges[i + 1]) for i in range(newest + 1)]


def estimate_noise_deviation(values: np.ndarray) -> float:
    """Return the standard deviation of the noise of a smooth channel, from its second differences."""
    bend = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    return float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(1.5))


def compute_corner_tolerance_of_force(force: np.ndarray) -> float:
    """Return the largest distance of a controlled force from its polyline, N.

    The tolerance is a fraction of the range of the force, which includes the unloaded state, and at least some standard
    deviations of the noise. A constant force with noise is therefore one hold.

    Args:
        force: force, N, shape (n,).
    """
    reach = max(float(force.max()), 0.0) - min(float(force.min()), 0.0)
    noise = estimate_noise_deviation(force) if force.size > 2 else 0.0
    return max(MOTION_SETTINGS.straightness * reach, MOTION_SETTINGS.noise_deviations * noise)


def find_motion_corners(time: np.ndarray, displacement: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the samples between which the motion is straight within `tolerance`, m.

    Source: Douglas and Peucker, Cartographica 10 (1973) 112.
    """
    keep = {0, time.size - 1}
    parts = [(0, time.size - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        inside = slice(first + 1, last)
        line = np.interp(time[inside], time[[first, last]], displacement[[first, last]])
        gap = np.abs(displacement[inside] - line)
        farthest = int(np.argmax(gap))
        if gap[farthest] > tolerance:
            middle = first + 1 + farthest
            keep.add(middle)
            parts += [(first, middle), (middle, last)]
    return np.array(sorted(keep))


def label_samples_ramp_hold_unload(time: np.ndarray, displacement: np.ndarray, tolerance: float | None = None, *,
                                   shortest_hold: float = 0.0) -> np.ndarray:
    """Label each sample of a motion as ``ramp``, ``hold`` or ``unload``, shape (n,).

    Args:
        time: time, s, shape (n,).
        displacement: displacement, m, shape (n,).
        tolerance: half of the hysteresis, m; None: the fraction
            `MotionSegmentationSettings.straightness` of the travel, for a machine.
        shortest_hold: shortest hold, s; a shorter hold belongs to the previous segment.
    """
    tolerance = MOTION_SETTINGS.straightness * np.ptp(displacement) if tolerance is None else tolerance
    corners = find_motion_corners(time, displacement, tolerance)
    way = np.diff(displacement[corners])
    names = np.where(np.abs(way) <= 2 * tolerance, "hold", np.where(way > 0, "ramp", "unload"))
    for part in np.flatnonzero(names == "hold") if shortest_hold else ():
        if _compute_duration_within_reach(time, displacement, corners[part], corners[part + 1],
                                          2 * tolerance) >= shortest_hold:
            continue
        names[part] = names[part - 1] if part else "ramp" if way[part] > 0 else "unload"
    return names[np.clip(np.searchsorted(corners, np.arange(time.size), side="left") - 1, 0, names.size - 1)]


def _compute_duration_within_reach(time: np.ndarray, displacement: np.ndarray, first: int, last: int,
                                   reach: float) -> float:
    """Return how long a motion stays within `reach` (m) of its value at sample `first`, around `first` to `last`, s."""
    away = np.flatnonzero(np.abs(displacement - displacement[first]) > reach)
    before, after = away[away < first], away[away > last]
    return time[after[0] - 1 if after.size else -1] - time[before[-1] + 1 if before.size else 0]


def label_reloads_and_cycles(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the labels with ``reload`` for each ramp after an unloading, and the numbers of the cycles, shapes (n,).

    Args:
        labels: labels that `label_samples_ramp_hold_unload` returned, shape (n,). A cycle, numbered from 1, begins at
            each reload.
    """
    labels, cycles = np.array(labels, dtype="U6"), np.ones(labels.size, dtype=int)
    begins = np.flatnonzero(np.append(True, labels[1:] != labels[:-1]))
    number, withdrawn = 1, False
    for first, last in zip(begins, np.append(begins[1:], labels.size), strict=True):
        if labels[first] == "ramp":
            number += withdrawn
            withdrawn = False
            if number > 1:
                labels[first:last] = "reload"
        withdrawn = withdrawn or labels[first] == "unload"
        cycles[first:last] = number
    return labels, cycles


def append_numbers_to_repeated_runs(labels: np.ndarray) -> np.ndarray:
    """Return the labels with a number for each repeated run: ``ramp``, ``unload``, ``ramp 2``; shape (n,)."""
    begins = np.flatnonzero(np.append(True, labels[1:] != labels[:-1]))
    seen: dict[str, int] = {}
    names = []
    for label in labels[begins].tolist():
        seen[label] = seen.get(label, 0) + 1
        names.append(label if seen[label] == 1 else f"{label} {seen[label]}")
    return np.repeat(np.array(names), np.diff(np.append(begins, labels.size)))


def find_loading_and_unloading_indices(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the samples of the first loading and of the first unloading after it, without holds.

    Labels of segments determine both; without labels, the reversals of the displacement do.

    Returns:
        Two arrays; the second one is empty without an unloading.
    """
    depth = recording.displacement
    has_labels = "segment" in recording.labels
    load, unload = _find_loading_and_unloading_by_labels(recording.labels["segment"]) if has_labels \
        else _find_loading_and_unloading_by_reversals(depth)
    if not load.size:  # labels of another vocabulary
        load, unload = _find_loading_and_unloading_by_reversals(depth)
    return load[find_strictly_monotone_sample_indices(depth[load], 1)], unload[
        find_strictly_monotone_sample_indices(depth[unload], -1)]


def _find_loading_and_unloading_by_labels(segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of the first run of loading segments, and of the first run of unloading segments."""
    kinds = np.where(np.isin(segment, _LOADING_LABELS), 1, np.where(np.isin(segment, _UNLOADING_LABELS), -1, 0))
    kinds[segment == "reload"] = 2
    out = np.flatnonzero(kinds == -1)
    first_out = out[0] if out.size else kinds.size
    load = np.flatnonzero(kinds[:first_out] == 1)
    again = np.flatnonzero(kinds[first_out:] > 0)
    last_out = first_out + (again[0] if again.size else kinds.size - first_out)
    unload = np.flatnonzero(kinds[first_out:last_out] == -1) + first_out
    # The sample at which two segments meet belongs to the first of them.
    return load, np.concatenate([[unload[0] - 1], unload]) if unload.size and unload[0] > 0 else unload


def _find_loading_and_unloading_by_reversals(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of the first branch that loads, and of the next branch."""
    reach = float(depth.max() - depth.min())
    # The tremor is at most that of a hand, and smaller in a small test.
    hysteresis = max(MOTION_SETTINGS.hysteresis, MOTION_SETTINGS.hysteresis_fraction * reach)
    reversals = ReversalDetector(min(hysteresis, 0.1 * reach))
    for index, value in enumerate(depth.tolist()):
        reversals.add_sample(index, value)
    branches = reversals.list_branch_directions_and_ranges(depth.size - 1)
    while branches and branches[0][0] < 0:
        del branches[0]
    first, second, *_ = [np.arange(begin, end + 1) for _, begin, end in branches[:2]] + 2 * [np.arange(0)]
    return first, second


def find_strictly_monotone_sample_indices(depth: np.ndarray, direction: int) -> np.ndarray:
    """Return the indices of samples of a branch between which the depth is strictly monotone.

    Samples of tremor and of rest at both ends are omitted. The first half of the branch keeps the last sample at each
    depth, the second half keeps the first one.

    Args:
        depth: m, shape (n,), in the order of time.
        direction: 1 loads, -1 unloads.
    """
    if not len(depth):
        return np.arange(0)
    way = direction * np.asarray(depth)
    middle = int(np.argmax(way >= 0.5 * (way[0] + way.max())))
    nearest = np.minimum.accumulate(way[middle::-1])[::-1]
    furthest = np.maximum.accumulate(way[middle:])
    leaving = np.flatnonzero(np.diff(nearest, append=np.inf) > 0)
    arriving = np.flatnonzero(np.diff(furthest, prepend=-np.inf) > 0) + middle
    return np.union1d(leaving, arriving)
