"""What has been felt so far in a run: kept small, split into loading and unloading, and written as a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from haptics.loop.ring import PAUSED
from tissue_sim.errors import InputError
from tissue_sim.recording.file import write_recording
from tissue_sim.recording.recording import Recording

#: Smallest way back that counts as a reversal, m: a hand trembles less.
HYSTERESIS = 0.05e-3
#: At least so long between two kept points, s, and at most so long where nothing moves.
SHORTEST, LONGEST = 5e-3, 0.1
#: A point is kept where depth (m), or force as a share of the largest so far, has changed by this much.
DEPTH_STEP, FORCE_SHARE = 0.02e-3, 0.01
MOST_POINTS = 20_000
#: A tool that stays within `HYSTERESIS` for so long holds, s.
HOLD_TIME = 1.0
#: A branch that ends on a point of a grid may miss it by so much, m.
_ROUNDING = 1e-12


class Reversals:
    """Where a motion turns round, found as it comes: a way back of no more than `hysteresis` (m) is noise.

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


@dataclass(frozen=True, eq=False)
class Branch:
    """Points of one way in or out; s, m and N, each of shape (n,)."""

    time: np.ndarray
    depth: np.ndarray
    force: np.ndarray


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


def on_grid(depth: np.ndarray, force: np.ndarray, direction: int, grid: np.ndarray) -> np.ndarray:
    """Force of a branch on a grid of depths by straight lines, NaN where the branch does not reach.

    Args:
        depth, force: of the branch in the order of time, shape (n,).
        direction: 1 in, -1 out.
        grid: ascending, shape (m,).
    """
    if not len(depth):
        return np.full(grid.size, np.nan)
    kept = one_way(depth, direction)[::direction]
    x = depth[kept]
    force = np.interp(grid, x, force[kept])
    return np.where((grid >= x[0] - _ROUNDING) & (grid <= x[-1] + _ROUNDING), force, np.nan)


class Trace:
    """Depth and force of a run, fed with the ticks of a loop.

    A point is kept every `SHORTEST` s at most, where depth or force has changed by `DEPTH_STEP` or `FORCE_SHARE`, and
    every `LONGEST` s at least. Dropped are the ticks between, paused ones, those whose depth or force is no number,
    and the oldest points where there are more than `most`: a tool that stands still fills these in half an hour, one
    that hurries in 100 s. Times are those of the loop; where they run backwards another loop has begun, and the trace
    begins anew.

    Args:
        most: kept points.
    """

    def __init__(self, most: int = MOST_POINTS):
        self._most = most
        self.clear()

    def clear(self) -> None:
        """Forget everything, as at a reset."""
        # Twice the room: the points are moved to its beginning once in `most` points, not at every one.
        self._points = np.empty((3, 2 * self._most))
        self._first = self._end = 0
        #: Points that were moved out: how far the indices of the reversals are ahead of those of `_points`.
        self._gone = 0
        self._reversals = Reversals()
        self._last = (-np.inf, np.nan, np.nan)
        self._bin = -1
        self._largest = 0.0

    def __len__(self) -> int:
        return self._end - self._first

    def append(self, records: np.ndarray) -> int:
        """Take in ticks, dtype `haptics.loop.ring.TICK`, in their order; returns how many were kept."""
        paused = (records["flags"] & PAUSED) != 0
        records = records[~paused & np.isfinite(records["tool_depth"]) & np.isfinite(records["tissue_force"])]
        if not records.size:
            return 0
        time = records["time"]
        back = np.flatnonzero(np.diff(time, prepend=self._last[0]) < 0)
        if back.size:
            self.clear()
            records, time = records[back[-1]:], time[back[-1]:]
        bins = np.floor(time / SHORTEST).astype(np.int64)
        chosen = np.diff(bins, prepend=self._bin) != 0
        self._bin = int(bins[-1])
        before = self._gone + self._end
        for point in zip(time[chosen].tolist(), records["tool_depth"][chosen].tolist(),
                         records["tissue_force"][chosen].tolist(), strict=True):
            if self._differs(*point):
                self._keep(point)
        return self._gone + self._end - before

    def _differs(self, time: float, depth: float, force: float) -> bool:
        last_time, last_depth, last_force = self._last
        self._largest = max(self._largest, abs(force))
        return (time - last_time >= LONGEST or abs(depth - last_depth) >= DEPTH_STEP
                or abs(force - last_force) > FORCE_SHARE * self._largest)

    def _keep(self, point: tuple[float, float, float]) -> None:
        if self._end == self._points.shape[1]:
            self._points[:, :len(self)] = self._points[:, self._first:self._end].copy()
            self._gone += self._first
            self._first, self._end = 0, self._end - self._first
        self._points[:, self._end] = point
        self._reversals.add(self._gone + self._end, point[1])
        self._end += 1
        self._last = point
        if len(self) > self._most:
            self._first += 1
            self._reversals.forget_before(self._gone + self._first)

    @property
    def time(self) -> np.ndarray:
        """Of the loop, s, shape (n,)."""
        return self._points[0, self._first:self._end]

    @property
    def depth(self) -> np.ndarray:
        """m, shape (n,)."""
        return self._points[1, self._first:self._end]

    @property
    def force(self) -> np.ndarray:
        """N, shape (n,)."""
        return self._points[2, self._first:self._end]

    def branches(self) -> tuple[Branch | None, Branch | None]:
        """The newest loading branch and the newest unloading branch; None where there was none."""
        found: dict[int, Branch] = {}
        for direction, first, last in reversed(self._branches()):
            found.setdefault(direction, self._branch(first, last))
            if len(found) == 2:
                break
        return found.get(1), found.get(-1)

    def newest_passes(self, grid: np.ndarray, most: int = 40) -> tuple[np.ndarray, np.ndarray]:
        """Force at each depth of a grid when the tool last went in past it, and when it last went out past it.

        So a small step back leaves what was felt above it standing.

        Args:
            grid: m, ascending, shape (n,).
            most: branches to look back.

        Returns:
            Load and unload, N, each of shape (n,), NaN where the tool did not pass.
        """
        passes = {1: np.full(grid.size, np.nan), -1: np.full(grid.size, np.nan)}
        for direction, first, last in reversed(self._branches()[-most:]):
            branch = self._branch(first, last)
            # A branch begins and ends at its extremes.
            low, high = sorted((branch.depth[0], branch.depth[-1]))
            missing = np.isnan(passes[direction]) & (grid >= low - _ROUNDING) & (grid <= high + _ROUNDING)
            if missing.any():
                passes[direction][missing] = on_grid(branch.depth, branch.force, direction, grid[missing])
        return passes[1], passes[-1]

    def recording(self, metadata: Mapping[str, Any]) -> Recording:
        """What was felt, as a recording that begins at time 0, with segments (ramp, hold, unload, reload) and cycles.

        Args:
            metadata: such as ``name`` and ``kind``.

        Raises:
            InputError: fewer than two points were felt.
        """
        if len(self) < 2:
            raise InputError("nothing has been felt yet; push the tool into the tissue first", field="trace")
        segment, cycle = self._labels()
        return Recording({"time": self.time - self.time[0], "displacement": self.depth, "force": self.force},
                         {"segment": segment, "cycle": cycle}, dict(metadata))

    def _labels(self) -> tuple[np.ndarray, np.ndarray]:
        segment, cycle = np.full(len(self), "hold", dtype="U6"), np.ones(len(self), dtype=int)
        number, withdrawn = 1, False
        for direction, first, last in self._branches():
            if direction > 0 and withdrawn:
                number += 1
            withdrawn = withdrawn or direction < 0
            # A sample where two segments meet belongs to the first of them.
            part = slice(first if first == 0 else first + 1, last + 1)
            segment[part] = "unload" if direction < 0 else "ramp" if number == 1 else "reload"
            cycle[part] = number
        segment[_holds(self.time, self.depth)] = "hold"
        return segment, cycle

    def _branches(self) -> list[tuple[int, int, int]]:
        """As `Reversals.branches`, with indices of `depth`."""
        gone = self._gone + self._first
        return [(way, first - gone, last - gone) for way, first, last in self._reversals.branches(gone + len(self) - 1)]

    def _branch(self, first: int, last: int) -> Branch:
        part = slice(first, last + 1)
        return Branch(self.time[part], self.depth[part], self.force[part])


def _holds(time: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Whether each point belongs to a hold: `HOLD_TIME` or more within `HYSTERESIS` of where the hold began."""
    holds = np.zeros(len(time), dtype=bool)
    begin = 0
    for i in range(1, len(time) + 1):
        if i == len(time) or abs(depth[i] - depth[begin]) > HYSTERESIS:
            if time[i - 1] - time[begin] >= HOLD_TIME:
                holds[begin:i] = True
            begin = i
    return holds


def recording_csv(recording: Recording) -> bytes:
    """The recording as the CSV that `tissue_sim.write_recording` makes of it, every digit kept; without the sidecar.

    Raises:
        InputError: labels or metadata that a file cannot hold.
    """
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / "recording.csv"
        write_recording(recording, path)
        return path.read_bytes()
