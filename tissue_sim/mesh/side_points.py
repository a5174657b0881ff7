"""Points on the sides of elements in space, between their nodes."""

from __future__ import annotations

import numpy as np

from tissue_sim.mesh.solid_element import SolidElement

#: No side of ours has a higher power of either coordinate.
_DEGREE = 4


class SidePoints:
    """Sides of elements as images of squares, polynomials of two coordinates from 0 to 1.

    Args:
        element: their type.
        nodes: where those of the sides are by its pattern, m, shape (m, nodes of a side, 3).

    Attributes:
        lattice: points of each side, its corners among them, m, shape (m, q, 3).
    """

    def __init__(self, element: SolidElement, nodes: np.ndarray):
        corners = element.reference_nodes[element.faces[0][element.face_corners]]
        # One edge of the square is one corner of a triangle.
        corners = corners if len(corners) == 4 else corners[[0, 0, 1, 2]]
        line = np.linspace(0.0, 1.0, _DEGREE + 1)
        u, v = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
        places = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1) @ corners
        values = element.shape_functions(places)[0][:, element.faces[0]]
        self.lattice = np.einsum("qn,mni->mqi", values, nodes)
        powers = np.linalg.inv(np.vander(line, increasing=True))
        self._factors = np.einsum("ai,bj,mijd->mabd", powers, powers,
                                  self.lattice.reshape(-1, _DEGREE + 1, _DEGREE + 1, 3))

    def at(self, sides: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Points of some sides, m, shape (k, q, 3).

        Args:
            sides: which, shape (k,).
            places: on the squares, shape (k, q, 2).
        """
        powers = places[..., None] ** np.arange(_DEGREE + 1)
        return np.einsum("kqa,kqb,kabd->kqd", powers[:, :, 0], powers[:, :, 1], self._factors[sides], optimize=True)
