"""Force rendering: from the device's depth to the force on the hand, one tick at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag

from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimits
from haptics.safety.passivity import PassivityController, PassivityObserver
from haptics.safety.watchdog import Watchdog, WatchdogState
from tissue_sim.tool_force import ForceStatus, ToolForce


class RenderFlag(IntFlag):
    """What happened to a force on its way to the device."""

    LIMITED = 1
    RATE_LIMITED = 2
    INVALID = 4
    LOST_POSE = 8
    ACTIVE = 16


# Plain numbers: arithmetic on enumerations costs a microsecond each.
_LIMITED, _RATE_LIMITED, _INVALID, _LOST_POSE, _ACTIVE = (flag.value for flag in RenderFlag)


@dataclass(frozen=True, slots=True)
class RenderedForce:
    """What one tick gives to the device.

    Attributes:
        force: along z, N, positive out of the tissue.
        proxy_depth: where the simulated tool was, m.
        flags: bits of `RenderFlag`.
        state: of the watchdog.
        energy: put in by the hand less given back, J, by the trapezoidal rule.
        held_energy: the same with the force held over a tick: what the hand really gets.
    """

    force: float
    proxy_depth: float
    flags: int
    state: WatchdogState
    energy: float
    held_energy: float

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


class ForceRendering:
    """One tick: coupling, tissue (stepped by the caller), passivity controller, watchdog, limits, observers.

    Call `depth_for` with what the device says, step the tissue to that depth, then `render` its answer. Neither raises
    on a missing or bad number: the force goes to zero, by the limits, and the flags say why.

    Args:
        limits: the last in the chain: no other part can jump past them.
        coupling: between device and simulated tool; None: the device's depth goes to the tissue as it is.
        watchdog: for a pose that stays away.
        controller_damping: most that a passivity controller may add, N s/m; None: observe only.

    Attributes:
        observer, held_observer: energy at the device, by the trapezoidal rule and with the force held.
    """

    def __init__(self, limits: ForceLimits, coupling: VirtualCoupling | None = None, watchdog: Watchdog | None = None,
                 controller_damping: float | None = None):
        self.limits, self.coupling, self.watchdog = limits, coupling, watchdog or Watchdog()
        self.observer, self.held_observer = PassivityObserver(), PassivityObserver(held=True)
        self.controller = (None if controller_damping is None
                           else PassivityController(self.held_observer, controller_damping))
        self.reset()

    def reset(self):
        """As if nothing had been touched, seen or missed."""
        for part in (self.limits, self.coupling, self.watchdog, self.observer, self.held_observer):
            if part is not None:
                part.reset()
        self._device: float | None = None
        self._seen = False
        self._proxy = 0.0
        self._answer: ToolForce | None = None
        self._force = 0.0

    def depth_for(self, device_depth: float | None, dt: float) -> float:
        """Depth to which the tissue is to be stepped, m.

        Args:
            device_depth: m; None, or not a finite number, where no new pose has come: the last one counts.
            dt: s.
        """
        self._seen = device_depth is not None and math.isfinite(device_depth)
        if self._seen:
            self._device = device_depth
        if self._device is not None and 0 < dt < math.inf:
            self._proxy = (self._device if self.coupling is None
                           else self.coupling.step(self._device, self._answer, dt))
        return self._proxy

    def render(self, answer: ToolForce, dt: float) -> RenderedForce:
        """Force for the device, from the tissue's answer to `depth_for`.

        LATE and STOPPED forces are rendered: they are local models. A REFUSED one, or one that is not a finite number,
        counts as a lost pose; meanwhile the force is the last that was believed.
        """
        believed = (answer.status is not ForceStatus.REFUSED and math.isfinite(answer.force)
                    and math.isfinite(answer.stiffness))
        self._answer = answer if believed else None
        if believed and self._device is not None:
            self._force = answer.force if self.coupling is None else self.coupling.force
        given = math.nan
        if 0 < dt < math.inf:
            given = self._force
            if self.controller is not None and self._seen:
                given += self.controller.force(self._device, dt)
            given *= self.watchdog.step(self._seen and believed, dt)
        given = self.limits.step(given)
        if self._seen:
            self.observer.observe(given, self._device)
            self.held_observer.observe(given, self._device)
        limits = self.limits
        flags = (_LIMITED * limits.limited | _RATE_LIMITED * limits.rate_limited | _INVALID * limits.invalid
                 | _LOST_POSE * (self.watchdog.gain < 1.0) | _ACTIVE * self.held_observer.is_active)
        return RenderedForce(given, self._proxy, flags, self.watchdog.state, self.observer.energy,
                             self.held_observer.energy)
