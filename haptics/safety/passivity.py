"""Time-domain passivity: count the energy that passes between hand and tissue (Hannaford and Ryu 2002)."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError


class PassivityObserver:
    """Energy that the hand has put in through one port, from samples of force and depth.

    Force is positive when it pushes the hand back, so pushing in puts energy in and the way back returns it. An elastic
    tissue returns all of it, a dissipative one less; what returns more is active and can shake.

    Two rules: the trapezoidal rule says what the tissue does, as if force and motion were straight lines between ticks;
    with `held`, the force of a tick acts until the next one, which is what a device with a zero-order hold does to the
    hand. On a spring of stiffness K the hold gives back (K/2) step^2 too much in every tick.

    Args:
        held: count with the force held over a tick.
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
        self._force = self._depth = math.nan

    @property
    def energy(self) -> float:
        """Energy put in less energy given back, J."""
        return self.energy_in - self.energy_out

    @property
    def is_active(self) -> bool:
        """Whether more came out than was ever put in, beyond the tolerance."""
        return self.energy < -self.tolerance * self.energy_in

    def work(self, force: float, depth: float) -> float:
        """Energy, J, that the hand puts in on the way from the last sample to this one; 0 for the first sample."""
        if math.isnan(self._depth):
            return 0.0
        acting = self._force if self.held else (self._force + force) / 2
        return acting * (depth - self._depth)

    def observe(self, force: float, depth: float):
        """Take one sample: force from this tick on, N; depth at this tick, m. Samples that are not finite are left out.

        With a velocity instead of a depth, observe the sum of velocity times dt.
        """
        if not (math.isfinite(force) and math.isfinite(depth)):
            return
        work = self.work(force, depth)
        if work > 0:
            self.energy_in += work
        else:
            self.energy_out -= work
        self._force, self._depth = force, depth

    def velocity(self, depth: float, dt: float) -> float:
        """Mean velocity since the last sample, m/s; 0 for the first."""
        return 0.0 if math.isnan(self._depth) else (depth - self._depth) / dt


class PassivityController:
    """Adds damping while the observer's energy is below zero (Hannaford and Ryu 2002, impedance causality).

    The damping takes out in the coming tick, if the speed stays, what has come out too much: -energy/(velocity^2 dt).

    Args:
        observer: of the same port, with the force held; it must be shown the force that leaves in the end.
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

    def force(self, depth: float, dt: float) -> float:
        """Force, N, to add in this tick; 0 while no energy is missing or the tool rests."""
        energy = self.observer.energy + self.observer.work(0.0, depth)
        velocity = self.observer.velocity(depth, dt)
        power = velocity * velocity * dt
        self.added = min(-energy / power, self.damping) if energy < 0 and power > 0 else 0.0
        return self.added * velocity
