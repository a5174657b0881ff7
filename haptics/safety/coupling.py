"""Virtual coupling: a spring and a damper between the haptic device and the simulated tool (the proxy)."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError
from tissue_sim.tool_force import ToolForce


class VirtualCoupling:
    """Spring-damper between device and proxy (Colgate, Stanley and Brown 1995; Adams and Hannaford 1999).

    The device measures its depth x and is given the force of the coupling; the proxy, at p, touches the tissue:

        f = K (x - p) + B (dx/dt - dp/dt),    mass d2p/dt2 = f - F(p)

    Every tick the proxy moves by one implicit (backward Euler) step, with the tissue's force taken as linear about the
    proxy: F + dF/dd (p - p_before). A tissue whose own mass was taken into account answers with a force that belongs to
    the proxy's motion, so there the linear force is taken about the motion going on: F + dF/dd (step - step_before).
    Without this the proxy is unstable where the mass of the tissue that it moves is above
    2 mass + B tick + (K + k) tick^2/2, k being its stiffness at rest.

    Passivity. With a zero-order hold of length T, a sampled wall K + B (z - 1)/(T z) on a device of physical damping b
    is passive if and only if b > K T/2 + |B| (Colgate and Schenkel 1997). A coupling to a proxy needs the same: for
    B >= 0 and any load that is passive in discrete time (a spring, a damper, a mass, all stepped implicitly) the worst
    case over all loads and frequencies is that of a proxy that does not move. A force that leaves n ticks later asks
    for (1 + n)^2 times as much, which then is sufficient but not necessary.

    Args:
        stiffness: K, N/m.
        damping: B, N s/m.
        mass: of the proxy, kg; 0: it is where coupling and tissue balance.

    Attributes:
        depth: of the proxy, m.
        force: on the device, N, positive out of the tissue.
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
        self.depth, self.force, self.dissipated = math.nan, 0.0, 0.0
        self._device = math.nan
        self._motion = 0.0

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

    def step(self, device_depth: float, answer: ToolForce | None, dt: float) -> float:
        """Move the proxy by one tick; `force` is then that of the coupling.

        Args:
            device_depth: m.
            answer: of the tissue, to the proxy's present depth; None where there is none to believe: the proxy stays.
            dt: s.

        Returns:
            The depth at which the tissue is to be asked next, m.
        """
        if math.isnan(self.depth):
            self.depth = self._device = device_depth
            answer = None  # what there is answers to another depth
        velocity = (device_depth - self._device) / dt
        self._device = device_depth
        before = self._motion
        self._motion = 0.0 if answer is None else self._balance(device_depth, velocity, answer, before, dt)
        self.depth += self._motion
        slip = velocity - self._motion / dt
        self.force = self.stiffness * (device_depth - self.depth) + self.damping * slip
        self.dissipated += self.damping * slip * slip * dt
        return self.depth

    def _balance(self, device_depth: float, velocity: float, answer: ToolForce, before: float, dt: float) -> float:
        """Motion of the proxy in this tick, m."""
        # A negative stiffness would push the implicit step the wrong way; the next tick mends what is left out.
        stiffness = max(answer.stiffness, 0.0)
        load = answer.force - stiffness * before if answer.inertial else answer.force
        pull = (self.mass / dt**2 * before + self.damping * velocity
                + self.stiffness * (device_depth - self.depth) - load)
        return pull / (self.mass / dt**2 + self.damping / dt + self.stiffness + stiffness)
