"""A stage that moves at its speed, on a clock."""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.settings import read_settings
from tissue_sim.errors import InputError

#: Motions that are remembered.
_MOST_MOTIONS = 256


class _Straight(NamedTuple):
    """One motion: when it began, s; from where, to where, m; how fast, m/s."""

    began: float
    start: float
    goal: float
    speed: float

    def place(self, at: float) -> float:
        way = self.goal - self.start
        gone = self.speed * max(at - self.began, 0.0)
        return self.goal if gone >= abs(way) else self.start + math.copysign(gone, way)


class VirtualStage(Stage):
    """Goes straight to where it is sent, at an even speed, with an encoder of finite steps.

    Args:
        limits: m, m/s.
        resolution: of a count of the encoder, m.
        start_at: where it stands before it is homed, m.
        clock: s, never backwards.
        encoder: whether `position` is where the tool is; otherwise where the motor was driven to.
        stalls_after: s after its start, from which on the tool stands although the motor is driven.

    Raises:
        InputError: limits or a resolution that make no sense.
    """

    #: It lives in this program.
    runs_on = 0.0

    def __init__(self, limits: StageLimits, resolution: float = 1e-6, start_at: float = 0.0,
                 clock: Callable[[], float] = time.monotonic, encoder: bool = True,
                 stalls_after: float = math.inf):
        if not -math.inf < limits.lowest <= 0.0 < limits.highest < math.inf:
            raise InputError(f"from {limits.lowest:g} to {limits.highest:g} m; give a range with the zero in it",
                             field="limits")
        for value, unit, field in ((limits.speed, "m/s", "limits.speed"), (resolution, "m", "resolution")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} {unit}; give a number above zero", field=field)
        self.limits, self._resolution, self._clock = limits, resolution, clock
        self.measures_position, self._stalls_after = encoder, stalls_after
        self._started = self._homed = False
        #: All motions, in their order; the last one goes on, or is at its end.
        self._motions = [_Straight(-math.inf, start_at, start_at, limits.speed)]
        self._turns = [(-math.inf, start_at)]
        #: When the tool stops to follow, s on the clock.
        self._stalls = math.inf
        self._homing, self._sequence = False, 0

    def start(self) -> None:
        if not self._started:
            self._started, self._sequence = True, 0
            self._stalls = self._clock() + self._stalls_after

    def home(self) -> None:
        self._require_start()
        self._go(0.0, self.limits.speed)
        self._homing = True

    def move(self, position: float, speed: float) -> None:
        self._require_start()
        self.limits.require(position, speed)
        self._settle()
        if not self._homed:
            raise DeviceError("the virtual stage does not know its zero; home it first, and wait until it is there")
        self._go(position, speed)

    def position(self) -> StageSample:
        self._require_start()
        self._settle()
        now = self._clock()
        place, goal = self._driven_to(now), self._motions[-1].goal
        moving = place != goal
        if self.measures_position:
            place = self.tool_place(now)
            moving = moving or place != goal
        counts = round(place / self._resolution)
        self._sequence += 1
        return StageSample(counts, counts * self._resolution, moving, self._homed, self._sequence - 1,
                           int(SampleStatus.GOOD), now)

    def tool_place(self, at: float) -> float:
        """Where the tool is, or was, at a time on the clock, s; m."""
        return self._driven_to(min(at, self._stalls))

    def turns(self, until: float) -> list[float]:
        """Where it began and where it turned round, until a time on the clock, s; m."""
        return [place for at, place in self._turns if at <= until]

    def halt(self) -> None:
        self._settle()
        place = self._driven_to(self._clock())
        self._go(place, self.limits.speed)
        self._homing = False

    def stop(self) -> None:
        self.halt()
        self._started = False

    def describe(self) -> dict[str, Any]:
        return {"stage": "virtual", "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "resolution_mm": self._resolution * 1e3}

    def _go(self, position: float, speed: float) -> None:
        now = self._clock()
        place, last = self._driven_to(now), self._motions[-1]
        if (position - place) * (last.goal - last.start) < 0:
            self._turns.append((now, self.tool_place(now)))
        # Motions that are over stay for those who ask about the past, but not for ever.
        self._motions = [*self._motions[-_MOST_MOTIONS:], _Straight(now, place, position, speed)]
        self._homing = False

    def _driven_to(self, at: float) -> float:
        """Where the motor is, or was, at a time on the clock, s; m."""
        motions = self._motions
        return motions[max(bisect_right(motions, at, key=lambda motion: motion.began) - 1, 0)].place(at)

    def _settle(self) -> None:
        """Notice that homing has come to its end."""
        if self._homing and self.tool_place(self._clock()) == self._motions[-1].goal:
            self._homing, self._homed = False, True

    def _require_start(self) -> None:
        if not self._started:
            raise DeviceError("the virtual stage is not started; start it first")


def open_virtual(text: str) -> VirtualStage:
    """``virtual:lowest_mm=-50,highest_mm=50,top_speed_mm_s=50,resolution_mm=0.001``."""
    given = read_settings(text, lowest_mm=-50.0, highest_mm=50.0, top_speed_mm_s=50.0, resolution_mm=1e-3)
    limits = StageLimits.of(given)
    return VirtualStage(limits, given["resolution_mm"] * 1e-3)
