"""Check the limits of a motor that moves a tool: before the motion, and at each poll of its sensor and its stage."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from tissue_sim.errors import InputError
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.settings import require_all_settings_positive

#: Default of the longest time without a sample of the sensor, s.
DEFAULT_SENSOR_SILENCE = 0.05


@dataclass(frozen=True)
class MotionGuardSettings:
    """Tolerances of `MotionGuard`; larger values detect a fault later and cause fewer false stops.

    Attributes:
        silent_periods: number of sampling periods that a sensor may be silent, if this time is longer than
            `MotionLimits.sensor_silence`.
        speed_window: time over which a speed is measured, s.
        speed_tolerance: relative amount by which a measured speed may exceed the limit, 1.
        stall_time: travel that a tool may be behind its commanded position, as a time at the commanded speed, s.
        stall_distance: least distance behind the commanded position that counts as a stall, m; also the tolerance of
            the position in the checks of travel and speed.
        path_tolerance: distance from the commanded path, or from the position at rest, that is always allowed, m.

    Raises:
        InputError: a tolerance is not positive and finite, so that no check can be switched off.
    """

    silent_periods: int = 3
    speed_window: float = 0.1
    speed_tolerance: float = 0.25
    stall_time: float = 0.25
    stall_distance: float = 50e-6
    path_tolerance: float = 0.1e-3

    def __post_init__(self) -> None:
        require_all_settings_positive(self)


#: Default tolerances of a guard.
GUARD = MotionGuardSettings()


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the motions of a run; every limit is finite, so that no limit can be switched off.

    Attributes:
        force: largest magnitude of the force, N.
        lowest: lowest position of the stage, m.
        highest: highest position of the stage, m; positive is into the specimen.
        speed: largest speed, m/s.
        duration: largest duration of a run, s.
        stiffness: largest stiffness of the specimen, N/m; with the speed it gives the force increase until a halt.
        force_margin: largest force increase between a fault and the halt, N.
        sensor_silence: longest time without a sample of the sensor, s.
        tare: largest magnitude of the reading of the sensor before its first tare, N.
        retracts: whether the tool is retracted after a stop; otherwise the tool stays in place.

    Raises:
        InputError: a limit is not a finite positive number, or the range of positions is empty.
    """

    force: float
    lowest: float
    highest: float
    speed: float
    duration: float
    stiffness: float
    force_margin: float
    sensor_silence: float = DEFAULT_SENSOR_SILENCE
    tare: float = 10.0
    retracts: bool = False

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name in ("lowest", "highest", "retracts"):
                continue
            if not 0 < value < math.inf:
                raise InputError(f"a limit of a run must be positive and finite; got {value:g}",
                                 field=f"limits.{each.name}")
        if not -math.inf < self.lowest < self.highest < math.inf:
            raise InputError(f"the lowest position must be below limits.highest, {self.highest * 1e3:g} mm; got "
                             f"{self.lowest * 1e3:g} mm",
                             field="limits.lowest")


@dataclass(frozen=True)
class StopReason:
    """Reason for which a motion was stopped.

    Attributes:
        cause: ``"force"``, ``"travel"``, ``"speed"``, ``"duration"``, ``"sensor lost"``, ``"sensor saturated"``,
            ``"sensor fault"``, ``"stage fault"``, ``"limit switch"``, ``"stage stalled"``, ``"stage astray"``,
            ``"device"``, ``"disk"``, ``"asked"``, ``"program late"``, ``"no contact"``, ``"zero"``, ``"force control"``
            or ``"contact lost"``.
        message: one sentence with the remedy.
    """

    cause: str
    message: str

    @property
    def allows_retraction(self) -> bool:
        """Whether the stage still works well enough to retract the tool."""
        return self.cause not in ("stage fault", "limit switch", "stage stalled", "stage astray", "device", "speed",
                                  "travel")


@dataclass(frozen=True)
class CommandedMotion:
    """The last motion that the stage was commanded to make, at a constant speed.

    Attributes:
        start: position at the start, m.
        goal: commanded position, m.
        speed: commanded speed, m/s; 0: the stage stays in place.
        started: time of the command, s.
    """

    start: float
    goal: float
    speed: float
    started: float

    def compute_expected_travel(self, now: float) -> float:
        """Return the distance that the tool should have moved at a time, m.

        Args:
            now: s, on the clock of `started`.
        """
        return min(self.speed * max(now - self.started, 0.0), abs(self.goal - self.start))


class MotionGuard:
    """Check each sample of a run against the limits, and report the reason to stop.

    Args:
        limits: limits of the run.
        sensor_rate: sampling rate of the sensor, Hz.
        channels: names of the channels of the sensor; the resultant of Fx, Fy and Fz counts against the force limit.
        measures_position: whether the stage measures its position, so that a stall is visible.
        started: start of the run, s, on the clock of the samples.
        settings: tolerances of the checks.

    Attributes:
        is_stage_homed: whether the stage was homed in this run; before that, its position is not checked.
        is_sensor_zeroed: whether the sensor was zeroed in this run; before that, its force is not checked, and the
            recorder moves nothing.
    """

    def __init__(self, limits: MotionLimits, sensor_rate: float, channels: Sequence[str], measures_position: bool,
                 started: float, settings: MotionGuardSettings = GUARD):
        self.limits, self._measures_position, self._started = limits, measures_position, started
        self.settings = settings
        self._longest_silence = max(limits.sensor_silence, settings.silent_periods / sensor_rate)
        self._force_channels = [number for number, name in enumerate(channels) if name in ("Fx", "Fy", "Fz")]
        self._last_sample = started
        self._stage_samples: deque[StageSample] = deque()
        self.is_stage_homed = self.is_sensor_zeroed = False

    def find_stop_reason(self, now: float, samples: Sequence[ForceSample], forces: Sequence[float], stage: StageSample,
                         command: CommandedMotion | None) -> StopReason | None:
        """Check the samples of one poll.

        Args:
            now: time of the poll, s, on the clock of the samples.
            samples: new force samples.
            forces: force along the tool of each sample, N.
            stage: new stage sample.
            command: last commanded motion; None: none.

        Returns:
            The reason to stop the motion, or None.
        """
        return (self._find_sensor_stop_reason(now, samples) or self._find_force_stop_reason(samples, forces)
                or self._find_stage_status_stop_reason(stage)
                or self._find_duration_or_motion_stop_reason(now, stage, command))

    def _find_sensor_stop_reason(self, now: float, samples: Sequence[ForceSample]) -> StopReason | None:
        """Check the status of the sensor, and the time since its last sample; return the reason to stop, or None."""
        for sample in samples:
            if sample.status & SampleStatus.SATURATED:
                return StopReason("sensor saturated",
                                  "the sensor is at the end of its range, and the force may be larger; remove the "
                                  "load, and check that the sensor reads zero")
            if sample.status & SampleStatus.FAULT:
                return StopReason("sensor fault", "the sensor reports a fault, and its samples are unreliable; check "
                                  "its status display or its manual")
        if samples:
            self._last_sample = now
        elif now - self._last_sample > self._longest_silence:
            return StopReason("sensor lost", f"the sensor was silent for {now - self._last_sample:.3g} s, longer than "
                              f"the allowed {self._longest_silence:.3g} s; check its cable and its "
                              "power supply")
        return None

    def _find_force_stop_reason(self, samples: Sequence[ForceSample], forces: Sequence[float]) -> StopReason | None:
        """Check the force along the tool and the resultant force; return the reason to stop, or None."""
        if not self.is_sensor_zeroed:
            return None
        for sample, force in zip(samples, forces, strict=True):
            resultant = math.sqrt(sum(sample.values[number] ** 2 for number in self._force_channels))
            for magnitude, direction in ((abs(force), "along the tool"), (resultant, "in all directions")):
                # Written as a negation, so that NaN exceeds the limit.
                if not magnitude <= self.limits.force:
                    return StopReason("force", f"the force {direction} was {magnitude:.4g} N, above the limit of "
                                      f"{self.limits.force:g} N")
        return None

    def _find_stage_status_stop_reason(self, stage: StageSample) -> StopReason | None:
        """Check the status flags of the stage; return the reason to stop, or None."""
        if stage.status & SampleStatus.FAULT:
            return StopReason("stage fault", "the stage reports a fault; check its status display, and home it again")
        if stage.status & SampleStatus.LIMIT and self.is_stage_homed and not stage.moving:
            return StopReason("limit switch", "the stage is at a limit switch within the limits of the motion; "
                              "home it again")
        return None

    def _find_duration_or_motion_stop_reason(self, now: float, stage: StageSample,
                                             command: CommandedMotion | None) -> StopReason | None:
        """Check duration of the run, position and speed of the homed stage; return the reason to stop, or None."""
        limits = self.limits
        if now - self._started > limits.duration:
            return StopReason("duration", f"the run took longer than its limit of {limits.duration:g} s")
        if not self.is_stage_homed or not stage.homed:
            self._stage_samples.clear()
            return None
        tolerance = self.settings.stall_distance
        if not limits.lowest - tolerance <= stage.position <= limits.highest + tolerance:
            return StopReason("travel", f"the stage is at {stage.position * 1e3:.4g} mm, outside of its limits of "
                              f"{limits.lowest * 1e3:g} to {limits.highest * 1e3:g} mm")
        return self._find_speed_stop_reason(stage) or (None if command is None
                                                       else self._find_path_or_stall_stop_reason(stage, command))

    def _find_speed_stop_reason(self, stage: StageSample) -> StopReason | None:
        """Compare the lowest speed that the stage samples of the last `speed_window` allow with the limit.

        The reply to a request for the position can be late, on a slow line or a busy computer: the position was read
        between request and reply. The time between two readings is therefore at most the time from the request of the
        first to the reply of the second, and that time gives the lowest speed.
        """
        samples, window = self._stage_samples, self.settings.speed_window
        samples.append(stage)
        while samples[-1].received - samples[0].received > window:
            samples.popleft()
        first, last = samples[0], samples[-1]
        if last.received - first.received > 0.5 * window:
            longest = last.received - first.earliest_reading_time
            speed = abs(last.position - first.position) / longest
            allowed = (1 + self.settings.speed_tolerance) * self.limits.speed + self.settings.stall_distance / longest
            if speed > allowed:
                return StopReason("speed", f"the stage moves at {speed * 1e3:.3g} mm/s or faster, above the limit of "
                                  f"{self.limits.speed * 1e3:g} mm/s")
        return None

    def _find_path_or_stall_stop_reason(self, stage: StageSample, command: CommandedMotion) -> StopReason | None:
        """Check that the tool is on the commanded path and does not stall; return the reason to stop, or None."""
        tolerance = max(self.settings.path_tolerance, self.settings.stall_time * command.speed)
        low, high = sorted((command.start, command.goal))
        if not low - tolerance <= stage.position <= high + tolerance:
            return StopReason("stage astray", f"the stage is at {stage.position * 1e3:.4g} mm, off the commanded path "
                              f"from {command.start * 1e3:.4g} to {command.goal * 1e3:.4g} mm; home it "
                              "again")
        behind = command.compute_expected_travel(stage.earliest_reading_time) - abs(stage.position - command.start)
        is_stall_testable = stage.earliest_reading_time - command.started > self.settings.stall_time
        if self._measures_position and command.speed and is_stall_testable and \
                behind > max(self.settings.stall_distance, self.settings.stall_time * command.speed):
            return StopReason("stage stalled", f"the stage is {behind * 1e3:.3g} mm behind its commanded position; "
                              "remove what blocks it, and home it again")
        return None


def require_stop_within_force_margin(limits: MotionLimits, speed: float, seconds: float) -> None:
    """Refuse a motion whose force can increase by more than the margin between a fault and the halt of the stage.

    The force increase is speed * seconds * stiffness of the specimen.

    Args:
        limits: limits of the run.
        speed: speed of the motion, m/s.
        seconds: longest time from a fault until the stage has stopped, s.

    Raises:
        InputError: the force increase exceeds `MotionLimits.force_margin`.
    """
    increase = speed * seconds * limits.stiffness
    if not increase <= limits.force_margin:
        allowed = limits.force_margin / (seconds * limits.stiffness) if seconds else math.inf
        raise InputError(
            f"the force increase before a halt must be at most {limits.force_margin:.3g} N; got {increase:.3g} N: at "
            f"{speed * 1e3:.3g} mm/s the tool stops {seconds:.3g} s after a fault, on a specimen of "
            f"{limits.stiffness * 1e-3:.3g} N/mm. "
            + (f"Use a speed of at most {allowed * 1e3:.2g} mm/s" if allowed > 0 else
               "Use a stage that stops when the program ends"), field="limits.force_margin")


__getattr__ = make_getattr_for_old_names(__name__, {"Stop": "StopReason"})
