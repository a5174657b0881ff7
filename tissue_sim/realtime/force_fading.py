"""Fade the force of a tissue: after lost poses, and after lost equilibrium.

`Watchdog` fades the force to zero when poses stop, and back to full force when they return. `ForceFader` fades out the
force of a tissue that has not reached equilibrium for some time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from tissue_sim.errors import InputError
from tissue_sim.public_names import OldName
from tissue_sim.tool_force import ForceStatus, ToolForce


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


@dataclass(frozen=True)
class ForceFadeTimesAndThresholds:
    """Times and forces of `ForceFader`.

    Attributes:
        patience: longest time without equilibrium at full force, s. A longer time bridges longer failures with an
            extrapolated force.
        ramp: duration of the fade to zero, and of the return to full force, s. A longer ramp changes the force more
            slowly.
        largest_first_force: largest magnitude of a first force that is given in full, N. A larger first force means
            that the tool starts inside the tissue; this force is faded in.
        longest_patience: finite replacement of an infinite patience, longer than any run, s.
    """

    patience: float = 0.050
    ramp: float = 0.050
    largest_first_force: float = 0.1
    longest_patience: float = 1e300


#: Defaults of every release.
RELEASE = ForceFadeTimesAndThresholds()


class ForceFader:
    """Fade the force of a tissue without equilibrium, before the force reaches a hand, a page or a client.

    An answer whose status is not CONVERGED extrapolates the last equilibrium, with one exception: tissue with mass is
    in equilibrium (`inertial`, age 0) but LATE while waves that the steps do not resolve make the force inaccurate.
    The momentum of the tissue limits this force, which is not faded. After `patience` without equilibrium,
    force and stiffness fade to zero together within `ramp` (status FADING): a client that extrapolates with the
    stiffness then stays below the force of the answer. With the next equilibrium they return within the same time
    (status RETURNING). If the first force exceeds `largest_first_force`, the hand starts inside the tissue, and the
    force returns from zero in the same way. The answer to a refused pose keeps the status
    REFUSED and is scaled by the same gain.

    Args:
        patience: longest time without equilibrium at full force, s; infinite for local models of a slow solver, which
            have their own age limit.
        ramp: duration of the fade, s; see `Watchdog`.
        largest_first_force: largest first force that is given in full, N; infinite for a tool that is not held by a
            hand.

    Raises:
        InputError: a time is not positive, or the ramp is infinite.
    """

    def __init__(self, patience: float = RELEASE.patience, ramp: float = RELEASE.ramp,
                 largest_first_force: float = RELEASE.largest_first_force):
        if not patience > 0.0:
            raise InputError(f"the time without equilibrium must be positive; got {patience:g} s", field="patience")
        self._watchdog = Watchdog(min(patience, RELEASE.longest_patience), ramp)
        self._largest_first_force = largest_first_force
        self.reset()

    @property
    def gain(self) -> float:
        """Factor by which the last step multiplied the force, 0 to 1."""
        return self._watchdog.gain

    def reset(self) -> None:
        """Set the gain to 1, and treat the next force as the first one."""
        self._watchdog.reset()
        self._last_step: float | None = None

    def step(self, answer: ToolForce, now: float) -> ToolForce:
        """Return the answer with force and stiffness scaled by the gain of this step.

        With a gain below 1 the status CONVERGED becomes RETURNING; LATE and STOPPED become FADING.

        Args:
            answer: answer of the tissue.
            now: time, s, on one clock that does not decrease: wall time in the loop and the server, simulated time in
                `ToolCoupling`.
        """
        watchdog, last, self._last_step = self._watchdog, self._last_step, now
        if last is None and math.hypot(*answer.wrench[:3]) > self._largest_first_force:
            watchdog.set_gain_to_zero()
        converged = answer.status is ForceStatus.CONVERGED
        has_equilibrium = converged or (answer.status is ForceStatus.LATE and answer.inertial and answer.age == 0.0)
        gain = watchdog.step(has_equilibrium, 0.0 if last is None else max(0.0, now - last))
        if gain == 1.0:
            return answer
        status = answer.status
        if converged:
            status = ForceStatus.RETURNING
        elif status in (ForceStatus.LATE, ForceStatus.STOPPED) and watchdog.state is not WatchdogState.MISSING:
            status = ForceStatus.FADING
        return answer.multiply_force_and_set_status(gain, status)
