"""Points on the sides of elements in space, between their nodes."""

from __future__ import annotations

import numpy as np

from tissue_sim.mesh.solid_element import SolidElement

#: No side of ours has a higher power of either coordinate.
_DEGREE = 4
#: Half the width of the differences for a normal.
_WIDTH = 1e-4


class SidePoints:
    """Sides of elements as images of squares, polynomials of two coordinates from 0 to 1.

    Args:
        element: their type.
        nodes: where those of the sides are by its pattern, m, shape (m, nodes of a side, 3).

    Attributes:
        squares: places of a lattice on the square, shape (q, 2). lattice: these points of each side, its corners among
            them, m, shape (m, q, 3).
        middles: of the sides, m, shape (m, 3). radii: of a ball about it that holds the lattice of the side, m, shape
            (m,). bulges: by how much a side may be beyond planes through its lattice, m, shape (m,).
    """

    def __init__(self, element: SolidElement, nodes: np.ndarray):
        corners = element.reference_nodes[element.faces[0][element.face_corners]]
        # One edge of the square is one corner of a triangle.
        corners = corners if len(corners) == 4 else corners[[0, 0, 1, 2]]
        line = np.linspace(0.0, 1.0, _DEGREE + 1)
        u, v = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
        self.squares = np.stack([u, v], axis=-1)
        places = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1) @ corners
        values = element.shape_functions(places)[0][:, element.faces[0]]
        self.lattice = np.einsum("qn,mni->mqi", values, nodes)
        self.middles = self.lattice[:, len(u) // 2]
        self.radii = np.linalg.norm(self.lattice - self.middles[:, None], axis=-1).max(axis=1)
        # Between points that are one step apart a curve leaves its chord by an eighth of its second difference.
        grid = self.lattice.reshape(-1, _DEGREE + 1, _DEGREE + 1, 3)
        bends = [np.linalg.norm(np.diff(grid, 2, axis=axis), axis=-1).max(axis=(1, 2)) for axis in (1, 2)]
        self.bulges = 0.25 * (bends[0] + bends[1])
        powers = np.linalg.inv(np.vander(line, increasing=True))
        self._factors = np.einsum("ai,bj,mijd->mabd", powers, powers, grid, optimize=True)

    def at(self, sides: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Points of some sides, m, shape (k, q, 3).

        Args:
            sides: which, shape (k,).
            places: on the squares, shape (k, q, 2).
        """
        u, v = np.moveaxis(places[..., None] ** np.arange(_DEGREE + 1), 2, 0)
        products = (u[..., :, None] * v[..., None, :]).reshape(*places.shape[:2], -1)
        return products @ self._factors[sides].reshape(len(sides), -1, 3)

    def normal(self, side: int, place: np.ndarray) -> np.ndarray:
        """Out of the element at a place on the square of a side, shape (3,)."""
        # On the edge that is one corner of a triangle there is none.
        u, v = np.clip(place, 2.0 * _WIDTH, 1.0 - 2.0 * _WIDTH)
        around = np.array([[[u - _WIDTH, v], [u + _WIDTH, v], [u, v - _WIDTH], [u, v + _WIDTH]]])
        left, right, below, above = self.at(np.array([side]), around)[0]
        normal = np.cross(right - left, above - below)
        return normal / np.linalg.norm(normal)
