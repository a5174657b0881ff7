"""Mixed displacement-pressure quadrilaterals of the axisymmetric solid.

Nodes that neighbours share come first; an interior node comes last and is condensed, as is the discontinuous
pressure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import leggauss


def lagrange(x: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Values and slopes of the Lagrange polynomials through order + 1 even places in [-1, 1], shapes (q, order + 1), at
    places (q,)."""
    lines = np.linspace(-1.0, 1.0, order + 1)
    values = np.ones((x.size, lines.size))
    slopes = np.zeros_like(values)
    for i, own in enumerate(lines):
        others = np.delete(lines, i)
        values[:, i] = np.prod([(x - o) / (own - o) for o in others], axis=0)
        slopes[:, i] = sum(np.prod([(x - o) for o in np.delete(others, k)], axis=0)
                           for k in range(others.size)) / np.prod(own - others)
    return values, slopes


@dataclass(frozen=True)
class Element:
    """A quadrilateral of tensor-product Lagrange polynomials.

    Attributes:
        name: as the field writes it.
        order: polynomial order in each direction, 1 or 2.
        pressure_modes: 1 (constant) or 3 (linear, discontinuous).
        boundary_nodes: nodes that neighbours share.
    """

    name: str
    order: int
    pressure_modes: int
    boundary_nodes: int

    @property
    def nodes(self) -> int:
        return (self.order + 1) ** 2

    @cached_property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates in [-1, 1]^2, shape (nodes, 2): corners, then mid-sides, then the centre."""
        corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        if self.order == 1:
            return np.array(corners, dtype=float)
        return np.array([*corners, (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)], dtype=float)

    @property
    def edges(self) -> tuple[tuple[int, ...], ...]:
        """Nodes of each side in order, the ends outside."""
        if self.order == 1:
            return (0, 1), (1, 2), (2, 3), (3, 0)
        return (0, 4, 1), (1, 5, 2), (2, 6, 3), (3, 7, 0)

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss points (q, 2) and weights (q,), order + 1 in each direction."""
        x, w = leggauss(self.order + 1)
        points = np.array([(a, b) for b in x for a in x])
        return points, np.array([v * u for u in w for v in w])

    @cached_property
    def from_quadrature(self) -> np.ndarray:
        """Weights of the quadrature points in the nodes, of the polynomial through them, shape (nodes, q)."""
        shapes, _ = self.shape_functions(self.quadrature[0])
        return np.linalg.inv(shapes)

    def shape_functions(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (q, nodes) and reference gradients (q, nodes, 2) at reference points (q, 2)."""
        (vx, sx), (vy, sy) = (lagrange(points[:, axis], self.order) for axis in range(2))
        where = np.rint((self.reference_nodes + 1.0) * 0.5 * self.order).astype(int)
        i, j = where[:, 0], where[:, 1]
        return vx[:, i] * vy[:, j], np.stack([sx[:, i] * vy[:, j], vx[:, i] * sy[:, j]], axis=-1)


#: Nine-node quad with three discontinuous pressures: the element of the program (Bathe, Finite Element Procedures,
#: 2014, section 4.4.3).
Q9P1 = Element("Q9/P-1", order=2, pressure_modes=3, boundary_nodes=8)
#: Four-node quad with one pressure, which is mean dilatation: oracle and benchmark peer.
Q4P0 = Element("Q4/P0", order=1, pressure_modes=1, boundary_nodes=4)
ELEMENTS = {element.name: element for element in (Q9P1, Q4P0)}
