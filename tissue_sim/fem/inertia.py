"""Inertia of the tissue by backward differences, for steps that move fast.

The second-order backward difference (BDF2, with variable steps) is applied to the displacement and once more to the
velocity; the first step, and one whose length is far from that of the one before, is of first order. Contact that
closes and opens makes it ring much less than Newmark's method: it is L-stable.
With rest = where the tissue would go without forces, the acceleration at the end of a step is (u - rest) rate, so that
in the equations of a step only the lumped mass times `rate` and `rest` appear.
Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section III.5.
"""

from __future__ import annotations

import numpy as np

#: Steps whose ratio to the one before lies here are of second order; the method is stable below 1 + sqrt 2.
_RATIOS = 0.4, 2.0


class Motion:
    """Velocity of every freedom, m/s, at the last equilibrium, and what went before.

    Args:
        masses, rest: arrays of the step's kernel, shape (freedoms,); kept up to date.
        mass: lumped, of each freedom of a shared node, kg, shape (freedoms,).
    """

    def __init__(self, masses: np.ndarray, rest: np.ndarray, mass: np.ndarray):
        masses[:] = mass
        self._rest = rest
        self.velocity = np.zeros_like(mass)
        self._earlier_place, self._earlier_velocity = np.zeros_like(mass), np.zeros_like(mass)
        self._scratch, self._acceleration = np.zeros_like(mass), np.zeros_like(mass)
        #: Of the last inertial step, 1/s2.
        self._rate = 0.0
        #: Length of the step before, s; 0 where there is none to go on from; shape (1,).
        self._before = np.zeros(1)
        self._weights = (1.0, -1.0, 0.0)

    def prepare(self, state: np.ndarray, dt: float) -> float:
        """Before an inertial step of dt (s) from a state whose first entries are displacements; returns `rate`,
        1/s2."""
        before = float(self._before[0])
        ratio = dt / before if before > 0.0 else 0.0
        if _RATIOS[0] <= ratio <= _RATIOS[1]:
            self._weights = (1.0 + 2.0 * ratio) / (1.0 + ratio), -(1.0 + ratio), ratio * ratio / (1.0 + ratio)
        else:
            self._weights = 1.0, -1.0, 0.0
        now, last, earlier = self._weights
        rest, scratch = self._rest, self._scratch
        np.multiply(state[: rest.size], -last / now, out=rest)
        for values, factor in ((self._earlier_place, -earlier / now), (self.velocity, -last * dt / now**2),
                               (self._earlier_velocity, -earlier * dt / now**2)):
            np.multiply(values, factor, out=scratch)
            rest += scratch
        return (now / dt) ** 2

    def commit(self, before: np.ndarray, after: np.ndarray, dt: float, inertial: bool) -> None:
        """After a step of dt (s) that converged; without inertia the velocity is that between the two
        states, and none in the first such step."""
        velocity, scratch, size = self.velocity, self._scratch, self.velocity.size
        if not inertial:
            swung = self._before[0] > 0.0
            self._before[:] = 0.0
            if swung:
                # It jumped to where it would rest: no motion to go on from, if the mass counts again.
                velocity[:] = 0.0
            elif dt > 0.0:
                np.subtract(after[:size], before[:size], out=velocity)
                velocity /= dt
            return
        now, last, earlier = self._weights
        self._rate = (now / dt) ** 2
        np.subtract(after[:size], self._rest, out=self._acceleration)
        self._acceleration *= self._rate
        self._earlier_velocity[:] = velocity
        np.multiply(after[:size], now / dt, out=velocity)
        for values, factor in ((before[:size], last / dt), (self._earlier_place, earlier / dt)):
            np.multiply(values, factor, out=scratch)
            velocity += scratch
        self._earlier_place[:] = before[:size]
        self._before[:] = dt

    def ahead(self, state: np.ndarray, dt: float, mass: np.ndarray, direction: np.ndarray) -> tuple[
            np.ndarray, np.ndarray]:
        """By how much the inertial forces along a direction, N, and their stiffness, N/m, would be larger in a next
        step of dt (s) in which nothing moves, just after an inertial step was committed; the next step must `prepare`
        anew.

        Args:
            state: where everything is.
            mass: of every freedom, kg, shape (freedoms,).
            direction: how far each goes for a metre of the tool, or as much of each of n motions of it, shape
                (freedoms,) or (freedoms, n); the answers are of the shapes () and (), or (n,) and (n, n).
        """
        rate = self.prepare(state, dt)
        change, weighted = self._scratch, mass * direction.T
        np.subtract(state[: change.size], self._rest, out=change)
        change *= rate
        change -= self._acceleration
        return weighted @ change, weighted @ direction * (rate - self._rate)

    def restart(self) -> None:
        """Let the next step be of first order: a difference of second order across an impact has no meaning."""
        self._before[:] = 0.0

    def stop(self) -> None:
        """Stand still."""
        self.velocity[:], self._before[:] = 0.0, 0.0

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that a committed step leaves behind; to go back there, fill them with what they were."""
        return self.velocity, self._earlier_place, self._earlier_velocity, self._before
