"""Virtual coupling: a spring and a damper between the haptic device and the simulated tool (the proxy)."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Vector
from tissue_sim.tool_force import ToolForce

_NO_VECTOR: Vector = (0.0, 0.0, 0.0)
#: Age up to which a coupling uses the stiffness of an answer, s. The tangents of a multirate bulk are 20 to 100 ms old.
LONGEST_STIFFNESS_AGE = 0.1
#: Motion of the proxy in a tick below which two forces give no secant stiffness, m.
_LEAST_MOTION = 1e-7


def is_stale(answer: ToolForce) -> bool:
    """Whether the stiffness of an answer is older than `LONGEST_STIFFNESS_AGE`."""
    return answer.stiffness_age > LONGEST_STIFFNESS_AGE


class VirtualCoupling:
    """Spring-damper between device and proxy (Colgate, Stanley and Brown 1995; Adams and Hannaford 1999).

    The device says where it is, x, and is given the force of the coupling, f; the proxy, at p, touches the tissue,
    which pushes it by F(p):

        f = K (p - x) + B (dp/dt - dx/dt),    mass d2p/dt2 = F(p) - f

    The coupling is the same in all three directions. The proxy is turned as the device is: rotation is coupled rigidly,
    and the torque of the tissue goes to the hand as it is.

    Every tick the proxy moves by one implicit (backward Euler) step, with the tissue's force taken as linear in the
    proxy's way: F - S (p - p_before), F being that of a step in which the tool stays, S the stiffness within the step.
    Of a tissue without mass that is its last answer. With mass it is not: the answer holds S = k + c m/T^2 times the
    last acceleration, and the next force is

        F_next(p) = F_next(p_before) - S (p - p_before),    F_next(p_before) = k p_before + m a(p_before, and the past)

    which only the tissue knows: `ToolForce.ahead`. So coupling, proxy and tissue make one system that is stepped
    implicitly: a linear tissue answers what the step took it for, f is F(p) - mass d2p/dt2 to rounding, and each of
    them is stable by itself under backward differences (first and second order damp every oscillation), whatever k, m
    and K. A guess from the motion alone will not do: with F - S (step - step_before) a mass by first-order differences
    gives a root at -1, by second-order ones (c = 9/4) at -1.5: the force changes sides and grows. An inertial answer
    that does not look ahead is taken as it is; the proxy is then stable only while the mass of the tissue that it moves
    is below 2 mass + B tick + (K + k) tick^2/2 (first order).

    A stiffness that is older than `LONGEST_STIFFNESS_AGE` is not used. In its place S is the same in every direction:
    the largest entry on the diagonal of all that were not too old, or the largest secant |change of the force| /
    |motion of the proxy| between two ticks since then. With S above the stiffness k of the tissue the distance of the
    proxy to its equilibrium changes by the factor 1 - (K + k)/(K + S) in a tick, between 0 and 1, so the step is
    stable; the proxy lags behind by about (K + S)/(K + k) ticks. The stiffness within the step, of a tissue with mass,
    belongs to its step and is never too old.

    Passivity. With a zero-order hold of length T, a sampled wall K + B (z - 1)/(T z) on a device of physical damping b
    is passive if and only if b > K T/2 + |B| (Colgate and Schenkel 1997). A coupling to a proxy needs the same: for
    B >= 0 and any load that is passive in discrete time (a spring, a damper, a mass, by first-order differences) the
    worst case over all loads and frequencies is that of a proxy that does not move. A mass by second-order differences
    is no such load; it asks for no more if B >= K T/5 (computed, masses of 1 mg to 100 kg). A force that leaves n ticks
    later asks for (1 + n)^2 times as much, which then is sufficient but not necessary.

    Args:
        stiffness: K, N/m.
        damping: B, N s/m.
        mass: of the proxy, kg; 0: it is where coupling and tissue balance.

    Attributes:
        pose: of the proxy; None before the first step.
        force: on the device, N.
        dissipated: energy taken out by the damper since the last reset, J.

    Raises:
        InputError: a stiffness that is not above zero, a negative damping or mass, or one that is not finite.
    """

    def __init__(self, stiffness: float, damping: float = 0.0, mass: float = 0.0):
        if not 0 < stiffness < math.inf:
            raise InputError(f"{stiffness:g} N/m couples nothing; give a stiffness above zero", field="stiffness")
        for value, unit, field in ((damping, "N s/m", "damping"), (mass, "kg", "mass")):
            if not 0 <= value < math.inf:
                raise InputError(f"{value:g} {unit} is out of range; give zero or more", field=field)
        self.stiffness, self.damping, self.mass = stiffness, damping, mass
        self.reset()

    def reset(self):
        """Forget the proxy; it is put at the device in the next step."""
        self.pose: Pose | None = None
        self.force, self.dissipated = _NO_VECTOR, 0.0
        self._device, self._motion = _NO_VECTOR, _NO_VECTOR
        #: Largest stiffness of the tissue so far, and largest secant since it is too old, N/m.
        self._stiffest = self._secant = 0.0
        #: Force of the tissue in the last tick, N.
        self._load: Vector | None = None

    def least_device_damping(self, tick: float, delay_ticks: int = 0) -> float:
        """Physical damping, N s/m, that the device must have more of: (1 + delay)^2 (K tick/2 + B).

        Args:
            tick: period of the loop, s.
            delay_ticks: whole ticks between the sample of the pose and the force that it causes.
        """
        if not (0 < tick < math.inf and delay_ticks >= 0):
            raise InputError("give a tick above zero, s, and a delay of 0 or more ticks", field="tick, delay_ticks")
        return (1 + delay_ticks) ** 2 * (self.stiffness * tick / 2 + self.damping)

    def is_passive(self, device_damping: float, tick: float, delay_ticks: int = 0) -> bool:
        """Whether a device with this physical damping, N s/m, stays passive with any passive tissue."""
        return device_damping > self.least_device_damping(tick, delay_ticks)

    def step(self, device: Pose, answer: ToolForce | None, dt: float) -> Pose:
        """Move the proxy by one tick; `force` is then that of the coupling.

        Args:
            device: where the device is.
            answer: of the tissue, to the proxy's present pose; None where there is none to believe: the proxy stays.
            dt: s.

        Returns:
            Where the tissue is to be asked next.
        """
        x, y, z = position = device.position
        if self.pose is None:
            self.pose, self._device = device, position
            answer = None  # what there is answers to another pose
        last_x, last_y, last_z = self._device
        self._device = position
        velocity = vx, vy, vz = (x - last_x) / dt, (y - last_y) / dt, (z - last_z) / dt
        px, py, pz = self.pose.position
        moved = (0.0, 0.0, 0.0) if answer is None else self._balance((x - px, y - py, z - pz), velocity, answer, dt)
        self._motion = mx, my, mz = moved
        px, py, pz = px + mx, py + my, pz + mz
        self.pose = Pose((px, py, pz), device.orientation)
        stiffness, damping = self.stiffness, self.damping
        vx, vy, vz = mx / dt - vx, my / dt - vy, mz / dt - vz
        self.force = (stiffness * (px - x) + damping * vx, stiffness * (py - y) + damping * vy,
                      stiffness * (pz - z) + damping * vz)
        self.dissipated += (damping * vx * vx + damping * vy * vy + damping * vz * vz) * dt
        return self.pose

    def _balance(self, away: Vector, velocity: Vector, answer: ToolForce, dt: float) -> Vector:
        """Motion of the proxy in this tick, m, from how far the device is away from it, m, and its velocity, m/s."""
        # A negative stiffness would push the implicit step the wrong way; the next tick mends what is left out.
        ahead = answer if answer.ahead is None else answer.ahead
        matrix = answer.within_step if answer.ahead is None else answer.ahead.stiffness_matrix
        a, b, c = matrix[0][:3]
        d, e, f = matrix[1][:3]
        g, h, i = matrix[2][:3]
        a, e, i = max(a, 0.0), max(e, 0.0), max(i, 0.0)
        if matrix is answer.stiffness_matrix:
            self._note_stiffness(answer, max(a, e, i))
            if is_stale(answer):
                a = e = i = max(self._stiffest, self._secant)
                b = c = d = f = g = h = 0.0
        before_x, before_y, before_z = self._motion
        load_x, load_y, load_z = ahead.wrench[:3]
        inertia, damping, stiffness = self.mass / dt**2, self.damping, self.stiffness
        x = inertia * before_x + damping * velocity[0] + stiffness * away[0] + load_x
        y = inertia * before_y + damping * velocity[1] + stiffness * away[1] + load_y
        z = inertia * before_z + damping * velocity[2] + stiffness * away[2] + load_z
        # Elimination. A tissue that resists in every direction makes no pivot smaller than that of the coupling alone.
        least = inertia + damping / dt + stiffness
        first = max(least + a, least)
        d, g = d / first, g / first
        second = max(least + e - d * b, least)
        f -= d * c
        h = (h - g * b) / second
        third = max(least + i - g * c - h * f, least)
        y -= d * x
        z = (z - g * x - h * y) / third
        y = (y - f * z) / second
        return ((x - b * y - c * z) / first, y, z)

    def _note_stiffness(self, answer: ToolForce, largest: float) -> None:
        """Note the largest stiffness, N/m, of an answer that is not too old, or else the secant of two forces."""
        load, before, motion = answer.wrench[:3], self._load, math.hypot(*self._motion)
        self._load = load
        if not is_stale(answer):
            self._stiffest, self._secant = max(self._stiffest, largest), 0.0
        elif before is not None and motion > _LEAST_MOTION:
            self._secant = max(self._secant, math.dist(load, before) / motion)
