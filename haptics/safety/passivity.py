"""Time-domain passivity: observe and limit the energy that passes between hand and tissue (Hannaford and Ryu 2002)."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw, Vector, compute_rigid_motion
from tissue_sim.public_names import OldName, with_old_names

_NO_WRENCH: Screw = (0.0,) * 6
_NO_MOTION: Screw = (0.0,) * 6


@with_old_names(compute_work_by_hand="compute_hand_work", is_active="is_port_active")
class PassivityObserver:
    """Sum the energy that the hand puts into one port: force times displacement plus torque times rotation.

    The wrench is the one on the hand, so pushing against it puts energy in, and the reverse motion returns energy. An
    elastic tissue returns all of the energy, a dissipative tissue less; a tissue that returns more is active and can
    cause vibrations.

    Two quadrature rules are available. The trapezoidal rule (`held` False) gives the work of the tissue, with wrench
    and motion linear between ticks. The rectangle rule (`held` True) gives the work of a device with a zero-order hold,
    whose wrench acts unchanged until the next tick. On a spring of stiffness K the hold returns (K/2) step^2 too much
    energy in every tick.

    Args:
        held: whether the wrench is held over a tick.
        tolerance: returned energy above the energy put in, as a fraction of the latter, from which `is_port_active` is
            True. The default, 1e-3, is far above rounding and far below the limit of perception.

    Attributes:
        energy_in: energy that the hand has put in, J: the sum over all ticks with positive work.
        energy_out: energy that the hand has received, J: the sum over all other ticks.

    Raises:
        InputError: the tolerance is negative or not finite.
    """

    def __init__(self, held: bool = False, tolerance: float = 1e-3):
        if not 0 <= tolerance < math.inf:
            raise InputError(f"the tolerance on the energy must be zero or more and finite; got {tolerance:g}",
                             field="tolerance")
        self.held, self.tolerance = held, tolerance
        self.reset()

    def reset(self):
        """Set the energies to zero, and discard the last sample."""
        self.energy_in = self.energy_out = 0.0
        self._wrench: Screw = _NO_WRENCH
        self._pose: Pose | None = None

    @property
    def energy(self) -> float:
        """Energy that the hand put in minus energy returned to the hand, J; negative for an active port."""
        return self.energy_in - self.energy_out

    @property
    def is_port_active(self) -> bool:
        """Whether the returned energy exceeds the energy put in by more than the tolerance."""
        return self.energy_in - self.energy_out < -self.tolerance * self.energy_in

    def displacement_to(self, pose: Pose) -> Screw:
        """Return translation and rotation vector from the last sample to a pose, m and rad; zero for the first sample.

        Args:
            pose: pose of the tool in this tick.
        """
        return _NO_MOTION if self._pose is None else compute_rigid_motion(self._pose, pose)

    way = OldName("displacement_to")

    def compute_hand_work(self, wrench: Screw, displacement: Screw) -> float:
        """Return the energy that the hand puts in between the last sample and a new one, J; the sums are unchanged.

        Args:
            wrench: wrench of the new sample, N and N m.
            displacement: translation and rotation vector since the last sample, m and rad.
        """
        a, b, c, d, e, f = self._wrench
        if not self.held:
            g, h, i, j, k, m = wrench
            a, b, c, d, e, f = 0.5 * (a + g), 0.5 * (b + h), 0.5 * (c + i), 0.5 * (d + j), 0.5 * (e + k), 0.5 * (f + m)
        x, y, z, u, v, w = displacement
        return -(a * x + b * y + c * z + d * u + e * v + f * w)

    work = OldName("compute_hand_work")
    velocity = OldName("compute_mean_velocity")

    def observe(self, wrench: Screw, pose: Pose, displacement: Screw | None = None):
        """Add one sample to the energies; a sample that is not finite is ignored.

        Args:
            wrench: wrench from this tick on, N and N m.
            pose: pose in this tick.
            displacement: translation and rotation vector since the last sample, m and rad, if already known and finite;
                None: computed from the pose.
        """
        if displacement is None:
            if self._pose is None and not pose.is_finite:
                return
            displacement = self.displacement_to(pose)
        work = self.compute_hand_work(wrench, displacement)
        # A component of the pose that is not finite makes the work not finite.
        if not math.isfinite(work + sum(wrench)):
            return
        if work > 0.0:
            self.energy_in += work
        else:
            self.energy_out -= work
        self._wrench, self._pose = wrench, pose

    def compute_mean_velocity(self, pose: Pose, dt: float) -> Vector:
        """Return the mean velocity of the tool tip since the last sample, m/s; zero for the first sample.

        Args:
            pose: pose in this tick.
            dt: length of the tick, s.
        """
        if self._pose is None:
            return (0.0, 0.0, 0.0)
        (x0, y0, z0), (x1, y1, z1) = self._pose.position, pose.position
        return ((x1 - x0) / dt, (y1 - y0) / dt, (z1 - z0) / dt)


class ReturnedEnergyCutoff:
    """Switch the force off permanently if the hand receives much more energy than it put in.

    This is the last safeguard behind the passivity controller, against tissue that drives the hand because of a wrong
    sign, a wrong pose or an instability. The energy that late or held forces return in ordinary use is small; it is
    forgiven at the rate `energy` per `FORGIVEN` seconds.

    Args:
        energy: largest net energy that the hand may receive, J; infinite: no limit. Use a value above the energy that
            the tissue stores: 0.03 J under the needle of the study at 10 mm.

    Attributes:
        exceeded: whether the limit was exceeded since the last `reset`.

    Raises:
        InputError: the energy is not positive.
    """

    #: Time in which the energy `energy` is forgiven, s.
    FORGIVEN = 60.0

    def __init__(self, energy: float):
        if not energy > 0:
            raise InputError(f"the largest returned energy must be positive; got {energy:g} J", field="energy")
        self.energy = energy
        self.reset()

    def reset(self):
        """Allow force again, and start from zero energy."""
        self.exceeded, self._reference = False, 0.0

    def step(self, energy: float, dt: float) -> bool:
        """Update the limit by one tick, and return whether force is allowed; after an excess it is not until `reset`.

        Args:
            energy: energy put in less energy returned so far, J.
            dt: length of the tick, s.
        """
        if self.energy == math.inf:
            return True
        self._reference = max(energy, self._reference - self.energy * dt / self.FORGIVEN)
        if energy < self._reference - self.energy:
            self.exceeded = True
        return not self.exceeded


class PassivityController:
    """Add damping while the energy of the observer is negative (Hannaford and Ryu 2002, impedance causality).

    The damping dissipates the excess energy in the next tick if the velocity stays the same:
    damping = -energy/(velocity^2 dt). It acts on the translation of the tool tip; rotation is not damped.

    Args:
        observer: observer of the same port with `held` True; it must observe the wrench that finally reaches the hand.
        damping: largest damping that is added, N s/m. Sampled damping is active if it exceeds the physical damping of
            the device, so stay below that value.

    Attributes:
        added: damping of the last step, N s/m.

    Raises:
        InputError: the damping is not positive and finite, or the observer does not count the held force.
    """

    def __init__(self, observer: PassivityObserver, damping: float):
        if not 0 < damping < math.inf:
            raise InputError(f"the damping must be positive and finite; got {damping:g} N s/m", field="damping")
        if not observer.held:
            raise InputError("the observer must count the held force; got held=False. Create the observer with "
                             "held=True",
                             field="observer")
        self.observer, self.damping, self.added = observer, damping, 0.0

    def compute_damping_force(self, pose: Pose, dt: float) -> Vector:
        """Return the damping force of this tick, N; zero if the energy is not negative or the tool rests.

        Args:
            pose: pose in this tick.
            dt: length of the tick, s.
        """
        energy = self.observer.energy + self.observer.compute_hand_work(_NO_WRENCH,
                                                                        self.observer.displacement_to(pose))
        x, y, z = self.observer.compute_mean_velocity(pose, dt)
        power = (x * x + y * y + z * z) * dt
        self.added = min(-energy / power, self.damping) if energy < 0 and power > 0 else 0.0
        return (-self.added * x, -self.added * y, -self.added * z)

    force = OldName("compute_damping_force")
