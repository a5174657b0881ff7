"""Control the force on a tool by the speed of a stage, and guard this control.

A proportional-integral controller converts the error of the force to a speed. Each command moves the stage by a short
distance only, so that a stage whose program has died stops there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from haptics.safety.motion_guard import StopReason
from tissue_sim.errors import InputError
from tissue_sim.settings import require_all_settings_positive


@dataclass(frozen=True)
class ForceControlLimits:
    """Limits of a stage that controls the force. All of them must be stated, so that no limit can be switched off.

    Attributes:
        depth: largest depth of the tool below the contact point, m.
        speed: largest speed of the stage, m/s.
        force_error: largest difference of the force and the prescribed force, N, over
            `ForceControlSettings.error_time`.

    Raises:
        InputError: a limit is not positive and finite.
    """

    depth: float
    speed: float
    force_error: float

    def __post_init__(self) -> None:
        for each in fields(self):
            if not 0 < (value := getattr(self, each.name)) < math.inf:
                raise InputError(f"must be positive and finite; got {value:g}.", field=f"force_control.{each.name}")


@dataclass(frozen=True)
class ForceControlSettings:
    """Gains of the control of a force, and times of its guard.

    Attributes:
        gain: speed over the error of the force divided by the stiffness of the specimen, 1/s: the error decays in
            1 / gain. A larger value is faster. The control of a specimen whose tangent stiffness is r times the ratio
            of force and depth oscillates if the sensor is late by more than about 1 / (r gain).
        integral: gain of the integral of the error, 1/s^2, which removes the error during creep. With gain^2 / 16 the
            damping ratio of the closed loop without delay is 2.
        least_stiffness: smallest stiffness that the control assumes, over the largest stiffness of the specimen, 1. A
            smaller value follows softer specimens, and moves faster where the tool loses contact.
        window: time over which the force is averaged, s.
        horizon: duration of the motion of one command, s: the stage stops after this time without a new command.
        error_time: longest time with an error above `ForceControlLimits.force_error`, s.
        lost_fraction: fraction of the prescribed force below which the contact counts as lost, 1.
        lost_time: longest time with less force, s.
        stall_time: time in which the stage must follow its commands, s.
        stall_distance: least distance behind the commands that counts as a stall, m.

    Raises:
        InputError: a setting is not positive and finite.
    """

    gain: float = 5.0
    integral: float = 25.0 / 16.0
    least_stiffness: float = 0.1
    window: float = 0.02
    horizon: float = 0.05
    error_time: float = 0.5
    lost_fraction: float = 0.2
    lost_time: float = 0.1
    stall_time: float = 0.25
    stall_distance: float = 50e-6

    def __post_init__(self) -> None:
        require_all_settings_positive(self)


#: Settings of every run.
FORCE_CONTROL = ForceControlSettings()


class ForceController:
    """Proportional-integral control of the force by the speed of a stage, with feedforward of the loading rate.

    The stiffness of the specimen is the ratio of force and depth, within bounds. In the air it is the largest
    stiffness, which gives the smallest speed.

    Args:
        limits: limits of the control.
        stiffness: largest stiffness of the specimen, N/m.
        settings: gains.
    """

    def __init__(self, limits: ForceControlLimits, stiffness: float, settings: ForceControlSettings = FORCE_CONTROL):
        self._limits, self._stiffness, self._settings = limits, stiffness, settings
        self._integral = 0.0

    def compute_speed(self, goal: float, rate: float, force: float, depth: float, dt: float) -> float:
        """Return the speed into the tissue, m/s, negative outwards, at most `ForceControlLimits.speed`.

        Args:
            goal: prescribed force, N.
            rate: rate of the prescribed force, N/s.
            force: measured force, N; the speed is 0 if it is not finite.
            depth: depth of the tool below the contact point, m.
            dt: time since the last call, s.
        """
        if not (math.isfinite(force) and math.isfinite(depth)):
            return 0.0
        settings, stiffness = self._settings, self._stiffness
        if depth > 0.0:
            stiffness = min(max(force / depth, settings.least_stiffness * stiffness), stiffness)
        error = (goal - force) / stiffness
        integral = self._integral + settings.integral * error * dt
        wanted, most = settings.gain * error + integral + rate / stiffness, self._limits.speed
        if abs(wanted) < most:
            # The integral stops at the limit of the speed (anti-windup).
            self._integral = integral
        return max(-most, min(wanted, most))


class ForceControlGuard:
    """Check the force, the depth and the motion of a controlled stage, and report the reason to stop.

    Args:
        limits: limits of the control.
        contact_force: force at which contact is detected, N. Smaller prescribed forces need no contact.
        measures_position: whether the stage measures its position, so that a stall is visible.
        settings: times of the guard.
    """

    def __init__(self, limits: ForceControlLimits, contact_force: float, measures_position: bool,
                 settings: ForceControlSettings = FORCE_CONTROL):
        self._limits, self._contact_force, self._settings = limits, contact_force, settings
        self._measures_position = measures_position
        #: Start of the present error of the force, s; infinite without an error.
        self._wrong_since = math.inf
        #: Start of the present loss of contact, s; infinite in contact.
        self._lost_since = math.inf
        #: Whether at least half of the prescribed force has been reached.
        self._had_contact = False
        #: Time, s, depth, m, and commanded travel since then, m, of the present test for a stall.
        self._stall_test: tuple[float, float, float] | None = None

    @property
    def suspects_lost_contact(self) -> bool:
        """Whether the force was too small at the last poll, so that the tool must not move into the tissue."""
        return self._lost_since < math.inf

    def find_stop_reason(self, now: float, goal: float, force: float, depth: float,
                         travel: float) -> StopReason | None:
        """Check one poll.

        Args:
            now: time of the poll, s.
            goal: prescribed force, N.
            force: mean of the last measured forces, N.
            depth: depth of the tool below the contact point, m.
            travel: travel that was commanded since the last poll, m, negative outwards.
        """
        limits, settings = self._limits, self._settings
        if not math.isfinite(force):
            return StopReason("sensor fault", f"the force was {force} while it was controlled; check the sensor")
        # Written as negations, so that NaN exceeds the limits.
        is_at_limit = depth > limits.depth - settings.stall_distance and not goal - force <= limits.force_error
        if is_at_limit or not depth <= limits.depth + settings.stall_distance:
            return StopReason("travel", f"the control of the force moved the tool to {depth * 1e3:.4g} mm below the "
                              f"contact point, and the limit is {limits.depth * 1e3:g} mm; prescribe a smaller "
                              "force, or increase depth_mm")
        needs_contact = goal >= 2 * self._contact_force
        self._had_contact |= needs_contact and force >= 0.5 * goal
        is_lost = needs_contact and self._had_contact and not force >= settings.lost_fraction * goal
        self._lost_since = min(self._lost_since, now) if is_lost else math.inf
        if now - self._lost_since > settings.lost_time:
            return StopReason("contact lost", f"the force fell to {force:.4g} N while {goal:.4g} N were prescribed: "
                              "the specimen has ruptured or moved, or the sensor does not measure the force on the "
                              "tool; check both")
        is_wrong = not abs(force - goal) <= limits.force_error
        self._wrong_since = min(self._wrong_since, now) if is_wrong else math.inf
        if now - self._wrong_since > settings.error_time:
            return StopReason("force control", f"the force was {force:.4g} N instead of {goal:.4g} N for more than "
                              f"{settings.error_time:g} s; use a slower loading rate, a larger speed_mm_s, or a "
                              "stiffness_N_per_mm nearer to that of the specimen")
        return self._find_stall(now, depth, travel)

    def _find_stall(self, now: float, depth: float, travel: float) -> StopReason | None:
        """Compare the motion of the stage with its commands over `stall_time`."""
        start = self._stall_test or (now, depth, 0.0)
        since, first, commanded = start[0], start[1], start[2] + travel
        self._stall_test = since, first, commanded
        if now - since < self._settings.stall_time:
            return None
        self._stall_test = None
        behind = abs(commanded) - abs(depth - first)
        if self._measures_position and behind > max(self._settings.stall_distance, 0.5 * abs(commanded)):
            return StopReason("stage stalled", f"the stage is {behind * 1e3:.3g} mm behind its commanded motion; "
                              "remove what blocks it, and home it again")
        return None
