"""Trace of a run: thinned motion and force of the tool, split into loading and unloading, and saved as a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from haptics.loop.ring import PAUSED
from tissue_sim.errors import InputError
from tissue_sim.recording.file import write_recording
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segmentation import (
    MOTION_SETTINGS,
    ReversalDetector,
    find_strictly_monotone_sample_indices,
    label_reloads_and_cycles,
    label_samples_ramp_hold_unload,
)
from tissue_sim.tool_force import ForceStatus


@dataclass(frozen=True)
class TraceSettings:
    """Rules for the points that a trace keeps; smaller steps give a finer curve and a shorter history.

    Attributes:
        shortest: Shortest time between two points, s.
        longest: Longest time between two points, also of a standing tool, s.
        depth_step: Change of depth for which a point is kept, m.
        force_step: Change of force for which a point is kept, relative to the largest force so far.
        max_points: Largest number of points; older points are dropped. 20 000 points last 100 s for a fast tool and
            half an hour for a standing one.
    """

    shortest: float = 5e-3
    longest: float = 0.1
    depth_step: float = 0.02e-3
    force_step: float = 0.01
    max_points: int = 20_000


#: Settings of the viewer.
SETTINGS = TraceSettings()
#: Statuses of ticks whose force is drawn. A saved recording excludes LATE ticks, whose force is extrapolated from an
#: earlier equilibrium.
DRAWN_STATUSES = (ForceStatus.CONVERGED, ForceStatus.LATE)


class TraceRowIndex(IntEnum):
    """Row numbers of the points of a trace; pose and wrench have seven and six rows."""

    TIME = 0
    DEPTH = 1
    FORCE = 2
    POSE = 3
    WRENCH = 10
    RENDERED_FORCE = 16
    STATUS = 17
    INERTIAL = 18
    COUNT = 19


#: Channels of the wrench in a recording.
_CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
#: Tolerance at the ends of a branch for rounding errors of the depth, m.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class TraceBranch:
    """Points of one loading or unloading.

    Attributes:
        time: Time, s, shape (n,).
        depth: Displacement of the tool, m, shape (n,).
        force: Force of the tissue, N, shape (n,).
        is_late: Whether a late tick extrapolated the force, shape (n,).
        includes_inertia: Whether the force includes the inertia of the tissue, shape (n,).
    """

    time: np.ndarray
    depth: np.ndarray
    force: np.ndarray
    is_late: np.ndarray
    includes_inertia: np.ndarray


def interpolate_branch_force(depth: np.ndarray, force: np.ndarray, direction: int, grid: np.ndarray) -> np.ndarray:
    """Interpolate the force of a branch linearly to a grid of depths.

    Args:
        depth: Depths of the branch in the order of time, m, shape (n,).
        force: Forces of the branch, N, shape (n,).
        direction: 1 for loading, -1 for unloading.
        grid: Ascending depths, m, shape (m,).

    Returns:
        Force, N, shape (m,), NaN at depths that the branch does not reach.
    """
    if not len(depth):
        return np.full(grid.size, np.nan)
    kept = find_strictly_monotone_sample_indices(depth, direction)[::direction]
    x = depth[kept]
    force = np.interp(grid, x, force[kept])
    return np.where((grid >= x[0] - _ROUNDING) & (grid <= x[-1] + _ROUNDING), force, np.nan)


class Trace:
    """Thinned history of tool poses and wrenches in a run.

    A tick becomes a point if depth or force has changed enough, as `TraceSettings` states. Ticks of a pause, ticks with
    other statuses than `DRAWN_STATUSES`, and ticks whose depth or force is not finite are skipped. If the time of the
    loop decreases, another loop has started, and the trace starts with empty data.

    Args:
        max_points: Largest number of points; older points are dropped.
    """

    def __init__(self, max_points: int = SETTINGS.max_points):
        self._max_points = max_points
        self.delete_all_points()

    def delete_all_points(self) -> None:
        """Delete all points."""
        # The array has twice the necessary length, so that points are moved to its start only once per `max_points`.
        self._points = np.empty((TraceRowIndex.COUNT, 2 * self._max_points))
        self._first = self._end = 0
        #: Number of dropped points: index of a point in the reversals minus its index in `_points`.
        self._dropped = 0
        self._reversals = ReversalDetector()
        self._last = (-np.inf, np.nan, np.nan)
        self._bin = -1
        self._largest = 0.0

    def __len__(self) -> int:
        return self._end - self._first

    def append_ticks_and_count_new_points(self, records: np.ndarray) -> int:
        """Append ticks, dtype `haptics.loop.ring.TICK`, in the order of time; return the number of new points."""
        drawn = ((records["flags"] & PAUSED) == 0) & np.any([records["status"] == status for status in DRAWN_STATUSES],
                                                            axis=0)
        records = records[drawn & np.isfinite(records["tool_depth"]) & np.isfinite(records["tissue_force"])]
        if not records.size:
            return 0
        time = records["time"]
        restarts = np.flatnonzero(np.diff(time, prepend=self._last[0]) < 0)
        if restarts.size:
            self.delete_all_points()
            records, time = records[restarts[-1]:], time[restarts[-1]:]
        bins = np.floor(time / SETTINGS.shortest).astype(np.int64)
        chosen = np.diff(bins, prepend=self._bin) != 0
        self._bin = int(bins[-1])
        before = self._dropped + self._end
        records = records[chosen]
        for point in np.column_stack([records[name] for name in (
                "time", "tool_depth", "tissue_force", "tool_pose", "tissue_wrench", "force", "status",
                "inertial")]).tolist():
            if self._update_largest_force_and_check_if_kept(*point[:3]):
                self._append_point_and_drop_oldest(point)
        return self._dropped + self._end - before

    def _update_largest_force_and_check_if_kept(self, time: float, depth: float, force: float) -> bool:
        """Return whether a tick differs enough from the last point to be kept; update the largest force so far."""
        last_time, last_depth, last_force = self._last
        self._largest = max(self._largest, abs(force))
        return (time - last_time >= SETTINGS.longest or abs(depth - last_depth) >= SETTINGS.depth_step
                or abs(force - last_force) > SETTINGS.force_step * self._largest)

    def _append_point_and_drop_oldest(self, point: list[float]) -> None:
        """Append a point; drop the oldest point if there are more than `max_points`."""
        if self._end == self._points.shape[1]:
            self._points[:, :len(self)] = self._points[:, self._first:self._end].copy()
            self._dropped += self._first
            self._first, self._end = 0, self._end - self._first
        self._points[:, self._end] = point
        self._reversals.add_sample(self._dropped + self._end, point[TraceRowIndex.DEPTH])
        self._end += 1
        time, depth, force, *_ = point
        self._last = time, depth, force
        if len(self) > self._max_points:
            self._first += 1
            self._reversals.discard_reversals_before_sample(self._dropped + self._first)

    @property
    def time(self) -> np.ndarray:
        """Time of the loop, s, shape (n,)."""
        return self._points[TraceRowIndex.TIME, self._first:self._end]

    @property
    def depth(self) -> np.ndarray:
        """Displacement of the tool along its axis, m, shape (n,)."""
        return self._points[TraceRowIndex.DEPTH, self._first:self._end]

    @property
    def force(self) -> np.ndarray:
        """Force of the tissue on the tool along z, N, shape (n,)."""
        return self._points[TraceRowIndex.FORCE, self._first:self._end]

    @property
    def is_late(self) -> np.ndarray:
        """Whether the budget of the tick ended before equilibrium, so that its force is extrapolated, shape (n,)."""
        return self._points[TraceRowIndex.STATUS, self._first:self._end] == ForceStatus.LATE

    @property
    def includes_inertia(self) -> np.ndarray:
        """Whether the force includes the inertia of the tissue, shape (n,)."""
        return self._points[TraceRowIndex.INERTIAL, self._first:self._end] != 0.0

    @property
    def rendered_force(self) -> np.ndarray:
        """Force on the hand along z after coupling, control and limits, N, shape (n,)."""
        return self._points[TraceRowIndex.RENDERED_FORCE, self._first:self._end]

    @property
    def pose(self) -> np.ndarray:
        """Pose of the tool: x, y, z, m, then the quaternion w, x, y, z; shape (n, 7)."""
        return self._points[TraceRowIndex.POSE:TraceRowIndex.WRENCH, self._first:self._end].T

    @property
    def wrench(self) -> np.ndarray:
        """Force and torque of the tissue on the tool about its deepest point, N and N m, shape (n, 6)."""
        return self._points[TraceRowIndex.WRENCH:TraceRowIndex.RENDERED_FORCE, self._first:self._end].T

    def get_newest_loading_and_unloading(self) -> tuple[TraceBranch | None, TraceBranch | None]:
        """Return the newest loading and the newest unloading; None instead of a branch that does not exist."""
        newest: dict[int, TraceBranch] = {}
        for direction, first, last in reversed(self._list_branch_directions_and_indices()):
            newest.setdefault(direction, self._slice_trace_branch_in_time_order(first, last))
            if len(newest) == 2:
                break
        return newest.get(1), newest.get(-1)

    def interpolate_newest_force_at_each_depth(self, grid: np.ndarray,
                                               max_branches: int = 40) -> tuple[np.ndarray, np.ndarray]:
        """Return the force of the last loading and of the last unloading at each depth of a grid.

        Each depth has its own last branch, so a short reversal replaces only the part of the curve that it covers.

        Args:
            grid: Ascending depths, m, shape (n,).
            max_branches: Number of newest branches to search.

        Returns:
            Load and unload, N, each of shape (n,), NaN where the tool did not pass.
        """
        passes = {1: np.full(grid.size, np.nan), -1: np.full(grid.size, np.nan)}
        for direction, first, last in reversed(self._list_branch_directions_and_indices()[-max_branches:]):
            # A branch has its smallest and largest depth at its ends.
            low, high = sorted((self.depth[first], self.depth[last]))
            missing = np.isnan(passes[direction]) & (grid >= low - _ROUNDING) & (grid <= high + _ROUNDING)
            if missing.any():
                branch = self._slice_trace_branch_in_time_order(first, last)
                passes[direction][missing] = interpolate_branch_force(branch.depth, branch.force, direction,
                                                                      grid[missing])
        return passes[1], passes[-1]

    def make_equilibrium_recording(self, metadata: Mapping[str, Any]) -> Recording:
        """Return the equilibrium points of the trace as a recording.

        The recording starts at time 0 and has the labels segment (ramp, hold, unload, reload) and cycle. If the wrench
        has other components than a force along z, the recording has the channels Fx to Tz. Points of late ticks are
        excluded.

        Args:
            metadata: Metadata of the recording, such as ``name`` and ``kind``.

        Raises:
            InputError: There are fewer than two equilibrium points.
        """
        in_equilibrium = ~self.is_late
        if in_equilibrium.sum() < 2:
            raise InputError("must have at least two equilibrium points. Push the tool into the tissue first, and "
                             "slowly if many ticks are late.", field="trace")
        time, depth, wrench = self.time[in_equilibrium], self.depth[in_equilibrium], self.wrench[in_equilibrium]
        labels = label_samples_ramp_hold_unload(time, depth, 0.5 * MOTION_SETTINGS.hysteresis,
                                                shortest_hold=MOTION_SETTINGS.hold_time)
        segment, cycle = label_reloads_and_cycles(labels)
        channels = {"time": time - time[0], "displacement": depth, "force": self.force[in_equilibrium]}
        if wrench[:, [0, 1, 3, 4, 5]].any():
            channels |= zip(_CHANNELS, wrench.T, strict=True)
        return Recording(channels, {"segment": segment, "cycle": cycle}, dict(metadata))

    def _list_branch_directions_and_indices(self) -> list[tuple[int, int, int]]:
        """Return direction (1 or -1), first index and last index of each branch in the arrays of the trace."""
        dropped = self._dropped + self._first
        return [(direction, first - dropped, last - dropped)
                for direction, first,
                last in self._reversals.list_branch_directions_and_ranges(dropped + len(self) - 1)]

    def _slice_trace_branch_in_time_order(self, first: int, last: int) -> TraceBranch:
        """Return the points from index `first` to index `last`, both included, in the order of time."""
        part = slice(first, last + 1)
        return TraceBranch(self.time[part], self.depth[part], self.force[part], self.is_late[part],
                           self.includes_inertia[part])


def make_csv_and_sidecar_bytes_by_name(recording: Recording, stem: str) -> dict[str, bytes]:
    """Return the files of a recording: ``STEM.csv`` with all digits, and its sidecar ``STEM.json``.

    Args:
        recording: The recording.
        stem: Name of the files without suffix.

    Returns:
        File name -> content, as `tissue_sim.write_recording` writes it.

    Raises:
        InputError: The labels or the metadata cannot be written to a file.
    """
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / f"{stem}.csv"
        write_recording(recording, path)
        return {each.name: each.read_bytes() for each in (path, path.with_suffix(".json"))}
