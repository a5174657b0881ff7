"""Force rendering: compute the wrench on the hand from the pose of the device, one tick at a time."""

from __future__ import annotations

import math
from enum import IntFlag
from typing import NamedTuple

from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimiter
from haptics.safety.passivity import PassivityController, PassivityObserver, ReturnedEnergyCutoff
from tissue_sim.pose import Pose, Screw, scale_screw
from tissue_sim.public_names import with_old_names
from tissue_sim.realtime.force_fading import Watchdog, WatchdogState
from tissue_sim.tool_force import ForceStatus, ToolForce


class RenderFlag(IntFlag):
    """Events of a tick that changed the force, or that explain it; see the properties of `RenderedForce`."""

    #: The magnitude was limited.
    LIMITED = 1
    #: The change since the last tick was limited.
    RATE_LIMITED = 2
    #: The force or the time step was not a finite number.
    INVALID = 4
    #: The watchdog reduces the force because poses or answers are missing.
    LOST_POSE = 8
    #: The held force has returned more energy than was put in.
    ACTIVE = 16
    #: The energy limit has switched the force off.
    ENERGY = 32


# Plain integers, because arithmetic on enumerations costs a microsecond per operation.
#: `RenderFlag.LIMITED` as an integer.
_LIMITED = RenderFlag.LIMITED.value
#: `RenderFlag.RATE_LIMITED` as an integer.
_RATE_LIMITED = RenderFlag.RATE_LIMITED.value
#: `RenderFlag.INVALID` as an integer.
_INVALID = RenderFlag.INVALID.value
#: `RenderFlag.LOST_POSE` as an integer.
_LOST_POSE = RenderFlag.LOST_POSE.value
#: `RenderFlag.ACTIVE` as an integer.
_ACTIVE = RenderFlag.ACTIVE.value
#: `RenderFlag.ENERGY` as an integer.
_ENERGY = RenderFlag.ENERGY.value
_NO_WRENCH: Screw = (0.0,) * 6
#: Wrench of a tick without a valid time step; the limits replace it by zero.
_INVALID_WRENCH: Screw = (math.nan,) * 6


@with_old_names(active="is_port_active", is_active="is_port_active", invalid="has_invalid_force_or_time_step",
                lost_pose="is_faded_by_watchdog", out_of_energy="has_exceeded_energy_limit")
class RenderedForce(NamedTuple):
    """Wrench on the hand in one tick, with flags and energies.

    Attributes:
        wrench: force, then torque about the deepest point of the tool, on the hand, N and N m, shape (6,).
        proxy: pose of the simulated tool.
        flags: bits of `RenderFlag`.
        state: state of the watchdog.
        energy: energy put in by the hand less energy returned, J, by the trapezoidal rule.
        held_energy: the same energy with the wrench held over each tick, as the device does, J.
    """

    wrench: Screw
    proxy: Pose
    flags: int
    state: WatchdogState
    energy: float
    held_energy: float

    @property
    def force(self) -> float:
        """Component of the force on the hand along z, N, positive out of the tissue."""
        return self.wrench[2]

    @property
    def proxy_depth(self) -> float:
        """Depth of the simulated tool, m."""
        return self.proxy.depth

    @property
    def limited(self) -> bool:
        """Whether the magnitude of force or torque was limited."""
        return bool(self.flags & _LIMITED)

    @property
    def rate_limited(self) -> bool:
        """Whether the change of force or torque since the last tick was limited."""
        return bool(self.flags & _RATE_LIMITED)

    @property
    def has_invalid_force_or_time_step(self) -> bool:
        """Whether the force or dt was not a finite number; the force then goes to zero."""
        return bool(self.flags & _INVALID)

    @property
    def is_faded_by_watchdog(self) -> bool:
        """Whether the watchdog reduces the force, because poses or valid tissue forces are or were missing."""
        return bool(self.flags & _LOST_POSE)

    @property
    def is_port_active(self) -> bool:
        """Whether the port to the hand is active: the held force has returned more energy than the hand put in."""
        return bool(self.flags & _ACTIVE)

    @property
    def has_exceeded_energy_limit(self) -> bool:
        """Whether the energy limit has switched the force off until a reset."""
        return bool(self.flags & _ENERGY)


@with_old_names(pose_for="advance_proxy")
class ForceRendering:
    """Compute the wrench of a tick: coupling, tissue, passivity controller, watchdog, energy limit, force limits.

    In each tick call `advance_proxy` with the pose of the device, step the tissue to the returned pose, then call
    `render` with the answer of the tissue. Missing or invalid numbers raise no error: force and torque go to zero at
    the rate of the limits, and the flags give the reason.

    Args:
        limits: limits of the wrench; they act last, so no other part can exceed them.
        coupling: virtual coupling between device and simulated tool; None: the tissue receives the pose of the device.
        watchdog: fades the force if poses are missing; None: a watchdog with default times.
        controller_damping: largest damping of a passivity controller, N s/m; None: energies are observed only.
        energy_limit: switches the force off after a large energy return; None: no limit.

    Attributes:
        observer: energy at the device by the trapezoidal rule.
        held_observer: energy at the device with the wrench held over each tick.
    """

    def __init__(self, limits: ForceLimiter, coupling: VirtualCoupling | None = None, watchdog: Watchdog | None = None,
                 controller_damping: float | None = None, energy_limit: ReturnedEnergyCutoff | None = None):
        self.limits, self.coupling, self.watchdog = limits, coupling, watchdog or Watchdog()
        self.energy_limit = energy_limit or ReturnedEnergyCutoff(math.inf)
        self.observer, self.held_observer = PassivityObserver(), PassivityObserver(held=True)
        self.controller = (None if controller_damping is None
                           else PassivityController(self.held_observer, controller_damping))
        self.reset()

    def reset(self):
        """Reset limits, coupling, watchdog, energy sums and energy limit to their initial states."""
        for part in (self.limits, self.coupling, self.watchdog, self.observer, self.held_observer,
                     self.energy_limit):
            if part is not None:
                part.reset()
        self._device: Pose | None = None
        #: Pose of the device in this tick; None: no valid pose has arrived.
        self._new_pose: Pose | None = None
        self._proxy = Pose.at_depth(0.0)
        self._answer: ToolForce | None = None
        self._wrench = _NO_WRENCH

    def advance_proxy(self, device: Pose | None, dt: float) -> Pose:
        """Advance the coupling by one tick, and return the pose to which the tissue must be stepped.

        Args:
            device: pose of the device; if it is None or not finite, the last valid pose is used.
            dt: length of the tick, s.
        """
        self._new_pose = device if device is not None and device.is_finite else None
        if self._new_pose is not None:
            self._device = self._new_pose
        if self._device is not None and 0 < dt < math.inf:
            self._proxy = (self._device if self.coupling is None
                           else self.coupling.step(self._device, self._answer, dt))
        return self._proxy

    def render(self, answer: ToolForce, dt: float) -> RenderedForce:
        """Compute the wrench for the device in this tick, and update observers, limits and watchdog.

        Answers with the status LATE or STOPPED are rendered, because they are local models of the tissue. An answer
        with the status REFUSED, or with a number that is not finite, counts as a missing pose: the last valid wrench is
        used until the watchdog fades it.

        Args:
            answer: answer of the tissue to the pose of `advance_proxy`.
            dt: length of the tick, s.
        """
        is_valid = answer.status is not ForceStatus.REFUSED and answer.is_finite
        self._answer = answer if is_valid else None
        if is_valid and self._device is not None:
            self._wrench = (answer.wrench if self.coupling is None
                            else self.coupling.force + answer.wrench[3:])
        wrench, pose = _INVALID_WRENCH, self._new_pose
        if 0 < dt < math.inf:
            wrench = self._wrench
            if self.controller is not None and pose is not None:
                x, y, z = self.controller.compute_damping_force(pose, dt)
                wrench = (wrench[0] + x, wrench[1] + y, wrench[2] + z, *wrench[3:])
            gain = self.watchdog.step(pose is not None and is_valid, dt)
            if gain != 1.0:
                wrench = scale_screw(gain, wrench)
        limits, observer, held = self.limits, self.observer, self.held_observer
        if not self.energy_limit.step(held.energy, dt if 0 < dt < math.inf else 0.0):
            wrench = _NO_WRENCH
        wrench = limits.step(wrench)
        if pose is not None:
            displacement = held.displacement_to(pose)
            observer.observe(wrench, pose, displacement)
            held.observe(wrench, pose, displacement)
        flags = _ACTIVE if held.is_port_active else 0
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
        return RenderedForce(wrench, self._proxy, flags, self.watchdog.state, observer.energy, held.energy)
