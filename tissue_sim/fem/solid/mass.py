"""The mass of a solid in space, lumped at its nodes, and its motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from tissue_sim.fem.inertia import Motion
from tissue_sim.mesh.solid import SolidMesh


def lumped_volumes(mesh: SolidMesh, weights: np.ndarray) -> np.ndarray:
    """Volume that each node stands for in a mass matrix, m3, shape (nodes,): all above zero, and of each element its
    own volume, shared as the diagonal of its consistent matrix is.

    Of hexahedra that are no more than stretched these are Simpson's rule, and that of trapezoids. Source: Hinton, Rock
    and Zienkiewicz, Earthquake Eng. Struct. Dyn. 4 (1976) 245.

    Args:
        mesh: undeformed. weights: volumes of its quadrature points, m3, shape (elements, q).
    """
    values, _ = mesh.element.shape_functions(mesh.element.quadrature[0])
    diagonal = weights @ values**2
    diagonal *= (weights.sum(axis=1) / diagonal.sum(axis=1))[:, None]
    return np.bincount(mesh.connectivity.ravel(), diagonal.ravel(), minlength=len(mesh.nodes))


class Mass:
    """Mass of the freedoms, and where they would go without forces; see `tissue_sim.fem.inertia`.

    Args:
        mesh: undeformed. weights: volumes of its quadrature points, m3, shape (elements, q).
        density: kg/m3.
        matrix: rows and columns of the stiffness of all freedoms, a `scipy.sparse.csc_array`.

    Attributes:
        rate: of this step: the acceleration at its end is (u - rest) rate, 1/s2; 0: no mass takes part.
        motion: velocities, and what went before.
        density: kg/m3.
    """

    def __init__(self, mesh: SolidMesh, weights: np.ndarray, density: float, matrix: Any):
        freedoms = 3 * len(mesh.nodes)
        self._masses, self._rest = np.zeros((2, freedoms))
        self.motion = Motion(self._masses, self._rest, np.repeat(density * lumped_volumes(mesh, weights), 3))
        columns = np.repeat(np.arange(freedoms), np.diff(matrix.indptr))
        self._diagonal = np.flatnonzero(matrix.indices == columns)
        self.rate, self.density = 0.0, density

    def prepare(self, x: np.ndarray, dt: float, inertial: bool) -> None:
        """Before a step of dt (s) from displacements x, m, shape (freedoms,)."""
        self.rate = self.motion.prepare(x, dt) if inertial else 0.0

    def resist(self, x: np.ndarray, residual: np.ndarray, matrix: Any | None) -> None:
        """Add forces of inertia at displacements x, m, to the residual, N, and their rates to a matrix."""
        if self.rate:
            residual[:] += self.rate * self._masses * (x - self._rest)
            if matrix is not None:
                matrix.data[self._diagonal] += self.rate * self._masses

    def ahead(self, x: np.ndarray, dt: float, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Motion.ahead`."""
        return self.motion.ahead(x, dt, self._masses, along)
