"""Evaluate points and normals on curved faces of solid elements."""

from __future__ import annotations

import numpy as np

from tissue_sim.mesh.solid_element import SolidElement

#: Highest power of a coordinate in the polynomial of a face.
_DEGREE = 4
#: Half of the step of the finite differences for a normal.
_HALF_STEP = 1e-4


class FacePolynomialMaps:
    """Faces of elements in 3D as polynomial maps from the unit square to positions.

    Args:
        element: element type.
        nodes: coordinates of the nodes of each face in the order of the element, m, shape (m, nodes of a face, 3).

    Attributes:
        squares: positions of a lattice on the square, shape (q, 2).
        lattice: lattice points of each face including its corners, m, shape (m, q, 3).
        middles: middle of each face, m, shape (m, 3).
        radii: radius of a ball around the middle that contains the lattice of the face, m, shape (m,).
        bulges: bound of the distance of a face from planes through its lattice points, m, shape (m,).
    """

    def __init__(self, element: SolidElement, nodes: np.ndarray):
        corners = element.reference_nodes[element.local_face_node_indices[0][element.corner_indices_within_face]]
        # For a triangle one edge of the square is collapsed to one corner.
        corners = corners if len(corners) == 4 else corners[[0, 0, 1, 2]]
        line = np.linspace(0.0, 1.0, _DEGREE + 1)
        u, v = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
        self.squares = np.stack([u, v], axis=-1)
        reference = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1) @ corners
        values = element.evaluate_shape_functions_and_gradients(reference)[0][:, element.local_face_node_indices[0]]
        self.lattice = np.einsum("qn,mni->mqi", values, nodes)
        self.middles = self.lattice[:, len(u) // 2]
        self.radii = np.linalg.norm(self.lattice - self.middles[:, None], axis=-1).max(axis=1)
        # The distance of a curve from the chord of two neighbouring points is an eighth of the second difference.
        grid = self.lattice.reshape(-1, _DEGREE + 1, _DEGREE + 1, 3)
        bends = [np.linalg.norm(np.diff(grid, 2, axis=axis), axis=-1).max(axis=(1, 2)) for axis in (1, 2)]
        self.bulges = 0.25 * (bends[0] + bends[1])
        powers = np.linalg.inv(np.vander(line, increasing=True))
        self._factors = np.einsum("ai,bj,mijd->mabd", powers, powers, grid, optimize=True)

    def evaluate_face_positions(self, sides: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Evaluate the polynomials of k faces at q points each; return the positions, m, shape (k, q, 3).

        Args:
            sides: numbers of the faces, shape (k,).
            places: positions on the squares, shape (k, q, 2).
        """
        u, v = np.moveaxis(places[..., None] ** np.arange(_DEGREE + 1), 2, 0)
        products = (u[..., :, None] * v[..., None, :]).reshape(*places.shape[:2], -1)
        return products @ self._factors[sides].reshape(len(sides), -1, 3)

    def compute_unit_normal(self, side: int, place: np.ndarray) -> np.ndarray:
        """Return the outward unit normal of face `side` at the position `place` in the unit square, shape (3,)."""
        # The normal is undefined on the collapsed edge of a triangle: keep a distance from the edges.
        u, v = np.clip(place, 2.0 * _HALF_STEP, 1.0 - 2.0 * _HALF_STEP)
        around = np.array([[[u - _HALF_STEP, v], [u + _HALF_STEP, v], [u, v - _HALF_STEP], [u, v + _HALF_STEP]]])
        left, right, below, above = self.evaluate_face_positions(np.array([side]), around)[0]
        normal = np.cross(right - left, above - below)
        return normal / np.linalg.norm(normal)
