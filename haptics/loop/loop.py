"""The 1 kHz loop: pose, tissue, force, ring; again and again, at deadlines that stand."""

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
from haptics.loop.real_time import RealTimeFeature, real_time
from haptics.loop.ring import CAPACITY, PAUSED, RingWriter
from haptics.loop.snapshot_board import SnapshotBoard
from haptics.loop.ticker import Quantiles, Ticker, TimeHistogram
from haptics.safety.force_release import RELEASE, ForceRelease
from haptics.safety.rendering import ForceRendering, RenderFlag
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.snapshot import ShownTissue
from tissue_sim.tool_force import ForceStatus, Tissue

#: How often the loop looks for commands, s.
LISTEN_EVERY = 0.01
#: Bits of the flags of a tick, by name.
_FLAGS = {flag.value: name.lower() for name, flag in RenderFlag.__members__.items()} | {PAUSED: "paused"}


@dataclass(frozen=True)
class LoopSettings:
    """How the loop runs.

    Attributes:
        period: s.
        spin: how long before a deadline to watch the clock instead of sleeping, s. It keeps a core busy
            but for a tenth of the time.
        seconds: how long it runs; None: until it is stopped.
        real_time: ask the system for what `haptics.loop.real_time` knows.
        snapshot_rate: how often the whole tissue is published, for viewers that draw it, Hz; 0: never.
        capacity: ticks that the ring keeps.
        patience: after so long without an equilibrium the tissue's force is let go, s; see `ForceRelease`.

    Raises:
        InputError: a time or a rate that does not fit.
    """

    period: float = 1e-3
    spin: float = 0.0
    seconds: float | None = None
    real_time: bool = True
    snapshot_rate: float = 0.0
    capacity: int = CAPACITY
    patience: float = RELEASE.patience

    def __post_init__(self):
        Ticker(self.period, spin=self.spin)  # refuses what it cannot keep
        ForceRelease(self.patience)  # and so does this
        if self.seconds is not None and not self.period <= self.seconds < math.inf:
            raise InputError(f"{self.seconds:g} s is no time to run; give at least one period of {self.period:g} s",
                             field="seconds")
        if not 0 <= self.snapshot_rate < math.inf:
            raise InputError(f"{self.snapshot_rate:g} Hz is not a rate; give 0 or more", field="snapshot_rate")

    @property
    def ticks_between_snapshots(self) -> int | None:
        """Deadlines from one snapshot to the next; None where there are none."""
        return max(round(1 / (self.snapshot_rate * self.period)), 1) if self.snapshot_rate else None


@dataclass(frozen=True)
class LoopReport:
    """What a loop has kept of its promises.

    Attributes:
        ended_by: ``time``, ``stop`` or ``parent`` (which is gone).
        seconds: from the start to the last tick.
        period: s.
        ticks, late, missed: ticks that ran, those that began late, deadlines that passed without one.
        lateness, compute_time: of the ticks, s; the latter from the beginning of a tick to its force.
        statuses: how many answers of the tissue had which `ForceStatus`, by its name in small letters.
        flagged: how many ticks had which `RenderFlag`, or were ``paused``, the same.
        largest_force: magnitude of the largest rendered force, N.
        real_time: what the system has granted; empty where it was not asked.
        peak_memory: of the process, bytes; None where the platform does not say.
        device: what the device said of itself at the end, with ``trouble`` where it was lost.
        resolution, force_error: of the tissue's mesh, and the largest known error of its force, over the force; "" and
            None where the tissue does not say.
    """

    ended_by: str
    seconds: float
    period: float
    ticks: int
    late: int
    missed: int
    lateness: Quantiles
    compute_time: Quantiles
    statuses: dict[str, int]
    flagged: dict[str, int]
    largest_force: float
    real_time: tuple[RealTimeFeature, ...]
    peak_memory: int | None
    device: dict[str, Any] = field(default_factory=dict)
    resolution: str = ""
    force_error: float | None = None

    def as_json(self) -> dict[str, Any]:
        """For `json.dumps`; units are in the names of the keys."""
        return {
            "ended_by": self.ended_by, "seconds": self.seconds, "period_us": self.period * 1e6, "ticks": self.ticks,
            "late": self.late, "missed": self.missed,
            "missed_percent": 100 * self.missed / max(self.ticks + self.missed, 1),
            "lateness_us": _microseconds(self.lateness), "compute_us": _microseconds(self.compute_time),
            "statuses": self.statuses, "flagged": self.flagged, "largest_force_N": self.largest_force,
            "real_time": [asdict(feature) for feature in self.real_time],
            "peak_memory_MB": None if self.peak_memory is None else self.peak_memory / 1e6,
            "device": self.device, "resolution": self.resolution,
            "force_error_percent": None if self.force_error is None else 100 * self.force_error,
        }


def mesh_of(tissue: Tissue) -> tuple[str, float | None]:
    """Name of a tissue's resolution, and largest known error of its force, over the force, where it knows."""
    return getattr(tissue, "resolution", ""), getattr(tissue, "force_error", None)


def _microseconds(times: Quantiles) -> dict[str, float]:
    return {"p50": times.p50 * 1e6, "p99": times.p99 * 1e6, "p99.9": times.p999 * 1e6, "max": times.maximum * 1e6}


class Loop:
    """The loop in this process; `haptics.loop.process` runs one in a process of its own.

    Args:
        tissue: answers a pose and a time step with a `ToolForce`; warmed up.
        device: gives poses and takes forces, or a motion, which ignores them; started. The loop stops it at its end.
        rendering: from the device's pose to the tool's, and from the tissue's wrench to the device's; its limit of the
            force is lowered to what the device allows.
        settings: see there.
        ring: where every tick goes.
        snapshots: where the whole tissue goes, if it can be shown; None: nowhere.
        listen: called between ticks every `LISTEN_EVERY` s, with this loop; it may pause, reset and stop it.
        clock, sleep: as of `Ticker`.
    """

    def __init__(self, tissue: Tissue, device: HapticDevice, rendering: ForceRendering, settings: LoopSettings,
                 ring: RingWriter, *, snapshots: SnapshotBoard | None = None,
                 listen: Callable[[Loop], None] | None = None, clock: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float], None] = time.sleep):
        if getattr(tissue, "waits", False):
            raise InputError("waits must be False in a loop; got True. A step that waits for the bulk misses its "
                             "deadline. Make the tissue with waits=False.", field="waits")
        self._tissue, self._device, self._rendering = tissue, device, rendering
        #: As asked for; a device may allow less.
        self._force_limit = rendering.limits.force
        self._keep_to(device)
        self._settings, self._ring, self._listen = settings, ring, listen
        #: What the tissue can do between two ticks; most have nothing.
        self._prepare: Callable[[], None] | None = getattr(tissue, "prepare", None)
        self._shown = (tissue, snapshots) if snapshots is not None and isinstance(tissue, ShownTissue) else None
        self._ticker = Ticker(settings.period, spin=settings.spin, clock=clock, sleep=sleep)
        self._release = ForceRelease(settings.patience)
        self._compute_time = TimeHistogram()
        self._statuses = [0] * len(ForceStatus)
        self._flagged = dict.fromkeys(_FLAGS, 0)
        self._largest_force = 0.0
        self._paused = False
        #: What is left of an advance through a pause, ns.
        self._advance = 0
        #: Time of the last tick, and of the motion then, ns; the motion stands still while the loop is paused.
        self._now = self._motion = 0
        #: Where the last tick had the simulated tool.
        self._tool: Pose | None = None
        self._ended_by = ""

    def run(self) -> LoopReport:
        """Tick until the time is over or the loop is stopped.

        Raises:
            Exception: what the tissue, the device or the listener raised.
        """
        try:
            features = self._run()
        finally:
            self._device.stop()
        ticker = self._ticker
        # Now that it has been stopped the device says whether it was there to the end.
        return LoopReport(
            self._ended_by or "time", self._now * 1e-9, self._settings.period, ticker.ticks, ticker.late,
            ticker.missed, ticker.lateness.quantiles, self._compute_time.quantiles,
            {status.name.lower(): self._statuses[status] for status in ForceStatus},
            {_FLAGS[flag]: count for flag, count in self._flagged.items()},
            self._largest_force, features, peak_memory(), self._device.describe(), *mesh_of(self._tissue))

    def _run(self) -> tuple[RealTimeFeature, ...]:
        """Tick; what of the features of the system was to be had."""
        settings, ticker, ring = self._settings, self._ticker, self._ring
        last = math.inf if settings.seconds is None else round(settings.seconds / settings.period)
        listen_every = max(round(LISTEN_EVERY / settings.period), 1)
        shown, every, next_snapshot, next_words = self._shown, settings.ticks_between_snapshots, 0, listen_every
        with real_time(settings.real_time) as features:
            ticker.start()
            while ticker.number < last and not self._ended_by:
                lateness = ticker.wait()
                self._tick(lateness * 1e-9, ring)
                if self._prepare is not None:
                    self._prepare()
                if shown and every and ticker.number >= next_snapshot:
                    next_snapshot = ticker.number + every
                    tissue, board = shown
                    board.publish(self._now * 1e-9, tissue.snapshot())
                # By deadlines, not by ticks: a tissue that takes long for a tick is listened for all the same.
                if self._listen is not None and ticker.number >= next_words:
                    next_words = ticker.number + listen_every
                    self._listen(self)
        return features

    def _tick(self, lateness: float, ring: RingWriter) -> None:
        ticker = self._ticker
        now = ticker.elapsed
        passed, self._now = now - self._now, now
        dt = passed * 1e-9
        pose = None
        moves = not self._paused or self._advance > 0
        if moves:
            going = min(passed, self._advance) if self._paused else passed
            self._advance = self._advance - going if self._paused else 0
            self._motion += going
            pose = self._device.pose(self._motion * 1e-9)
        self._tool = tool = self._rendering.pose_for(pose, dt)
        answer = self._release.step(self._tissue.step(tool, dt), now * 1e-9)
        rendered = self._rendering.render(answer, dt)
        wrench = rendered.wrench
        self._device.render(wrench)
        taken = ticker.elapsed - now
        self._compute_time.add(taken)
        self._statuses[answer.status] += 1
        flags = rendered.flags | PAUSED * (not moves)
        if flags:
            for flag in self._flagged:
                self._flagged[flag] += flags & flag != 0
        force = math.hypot(wrench[0], wrench[1], wrench[2])
        if force > self._largest_force:
            self._largest_force = force
        ring.append(ticker.number, now * 1e-9, pose, tool, wrench, answer, taken * 1e-9, lateness, ticker.late,
                    ticker.missed, flags)

    def pause(self) -> None:
        """Let the motion stand still; to the rendering the pose is lost, so that the force fades."""
        self._paused = True

    def resume(self) -> None:
        """Let the motion go on from where it stood."""
        self._paused = False

    def reset(self) -> None:
        """Begin the motion again, with undeformed tissue and no force.

        Raises:
            InputError: the tissue cannot be reset.
        """
        self._able("reset")()
        self._rendering.reset()
        self._release.reset()
        self._motion = 0

    def advance(self, seconds: float) -> None:
        """Let the motion of a loop that is paused go on for so long."""
        self._advance += round(seconds * 1e9)

    def follow(self, device: HapticDevice, anew: bool = False) -> None:
        """Take the poses from another device or motion, from its beginning on, and give it the forces.

        Args:
            device: not started; the loop goes on with the one before where it cannot be. Without `anew` it is told
                where the tool is, to go on from there if it can.
            anew: on undeformed tissue, as `reset`.

        Raises:
            InputError: the tissue cannot be reset.
            DeviceError: the device is not there.
        """
        reset = self._able("reset") if anew else None
        device.start()
        self._device.stop()
        if self._tool is not None and not anew:
            device.take_over(self._tool)
        self._device, self._motion = device, 0
        self._keep_to(device)
        if reset is not None:
            reset()
            self._rendering.reset()
            self._release.reset()

    def _keep_to(self, device: HapticDevice) -> None:
        """No more force than a device allows."""
        self._rendering.limits.force = min(self._force_limit, device.largest_force)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Tell the device where to go, m; see `HapticDevice.aim`.

        Raises:
            InputError: one that goes where it likes, or a place that is no number.
        """
        # Devices of others may know a depth only.
        self._device.aim(depth) if across is None else self._device.aim(depth, across)

    def set_parameters(self, **values: float) -> None:
        """Change the tissue while it is felt.

        Raises:
            InputError: what the tissue refuses.
        """
        self._able("set_parameters")(**values)

    def stop(self, ended_by: str = "stop") -> None:
        """End after this tick."""
        self._ended_by = ended_by

    def _able(self, name: str) -> Callable[..., None]:
        method = getattr(self._tissue, name, None)
        if method is None:
            raise InputError(f"this tissue ({type(self._tissue).__name__}) has no {name}; use one that has")
        return method


def peak_memory() -> int | None:
    """The most memory that this process has used, bytes; None where the platform does not say."""
    # Of this program: what `resource` reports on Linux begins with that of the process which started it.
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    with suppress(ImportError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return None
