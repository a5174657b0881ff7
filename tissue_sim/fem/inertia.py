"""Inertia of the tissue: second-order backward differences (BDF2) with variable steps.

BDF2 is applied to the displacement u and again to the velocity. The first step, and a step whose length differs much
from that of the step before, are of first order. The method is L-stable, so that opening and closing contact excites
less ringing than with Newmark's method. The acceleration at the end of a step is (u - rest) rate, where `rest` is the
displacement without forces, so that the equations of a step contain only the lumped mass times `rate` and `rest`.

Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section III.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tissue_sim.mesh.solid import SolidMesh


@dataclass(frozen=True)
class SecondOrderStepRatioLimits:
    """Ratios of a time step to the step before for which the step is of second order.

    Attributes:
        smallest: smallest ratio, 1.
        largest: largest ratio, 1. Variable-step BDF2 is stable for ratios below 1 + sqrt 2.
    """

    smallest: float = 0.4
    largest: float = 2.0


_RATIOS = SecondOrderStepRatioLimits()


class InertiaTimeIntegrator:
    """Time integration of the inertia by BDF2: velocities at the last equilibrium, m/s, and earlier states.

    Args:
        masses, rest: arrays of the step's kernel, shape (freedoms,), which this object updates.
        mass: lumped mass of each degree of freedom, kg, shape (freedoms,); shared nodes have the sum.
    """

    def __init__(self, masses: np.ndarray, rest: np.ndarray, mass: np.ndarray):
        masses[:] = mass
        self._rest = rest
        self.velocity = np.zeros_like(mass)
        self._earlier_place, self._earlier_velocity = np.zeros_like(mass), np.zeros_like(mass)
        self._scratch, self._acceleration = np.zeros_like(mass), np.zeros_like(mass)
        #: `rate` of the last inertial step, 1/s2.
        self._rate = 0.0
        #: Length of the last inertial step, s; 0 if the next step is of first order; shape (1,).
        self._before = np.zeros(1)
        self._weights = (1.0, -1.0, 0.0)

    def prepare_step(self, state: np.ndarray, dt: float) -> float:
        """Compute the force-free displacements (`rest`) of the next inertial step, and return its `rate`.

        Args:
            state: committed state, whose first entries are the displacements, m.
            dt: length of the step, s.

        Returns:
            `rate`, 1/s2: inertial force per mass and displacement from `rest`.
        """
        before = float(self._before[0])
        ratio = dt / before if before > 0.0 else 0.0
        if _RATIOS.smallest <= ratio <= _RATIOS.largest:
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

    def commit_step(self, before: np.ndarray, after: np.ndarray, dt: float, inertial: bool) -> None:
        """Update velocities and earlier states with a converged step.

        Args:
            before: state before the step, displacements first, m.
            after: state after the step, displacements first, m.
            dt: length of the step, s.
            inertial: whether the step was inertial. After a static step the velocity is the difference quotient of the
                two states; it is zero after the first static step that follows an inertial one.
        """
        velocity, scratch, size = self.velocity, self._scratch, self.velocity.size
        if not inertial:
            swung = self._before[0] > 0.0
            self._before[:] = 0.0
            if swung:
                # The displacement jumped to the static equilibrium: this jump is not a velocity.
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

    def predict_inertial_force_and_stiffness_change(self, state: np.ndarray, dt: float, mass: np.ndarray,
                                                    direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict the change of the inertial forces in a next step without motion, after a committed inertial step.

        The next step must call `prepare_step` again.

        Args:
            state: committed state, displacements first, m.
            dt: length of the next step, s.
            mass: mass of every degree of freedom, kg, shape (freedoms,).
            direction: displacement of every degree of freedom per unit of tool motion, for one motion, shape
                (freedoms,), or n motions, shape (freedoms, n).

        Returns:
            Change of the inertial force along each motion, N, shape () or (n,); change of its stiffness, N/m, shape ()
            or (n, n).
        """
        rate = self.prepare_step(state, dt)
        change, weighted = self._scratch, mass * direction.T
        np.subtract(state[: change.size], self._rest, out=change)
        change *= rate
        change -= self._acceleration
        return weighted @ change, weighted @ direction * (rate - self._rate)

    def restart_at_first_order(self) -> None:
        """Use first-order differences in the next step, as after an impact, where the velocity jumps."""
        self._before[:] = 0.0

    def reset_velocity(self) -> None:
        """Set the velocity of all degrees of freedom to zero."""
        self.velocity[:], self._before[:] = 0.0, 0.0

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that define the committed state; writing saved copies into them restores the state."""
        return self.velocity, self._earlier_place, self._earlier_velocity, self._before


def compute_lumped_volumes(mesh: SolidMesh, weights: np.ndarray) -> np.ndarray:
    """Return the lumped volume of each node, m3, shape (nodes,).

    The diagonal of the consistent mass matrix is scaled so that each element keeps its volume; all entries are positive
    (Hinton, Rock and Zienkiewicz, Earthquake Eng. Struct. Dyn. 4 (1976) 245). For rectangular hexahedra the result is
    Simpson's rule, or the trapezoidal rule.

    Args:
        mesh: undeformed mesh.
        weights: volumes of its quadrature points, m3, shape (elements, q).
    """
    values, _ = mesh.element.evaluate_shape_functions_and_gradients(mesh.element.quadrature[0])
    diagonal = weights @ values**2
    diagonal *= (weights.sum(axis=1) / diagonal.sum(axis=1))[:, None]
    return np.bincount(mesh.connectivity.ravel(), diagonal.ravel(), minlength=len(mesh.nodes))


class LumpedMass:
    """Lumped mass of a solid and its inertial forces; integrated by `InertiaTimeIntegrator`.

    Args:
        mesh: undeformed mesh.
        weights: volumes of its quadrature points, m3, shape (elements, q).
        density: mass density, kg/m3.
        matrix: stiffness matrix of all degrees of freedom, a `scipy.sparse.csc_array`.

    Attributes:
        rate: factor of the present step, 1/s2; the acceleration at its end is rate (u - u0); 0 in a static step.
        motion: velocities, and the displacements u0 that the acceleration refers to.
        density: mass density, kg/m3.
    """

    def __init__(self, mesh: SolidMesh, weights: np.ndarray, density: float, matrix: Any):
        freedoms = 3 * len(mesh.nodes)
        self._masses, self._rest = np.zeros((2, freedoms))
        volumes = compute_lumped_volumes(mesh, weights)
        self.motion = InertiaTimeIntegrator(self._masses, self._rest, np.repeat(density * volumes, 3))
        columns = np.repeat(np.arange(freedoms), np.diff(matrix.indptr))
        self._diagonal = np.flatnonzero(matrix.indices == columns)
        self.rate, self.density = 0.0, density

    def prepare_step(self, x: np.ndarray, dt: float, inertial: bool) -> None:
        """Set `rate` for a step of dt seconds from displacements x, m, shape (freedoms,); 0 unless `inertial`."""
        self.rate = self.motion.prepare_step(x, dt) if inertial else 0.0

    def add_inertial_forces(self, x: np.ndarray, residual: np.ndarray, matrix: Any | None) -> None:
        """Add inertial forces at displacements x, m, to the residual, N, and their stiffness to the matrix, N/m."""
        if self.rate:
            residual[:] += self.rate * self._masses * (x - self._rest)
            if matrix is not None:
                matrix.data[self._diagonal] += self.rate * self._masses

    def predict_force_and_stiffness_change(self, x: np.ndarray, dt: float,
                                           along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict the change of the inertial forces in a next step without motion of the tool."""
        return self.motion.predict_inertial_force_and_stiffness_change(x, dt, self._masses, along)
