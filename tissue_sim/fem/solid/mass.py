"""Lumped mass of a three-dimensional solid, and its inertia."""

from __future__ import annotations

from typing import Any

import numpy as np

from tissue_sim.fem.inertia import InertiaTimeIntegrator
from tissue_sim.mesh.solid import SolidMesh


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
    """Lumped mass of a solid and its inertial forces; see `tissue_sim.fem.inertia`.

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
