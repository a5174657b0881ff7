"""Haptic loop: in each tick read the pose, step the tissue, render the force and record the tick."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from haptics.devices.contracts import HapticDevice
from haptics.loop.ring import CAPACITY, PAUSED, RingWriter
from haptics.loop.shared_slots import SnapshotWriter
from haptics.loop.ticker import RealTimeFeature, Ticker, TimeHistogram, TimeQuantiles, request_real_time_features
from haptics.safety.rendering import ForceRendering, RenderFlag
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.realtime.force_fading import RELEASE, ForceFader
from tissue_sim.snapshot import DisplayableTissue
from tissue_sim.tool_force import ForceStatus, Tissue

#: Time between two checks for commands, s.
LISTEN_EVERY = 0.01
#: Bit of the flags of a tick -> name.
_FLAGS = {flag.value: name.lower() for name, flag in RenderFlag.__members__.items()} | {PAUSED: "paused"}


@dataclass(frozen=True)
class LoopSettings:
    """Settings of a loop.

    Attributes:
        period: time between two ticks, s.
        spin: time before a deadline in which the clock is polled instead of sleeping, s. Polling uses up to 90 % of a
            core.
        seconds: duration of the loop, s; None: until it is stopped.
        real_time: whether to request the real-time features of `haptics.loop.ticker`.
        snapshot_rate: rate at which the whole tissue is published for viewers, Hz; 0: never.
        capacity: number of ticks in the ring.
        patience: time without equilibrium after which the force is reduced to zero, s; see `ForceFader`.

    Raises:
        InputError: a time or a rate is outside its range.
    """

    period: float = 1e-3
    spin: float = 0.0
    seconds: float | None = None
    real_time: bool = True
    snapshot_rate: float = 0.0
    capacity: int = CAPACITY
    patience: float = RELEASE.patience

    def __post_init__(self):
        Ticker(self.period, spin=self.spin)  # checks its arguments
        ForceFader(self.patience)  # checks its argument
        if self.seconds is not None and not self.period <= self.seconds < math.inf:
            raise InputError(f"seconds must be at least one period of {self.period:g} s and finite; got "
                             f"{self.seconds:g} s", field="seconds")
        if not 0 <= self.snapshot_rate < math.inf:
            raise InputError(f"snapshot_rate must be at least 0 Hz and finite; got {self.snapshot_rate:g} Hz",
                             field="snapshot_rate")

    @property
    def ticks_between_snapshots(self) -> int | None:
        """Number of deadlines from one snapshot to the next; None without snapshots."""
        return max(round(1 / (self.snapshot_rate * self.period)), 1) if self.snapshot_rate else None


@dataclass(frozen=True)
class LoopReport:
    """Statistics of a loop that has ended.

    Attributes:
        ended_by: ``time``, ``stop`` or ``parent`` (the parent process ended).
        seconds: time from the start to the last tick, s.
        period: time between two ticks, s.
        ticks: number of ticks.
        late: number of ticks that began late.
        missed: number of deadlines without a tick.
        lateness: quantiles of the lateness of ticks, s.
        compute_time: quantiles of the time from the beginning of a tick to its force, s.
        statuses: number of ticks for each `ForceStatus` of the tissue, by name in lower case.
        flagged: number of ticks for each `RenderFlag` and for ``paused``, by name in lower case.
        largest_force: magnitude of the largest rendered force, N.
        real_time: real-time features, obtained or refused; empty if none were requested.
        peak_memory: peak memory of the process, bytes; None if the platform does not report it.
        device: description of the device at the end, with ``trouble`` if the device was lost.
        resolution: resolution of the mesh; empty if the tissue does not state it.
        force_error: largest known relative error of the force; None if the tissue does not state it.
    """

    ended_by: str
    seconds: float
    period: float
    ticks: int
    late: int
    missed: int
    lateness: TimeQuantiles
    compute_time: TimeQuantiles
    statuses: dict[str, int]
    flagged: dict[str, int]
    largest_force: float
    real_time: tuple[RealTimeFeature, ...]
    peak_memory: int | None
    device: dict[str, Any] = field(default_factory=dict)
    resolution: str = ""
    force_error: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the report as an object for `json.dumps`; keys contain the units, such as ``period_us``."""
        return {
            "ended_by": self.ended_by, "seconds": self.seconds, "period_us": self.period * 1e6, "ticks": self.ticks,
            "late": self.late, "missed": self.missed,
            "missed_percent": 100 * self.missed / max(self.ticks + self.missed, 1),
            "lateness_us": _convert_quantiles_to_microseconds(self.lateness),
            "compute_us": _convert_quantiles_to_microseconds(self.compute_time),
            "statuses": self.statuses, "flagged": self.flagged, "largest_force_N": self.largest_force,
            "real_time": [asdict(feature) for feature in self.real_time],
            "peak_memory_MB": None if self.peak_memory is None else self.peak_memory / 1e6,
            "device": self.device, "resolution": self.resolution,
            "force_error_percent": None if self.force_error is None else 100 * self.force_error,
        }


def get_mesh_resolution_and_force_error(tissue: Tissue) -> tuple[str, float | None]:
    """Return a tissue's mesh resolution, by name, and relative force error; ``""`` and None if it has none."""
    return getattr(tissue, "resolution", ""), getattr(tissue, "force_error", None)


def _convert_quantiles_to_microseconds(times: TimeQuantiles) -> dict[str, float]:
    """Return quantiles as an object with the keys p50, p99, p99.9 and max, in microseconds."""
    return {"p50": times.p50 * 1e6, "p99": times.p99 * 1e6, "p99.9": times.p999 * 1e6, "max": times.maximum * 1e6}


class Loop:
    """Haptic loop in this process; `haptics.loop.process` runs a loop in a separate process.

    Args:
        tissue: warmed-up tissue that returns a `ToolForce` for a pose and a time step.
        device: started haptic device, or a motion that ignores forces; the loop stops the device at its end.
        rendering: converts device poses to tool poses and tissue wrenches to device wrenches; its force limit is
            reduced to the limit of the device.
        settings: settings of the loop.
        ring: ring to which each tick is written.
        snapshots: board to which the whole tissue is published; None: no snapshots.
        listen: called with this loop between ticks every `LISTEN_EVERY` s; may pause, reset and stop the loop.
        clock: clock of the `Ticker`, ns.
        sleep: sleep function of the `Ticker`.

    Raises:
        InputError: steps of the tissue wait for its bulk.
    """

    def __init__(self, tissue: Tissue, device: HapticDevice, rendering: ForceRendering, settings: LoopSettings,
                 ring: RingWriter, *, snapshots: SnapshotWriter | None = None,
                 listen: Callable[[Loop], None] | None = None, clock: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float], None] = time.sleep):
        if getattr(tissue, "waits", False):
            raise InputError("waits must be False in a loop; got True. A step that waits for the bulk misses its "
                             "deadline. Make the tissue with waits=False.", field="waits")
        self._tissue, self._device, self._rendering = tissue, device, rendering
        #: Requested force limit, N; the limit of the device may be lower.
        self._force_limit = rendering.limits.force
        self._set_force_limit_for_device(device)
        self._settings, self._ring, self._listen = settings, ring, listen
        #: Work of the tissue between two ticks, if it has any.
        self._prepare: Callable[[], None] | None = getattr(tissue, "prepare", None)
        self._shown = (tissue, snapshots) if snapshots is not None and isinstance(tissue, DisplayableTissue) else None
        self._ticker = Ticker(settings.period, spin=settings.spin, clock=clock, sleep=sleep)
        self._release = ForceFader(settings.patience)
        self._compute_time = TimeHistogram()
        self._statuses = [0] * len(ForceStatus)
        self._flagged = dict.fromkeys(_FLAGS, 0)
        self._largest_force = 0.0
        self._paused = False
        #: Remaining motion time of an advance during a pause, ns.
        self._advance = 0
        #: Time of the last tick, and time of the motion in this tick, ns; the motion time stops during a pause.
        self._now = self._motion = 0
        #: Pose of the simulated tool in the last tick.
        self._tool: Pose | None = None
        self._ended_by = ""

    def run(self) -> LoopReport:
        """Run the loop until its duration is over or it is stopped.

        Returns:
            The statistics of the loop.

        Raises:
            Exception: an exception of the tissue, the device or the listener.
        """
        try:
            features = self._run_ticks_with_real_time_features()
        finally:
            self._device.stop()
        ticker = self._ticker
        # The stopped device reports whether it was connected until the end.
        return LoopReport(
            self._ended_by or "time", self._now * 1e-9, self._settings.period, ticker.ticks, ticker.late,
            ticker.missed, ticker.lateness.quantiles, self._compute_time.quantiles,
            {status.name.lower(): self._statuses[status] for status in ForceStatus},
            {_FLAGS[flag]: count for flag, count in self._flagged.items()},
            self._largest_force, features, read_peak_memory_bytes_or_none(), self._device.describe(),
            *get_mesh_resolution_and_force_error(self._tissue))

    def _run_ticks_with_real_time_features(self) -> tuple[RealTimeFeature, ...]:
        """Run all ticks until the end; return the real-time features that were requested for this time."""
        settings, ticker, ring = self._settings, self._ticker, self._ring
        last = math.inf if settings.seconds is None else round(settings.seconds / settings.period)
        listen_every = max(round(LISTEN_EVERY / settings.period), 1)
        shown, every, next_snapshot, next_listen = self._shown, settings.ticks_between_snapshots, 0, listen_every
        with request_real_time_features(settings.real_time) as features:
            ticker.start_first_period()
            while ticker.number < last and not self._ended_by:
                lateness = ticker.wait_and_get_lateness_nanoseconds()
                self._compute_and_record_tick(lateness * 1e-9, ring)
                if self._prepare is not None:
                    self._prepare()
                if shown and every and ticker.number >= next_snapshot:
                    next_snapshot = ticker.number + every
                    tissue, board = shown
                    board.publish(self._now * 1e-9, tissue.snapshot())
                # Counted in deadlines instead of ticks, so that slow ticks do not delay commands.
                if self._listen is not None and ticker.number >= next_listen:
                    next_listen = ticker.number + listen_every
                    self._listen(self)
        return features

    def _compute_and_record_tick(self, lateness: float, ring: RingWriter) -> None:
        """Execute one tick: read the pose, step the tissue, render the force, and append the tick to the ring."""
        ticker = self._ticker
        now = ticker.nanoseconds_since_start
        passed, self._now = now - self._now, now
        dt = passed * 1e-9
        pose = None
        moves = not self._paused or self._advance > 0
        if moves:
            motion_time = min(passed, self._advance) if self._paused else passed
            self._advance = self._advance - motion_time if self._paused else 0
            self._motion += motion_time
            pose = self._device.pose(self._motion * 1e-9)
        self._tool = tool = self._rendering.advance_proxy(pose, dt)
        answer = self._release.step(self._tissue.step(tool, dt), now * 1e-9)
        rendered = self._rendering.render(answer, dt)
        wrench = rendered.wrench
        self._device.render(wrench)
        spent = ticker.nanoseconds_since_start - now
        self._compute_time.add_nanoseconds(spent)
        self._statuses[answer.status] += 1
        flags = rendered.flags | PAUSED * (not moves)
        if flags:
            for flag in self._flagged:
                self._flagged[flag] += flags & flag != 0
        force = math.hypot(wrench[0], wrench[1], wrench[2])
        if force > self._largest_force:
            self._largest_force = force
        ring.append_tick(ticker.number, now * 1e-9, pose, tool, wrench, answer, spent * 1e-9, lateness, ticker.late,
                         ticker.missed, flags)

    def pause(self) -> None:
        """Stop the clock of the motion; ticks and tissue continue without a device pose, so the force fades to zero."""
        self._paused = True

    def resume(self) -> None:
        """Continue the motion, and its clock, after a pause."""
        self._paused = False

    def reset(self) -> None:
        """Reset the tissue to undeformed and the force to zero, and restart the motion at time 0.

        Raises:
            InputError: the tissue cannot be reset.
        """
        self._get_tissue_method("reset")()
        self._rendering.reset()
        self._release.reset()
        self._motion = 0

    def advance_paused_motion(self, seconds: float) -> None:
        """Let the motion of a paused loop continue for this time, s, in real time; it then pauses again."""
        self._advance += round(seconds * 1e9)

    def switch_device(self, device: HapticDevice, restart: bool = False) -> None:
        """Replace the device or motion by another one, which starts from its beginning.

        Args:
            device: new device, not started. If it cannot be started, the loop continues with the present device.
                Without `restart` the new device is informed of the pose of the tool, so that it can continue there.
            restart: whether to continue with undeformed tissue and zero force, as after `reset`.

        Raises:
            InputError: the tissue cannot be reset.
            DeviceError: the device is missing.
        """
        reset = self._get_tissue_method("reset") if restart else None
        device.start()
        self._device.stop()
        if self._tool is not None and not restart:
            device.continue_from_pose(self._tool)
        self._device, self._motion = device, 0
        self._set_force_limit_for_device(device)
        if reset is not None:
            reset()
            self._rendering.reset()
            self._release.reset()

    def _set_force_limit_for_device(self, device: HapticDevice) -> None:
        """Set the force limit of the rendering to the smaller of the requested limit and this device's limit."""
        self._rendering.limits.force = min(self._force_limit, device.largest_force)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Set the position to which a steerable motion moves, m; see `HapticDevice.aim`.

        Args:
            depth: target depth, m.
            across: target position across the axis, m; None: unchanged.

        Raises:
            InputError: the device has no target position, or the target is not finite.
        """
        # Devices of plug-ins may accept a depth only.
        self._device.aim(depth) if across is None else self._device.aim(depth, across)

    def set_parameters(self, **values: float) -> None:
        """Change parameters of the tissue between two ticks.

        Raises:
            InputError: the tissue has no such parameter or refuses the value.
        """
        self._get_tissue_method("set_parameters")(**values)

    def stop(self, ended_by: str = "stop") -> None:
        """Let `run` end after this tick; `ended_by` is the reason in the report. Does not wait."""
        self._ended_by = ended_by

    def _get_tissue_method(self, name: str) -> Callable[..., None]:
        """Return an optional method of the tissue by name; raises an InputError if the tissue lacks it."""
        method = getattr(self._tissue, name, None)
        if method is None:
            raise InputError(f"this tissue ({type(self._tissue).__name__}) has no method {name}; use a tissue with "
                             "this method")
        return method


#: Name of a command -> method that executes it between two ticks with the values of the command as arguments.
COMMANDS: dict[str, Callable[..., None]] = {
    "pause": Loop.pause,
    "resume": Loop.resume,
    "reset": Loop.reset,
    "advance": Loop.advance_paused_motion,
    "switch_device": Loop.switch_device,
    "aim": Loop.aim,
    "set_parameters": Loop.set_parameters,
    "stop": Loop.stop,
}


def read_peak_memory_bytes_or_none() -> int | None:
    """Return the largest resident memory of this process so far, bytes; None if it is not reported."""
    # On Linux `resource` also counts the memory of the parent process at the start.
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    with suppress(ImportError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return None
