"""Time-domain passivity: count the energy that passes between hand and tissue (Hannaford and Ryu 2002)."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw, Vector, motion

_NO_WRENCH: Screw = (0.0,) * 6
_NO_WAY: Screw = (0.0,) * 6


class PassivityObserver:
    """Energy that the hand has put in through one port, from samples of wrench and pose: force along the way, torque
    along the rotation.

    The wrench is that on the hand, so pushing against it puts energy in and the way back returns it. An elastic tissue
    returns all of it, a dissipative one less; what returns more is active and can shake.

    Two rules: the trapezoidal rule says what the tissue does, as if wrench and motion were straight lines between
    ticks; with `held`, the wrench of a tick acts until the next one, which is what a device with a zero-order hold does
    to the hand. On a spring of stiffness K the hold gives back (K/2) step^2 too much in every tick.

    Args:
        held: count with the wrench held over a tick.
        tolerance: part of the energy put in that may come out on top before `is_active`; 1e-3 is far above rounding
            and far below what is felt.

    Attributes:
        energy_in: put in by the hand, J: the sum of all ticks in which it did work.
        energy_out: given back, J: the sum of the others.
    """

    def __init__(self, held: bool = False, tolerance: float = 1e-3):
        if not 0 <= tolerance < math.inf:
            raise InputError(f"{tolerance:g} is no part of the energy; give zero or more", field="tolerance")
        self.held, self.tolerance = held, tolerance
        self.reset()

    def reset(self):
        """Start again from zero energy."""
        self.energy_in = self.energy_out = 0.0
        self._wrench: Screw = _NO_WRENCH
        self._pose: Pose | None = None

    @property
    def energy(self) -> float:
        """Energy put in less energy given back, J."""
        return self.energy_in - self.energy_out

    @property
    def is_active(self) -> bool:
        """Whether more came out than was ever put in, beyond the tolerance."""
        return self.energy_in - self.energy_out < -self.tolerance * self.energy_in

    def way(self, pose: Pose) -> Screw:
        """From the last sample to a pose, m and rad; none for the first sample."""
        return _NO_WAY if self._pose is None else motion(self._pose, pose)

    def work(self, wrench: Screw, way: Screw) -> float:
        """Energy, J, that the hand puts in on the way from the last sample to one with this wrench."""
        a, b, c, d, e, f = self._wrench
        if not self.held:
            g, h, i, j, k, m = wrench
            a, b, c, d, e, f = 0.5 * (a + g), 0.5 * (b + h), 0.5 * (c + i), 0.5 * (d + j), 0.5 * (e + k), 0.5 * (f + m)
        x, y, z, u, v, w = way
        return -(a * x + b * y + c * z + d * u + e * v + f * w)

    def observe(self, wrench: Screw, pose: Pose, way: Screw | None = None):
        """Take one sample: wrench from this tick on, N and N m; pose at this tick. Samples that are not finite are left
        out.

        Args:
            wrench, pose: the sample.
            way: to that pose, where it is known already, and finite.
        """
        if way is None:
            if self._pose is None and not pose.is_finite:
                return
            way = self.way(pose)
        work = self.work(wrench, way)
        # What is not finite in a later pose is in the work.
        if not math.isfinite(work + sum(wrench)):
            return
        if work > 0.0:
            self.energy_in += work
        else:
            self.energy_out -= work
        self._wrench, self._pose = wrench, pose

    def velocity(self, pose: Pose, dt: float) -> Vector:
        """Mean velocity of the tool's tip since the last sample, m/s; 0 for the first."""
        if self._pose is None:
            return (0.0, 0.0, 0.0)
        (x0, y0, z0), (x1, y1, z1) = self._pose.position, pose.position
        return ((x1 - x0) / dt, (y1 - y0) / dt, (z1 - z0) / dt)


class EnergyLimit:
    """Takes the force away for good where a hand is given much more energy than it put in.

    The last line behind the controller: tissue that drives a hand by itself, through a wrong sign, a wrong pose or an
    instability, is let go of. What a force that was late or held over a tick gives out in ordinary use is little, and
    forgiven as fast as `energy` in `FORGIVEN` s.

    Args:
        energy: J, or infinite: no limit. Above what tissue stores and a hand may take back: 0.03 J under the study's
            needle at 10 mm.

    Attributes:
        exceeded: whether it has happened since the last `reset`.

    Raises:
        InputError: not above zero.
    """

    #: s.
    FORGIVEN = 60.0

    def __init__(self, energy: float):
        if not energy > 0:
            raise InputError(f"{energy:g} J is no limit; give an energy above zero", field="energy")
        self.energy = energy
        self.reset()

    def reset(self):
        """Let force through again."""
        self.exceeded, self._most = False, 0.0

    def step(self, energy: float, dt: float) -> bool:
        """Whether force may still be given: energy put in less energy given back so far, J, after dt, s."""
        if self.energy == math.inf:
            return True
        self._most = max(energy, self._most - self.energy * dt / self.FORGIVEN)
        if energy < self._most - self.energy:
            self.exceeded = True
        return not self.exceeded


class PassivityController:
    """Adds damping while the observer's energy is below zero (Hannaford and Ryu 2002, impedance causality).

    The damping takes out in the coming tick, if the speed stays, what has come out too much: -energy/(velocity^2 dt).
    It acts on the way of the tool's tip; rotation is not damped.

    Args:
        observer: of the same port, with the wrench held; it must be shown the wrench that leaves in the end.
        damping: most that is added, N s/m. Sampled damping is itself active above the device's own damping: stay below.

    Attributes:
        added: damping of the last step, N s/m.
    """

    def __init__(self, observer: PassivityObserver, damping: float):
        if not 0 < damping < math.inf:
            raise InputError(f"{damping:g} N s/m controls nothing; give a damping above zero", field="damping")
        if not observer.held:
            raise InputError("the observer of a controller counts the held force; make it with held=True",
                             field="observer")
        self.observer, self.damping, self.added = observer, damping, 0.0

    def force(self, pose: Pose, dt: float) -> Vector:
        """Force, N, to add in this tick, against the motion; 0 while no energy is missing or the tool rests."""
        energy = self.observer.energy + self.observer.work(_NO_WRENCH, self.observer.way(pose))
        x, y, z = self.observer.velocity(pose, dt)
        power = (x * x + y * y + z * z) * dt
        self.added = min(-energy / power, self.damping) if energy < 0 and power > 0 else 0.0
        return (-self.added * x, -self.added * y, -self.added * z)
