"""Fade the force to zero when the poses of the device stop, and back to full force when they return."""

from __future__ import annotations

import math
from enum import Enum

from tissue_sim.errors import InputError
from tissue_sim.public_names import OldName


class WatchdogState(Enum):
    """State of the force under a `Watchdog`."""

    TRACKING = "the pose is present: full force"
    MISSING = "the pose is missing for less than the timeout: full force"
    FADING = "the pose is lost: the force goes to zero"
    LOST = "the pose is lost: no force"
    RETURNING = "the pose is back: the force returns"


class Watchdog:
    """Scale the force by a gain that falls from 1 to 0 when the pose is missing for longer than `timeout`.

    The gain falls to 0 within `ramp`, and rises within the same time when the pose is back. It is 3 s^2 - 2 s^3 of the
    progress s from 0 to 1: the slope is at most 1.5/ramp and zero at both ends, and the gain is continuous when the
    pose is lost and found during the ramp.

    Args:
        timeout: longest time without a pose at full force, s.
        ramp: duration of the ramp, s. A force F changes by at most 1.5 F tick/ramp in a tick, in addition to the change
            of F itself.

    Attributes:
        state: `WatchdogState` of the last step.
        gain: factor of the force in the last step, 0 to 1.
        missing: time without a pose, s.

    Raises:
        InputError: a time is not positive and finite.
    """

    def __init__(self, timeout: float = 0.050, ramp: float = 0.100):
        for value, field in ((timeout, "timeout"), (ramp, "ramp")):
            if not 0 < value < math.inf:
                raise InputError(f"timeout and ramp must be positive and finite; got {value:g} s", field=field)
        self.timeout, self.ramp = timeout, ramp
        self.reset()

    def reset(self):
        """Restore full force and the state TRACKING."""
        self.state, self.gain, self.missing = WatchdogState.TRACKING, 1.0, 0.0
        self._progress = 1.0

    def set_gain_to_zero(self):
        """Set the gain to zero and the state to LOST; the next pose starts the ramp to full force."""
        self.state, self.gain, self._progress = WatchdogState.LOST, 0.0, 0.0

    withdraw = OldName("set_gain_to_zero")

    def step(self, seen: bool, dt: float) -> float:
        """Advance by one tick, and return the gain of the force.

        Args:
            seen: whether a pose arrived in this tick.
            dt: length of the tick, s.

        Returns:
            Gain of the force in this tick, 0 to 1.
        """
        if seen and self._progress == 1.0:
            self.missing, self.state = 0.0, WatchdogState.TRACKING
            return 1.0
        self.missing = 0.0 if seen else self.missing + dt
        # The tolerance covers the rounding of the sum of ticks, which would delay the fading by a tick.
        lost = self.missing > self.timeout * (1 - 1e-9)
        if seen or lost:
            change = dt / self.ramp if seen else -dt / self.ramp
            self._progress = min(max(self._progress + change, 0.0), 1.0)
        self.gain = self._progress * self._progress * (3 - 2 * self._progress)
        self.state = self._find_watchdog_state(seen, lost)
        return self.gain

    def _find_watchdog_state(self, seen: bool, lost: bool) -> WatchdogState:
        """Return the state of this tick; `lost`: the pose is missing for longer than the timeout."""
        if seen:
            return WatchdogState.TRACKING if self.gain == 1.0 else WatchdogState.RETURNING
        if not lost:
            return WatchdogState.MISSING
        return WatchdogState.FADING if self.gain > 0 else WatchdogState.LOST
