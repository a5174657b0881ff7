"""Virtual coupling: a spring and a damper between the haptic device and the simulated tool (the proxy)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Vector
from tissue_sim.public_names import OldName
from tissue_sim.tool_force import ToolForce

_NO_VECTOR: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CouplingSettings:
    """Conditions under which a virtual coupling uses a stiffness of the tissue.

    Attributes:
        longest_stiffness_age: largest age of a stiffness that the coupling uses, s. The tangents of a multirate bulk
            are 20 to 100 ms old.
        smallest_motion: smallest motion of the proxy in a tick for which a secant stiffness is computed, m. A smaller
            value admits secants that consist of rounding errors.
    """

    longest_stiffness_age: float = 0.1
    smallest_motion: float = 1e-7


#: Limits of every coupling.
COUPLING = CouplingSettings()


def is_tool_force_stiffness_stale(answer: ToolForce) -> bool:
    """Return whether the stiffness of an answer is older than `CouplingSettings.longest_stiffness_age`."""
    return answer.stiffness_age > COUPLING.longest_stiffness_age


class VirtualCoupling:
    """Spring-damper between device and proxy (Colgate, Stanley and Brown 1995; Adams and Hannaford 1999).

    The device is at x and receives the force f of the coupling. The proxy is at p and touches the tissue, which pushes
    the proxy by F(p):

        f = K (p - x) + B (dp/dt - dx/dt),    mass d2p/dt2 = F(p) - f

    The coupling is isotropic. The orientation of the proxy is that of the device: rotation is coupled rigidly, and the
    torque of the tissue is given to the hand unchanged.

    Time step. In each tick the proxy moves by one implicit (backward Euler) step. The force of the tissue is linearised
    in the motion of the proxy, F - S (p - p_before): F is the force of a step in which the tool rests, S the stiffness
    within the step. For a tissue without mass, F is the last answer. For a tissue with mass, the answer contains
    S = k + c m/T^2 times the last acceleration, and the next force is

        F_next(p) = F_next(p_before) - S (p - p_before),    F_next(p_before) = k p_before + m a(p_before, history)

    Only the tissue can compute F_next(p_before): `ToolForce.ahead`. Coupling, proxy and tissue are then one system with
    an implicit step. For a linear tissue the linearisation is exact, f equals F(p) - mass d2p/dt2 to rounding, and the
    step is stable for all k, m and K, because backward differences of first and second order damp every oscillation.

    Extrapolation of the force from the motion alone is unstable: with F - S (step - step_before) a mass by first-order
    differences has a root at -1, by second-order differences (c = 9/4) a root at -1.5, and the force oscillates with
    growing amplitude. An inertial answer without `ahead` is used unchanged; the proxy is then stable only if the mass
    of tissue that it moves is below 2 mass + B tick + (K + k) tick^2/2 (first order).

    Old stiffness. A stiffness that is older than `CouplingSettings.longest_stiffness_age` is not used. S is then
    isotropic: the larger of the largest diagonal entry of all earlier stiffnesses that were not too old, and the
    largest secant |change of the force| / |motion of the proxy| between two ticks since then. If S exceeds the
    stiffness k of the tissue, the distance of the proxy to its equilibrium changes in each tick by the factor
    1 - (K + k)/(K + S), which is between 0 and 1: the step is stable, and the proxy lags behind by about
    (K + S)/(K + k) ticks. The stiffness within the step of a tissue with mass belongs to that step and is never too
    old.

    Passivity. With a zero-order hold of length T, a sampled wall K + B (z - 1)/(T z) on a device of physical damping b
    is passive if and only if b > K T/2 + |B| (Colgate and Schenkel 1997). The same condition holds for a coupling to a
    proxy: for B >= 0 and any load that is passive in discrete time (a spring, a damper, a mass by first-order
    differences) the worst case over all loads and frequencies is a proxy at rest. A mass by second-order differences is
    not passive in discrete time; it requires no more damping if B >= K T/5 (computed, masses of 1 mg to 100 kg). A
    force that leaves n ticks later requires (1 + n)^2 times the damping; this condition is sufficient but not
    necessary.

    Args:
        stiffness: stiffness K of the spring, N/m.
        damping: damping B of the damper, N s/m.
        mass: mass of the proxy, kg; 0: the proxy is in static equilibrium between coupling and tissue.

    Attributes:
        pose: pose of the proxy; None before the first step.
        force: force of the coupling on the device, N.
        dissipated: energy that the damper has dissipated since the last reset, J.

    Raises:
        InputError: the stiffness is not positive, damping or mass is negative, or a value is not finite.
    """

    def __init__(self, stiffness: float, damping: float = 0.0, mass: float = 0.0):
        if not 0 < stiffness < math.inf:
            raise InputError(f"the stiffness must be positive and finite; got {stiffness:g} N/m", field="stiffness")
        for value, unit, field in ((damping, "N s/m", "damping"), (mass, "kg", "mass")):
            if not 0 <= value < math.inf:
                raise InputError(f"damping and mass must be zero or more and finite; got {value:g} {unit}", field=field)
        self.stiffness, self.damping, self.mass = stiffness, damping, mass
        self.reset()

    def reset(self):
        """Discard the state of the proxy; the next step places the proxy at the device."""
        self.pose: Pose | None = None
        self.force, self.dissipated = _NO_VECTOR, 0.0
        self._device, self._motion = _NO_VECTOR, _NO_VECTOR
        #: Largest stiffness of the tissue so far, N/m.
        self._largest_stiffness = 0.0
        #: Largest secant stiffness since the stiffness of the answers is too old, N/m.
        self._secant = 0.0
        #: Force of the tissue in the last tick, N.
        self._load: Vector | None = None

    def required_device_damping(self, tick: float, delay_ticks: int = 0) -> float:
        """Return the physical damping that the device must exceed for passivity: (1 + delay)^2 (K tick/2 + B), N s/m.

        Args:
            tick: period of the loop, s.
            delay_ticks: whole ticks between the sample of the pose and the force that it causes.

        Raises:
            InputError: the tick is not positive and finite, or the delay is negative.
        """
        if not (0 < tick < math.inf and delay_ticks >= 0):
            raise InputError(f"tick must be positive and finite, and delay_ticks zero or more; got {tick:g} s and "
                             f"{delay_ticks}", field="tick, delay_ticks")
        return (1 + delay_ticks) ** 2 * (self.stiffness * tick / 2 + self.damping)

    least_device_damping = OldName("required_device_damping")

    def is_passive(self, device_damping: float, tick: float, delay_ticks: int = 0) -> bool:
        """Return whether the coupled device is passive with any passive tissue.

        Args:
            device_damping: physical damping of the device, N s/m.
            tick: period of the loop, s.
            delay_ticks: whole ticks between the sample of the pose and the force that it causes.
        """
        return device_damping > self.required_device_damping(tick, delay_ticks)

    def step(self, device: Pose, answer: ToolForce | None, dt: float) -> Pose:
        """Move the proxy by one tick, and update `force`.

        Args:
            device: pose of the device.
            answer: answer of the tissue to the present pose of the proxy; None: no valid answer, the proxy stays.
            dt: length of the tick, s.

        Returns:
            New pose of the proxy, which is the next pose for the tissue.
        """
        x, y, z = position = device.position
        if self.pose is None:
            self.pose, self._device = device, position
            answer = None  # the answer belongs to another pose
        last_x, last_y, last_z = self._device
        self._device = position
        velocity = vx, vy, vz = (x - last_x) / dt, (y - last_y) / dt, (z - last_z) / dt
        px, py, pz = self.pose.position
        offset = (x - px, y - py, z - pz)
        moved = (0.0, 0.0, 0.0) if answer is None else self._solve_proxy_displacement(offset, velocity, answer, dt)
        self._motion = mx, my, mz = moved
        px, py, pz = px + mx, py + my, pz + mz
        self.pose = Pose((px, py, pz), device.orientation)
        stiffness, damping = self.stiffness, self.damping
        vx, vy, vz = mx / dt - vx, my / dt - vy, mz / dt - vz
        self.force = (stiffness * (px - x) + damping * vx, stiffness * (py - y) + damping * vy,
                      stiffness * (pz - z) + damping * vz)
        self.dissipated += (damping * vx * vx + damping * vy * vy + damping * vz * vz) * dt
        return self.pose

    def _solve_proxy_displacement(self, offset: Vector, velocity: Vector, answer: ToolForce, dt: float) -> Vector:
        """Solve the implicit step for the displacement of the proxy in one tick, and update the stored stiffnesses.

        Args:
            offset: position of the device less position of the proxy, m.
            velocity: velocity of the device, m/s.
            answer: answer of the tissue to the present pose of the proxy.
            dt: length of the tick, s.

        Returns:
            Motion of the proxy in this tick, m.
        """
        # A negative stiffness would reverse the implicit step, so it is set to zero; the next tick corrects the rest.
        ahead = answer if answer.ahead is None else answer.ahead
        matrix = answer.stiffness_matrix_within_step if answer.ahead is None else answer.ahead.stiffness_matrix
        a, b, c = matrix[0][:3]
        d, e, f = matrix[1][:3]
        g, h, i = matrix[2][:3]
        a, e, i = max(a, 0.0), max(e, 0.0), max(i, 0.0)
        if matrix is answer.stiffness_matrix:
            self._update_largest_and_secant_stiffness(answer, max(a, e, i))
            if is_tool_force_stiffness_stale(answer):
                a = e = i = max(self._largest_stiffness, self._secant)
                b = c = d = f = g = h = 0.0
        before_x, before_y, before_z = self._motion
        load_x, load_y, load_z = ahead.wrench[:3]
        inertia, damping, stiffness = self.mass / dt**2, self.damping, self.stiffness
        x = inertia * before_x + damping * velocity[0] + stiffness * offset[0] + load_x
        y = inertia * before_y + damping * velocity[1] + stiffness * offset[1] + load_y
        z = inertia * before_z + damping * velocity[2] + stiffness * offset[2] + load_z
        # Gaussian elimination. With a tissue of positive stiffness no pivot is below that of the coupling alone.
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

    def _update_largest_and_secant_stiffness(self, answer: ToolForce, largest: float) -> None:
        """Update the largest stiffness, or the secant stiffness if the stiffness of the answer is too old.

        Args:
            answer: answer of the tissue.
            largest: largest diagonal entry of its stiffness, N/m.
        """
        load, before, motion = answer.wrench[:3], self._load, math.hypot(*self._motion)
        self._load = load
        if not is_tool_force_stiffness_stale(answer):
            self._largest_stiffness, self._secant = max(self._largest_stiffness, largest), 0.0
        elif before is not None and motion > COUPLING.smallest_motion:
            self._secant = max(self._secant, math.dist(load, before) / motion)


def __getattr__(name: str) -> float:
    """Return `CouplingSettings.longest_stiffness_age` for its old name, with a warning, for one release."""
    if name == "LONGEST_STIFFNESS_AGE":
        warnings.warn("haptics.safety.coupling.LONGEST_STIFFNESS_AGE is renamed to COUPLING.longest_stiffness_age",
                      DeprecationWarning, stacklevel=2)
        return COUPLING.longest_stiffness_age
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
