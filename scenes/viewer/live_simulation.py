"""Running simulation of a session: starts the loop process, reads its ticks and snapshots, and computes read-outs."""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import tissue_sim as ts
from haptics.devices.contracts import HapticDevice
from haptics.loop.loop import LoopSettings
from haptics.loop.multirate import STEP_BUDGET, make_real_time_tissue_factory
from haptics.loop.process import PATIENCE, LoopError, LoopProcess
from haptics.loop.ring import PAUSED, RingReader
from haptics.loop.shared_slots import SnapshotReader
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from scenes.viewer.background_simulation import ExtendableBudgetSimulator
from scenes.viewer.frame import Phase, SimulationReadouts
from scenes.viewer.revolution import TriangulatedSurface
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import ForceStatus

#: Wall-time budget of a step, s.
BUDGET = STEP_BUDGET


@dataclass(frozen=True)
class ReadoutTimeWindows:
    """Time windows of the read-outs; longer windows give steadier and slower numbers.

    Attributes:
        statistics: Window of step time and iterations, simulated time, s.
        unconverged: Window in which ticks without an accurate equilibrium are counted, simulated time, s.
        rate: Window of the loop rate, wall time, s.
    """

    statistics: float = 0.5
    unconverged: float = 1.0
    rate: float = 2.0


_READOUTS = ReadoutTimeWindows()
#: Fields of a tick from which the statistics are computed.
_STATISTICS_FIELDS = ("time", "compute_time", "iterations", "status")
#: Loop settings of the viewer: one tick per millisecond, 30 snapshots per second.
SETTINGS = LoopSettings(snapshot_rate=30.0)
#: Loop settings for tissue whose equilibria take longer than a tick: its forces are extrapolated with the status LATE
#: for up to 60 s. Not for a haptic device.
PATIENT = replace(SETTINGS, patience=60.0)
#: Limits of the rendered force, N, and of its change per tick, N. They are so large that they have no effect: no device
#: receives the force, and the page shows the force of the tissue.
_NO_LIMITS = ForceLimiter(1e3, 1e3)


class LiveSimulation:
    """Simulation in a loop process that the viewer observes without waiting for it; call `close` at the end.

    Args:
        model: Experiment and material.
        device: Haptic device, or a motion.
        solver: Name in `tissue_sim.fem.solver.SOLVERS`.
        resolution: Resolution of the `Simulator`.
        settings: Settings of the loop.
        reduced: Reduced model for the solver ``"reduced"``; otherwise None.

    Attributes:
        phase: Phase of the simulation.
        message: Present activity, or why the simulation has stopped.
        snapshot: Newest snapshot; None before the first one.
        surface: Surface of the tissue at that snapshot if the snapshot has no fields to draw; otherwise None.
        readouts: Present numbers; None before the first tick.
    """

    def __init__(self, model: ts.Model, device: HapticDevice, *, solver: str = "axisymmetric",
                 resolution: str = "realtime", settings: LoopSettings = SETTINGS,
                 reduced: ts.ReducedModel | None = None):
        self._loop = LoopProcess(
            make_real_time_tissue_factory(model, solver=solver, resolution=resolution, budget=BUDGET, mesh=reduced,
                                          simulator=ExtendableBudgetSimulator), device,
            ForceRendering(_NO_LIMITS), settings)
        if settings.patience > PATIENCE:
            # The loop answers a command after the present tick, which may take as long as `settings.patience`.
            self._loop.patience = settings.patience
        self._files = ExitStack()
        self._ring: RingReader | None = None
        self._snapshots: SnapshotReader | None = None
        self._number, self._published = 0, 0
        #: Wall time, s, and number of ticks at the polls of the last `ReadoutTimeWindows.rate` s.
        self._tick_counts: deque[tuple[float, int]] = deque()
        #: Ticks of the last `ReadoutTimeWindows.unconverged` s, columns as in `_STATISTICS_FIELDS`.
        self._statistics = np.empty((0, len(_STATISTICS_FIELDS)))
        self._paused = False
        self._model = model
        self.phase, self.message = Phase.STARTING, "starting"
        self.snapshot: Snapshot | None = None
        self.surface: TriangulatedSurface | None = None
        self.readouts: SimulationReadouts | None = None
        self._loop.start()

    @property
    def haptic_loop_process(self) -> LoopProcess:
        """The loop process, for measurements and tests."""
        return self._loop

    @property
    def _inclination_cosine(self) -> float:
        """Depth over displacement along the axis of the tool: the cosine of its inclination."""
        approach = self._model.experiment.approach
        return 1.0 if approach is None else math.cos(approach.angle)

    @property
    def tool_displacement(self) -> float:
        """Present displacement of the tool along its axis, m; 0 before the first tick."""
        last = None if self._ring is None else self._ring.latest()
        return 0.0 if last is None else float(last["tool_depth"]) / self._inclination_cosine

    @property
    def tool_axis_surface_crossing_or_none(self) -> tuple[float, float] | None:
        """Present x and y at which the tool's axis crosses the undeformed surface, m; None before the first tick."""
        last = None if self._ring is None else self._ring.latest()
        if last is None:
            return None
        (x, y, z), (a, b, c, d) = last["tool_pose"][:3].tolist(), last["tool_pose"][3:].tolist()
        (_, _, u), (_, _, v), (_, _, w) = Pose((x, y, z), (a, b, c, d)).rotation_matrix
        return x - u / max(w, 0.1) * z, y - v / max(w, 0.1) * z

    def poll_loop_process(self) -> np.ndarray | None:
        """Read new ticks and the newest snapshot, and update phase, message and read-outs.

        Returns:
            The ticks since the last call, dtype `haptics.loop.ring.TICK`, with `tool_depth` converted to the
            displacement along the axis of an inclined tool; None before the first tick and after the end of the loop.
        """
        if self.phase is Phase.DIED:
            return None
        try:
            ready = self._loop.read_message_and_check_ready()
        except (LoopError, ts.InputError) as error:
            self._set_stopped_phase(str(error))
            return None
        self.message = self._loop.message
        if not ready:
            return None
        if self._loop.report is not None:
            self._set_stopped_phase(f"the loop has ended ({self._loop.report.ended_by})")
            return None
        if self._ring is None:
            self._ring = self._files.enter_context(self._loop.open_ring_reader())
            snapshots = self._loop.open_snapshot_reader()
            if snapshots is not None:
                self._snapshots = self._files.enter_context(snapshots)
        self.phase = Phase.PAUSED if self._paused else Phase.RUNNING
        ticks = self._ring.read_ticks_after(self._number)
        self._number = ticks.number
        records = ticks.records
        if self._inclination_cosine != 1.0:
            records = records.copy()
            records["tool_depth"] /= self._inclination_cosine
        if self._snapshots is not None and self._loop.pattern is not None:
            self._snapshots.pattern = self._loop.pattern
            published = self._snapshots.latest(after=self._published)
            if published is not None:
                self._published = published.number
                self._store_snapshot_and_surface(published.snapshot)
        if len(records):
            self._update_readouts(records)
        return records

    def send_command_and_wait(self, command: str, **values: Any) -> None:
        """Send a command to the loop and wait some milliseconds for its execution.

        Args:
            command: Name of a command of the loop.
            values: Arguments of the command.

        Raises:
            InputError: The loop refuses the command, or the simulation is not running.
        """
        if self.phase not in (Phase.RUNNING, Phase.PAUSED):
            raise ts.InputError(f"The simulation is not running ({self.message}).")
        try:
            self._loop.execute_command(command, **values)
        except LoopError as error:
            self._set_stopped_phase(str(error))
            raise ts.InputError(str(error)) from error
        if command in ("pause", "resume"):
            self._paused = command == "pause"
            self.phase = Phase.PAUSED if self._paused else Phase.RUNNING

    def close(self) -> None:
        """Stop the loop process and close its shared memory."""
        self._files.close()
        self._loop.stop()

    def skip_unread_ticks(self) -> None:
        """Skip the ticks that `poll_loop_process` has not read yet, and clear the statistics of the read-outs."""
        if self._ring is not None:
            self._number = self._ring.written_count
        self._statistics = self._statistics[:0]

    def _store_snapshot_and_surface(self, snapshot: Snapshot) -> None:
        """Store a snapshot, and the surface of the tissue if the snapshot contains one."""
        skin = snapshot.skin
        if skin is not None:
            self.surface = TriangulatedSurface(skin.vertices.astype(np.float32), skin.triangles.astype(np.uint32))
        self.snapshot = snapshot

    def _set_stopped_phase(self, reason: str) -> None:
        """Set the phase to DIED, and the message to the reason."""
        self.phase, self.message = Phase.DIED, reason

    def _update_readouts(self, records: np.ndarray) -> None:
        """Compute the read-outs from the new ticks, and store them in `readouts`."""
        now, last = time.monotonic(), records[-1]
        self._tick_counts.append((now, self._number))
        while now - self._tick_counts[0][0] > _READOUTS.rate:
            self._tick_counts.popleft()
        (then, before) = self._tick_counts[0]
        rate = (self._number - before) / (now - then) if now > then else 0.0
        # Copy only the needed columns, because a tick has many fields.
        added = np.column_stack([records[name] for name in _STATISTICS_FIELDS])
        ticks = np.concatenate([self._statistics, added])
        self._statistics = ticks = ticks[ticks[:, 0] > last["time"] - _READOUTS.unconverged]
        times, compute_time, iterations, statuses = ticks.T
        recent = times > last["time"] - _READOUTS.statistics
        status = ForceStatus(int(last["status"]))
        deadlines = last["tick"]
        self.readouts = SimulationReadouts(
            float(last["time"]), float(last["tool_depth"]), float(last["tissue_force"]), float(last["stiffness"]),
            float(np.median(compute_time[recent])), float(iterations[recent].mean()), rate,
            float((last["late"] + last["missed"]) / max(deadlines, 1)), _describe_force_status(status, last),
            _describe_resolution_and_force_error(self._loop.resolution, self._loop.force_error),
            _describe_force_warning(status, last),
            int(np.count_nonzero(statuses != ForceStatus.CONVERGED)),
            (float(last["tissue_wrench"][0]), float(last["tissue_wrench"][1])))


def _describe_resolution_and_force_error(resolution: str, force_error: float | None) -> str:
    """Return the resolution of the mesh, with the relative error of its force if it is known."""
    return resolution if force_error is None else f"{resolution}, force within {100 * force_error:.2g} %"


def _describe_force_status(status: ForceStatus, last: np.void) -> str:
    """Return the status of the newest force in words."""
    if status is ForceStatus.CONVERGED:
        return "paused" if last["flags"] & PAUSED else "in equilibrium"
    return "inaccurate" if _is_late_status_despite_equilibrium(status, last) else status.name.lower()


def _describe_force_warning(status: ForceStatus, last: np.void) -> str:
    """Return cause and remedy of a status; empty for an accurate equilibrium."""
    if _is_late_status_despite_equilibrium(status, last):
        return (f"The force is in equilibrium, but its estimated error is {last['force_error']:.2g} N. "
                "Use a finer mesh, a deeper indentation or a slower motion.")
    return "" if status is ForceStatus.CONVERGED else status.message


def _is_late_status_despite_equilibrium(status: ForceStatus, last: np.void) -> bool:
    """Return whether the newest force is an equilibrium force whose estimated error is too large."""
    return status is ForceStatus.LATE and last["age"] == 0.0 and bool(np.isfinite(last["force_error"]))
