"""Segments of a motion, measured or simulated: where it goes in, holds, goes out, and turns round.

One definition for all: a way of no more than the hysteresis is none. A motion turns round where it comes back farther
than that (`Reversals`, which can be fed sample by sample); between, it is made of straight lines within half of it
(`corners_of`), and one of them that gets no farther is a hold (`label_motion`).
"""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.recording import Recording

#: Hysteresis of a hand, m, which trembles less, and how long it stays where it is to hold, s.
HYSTERESIS, HOLD_TIME = 0.05e-3, 1.0
#: The motion of a machine is made of straight lines within this share of its travel.
STRAIGHT = 3e-3
#: Hysteresis of a motion that nobody describes, as a share of its travel, where that is more than `HYSTERESIS`.
_NOISE_SHARE = 0.01
_IN, _OUT = ("approach", "ramp", "load"), ("unload", "retract")


class Reversals:
    """Where a motion turns round, as it comes: a way back of no more than `hysteresis` (m) is none.

    Attributes:
        starts: index of the first point of each branch, in order; each branch but the last ends where the next begins.
        direction: of the last branch: 1 loads, -1 unloads, 0 before the first motion.
    """

    def __init__(self, hysteresis: float = HYSTERESIS):
        self._hysteresis = hysteresis
        self.starts: list[int] = []
        self.direction = 0
        self._low = self._high = (np.nan, 0)

    def add(self, index: int, depth: float) -> None:
        """Take in the next point."""
        # The first comparison with NaN is false: the first point is both extremes.
        if not depth >= self._low[0]:
            self._low = (depth, index)
        if not depth <= self._high[0]:
            self._high = (depth, index)
        if self.direction < 1 and depth - self._low[0] > self._hysteresis:
            self._turn(1, self._low[1], (depth, index))
        elif self.direction > -1 and self._high[0] - depth > self._hysteresis:
            self._turn(-1, self._high[1], (depth, index))

    def _turn(self, direction: int, start: int, here: tuple[float, int]) -> None:
        self.direction = direction
        self.starts.append(start)
        self._low = self._high = here

    def forget_before(self, first: int) -> None:
        """Points before index `first` are gone."""
        while len(self.starts) > 1 and self.starts[1] <= first:
            del self.starts[0]
        if self.starts:
            self.starts[0] = max(self.starts[0], first)

    def branches(self, end: int) -> list[tuple[int, int, int]]:
        """(direction, first, last) of every branch up to index `end`, both ends included."""
        edges = [*self.starts, end]
        newest = len(self.starts) - 1
        return [(self.direction * (-1) ** (newest - i), edges[i], edges[i + 1]) for i in range(newest + 1)]


def corners_of(time: np.ndarray, displacement: np.ndarray, tolerance: float) -> np.ndarray:
    """Samples between which the motion is straight within `tolerance`, m.

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


def label_motion(time: np.ndarray, displacement: np.ndarray, tolerance: float | None = None, *,
                 shortest_hold: float = 0.0) -> np.ndarray:
    """Names of the segments of a motion, one a sample: ``ramp``, ``hold``, ``unload``; shapes (n,).

    Args:
        time, displacement: s and m.
        tolerance: half of the hysteresis, m; None: `STRAIGHT` of the travel, of a machine.
        shortest_hold: s; what holds for less belongs to the segment before it.
    """
    tolerance = STRAIGHT * np.ptp(displacement) if tolerance is None else tolerance
    corners = corners_of(time, displacement, tolerance)
    way = np.diff(displacement[corners])
    names = np.where(np.abs(way) <= 2 * tolerance, "hold", np.where(way > 0, "ramp", "unload"))
    for part in np.flatnonzero(names == "hold") if shortest_hold else ():
        if _stays(time, displacement, corners[part], corners[part + 1], 2 * tolerance) >= shortest_hold:
            continue
        names[part] = names[part - 1] if part else "ramp" if way[part] > 0 else "unload"
    return names[np.clip(np.searchsorted(corners, np.arange(time.size), side="left") - 1, 0, names.size - 1)]


def _stays(time: np.ndarray, displacement: np.ndarray, first: int, last: int, reach: float) -> float:
    """How long a motion stays within `reach` (m) of where it is from sample `first` to `last`, s."""
    away = np.flatnonzero(np.abs(displacement - displacement[first]) > reach)
    before, after = away[away < first], away[away > last]
    return time[after[0] - 1 if after.size else -1] - time[before[-1] + 1 if before.size else 0]


def count_cycles(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels of `label_motion` with ``reload`` for each ramp after an unloading, and the number of the cycle, from 1,
    which begins there; shapes (n,)."""
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


def number_runs(labels: np.ndarray) -> np.ndarray:
    """Labels of samples, shape (n,), with a number behind each that comes again after another: ``ramp``, ``unload``,
    ``ramp 2``."""
    begins = np.flatnonzero(np.append(True, labels[1:] != labels[:-1]))
    seen: dict[str, int] = {}
    names = []
    for label in labels[begins].tolist():
        seen[label] = seen.get(label, 0) + 1
        names.append(label if seen[label] == 1 else f"{label} {seen[label]}")
    return np.repeat(np.array(names), np.diff(np.append(begins, labels.size)))


def load_and_unload(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the samples of the first way in and of the first way out after it, without holds.

    By the labels where there are segments, else by where the displacement turns round.

    Returns:
        Two arrays; the second is empty where the tool never comes out.
    """
    depth = recording.displacement
    load, unload = _labelled(recording.labels["segment"]) if "segment" in recording.labels else _turned(depth)
    if not load.size:  # labels in words of somebody else
        load, unload = _turned(depth)
    return load[one_way(depth[load], 1)], unload[one_way(depth[unload], -1)]


def _labelled(segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the first run of segments that go in, and of the first run of those that go out."""
    kinds = np.where(np.isin(segment, _IN), 1, np.where(np.isin(segment, _OUT), -1, 0))
    kinds[segment == "reload"] = 2
    out = np.flatnonzero(kinds == -1)
    first_out = out[0] if out.size else kinds.size
    load = np.flatnonzero(kinds[:first_out] == 1)
    again = np.flatnonzero(kinds[first_out:] > 0)
    last_out = first_out + (again[0] if again.size else kinds.size - first_out)
    unload = np.flatnonzero(kinds[first_out:last_out] == -1) + first_out
    # A sample where two segments meet belongs to the first of them.
    return load, np.concatenate([[unload[0] - 1], unload]) if unload.size and unload[0] > 0 else unload


def _turned(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the first branch that goes in, and of the one after it."""
    reach = float(depth.max() - depth.min())
    # Trembling as that of a hand, less where the whole test is small.
    reversals = Reversals(min(max(HYSTERESIS, _NOISE_SHARE * reach), 0.1 * reach))
    for index, value in enumerate(depth.tolist()):
        reversals.add(index, value)
    branches = reversals.branches(depth.size - 1)
    while branches and branches[0][0] < 0:
        del branches[0]
    first, second, *_ = [np.arange(begin, end + 1) for _, begin, end in branches[:2]] + 2 * [np.arange(0)]
    return first, second


def one_way(depth: np.ndarray, direction: int) -> np.ndarray:
    """Indices of samples of a branch between which depth is strictly monotone; trembling drops out, and so does
    standing still at either end.

    In the first half of the way that is the last sample at each depth, in the second half the first one.

    Args:
        depth: m, shape (n,), in the order of time.
        direction: 1 in, -1 out.
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
