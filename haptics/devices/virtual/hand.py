"""A simulated hand on a simulated haptic device: a damped mass on a spring, pushed by the rendered force."""

from __future__ import annotations

import cmath
import math
from typing import Any

from haptics.devices.back_ends import make_motion
from haptics.devices.contracts import HapticDevice, Motion
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Approach
from tissue_sim.pose import Pose, Screw, Vector

#: Smallest difference of the two characteristic roots, as a fraction of their size; closer roots are separated to this
#: difference, because the solution divides by it. The same limit selects the undamped formula without a grip.
_LEAST_ROOT_SEPARATION = 1e-6


class VirtualHand(HapticDevice):
    """A handle that follows a motion as a hand would, and yields to the rendered force.

    The equation of motion is

        mass x'' + damping x' + grip (x - target) = force

    in x, y and z, with the orientation of the motion for every torque. Force and target are constant between two ticks
    and the equation is solved exactly, so every tick length is stable. Without a grip the hand begins at the motion's
    first position and then moves by force, inertia and damping alone.

    Args:
        motion: Target of the hand against time.
        mass: Mass of handle and hand, kg.
        damping: Damping of device and hand, N s/m.
        grip: Stiffness between hand and target, N/m; 0: the hand ignores the target.
        push: Constant force of the hand into the tissue, along the axis of the scene, N.

    Raises:
        InputError: The mass is not positive, the damping or the grip is negative, or the push is not finite.
    """

    def __init__(self, motion: Motion, mass: float = 0.15, damping: float = 5.0, grip: float = 400.0,
                 push: float = 0.0):
        if not 0 < mass < math.inf:
            raise InputError(f"the mass must be above 0 kg; got {mass:g} kg", field="mass")
        for value, unit, field in ((damping, "N s/m", "damping"), (grip, "N/m", "grip")):
            if not 0 <= value < math.inf:
                raise InputError(f"damping and grip stiffness must be 0 or more; got {value:g} {unit}", field=field)
        if not math.isfinite(push):
            raise InputError(f"the push must be finite; got {push:g} N", field="push")
        self._motion, self._mass, self._damping, self._grip = motion, mass, damping, grip
        self._push = push
        # Characteristic roots: r = -d / 2m +- sqrt((d / 2m)^2 - grip / m).
        mean = complex(-damping / (2 * mass))
        half_difference = cmath.sqrt(mean * mean - grip / mass)
        if abs(half_difference) < _LEAST_ROOT_SEPARATION * abs(mean):
            half_difference = complex(_LEAST_ROOT_SEPARATION * abs(mean))
        self._roots = mean + half_difference, mean - half_difference
        self.start()

    def start(self) -> None:
        """Restart: the push is the only force, and the next call of `pose` places the hand at rest on its target."""
        #: Rendered force plus push, N.
        self._force: Vector = (0.0, 0.0, -self._push)
        self._time = 0.0
        self._position: Vector | None = None
        self._velocity: Vector = (0.0, 0.0, 0.0)

    def pose(self, time: float) -> Pose | None:
        """Advance the hand to a time, s, and return its pose; None if the motion that it follows has no pose."""
        target = self._motion.pose(time)
        if target is None:
            return None
        if self._position is None or time < self._time:
            # First call, or time restarted: at rest on the target.
            self._position, self._velocity = target.position, (0.0, 0.0, 0.0)
        elif time > self._time:
            self._position, self._velocity = self._compute_position_and_velocity_after_dt(
                self._position, target.position, time - self._time)
        self._time = time
        return Pose(self._position, target.orientation)

    def _compute_position_and_velocity_after_dt(self, position: Vector, target: Vector,
                                                dt: float) -> tuple[Vector, Vector]:
        """Return position, m, and velocity, m/s, after a time step, s, with constant target and force."""
        if self._grip == 0.0:
            return self._compute_gripless_position_and_velocity(position, dt)
        r, s = self._roots
        exp_r, exp_s = cmath.exp(r * dt), cmath.exp(s * dt)
        # Coefficients of x(dt) and x'(dt) for x = a exp(r t) + b exp(s t), by initial offset and initial velocity.
        difference = r - s
        offset_to_offset = ((r * exp_s - s * exp_r) / difference).real
        velocity_to_offset = ((exp_r - exp_s) / difference).real
        offset_to_velocity = (r * s * (exp_s - exp_r) / difference).real
        velocity_to_velocity = ((r * exp_r - s * exp_s) / difference).real

        def integrate_axis(axis: int) -> tuple[float, float]:
            """Return position, m, and velocity, m/s, along one axis (0 to 2) after the step."""
            equilibrium, velocity = target[axis] + self._force[axis] / self._grip, self._velocity[axis]
            offset = position[axis] - equilibrium
            return (equilibrium + offset_to_offset * offset + velocity_to_offset * velocity,
                    offset_to_velocity * offset + velocity_to_velocity * velocity)

        (x, u), (y, v), (z, w) = integrate_axis(0), integrate_axis(1), integrate_axis(2)
        return (x, y, z), (u, v, w)

    def _compute_gripless_position_and_velocity(self, position: Vector, dt: float) -> tuple[Vector, Vector]:
        """Return position, m, and velocity, m/s, after a step, s, of mass x'' + damping x' = force."""
        mass, damping = self._mass, self._damping
        decay = damping * dt / mass
        if decay < _LEAST_ROOT_SEPARATION:
            # The limit of zero damping; the formula below divides by the damping.
            velocity_to_offset, force_to_velocity, force_to_offset, velocity_to_velocity = (
                dt, dt / mass, 0.5 * dt * dt / mass, 1.0)
        else:
            velocity_to_velocity = math.exp(-decay)
            force_to_velocity = -math.expm1(-decay) / damping
            velocity_to_offset = mass * force_to_velocity
            force_to_offset = (dt - velocity_to_offset) / damping

        def integrate_axis(axis: int) -> tuple[float, float]:
            """Return position, m, and velocity, m/s, along one axis (0 to 2) after the step."""
            force, velocity = self._force[axis], self._velocity[axis]
            return (position[axis] + velocity_to_offset * velocity + force_to_offset * force,
                    velocity_to_velocity * velocity + force_to_velocity * force)

        (x, u), (y, v), (z, w) = integrate_axis(0), integrate_axis(1), integrate_axis(2)
        return (x, y, z), (u, v, w)

    @property
    def velocity(self) -> Vector:
        """Velocity (x, y, z) of the handle at the last call of `pose`, m/s."""
        return self._velocity

    def render(self, wrench: Screw) -> None:
        """Apply the force of a wrench, N, in addition to the push; the torque is ignored."""
        x, y, z = wrench[:3]
        self._force = (x, y, z - self._push)

    def stop(self) -> None:
        """Remove the rendered force."""
        self._force = (0.0, 0.0, -self._push)

    def set_approach(self, approach: Approach | None) -> None:
        """Set the approach of the motion that the hand follows."""
        self._motion.set_approach(approach)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Set the target of the motion that the hand follows, depth and position across, m; see `HapticDevice.aim`."""
        self._motion.aim(depth, across)

    def describe(self) -> dict[str, Any]:
        """Return motion, mass, damping, grip and push; keys carry units."""
        return {"device": "virtual hand", "motion": type(self._motion).__name__, "mass_kg": self._mass,
                "damping_N_s_m": self._damping, "grip_N_m": self._grip, "push_N": self._push}


def make_virtual_hand_following_motion(text: str) -> VirtualHand:
    """Make a simulated hand that follows the motion named in `text`, as ``random:seed=3``; by default ``hand``."""
    return VirtualHand(make_motion(text or "hand"))
