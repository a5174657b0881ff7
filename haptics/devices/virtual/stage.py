"""A simulated stage that moves at constant speed."""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.settings import parse_number_settings
from tissue_sim.errors import InputError

#: Number of past motions that are kept for queries of past positions.
_KEPT_MOTIONS = 256


class _LinearMotion(NamedTuple):
    """A motion at constant speed.

    Attributes:
        began: Time of its start, s.
        start: Initial position, m.
        goal: Final position, m.
        speed: Speed, m/s.
    """

    began: float
    start: float
    goal: float
    speed: float

    def compute_position(self, at: float) -> float:
        """Return the position of the motor, m, at a time `at` on the clock, s; `goal` after the end of the motion."""
        length = self.goal - self.start
        travelled = self.speed * max(at - self.began, 0.0)
        return self.goal if travelled >= abs(length) else self.start + math.copysign(travelled, length)


class VirtualStage(Stage):
    """A stage that moves straight to its target at constant speed, with an encoder of finite resolution.

    Args:
        limits: Travel and top speed.
        resolution: Length of one count, m.
        start_at: Position before homing, m.
        clock: Monotonic clock, s.
        encoder: True: `position` returns the tool's position. False: it returns the commanded position of the motor.
        stalls_after: Time since the start after which the driven motor no longer moves the tool, s.

    Raises:
        InputError: The lowest position is above 0, or the highest position, the top speed or the resolution is not
            above 0.
    """

    #: The stage exists in this program only.
    runs_on = 0.0
    #: The virtual stage accepts a command at every poll.
    supports_force_control = True

    def __init__(self, limits: StageLimits, resolution: float = 1e-6, start_at: float = 0.0,
                 clock: Callable[[], float] = time.monotonic, encoder: bool = True,
                 stalls_after: float = math.inf):
        if not -math.inf < limits.lowest <= 0.0 < limits.highest < math.inf:
            raise InputError("lowest must be 0 or less and highest above 0; got "
                             f"{limits.lowest:g} to {limits.highest:g} m", field="limits")
        for value, unit, field in ((limits.speed, "m/s", "limits.speed"), (resolution, "m", "resolution")):
            if not 0 < value < math.inf:
                raise InputError(f"top speed and resolution must be above 0; got {value:g} {unit}", field=field)
        self.limits, self._resolution, self._clock = limits, resolution, clock
        self.measures_position, self._stalls_after = encoder, stalls_after
        self._started = self._homed = False
        #: Motions, oldest first; the last one is in progress or finished.
        self._motions = [_LinearMotion(-math.inf, start_at, start_at, limits.speed)]
        #: Time, s, and position of the tool, m, at the start and at each reversal.
        self._reversals = [(-math.inf, start_at)]
        #: Time at which the tool stalls, s on the clock.
        self._stalls = math.inf
        self._homing, self._sequence = False, 0

    def start(self) -> None:
        """Connect without moving; a fault of stalling counts its time from now."""
        if not self._started:
            self._started, self._sequence = True, 0
            self._stalls = self._clock() + self._stalls_after

    def home(self) -> None:
        """Begin a motion to zero at top speed; the zero is known at its end."""
        self._require_started()
        self._begin_motion(0.0, self.limits.speed)
        self._homing = True

    def move(self, position: float, speed: float) -> None:
        """Begin a motion to a position, m, at a speed, m/s, and return at once."""
        self._require_started()
        self.limits.require_within_limits(position, speed)
        self._mark_homed_if_homing_ended()
        if not self._homed:
            raise DeviceError("the virtual stage does not know its zero; home it first, and wait until it is there")
        self._begin_motion(position, speed)

    def position(self) -> StageSample:
        """Return a sample with the position, m, of the tool if `measures_position`, otherwise of the motor."""
        self._require_started()
        self._mark_homed_if_homing_ended()
        now = self._clock()
        position, goal = self._motor_position_at(now), self._motions[-1].goal
        moving = position != goal
        if self.measures_position:
            position = self.compute_tool_position_with_stall(now)
            moving = moving or position != goal
        counts = round(position / self._resolution)
        self._sequence += 1
        return StageSample(counts, counts * self._resolution, moving, self._homed, self._sequence - 1,
                           int(SampleStatus.GOOD), now)

    def compute_tool_position_with_stall(self, at: float) -> float:
        """Return the position of the tool, m, at a present or past time on the clock, s; constant after the stall."""
        return self._motor_position_at(min(at, self._stalls))

    def list_first_and_reversal_positions(self, until: float) -> list[float]:
        """Return the first position of the tool and its positions at all reversals until a time on the clock, s; m."""
        return [position for at, position in self._reversals if at <= until]

    def halt(self) -> None:
        """Stop the motor at its present position."""
        self._mark_homed_if_homing_ended()
        position = self._motor_position_at(self._clock())
        self._begin_motion(position, self.limits.speed)
        self._homing = False

    def stop(self) -> None:
        """Halt the motor and disconnect."""
        self.halt()
        self._started = False

    def describe(self) -> dict[str, Any]:
        """Return travel range, top speed and resolution; keys carry units."""
        return {"stage": "virtual", "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "resolution_mm": self._resolution * 1e3}

    def _begin_motion(self, position: float, speed: float) -> None:
        """Begin a motion from the present position to a position, m, at a speed, m/s; homing counts as interrupted."""
        now = self._clock()
        start, last = self._motor_position_at(now), self._motions[-1]
        if (position - start) * (last.goal - last.start) < 0:
            self._reversals.append((now, self.compute_tool_position_with_stall(now)))
        # Past motions answer queries of past positions; the limit bounds the memory.
        self._motions = [*self._motions[-_KEPT_MOTIONS:], _LinearMotion(now, start, position, speed)]
        self._homing = False

    def _motor_position_at(self, at: float) -> float:
        """Return the position of the motor, m, at a present or past time on the clock, s, also after a stall."""
        motions = self._motions
        return motions[max(bisect_right(motions, at, key=lambda motion: motion.began) - 1, 0)].compute_position(at)

    def _mark_homed_if_homing_ended(self) -> None:
        """Mark the stage as homed if the tool is at the end of a homing motion; otherwise change nothing."""
        if self._homing and self.compute_tool_position_with_stall(self._clock()) == self._motions[-1].goal:
            self._homing, self._homed = False, True

    def _require_started(self) -> None:
        """Raise a DeviceError if the stage is not started."""
        if not self._started:
            raise DeviceError("the virtual stage is not started; start it first")


def make_stand_alone_virtual_stage(text: str) -> VirtualStage:
    """Make a stage without a rig from ``lowest_mm=-50,highest_mm=50,top_speed_mm_s=50,resolution_mm=0.001``."""
    given = parse_number_settings(text, lowest_mm=-50.0, highest_mm=50.0, top_speed_mm_s=50.0, resolution_mm=1e-3)
    limits = StageLimits.from_settings(given)
    return VirtualStage(limits, given["resolution_mm"] * 1e-3)
