"""Watchdog: a pose that stays away brings the force to zero, without a jerk, and back when it returns."""

from __future__ import annotations

import math
from enum import Enum

from tissue_sim.errors import InputError


class WatchdogState(Enum):
    """What the watchdog does with the force."""

    TRACKING = "the pose is there: full force"
    MISSING = "the pose is missing, not yet for long: the force stays"
    FADING = "the pose is lost: the force goes to zero"
    LOST = "the pose is lost: no force"
    RETURNING = "the pose is back: the force returns"


class Watchdog:
    """Scales the force by a gain that leaves 1 when the pose has been missing for `timeout`.

    The gain falls to 0 within `ramp` and rises as long when the pose is back, along 3 s^2 - 2 s^3: its slope is nowhere
    above 1.5/ramp and zero at both ends, and it turns without a jump when the pose comes and goes on the way.

    Args:
        timeout: s.
        ramp: s. A force F changes by at most 1.5 F tick/ramp in a tick, plus what F itself changes.

    Attributes:
        state: a `WatchdogState`.
        gain: 0 to 1.
        missing: time without a pose, s.

    Raises:
        InputError: times that are not above zero, or not finite.
    """

    def __init__(self, timeout: float = 0.050, ramp: float = 0.100):
        for value, field in ((timeout, "timeout"), (ramp, "ramp")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} s is too short or endless; give a time above zero", field=field)
        self.timeout, self.ramp = timeout, ramp
        self.reset()

    def reset(self):
        """As if the pose had always been there."""
        self.state, self.gain, self.missing = WatchdogState.TRACKING, 1.0, 0.0
        self._progress = 1.0

    def withdraw(self):
        """As if the pose had been away for long: no force, and the way back begins."""
        self.state, self.gain, self._progress = WatchdogState.LOST, 0.0, 0.0

    def step(self, seen: bool, dt: float) -> float:
        """The gain of this tick: whether the pose was seen in it, and its length, s."""
        if seen and self._progress == 1.0:
            self.missing, self.state = 0.0, WatchdogState.TRACKING
            return 1.0
        self.missing = 0.0 if seen else self.missing + dt
        # Sums of ticks miss the timeout by rounding; a tick too late would be a tick of force too many.
        lost = self.missing > self.timeout * (1 - 1e-9)
        if seen or lost:
            towards = dt / self.ramp if seen else -dt / self.ramp
            self._progress = min(max(self._progress + towards, 0.0), 1.0)
        self.gain = self._progress * self._progress * (3 - 2 * self._progress)
        self.state = self._state(seen, lost)
        return self.gain

    def _state(self, seen: bool, lost: bool) -> WatchdogState:
        if seen:
            return WatchdogState.TRACKING if self.gain == 1.0 else WatchdogState.RETURNING
        if not lost:
            return WatchdogState.MISSING
        return WatchdogState.FADING if self.gain > 0 else WatchdogState.LOST
