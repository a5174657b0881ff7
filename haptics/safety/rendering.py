"""Force rendering: from the device's pose to the wrench on the hand, one tick at a time."""

from __future__ import annotations

import math
from enum import IntFlag
from typing import NamedTuple

from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimits
from haptics.safety.passivity import EnergyLimit, PassivityController, PassivityObserver
from haptics.safety.watchdog import Watchdog, WatchdogState
from tissue_sim.pose import Pose, Screw, scaled
from tissue_sim.tool_force import ForceStatus, ToolForce


class RenderFlag(IntFlag):
    """What happened to a force on its way to the device."""

    LIMITED = 1
    RATE_LIMITED = 2
    INVALID = 4
    LOST_POSE = 8
    ACTIVE = 16
    ENERGY = 32


# Plain numbers: arithmetic on enumerations costs a microsecond each.
_LIMITED, _RATE_LIMITED, _INVALID, _LOST_POSE, _ACTIVE, _ENERGY = (flag.value for flag in RenderFlag)
_NO_WRENCH: Screw = (0.0,) * 6
_NOT_KNOWN: Screw = (math.nan,) * 6


class RenderedForce(NamedTuple):
    """What one tick gives to the device.

    Attributes:
        wrench: force, then torque about the tool's deepest point, on the hand, N and N m.
        proxy: where the simulated tool was.
        flags: bits of `RenderFlag`.
        state: of the watchdog.
        energy: put in by the hand less given back, J, by the trapezoidal rule.
        held_energy: the same with the wrench held over a tick: what the hand really gets.
    """

    wrench: Screw
    proxy: Pose
    flags: int
    state: WatchdogState
    energy: float
    held_energy: float

    @property
    def force(self) -> float:
        """Along z, N, positive out of the tissue."""
        return self.wrench[2]

    @property
    def proxy_depth(self) -> float:
        """How far the simulated tool was pushed in, m."""
        return self.proxy.depth

    @property
    def limited(self) -> bool:
        """The magnitude was cut."""
        return bool(self.flags & _LIMITED)

    @property
    def rate_limited(self) -> bool:
        """The change since the last tick was cut."""
        return bool(self.flags & _RATE_LIMITED)

    @property
    def invalid(self) -> bool:
        """The force or dt was no finite number; the force goes to zero."""
        return bool(self.flags & _INVALID)

    @property
    def lost_pose(self) -> bool:
        """The watchdog holds force back: pose or answer were missing for longer than the timeout."""
        return bool(self.flags & _LOST_POSE)

    @property
    def active(self) -> bool:
        """The held force has given out more than was put in."""
        return bool(self.flags & _ACTIVE)

    @property
    def out_of_energy(self) -> bool:
        """So much more came out than was put in that there is no force until a reset."""
        return bool(self.flags & _ENERGY)


class ForceRendering:
    """One tick: coupling, tissue (stepped by the caller), passivity controller, watchdog, limits, observers.

    Call `pose_for` with what the device says, step the tissue to that pose, then `render` its answer. Neither raises
    on a missing or bad number: force and torque go to zero, by the limits, and the flags say why.

    Args:
        limits: the last in the chain: no other part can jump past them.
        coupling: between device and simulated tool; None: the device's pose goes to the tissue as it is.
        watchdog: for a pose that stays away.
        controller_damping: most that a passivity controller may add, N s/m; None: observe only.
        energy_limit: takes the force away where far too much energy has come out; None: never.

    Attributes:
        observer, held_observer: energy at the device, by the trapezoidal rule and with the wrench held.
    """

    def __init__(self, limits: ForceLimits, coupling: VirtualCoupling | None = None, watchdog: Watchdog | None = None,
                 controller_damping: float | None = None, energy_limit: EnergyLimit | None = None):
        self.limits, self.coupling, self.watchdog = limits, coupling, watchdog or Watchdog()
        self.energy_limit = energy_limit or EnergyLimit(math.inf)
        self.observer, self.held_observer = PassivityObserver(), PassivityObserver(held=True)
        self.controller = (None if controller_damping is None
                           else PassivityController(self.held_observer, controller_damping))
        self.reset()

    def reset(self):
        """As if nothing had been touched, seen or missed."""
        for part in (self.limits, self.coupling, self.watchdog, self.observer, self.held_observer,
                     self.energy_limit):
            if part is not None:
                part.reset()
        self._device: Pose | None = None
        # The device's pose of this tick, where one has come.
        self._seen: Pose | None = None
        self._proxy = Pose.at_depth(0.0)
        self._answer: ToolForce | None = None
        self._wrench = _NO_WRENCH

    def pose_for(self, device: Pose | None, dt: float) -> Pose:
        """Pose to which the tissue is to be stepped.

        Args:
            device: where the device is; None, or not finite, where no new pose has come: the last one counts.
            dt: s.
        """
        self._seen = device if device is not None and device.is_finite else None
        if self._seen is not None:
            self._device = self._seen
        if self._device is not None and 0 < dt < math.inf:
            self._proxy = (self._device if self.coupling is None
                           else self.coupling.step(self._device, self._answer, dt))
        return self._proxy

    def render(self, answer: ToolForce, dt: float) -> RenderedForce:
        """Wrench for the device, from the tissue's answer to `pose_for`.

        LATE and STOPPED forces are rendered: they are local models. A REFUSED one, or one that is not finite, counts
        as a lost pose; meanwhile the wrench is the last that was believed.
        """
        believed = answer.status is not ForceStatus.REFUSED and answer.is_finite
        self._answer = answer if believed else None
        if believed and self._device is not None:
            self._wrench = (answer.wrench if self.coupling is None
                            else self.coupling.force + answer.wrench[3:])
        given, seen = _NOT_KNOWN, self._seen
        if 0 < dt < math.inf:
            given = self._wrench
            if self.controller is not None and seen is not None:
                x, y, z = self.controller.force(seen, dt)
                given = (given[0] + x, given[1] + y, given[2] + z, *given[3:])
            gain = self.watchdog.step(seen is not None and believed, dt)
            if gain != 1.0:
                given = scaled(gain, given)
        limits, observer, held = self.limits, self.observer, self.held_observer
        if not self.energy_limit.step(held.energy, dt if 0 < dt < math.inf else 0.0):
            given = _NO_WRENCH
        given = limits.step(given)
        if seen is not None:
            way = held.way(seen)
            observer.observe(given, seen, way)
            held.observe(given, seen, way)
        flags = _ACTIVE if held.is_active else 0
        if limits.limited:
            flags |= _LIMITED
        if limits.rate_limited:
            flags |= _RATE_LIMITED
        if limits.invalid:
            flags |= _INVALID
        if self.energy_limit.exceeded:
            flags |= _ENERGY
        if self.watchdog.gain < 1.0:
            flags |= _LOST_POSE
        return RenderedForce(given, self._proxy, flags, self.watchdog.state, observer.energy, held.energy)
