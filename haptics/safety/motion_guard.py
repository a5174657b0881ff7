"""Limits of a motor that moves a tool: checked at every look at its sensor and its stage, and before it moves at
all."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from tissue_sim.errors import InputError

#: How long a sensor may be silent, s, and in periods of it; whichever is longer.
SILENCE, SILENT_PERIODS = 0.05, 3
#: Over which time a speed is taken, s; and by how much it may be missed: a share, and steps of the position.
_SPEED_OVER, _SPEED_SLACK = 0.1, 0.25
#: How far a driven tool may stay behind before it counts as stalled, s of its way, and m.
_BEHIND_TIME, _BEHIND = 0.25, 50e-6
#: How far it may be off the way that it was sent, or from where it rests, m.
_ASTRAY = 0.1e-3


@dataclass(frozen=True)
class MotionLimits:
    """What must not be passed. They can be set, not switched off.

    Attributes:
        force: largest magnitude, N.
        lowest, highest: of the stage's position, m.
        speed: m/s.
        duration: of a whole run, s.
        stiffness: largest that the specimen may show, N/m: what a motion that ends late costs.
        force_margin: what that may cost, N.
        sensor_silence: how long the sensor may be silent, s.
        tare: largest magnitude that the sensor may read before it is zeroed for the first time, N.
        retracts: whether the tool is taken back after a stop; otherwise it stands where it is.

    Raises:
        InputError: one that is no finite number above zero, or an empty way.
    """

    force: float
    lowest: float
    highest: float
    speed: float
    duration: float
    stiffness: float
    force_margin: float
    sensor_silence: float = SILENCE
    tare: float = 10.0
    retracts: bool = False

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name in ("lowest", "highest", "retracts"):
                continue
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} limits nothing; give a number above zero", field=f"limits.{each.name}")
        if not -math.inf < self.lowest < self.highest < math.inf:
            raise InputError(f"from {self.lowest * 1e3:g} to {self.highest * 1e3:g} mm is no way; give the lower end "
                             "first",
                             field="limits.lowest")


@dataclass(frozen=True)
class Stop:
    """Why a motion was ended.

    Attributes:
        cause: ``"force"``, ``"travel"``, ``"speed"``, ``"duration"``, ``"sensor lost"``, ``"sensor saturated"``,
            ``"sensor fault"``, ``"stage fault"``, ``"limit switch"``, ``"stage stalled"``, ``"stage astray"``,
            ``"device"``, ``"disk"``, ``"asked"``, ``"program late"``, ``"no contact"``, ``"zero"``.
        message: one sentence, with what to do.
    """

    cause: str
    message: str

    @property
    def may_retract(self) -> bool:
        """Whether the stage can still be believed to move the tool back."""
        return self.cause not in ("stage fault", "limit switch", "stage stalled", "stage astray", "device", "speed",
                                  "travel")


@dataclass(frozen=True)
class Drive:
    """A motion that is under way: from, to, m; at what speed, m/s; since when, s."""

    start: float
    goal: float
    speed: float
    began: float

    def expected(self, now: float) -> float:
        """How far it should have come, m."""
        return min(self.speed * max(now - self.began, 0.0), abs(self.goal - self.start))


class MotionGuard:
    """Looks at every sample, and says when a motion has to end.

    Args:
        limits: see there.
        sensor_rate: Hz. channels: of the sensor: all forces among them count against the limit together.
        measures_position: of the stage: whether a stall can be seen in its position.
        began: when the run began, s on the clock of the samples.

    Attributes:
        knows_place, knows_zero: whether the stage was homed and the sensor zeroed in this run, so that they can be
            judged. Nothing is moved before the sensor is.
    """

    def __init__(self, limits: MotionLimits, sensor_rate: float, channels: Sequence[str], measures_position: bool,
                 began: float):
        self.limits, self._measured, self._began = limits, measures_position, began
        self._silence = max(limits.sensor_silence, SILENT_PERIODS / sensor_rate)
        self._forces = [number for number, name in enumerate(channels) if name in ("Fx", "Fy", "Fz")]
        self._heard = began
        self._readings: deque[StageSample] = deque()
        self.knows_place = self.knows_zero = False

    def check(self, now: float, samples: Sequence[ForceSample], forces: Sequence[float], stage: StageSample,
              drive: Drive | None) -> Stop | None:
        """Why the motion has to end; None: it need not.

        Args:
            now: s on the clock of the samples. samples: new ones. forces: what they say along the tool, N.
            stage: where it is. drive: what it was told last; None: nothing.
        """
        return (self._check_sensor(now, samples) or self._check_force(samples, forces) or self._check_stage(stage)
                or self._check_motion(now, stage, drive))

    def _check_sensor(self, now: float, samples: Sequence[ForceSample]) -> Stop | None:
        for sample in samples:
            if sample.status & SampleStatus.SATURATED:
                return Stop("sensor saturated", "the sensor is at the end of its range, and the force may be larger; "
                                                "take the load off and look whether it reads zero")
            if sample.status & SampleStatus.FAULT:
                return Stop("sensor fault", "the sensor reports a fault, and its samples are not to be trusted; look "
                                            "at what it says of itself")
        if samples:
            self._heard = now
        elif now - self._heard > self._silence:
            return Stop("sensor lost", f"the sensor was silent for {now - self._heard:.3g} s, where "
                                       f"{self._silence:.3g} s are allowed; look at its cable and its power")
        return None

    def _check_force(self, samples: Sequence[ForceSample], forces: Sequence[float]) -> Stop | None:
        if not self.knows_zero:
            return None
        for sample, force in zip(samples, forces, strict=True):
            together = math.sqrt(sum(sample.values[number] ** 2 for number in self._forces))
            for size, words in ((abs(force), "along the tool"), (together, "in all directions")):
                # Not the other way round: what is no number passes no limit.
                if not size <= self.limits.force:
                    return Stop("force", f"the force {words} was {size:.4g} N, above the limit of "
                                         f"{self.limits.force:g} N")
        return None

    def _check_stage(self, stage: StageSample) -> Stop | None:
        if stage.status & SampleStatus.FAULT:
            return Stop("stage fault", "the stage reports a fault; look at what it says of itself, and home it again")
        if stage.status & SampleStatus.LIMIT and self.knows_place and not stage.moving:
            return Stop("limit switch", "the stage stands at a limit switch, where it should not be; home it again")
        return None

    def _check_motion(self, now: float, stage: StageSample, drive: Drive | None) -> Stop | None:
        limits = self.limits
        if now - self._began > limits.duration:
            return Stop("duration", f"the run took longer than its limit of {limits.duration:g} s")
        if not self.knows_place or not stage.homed:
            self._readings.clear()
            return None
        if not limits.lowest - _BEHIND <= stage.position <= limits.highest + _BEHIND:
            return Stop("travel", f"the stage is at {stage.position * 1e3:.4g} mm, outside of its limits of "
                                  f"{limits.lowest * 1e3:g} to {limits.highest * 1e3:g} mm")
        return self._check_speed(stage) or (None if drive is None else self._check_drive(stage, drive))

    def _check_speed(self, stage: StageSample) -> Stop | None:
        """Compare the lowest speed that the readings of the last `_SPEED_OVER` allow with the limit.

        The reply to a request for the position can be late, on a slow line or a busy computer: the position was read
        between request and reply. The time between two readings is therefore at most the time from the request of the
        first to the reply of the second, and that time gives the lowest speed.
        """
        readings = self._readings
        readings.append(stage)
        while readings[-1].received - readings[0].received > _SPEED_OVER:
            readings.popleft()
        first, last = readings[0], readings[-1]
        if last.received - first.received > 0.5 * _SPEED_OVER:
            passed = last.received - first.earliest
            speed = abs(last.position - first.position) / passed
            if speed > (1 + _SPEED_SLACK) * self.limits.speed + _BEHIND / passed:
                return Stop("speed", f"the stage moves at {speed * 1e3:.3g} mm/s or faster, above the limit of "
                                     f"{self.limits.speed * 1e3:g} mm/s")
        return None

    def _check_drive(self, stage: StageSample, drive: Drive) -> Stop | None:
        slack = max(_ASTRAY, _BEHIND_TIME * drive.speed)
        low, high = sorted((drive.start, drive.goal))
        if not low - slack <= stage.position <= high + slack:
            return Stop("stage astray", f"the stage is at {stage.position * 1e3:.4g} mm, where it was sent from "
                                        f"{drive.start * 1e3:.4g} to {drive.goal * 1e3:.4g} mm; home it again")
        behind = drive.expected(stage.earliest) - abs(stage.position - drive.start)
        if self._measured and drive.speed and stage.earliest - drive.began > _BEHIND_TIME and \
                behind > max(_BEHIND, _BEHIND_TIME * drive.speed):
            return Stop("stage stalled", f"the stage is {behind * 1e3:.3g} mm behind where it was driven; look what "
                                         "holds it, and home it again")
        return None


def require_stoppable(limits: MotionLimits, speed: float, seconds: float) -> None:
    """Refuse a motion that would cost more force than the margin until it stands.

    Args:
        limits: see there. speed: of the motion, m/s. seconds: until it stands, after something went wrong.

    Raises:
        InputError: it would.
    """
    cost = speed * seconds * limits.stiffness
    if not cost <= limits.force_margin:
        allowed = limits.force_margin / (seconds * limits.stiffness) if seconds else math.inf
        raise InputError(
            f"at {speed * 1e3:.3g} mm/s it takes {seconds:.3g} s until the tool stands, which costs {cost:.3g} N on a "
            f"specimen of {limits.stiffness * 1e-3:.3g} N/mm, more than the margin of {limits.force_margin:.3g} N; "
            + (f"go no faster than {allowed * 1e3:.2g} mm/s" if allowed > 0 else
               "take a stage that stops when the program ends"), field="limits.force_margin")
