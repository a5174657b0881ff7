"""Mixed displacement-pressure hexahedra of the solid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.mesh.elements import evaluate_equidistant_lagrange_and_slopes
from tissue_sim.mesh.solid_element import SolidElement


@dataclass(frozen=True)
class Hexahedron(SolidElement):
    """Hexahedron with tensor-product Lagrange polynomials; nodes are numbered along x first, then y, then z."""

    @cached_property
    def _lattice_indices(self) -> np.ndarray:
        """Index of each node along x, y and z, shape (nodes, 3)."""
        line = np.arange(self.order + 1)
        return np.array([(i, j, k) for k in line for j in line for i in line])

    @cached_property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates in [-1, 1]^3, shape (nodes, 3)."""
        return np.linspace(-1.0, 1.0, self.order + 1)[self._lattice_indices]

    @cached_property
    def local_corner_indices(self) -> np.ndarray:
        """Local indices of the corner nodes in the element, shape (8,)."""
        return np.flatnonzero(np.abs(self.reference_nodes).all(axis=1))

    @cached_property
    def local_face_node_indices(self) -> np.ndarray:
        """Local node indices of each face, shape (6, nodes of a face), in the order -x, +x, -y, +y, -z, +z.

        Nodes are numbered along two directions, the first varying faster; the cross product of the directions points
        outwards.
        """
        count = self.order + 1
        numbers = np.arange(count**3).reshape(count, count, count)  # [z, y, x]
        sides = []
        for axis in (2, 1, 0):
            for end in (0, -1):
                side = np.take(numbers, end, axis=axis)
                # The cross products y * z, z * x and x * y point to +x, +y and +z.
                is_transposed = (axis == 1) == (end == -1)
                sides.append((side.T if is_transposed else side).ravel())
        return np.array(sides)

    @cached_property
    def corner_indices_within_face(self) -> np.ndarray:
        """Indices of the corners among the nodes of a face, in order around the face, shape (4,)."""
        side = self.order + 1
        return np.array([0, side - 1, side**2 - 1, side**2 - side])

    @cached_property
    def edge_midpoint_indices_within_face(self) -> np.ndarray:
        """Indices of the midpoints of the edges among the nodes of a face, shape (4,); empty for order 1."""
        return np.array([1, 5, 7, 3] if self.order == 2 else [], dtype=np.intp)

    @cached_property
    def face_area_fractions_by_node(self) -> np.ndarray:
        """Fraction of the area of a face that belongs to each of its nodes, shape (nodes of a face,).

        The fractions are weights of Simpson's rule (order 2) or of the trapezoidal rule (order 1).
        """
        line = np.array([1.0, 4.0, 1.0]) / 6.0 if self.order == 2 else np.array([0.5, 0.5])
        return np.outer(line, line).ravel()

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss points, shape (q, 3), and weights, shape (q,), with order + 1 points in each direction."""
        x, w = leggauss(self.order + 1)
        return x[self._lattice_indices], w[self._lattice_indices].prod(axis=1)

    @cached_property
    def quadrature_extrapolation_matrix(self) -> np.ndarray:
        """Matrix that extrapolates values at the quadrature points to the nodes, shape (nodes, q)."""
        return np.linalg.inv(self.evaluate_shape_functions_and_gradients(self.quadrature[0])[0])

    def evaluate_shape_functions_and_gradients(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (q, nodes) and reference gradients (q, nodes, 3) at reference points (q, 3)."""
        values, slopes = zip(*(evaluate_equidistant_lagrange_and_slopes(points[:, axis], self.order)
                               for axis in range(3)),
                             strict=True)
        factors = [(values[axis][:, self._lattice_indices[:, axis]], slopes[axis][:, self._lattice_indices[:, axis]])
                   for axis in range(3)]
        (vx, sx), (vy, sy), (vz, sz) = factors
        return vx * vy * vz, np.stack([sx * vy * vz, vx * sy * vz, vx * vy * sz], axis=-1)

    def evaluate_corner_functions(self, points: np.ndarray) -> np.ndarray:
        """Return the values of the trilinear functions in the order of `corner_nodes`, shape (q, 8)."""
        signs = self.reference_nodes[self.local_corner_indices]
        return (0.5 * (1.0 + signs * points[:, None])).prod(axis=-1)


#: 27-node hexahedron with four discontinuous pressures, for accuracy (Bathe, Finite Element Procedures, 2014, section
#: 4.4.3, the three-dimensional 27/4 element).
HEX27P1 = Hexahedron("H27/P-1", order=2, pressure_modes=4)
#: Eight-node hexahedron with one pressure (mean dilatation), for speed.
HEX8P0 = Hexahedron("H8/P0", order=1, pressure_modes=1)
