"""The simulation that is felt: its loop, what it says of itself, and what it publishes."""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

import tissue_sim as ts
from haptics.devices.contracts import HapticDevice
from haptics.loop.loop import LoopSettings
from haptics.loop.multirate import real_time_tissue
from haptics.loop.process import PATIENCE, LoopError, LoopProcess
from haptics.loop.ring import PAUSED, RingReader
from haptics.loop.snapshot_board import SnapshotReader
from haptics.safety.limits import ForceLimits
from haptics.safety.rendering import ForceRendering
from scenes.viewer.frame import Phase, Readouts
from scenes.viewer.revolution import Surface
from scenes.viewer.viewed_simulator import ViewedSimulator
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import ForceStatus

#: Wall time of a step in a tick of 1000, s: the rest is for ring and snapshots.
BUDGET = 0.8e-3
#: Over which time read-outs are taken, and rates are counted, s.
_LOOK_BACK, _DOUBTS_OVER, _COUNT_OVER = 0.5, 1.0, 2.0
_COUNTED = ("time", "compute_time", "iterations", "status")
#: A tick each millisecond, and the tissue 30 times a second.
SETTINGS = LoopSettings(snapshot_rate=30.0)
#: The same for tissue whose equilibria take longer than a tick; meanwhile its forces are carried on, and said to be
#: LATE. Not for a hand at a device.
PATIENT = replace(SETTINGS, patience=60.0)
#: N, and N per tick: limits of the rendered force, which no device takes; what is shown is the force of the tissue.
_LIMITS = 1e3, 1e3


class LiveSimulation:
    """A loop process, seen without ever waiting for it. Close it.

    Args:
        model: what is simulated.
        device: gives poses and takes forces, or a motion.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        resolution: of the `Simulator`.
        settings: of the loop.
        reduced: what the solver ``"reduced"`` steps.

    Attributes:
        phase, message: what it does, or why it ended.
        snapshot: newest; None before the first.
        surface: of the tissue at that snapshot, where it has no fields to draw; else None.
        readouts: None before the first tick.
    """

    def __init__(self, model: ts.Model, device: HapticDevice, *, solver: str = "axisymmetric",
                 resolution: str = "realtime", settings: LoopSettings = SETTINGS,
                 reduced: ts.ReducedModel | None = None):
        self._loop = LoopProcess(
            real_time_tissue(model, solver=solver, resolution=resolution, budget=BUDGET, mesh=reduced,
                             simulator=ViewedSimulator), device,
            ForceRendering(ForceLimits(*_LIMITS)), settings)
        if settings.patience > PATIENCE:
            # Of tissue that may take long for a tick a command is done no sooner.
            self._loop.patience = settings.patience
        self._files = ExitStack()
        self._ring: RingReader | None = None
        self._snapshots: SnapshotReader | None = None
        self._number, self._published = 0, 0
        self._recent: deque[tuple[float, int]] = deque()
        #: What is counted of the ticks of the last `_DOUBTS_OVER` s, columns as in `_COUNTED`.
        self._felt = np.empty((0, len(_COUNTED)))
        self._paused = False
        self._model = model
        self.phase, self.message = Phase.STARTING, "starting"
        self.snapshot: Snapshot | None = None
        self.surface: Surface | None = None
        self.readouts: Readouts | None = None
        self._loop.start()

    @property
    def process(self) -> LoopProcess:
        """The process, for those who measure it."""
        return self._loop

    @property
    def _cosine(self) -> float:
        """Of a way along the tool's axis the share that is depth."""
        approach = self._model.experiment.approach
        return 1.0 if approach is None else math.cos(approach.angle)

    @property
    def tool_depth(self) -> float:
        """How far along its axis the tool is now, m; where it has not been seen yet, the touch."""
        last = None if self._ring is None else self._ring.latest()
        return 0.0 if last is None else float(last["tool_depth"]) / self._cosine

    @property
    def tool_across(self) -> tuple[float, float] | None:
        """x and y where the tool's axis meets the height of the touch now, m; None where it has not been seen yet."""
        last = None if self._ring is None else self._ring.latest()
        if last is None:
            return None
        (x, y, z), (a, b, c, d) = last["tool_pose"][:3].tolist(), last["tool_pose"][3:].tolist()
        (_, _, u), (_, _, v), (_, _, w) = Pose((x, y, z), (a, b, c, d)).rotation
        return x - u / max(w, 0.1) * z, y - v / max(w, 0.1) * z

    def poll(self) -> np.ndarray | None:
        """Take in what is new.

        Returns:
            The ticks since the last time, dtype `haptics.loop.ring.TICK`, their depths along the axis of a tool that
            leans, as displacements are; None before the first and after the last.
        """
        if self.phase is Phase.DIED:
            return None
        try:
            ready = self._loop.poll()
        except (LoopError, ts.InputError) as error:
            self._die(str(error))
            return None
        self.message = self._loop.message
        if not ready:
            return None
        if self._loop.report is not None:
            self._die(f"the loop has ended ({self._loop.report.ended_by})")
            return None
        if self._ring is None:
            self._ring = self._files.enter_context(self._loop.ring())
            snapshots = self._loop.snapshots()
            if snapshots is not None:
                self._snapshots = self._files.enter_context(snapshots)
        self.phase = Phase.PAUSED if self._paused else Phase.RUNNING
        ticks = self._ring.since(self._number)
        self._number = ticks.number
        records = ticks.records
        if self._cosine != 1.0:
            records = records.copy()
            records["tool_depth"] /= self._cosine
        if self._snapshots is not None and self._loop.pattern is not None:
            self._snapshots.pattern = self._loop.pattern
            published = self._snapshots.latest(after=self._published)
            if published is not None:
                self._published = published.number
                self._take(published.snapshot)
        if len(records):
            self._read_out(records)
        return records

    def ask(self, command: str, **values: Any) -> None:
        """Ask the loop for something and wait until it has done so, some milliseconds.

        Raises:
            InputError: what it refuses, or it is not running.
        """
        if self.phase not in (Phase.RUNNING, Phase.PAUSED):
            raise ts.InputError(f"the simulation is not running ({self.message})")
        try:
            self._loop.ask(command, **values)
        except LoopError as error:
            self._die(str(error))
            raise ts.InputError(str(error)) from error
        if command in ("pause", "resume"):
            self._paused = command == "pause"
            self.phase = Phase.PAUSED if self._paused else Phase.RUNNING

    def close(self) -> None:
        """End the process."""
        self._files.close()
        self._loop.stop()

    def forget(self) -> None:
        """Leave out the ticks that have not been polled yet."""
        if self._ring is not None:
            self._number = self._ring.written
        self._felt = self._felt[:0]

    def _take(self, snapshot: Snapshot) -> None:
        skin = snapshot.skin
        if skin is not None:
            self.surface = Surface(skin.vertices.astype(np.float32), skin.triangles.astype(np.uint32))
        self.snapshot = snapshot

    def _die(self, reason: str) -> None:
        self.phase, self.message = Phase.DIED, reason

    def _read_out(self, records: np.ndarray) -> None:
        now, last = time.monotonic(), records[-1]
        self._recent.append((now, self._number))
        while now - self._recent[0][0] > _COUNT_OVER:
            self._recent.popleft()
        (then, before) = self._recent[0]
        rate = (self._number - before) / (now - then) if now > then else 0.0
        # A record of the ring is long: its columns that are wanted alone are copied.
        felt = np.concatenate([self._felt, np.column_stack([records[name] for name in _COUNTED])])
        self._felt = felt = felt[felt[:, 0] > last["time"] - _DOUBTS_OVER]
        times, compute_time, iterations, statuses = felt.T
        recent = times > last["time"] - _LOOK_BACK
        status = ForceStatus(int(last["status"]))
        deadlines = last["tick"]
        self.readouts = Readouts(
            float(last["time"]), float(last["tool_depth"]), float(last["tissue_force"]), float(last["stiffness"]),
            float(np.median(compute_time[recent])), float(iterations[recent].mean()), rate,
            float((last["late"] + last["missed"]) / max(deadlines, 1)), _in_words(status, last),
            _mesh_in_words(self._loop.resolution, self._loop.force_error),
            _message(status, last),
            int(np.count_nonzero(statuses != ForceStatus.CONVERGED)),
            (float(last["tissue_wrench"][0]), float(last["tissue_wrench"][1])))


def _mesh_in_words(resolution: str, force_error: float | None) -> str:
    """The mesh, and how good it is known to be."""
    return resolution if force_error is None else f"{resolution}, force within {100 * force_error:.2g} %"


def _in_words(status: ForceStatus, last: np.void) -> str:
    """How the newest force came about."""
    if status is ForceStatus.CONVERGED:
        return "paused" if last["flags"] & PAUSED else "in equilibrium"
    return "inaccurate" if _is_inaccurate(status, last) else status.name.lower()


def _message(status: ForceStatus, last: np.void) -> str:
    """Cause and remedy of a status; empty in equilibrium."""
    if _is_inaccurate(status, last):
        return (f"The force is in equilibrium, but its estimated error is {last['force_error']:.2g} N. "
                "Use a finer mesh or a deeper indentation.")
    return "" if status is ForceStatus.CONVERGED else status.message


def _is_inaccurate(status: ForceStatus, last: np.void) -> bool:
    """Whether the newest force is one of an equilibrium that the mesh does not resolve."""
    return status is ForceStatus.LATE and last["age"] == 0.0 and bool(np.isfinite(last["force_error"]))
