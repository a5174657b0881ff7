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
from tissue_sim.recording.segmentation import HOLD_TIME, HYSTERESIS, Reversals, count_cycles, label_motion, one_way
from tissue_sim.tool_force import ForceStatus

#: At least so long between two kept points, s, and at most so long where nothing moves.
SHORTEST, LONGEST = 5e-3, 0.1
#: A point is kept where depth (m), or force as a share of the largest so far, has changed by this much.
DEPTH_STEP, FORCE_SHARE = 0.02e-3, 0.01
MOST_POINTS = 20_000
#: Statuses of ticks whose force is drawn; a recording has no LATE ones, which are carried on from an equilibrium.
OF_TISSUE = (ForceStatus.CONVERGED, ForceStatus.LATE)
#: Of a kept point: time, depth, force, pose (7), wrench (6), rendered force, status, inertial; and the channels of a
#: recording of the wrench.
_ROWS, _POSE, _WRENCH, _RENDERED, _STATUS, _INERTIAL = 19, slice(3, 10), slice(10, 16), 16, 17, 18
_CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
#: A branch that ends on a point of a grid may miss it by so much, m.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Branch:
    """Points of one way in or out; s, m and N, each of shape (n,), and whether the force is that of a late tick, and
    of tissue whose mass counted."""

    time: np.ndarray
    depth: np.ndarray
    force: np.ndarray
    late: np.ndarray
    inertial: np.ndarray


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
    """Poses of the tool and wrenches on it in a run, fed with the ticks of a loop; depth and force are what is drawn.

    A point is kept every `SHORTEST` s at most, where depth or force has changed by `DEPTH_STEP` or `FORCE_SHARE`, and
    every `LONGEST` s at least. Dropped are the ticks between, paused ones, those whose force is no longer the tissue's
    (`OF_TISSUE`) or whose depth or force is no number, and the oldest points where there are more than `most`: a tool
    that stands still fills these in half an hour, one that hurries in 100 s. Times are those of the loop; where they
    run backwards another loop has begun, and the trace begins anew.

    Args:
        most: kept points.
    """

    def __init__(self, most: int = MOST_POINTS):
        self._most = most
        self.clear()

    def clear(self) -> None:
        """Forget everything, as at a reset."""
        # Twice the room: the points are moved to its beginning once in `most` points, not at every one.
        self._points = np.empty((_ROWS, 2 * self._most))
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
        felt = ((records["flags"] & PAUSED) == 0) & np.any([records["status"] == status for status in OF_TISSUE],
                                                                      axis=0)
        records = records[felt & np.isfinite(records["tool_depth"]) & np.isfinite(records["tissue_force"])]
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
        records = records[chosen]
        for point in np.column_stack([records[name] for name in (
                "time", "tool_depth", "tissue_force", "tool_pose", "tissue_wrench", "force", "status",
                "inertial")]).tolist():
            if self._differs(*point[:3]):
                self._keep(point)
        return self._gone + self._end - before

    def _differs(self, time: float, depth: float, force: float) -> bool:
        last_time, last_depth, last_force = self._last
        self._largest = max(self._largest, abs(force))
        return (time - last_time >= LONGEST or abs(depth - last_depth) >= DEPTH_STEP
                or abs(force - last_force) > FORCE_SHARE * self._largest)

    def _keep(self, point: list[float]) -> None:
        if self._end == self._points.shape[1]:
            self._points[:, :len(self)] = self._points[:, self._first:self._end].copy()
            self._gone += self._first
            self._first, self._end = 0, self._end - self._first
        self._points[:, self._end] = point
        self._reversals.add(self._gone + self._end, point[1])
        self._end += 1
        time, depth, force, *_ = point
        self._last = time, depth, force
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

    @property
    def late(self) -> np.ndarray:
        """Whether the budget of the tick ended before equilibrium, so that its force is carried on, shape (n,)."""
        return self._points[_STATUS, self._first:self._end] == ForceStatus.LATE

    @property
    def inertial(self) -> np.ndarray:
        """Whether the mass of the tissue was taken into account, shape (n,)."""
        return self._points[_INERTIAL, self._first:self._end] != 0.0

    @property
    def rendered_force(self) -> np.ndarray:
        """Along z, as the hand gets it after coupling, control and limits, N, shape (n,)."""
        return self._points[_RENDERED, self._first:self._end]

    @property
    def pose(self) -> np.ndarray:
        """Of the tool: x, y, z, m, then the quaternion w, x, y, z; shape (n, 7)."""
        return self._points[_POSE, self._first:self._end].T

    @property
    def wrench(self) -> np.ndarray:
        """Of the tissue on the tool about its deepest point, N and N m, shape (n, 6)."""
        return self._points[_WRENCH, self._first:self._end].T

    def branches(self) -> tuple[Branch | None, Branch | None]:
        """The newest loading branch and the newest unloading branch; None where there was none."""
        newest: dict[int, Branch] = {}
        for direction, first, last in reversed(self._branches()):
            newest.setdefault(direction, self._branch(first, last))
            if len(newest) == 2:
                break
        return newest.get(1), newest.get(-1)

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
            # A branch begins and ends at its extremes.
            low, high = sorted((self.depth[first], self.depth[last]))
            missing = np.isnan(passes[direction]) & (grid >= low - _ROUNDING) & (grid <= high + _ROUNDING)
            if missing.any():
                branch = self._branch(first, last)
                passes[direction][missing] = on_grid(branch.depth, branch.force, direction, grid[missing])
        return passes[1], passes[-1]

    def recording(self, metadata: Mapping[str, Any]) -> Recording:
        """What was felt, as a recording that begins at time 0, with segments (ramp, hold, unload, reload) and cycles;
        where the wrench is more than a force along z, with the channels Fx to Tz. Points whose force was carried on
        from an earlier equilibrium are left out.

        Args:
            metadata: such as ``name`` and ``kind``.

        Raises:
            InputError: fewer than two points were felt.
        """
        felt = ~self.late
        if felt.sum() < 2:
            raise InputError("nothing has been felt in equilibrium yet; push the tool into the tissue first, slowly "
                             "where this computer is often late", field="trace")
        time, depth, wrench = self.time[felt], self.depth[felt], self.wrench[felt]
        labels = label_motion(time, depth, 0.5 * HYSTERESIS, shortest_hold=HOLD_TIME)
        segment, cycle = count_cycles(labels)
        channels = {"time": time - time[0], "displacement": depth, "force": self.force[felt]}
        if wrench[:, [0, 1, 3, 4, 5]].any():
            channels |= zip(_CHANNELS, wrench.T, strict=True)
        return Recording(channels, {"segment": segment, "cycle": cycle}, dict(metadata))

    def _branches(self) -> list[tuple[int, int, int]]:
        """As `Reversals.branches`, with indices of `depth`."""
        gone = self._gone + self._first
        return [(way, first - gone, last - gone) for way, first, last in self._reversals.branches(gone + len(self) - 1)]

    def _branch(self, first: int, last: int) -> Branch:
        part = slice(first, last + 1)
        return Branch(self.time[part], self.depth[part], self.force[part], self.late[part],
                      self.inertial[part])


def recording_files(recording: Recording, stem: str) -> dict[str, bytes]:
    """Name -> content of the files that `tissue_sim.write_recording` makes of a recording: ``STEM.csv``, every digit
    kept, and ``STEM.json``, its sidecar.

    Raises:
        InputError: labels or metadata that a file cannot hold.
    """
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / f"{stem}.csv"
        write_recording(recording, path)
        return {each.name: each.read_bytes() for each in (path, path.with_suffix(".json"))}
