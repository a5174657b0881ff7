"""A hand on a haptic device, without either: a mass that somebody's grip moves and the rendered force pushes."""

from __future__ import annotations

import cmath
import math
from typing import Any

from haptics.devices.back_ends import open_motion
from haptics.devices.contracts import HapticDevice, Motion
from tissue_sim.errors import InputError
from tissue_sim.experiment.approach import Approach
from tissue_sim.pose import Pose, Screw, Vector

#: Roots of the motion that are closer than this, as a share of their size, are taken apart: the formula divides by
#: their difference.
_APART = 1e-6


class VirtualHand(HapticDevice):
    """A handle that follows a motion as a hand would, and gives way to the force:

        mass x'' + damping x' + grip (x - wanted) = force

    in all three directions; it is turned as the motion is, whatever the torque. Between two ticks the force and the
    wanted place stand still, and the motion is solved exactly: no period is too long for it. Without a grip it begins
    where the motion begins, and goes where the force drives it; a push is the weight that it lays on the tool.

    Args:
        motion: where the hand wants to be.
        mass: of handle and hand, kg.
        damping: of device and hand, N s/m.
        grip: stiffness with which the hand holds its way, N/m; 0: it holds none.
        push: into the tissue, along the axis of the scene, N.

    Raises:
        InputError: a mass that is not positive, a damping or a grip below zero, or a push that is no number.
    """

    def __init__(self, motion: Motion, mass: float = 0.15, damping: float = 5.0, grip: float = 400.0,
                 push: float = 0.0):
        if not 0 < mass < math.inf:
            raise InputError(f"{mass:g} kg; give a number above zero", field="mass")
        for value, unit, field in ((damping, "N s/m", "damping"), (grip, "N/m", "grip")):
            if not 0 <= value < math.inf:
                raise InputError(f"{value:g} {unit}; give zero or more", field=field)
        if not math.isfinite(push):
            raise InputError(f"{push:g} N; give a finite number", field="push")
        self._motion, self._mass, self._damping, self._grip = motion, mass, damping, grip
        self._push = push
        rate = complex(-damping / (2 * mass))
        swing = cmath.sqrt(rate * rate - grip / mass)
        if abs(swing) < _APART * abs(rate):
            swing = complex(_APART * abs(rate))
        self._roots = rate + swing, rate - swing
        self.start()

    def start(self) -> None:
        #: On the hand: what is rendered, and its own push.
        self._force: Vector = (0.0, 0.0, -self._push)
        self._time = 0.0
        self._place: Vector | None = None
        self._velocity: Vector = (0.0, 0.0, 0.0)

    def pose(self, time: float) -> Pose | None:
        wanted = self._motion.pose(time)
        if wanted is None:
            return None
        if self._place is None or time < self._time:
            # It begins, or begins again, at rest where the hand is.
            self._place, self._velocity = wanted.position, (0.0, 0.0, 0.0)
        elif time > self._time:
            self._place, self._velocity = self._moved(self._place, wanted.position, time - self._time)
        self._time = time
        return Pose(self._place, wanted.orientation)

    def _moved(self, place: Vector, wanted: Vector, dt: float) -> tuple[Vector, Vector]:
        """Place and velocity of the hand that is held towards a place for a time, s."""
        if self._grip == 0.0:
            return self._drifted(place, dt)
        one, other = self._roots
        fade_one, fade_other = cmath.exp(one * dt), cmath.exp(other * dt)
        # Of x = a exp(one t) + b exp(other t), by the place (from its rest) and the velocity at the beginning.
        apart = one - other
        stays = ((one * fade_other - other * fade_one) / apart).real
        gains = ((fade_one - fade_other) / apart).real
        falls = (one * other * (fade_other - fade_one) / apart).real
        keeps = ((one * fade_one - other * fade_other) / apart).real

        def along(axis: int) -> tuple[float, float]:
            rest, velocity = wanted[axis] + self._force[axis] / self._grip, self._velocity[axis]
            return (rest + stays * (place[axis] - rest) + gains * velocity,
                    falls * (place[axis] - rest) + keeps * velocity)

        (x, u), (y, v), (z, w) = along(0), along(1), along(2)
        return (x, y, z), (u, v, w)

    def _drifted(self, place: Vector, dt: float) -> tuple[Vector, Vector]:
        """The same of a hand without a grip."""
        mass, damping = self._mass, self._damping
        slowed = damping * dt / mass
        if slowed < _APART:
            # As good as undamped; the formula below divides by the damping.
            reach, gain, way, keeps = dt, dt / mass, 0.5 * dt * dt / mass, 1.0
        else:
            keeps = math.exp(-slowed)
            gain = -math.expm1(-slowed) / damping
            reach = mass * gain
            way = (dt - reach) / damping

        def along(axis: int) -> tuple[float, float]:
            force, velocity = self._force[axis], self._velocity[axis]
            return place[axis] + reach * velocity + way * force, keeps * velocity + gain * force

        (x, u), (y, v), (z, w) = along(0), along(1), along(2)
        return (x, y, z), (u, v, w)

    @property
    def velocity(self) -> Vector:
        """When its pose was asked for the last time, m/s."""
        return self._velocity

    def render(self, wrench: Screw) -> None:
        x, y, z = wrench[:3]
        self._force = (x, y, z - self._push)

    def stop(self) -> None:
        self._force = (0.0, 0.0, -self._push)

    def go_along(self, approach: Approach | None) -> None:
        self._motion.go_along(approach)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        self._motion.aim(depth, across)

    def describe(self) -> dict[str, Any]:
        return {"device": "virtual hand", "motion": type(self._motion).__name__, "mass_kg": self._mass,
                "damping_N_s_m": self._damping, "grip_N_m": self._grip, "push_N": self._push}


def open_virtual(text: str) -> VirtualHand:
    """``virtual:random:seed=3``: a hand that follows the motion of that name; ``virtual:`` one that is aimed."""
    return VirtualHand(open_motion(text or "hand"))
