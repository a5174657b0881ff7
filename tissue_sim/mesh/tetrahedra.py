"""Mixed displacement-pressure tetrahedra of the solid.

Nodes stand in the order of VTK, Abaqus and CalculiX: corners, then the middles of the edges 01, 12, 20, 03, 13, 23;
where there are more, the middles of the sides in the order of `Tetrahedron.faces`, then that of the element.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations

import numpy as np

from tissue_sim.mesh.solid_element import SolidElement

_EDGES = np.array([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])
#: Corners of each side, counter-clockwise from outside.
_SIDES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
#: Rules as orbits: barycentric coordinates of a point, and the weight of each of its permutations, as a share of the
#: volume. Degree 2 with four points (Hammer, Marlowe and Stroud, Math. Tables Aids Comput. 10 (1956) 130); degree 5
#: with 14 (Walkington, Quadrature on simplices of arbitrary dimension, CMU 2000).
_DEGREE_2 = (((0.5854101966249685, *3 * (0.1381966011250105,)), 0.25),)
_DEGREE_5 = (((*3 * (0.31088591926330060980,), 0.06734224221009817060), 0.11268792571801585080),
             ((*3 * (0.092735250310891226402,), 0.72179424906732632079), 0.073493043116361949544),
             ((*2 * (0.045503704125649649492,), *2 * (0.45449629587435035051,)), 0.042546020777081466438))


@dataclass(frozen=True)
class Tetrahedron(SolidElement):
    """A tetrahedron of quadratic polynomials; reference coordinates are the shares of the corners 1, 2 and 3.

    Attributes:
        bubbles: whether a cubic polynomial for each side and a quartic one for the interior are added.
    """

    bubbles: bool = False

    @cached_property
    def _barycentric(self) -> np.ndarray:
        """Of the nodes, shape (nodes, 4)."""
        corners = np.eye(4)
        places = [corners, corners[_EDGES].mean(axis=1)]
        if self.bubbles:
            places += [corners[_SIDES].mean(axis=1), np.full((1, 4), 0.25)]
        return np.concatenate(places)

    @cached_property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates, shape (nodes, 3)."""
        return self._barycentric[:, 1:]

    @cached_property
    def corners(self) -> np.ndarray:
        return np.arange(4)

    @cached_property
    def faces(self) -> np.ndarray:
        """See `SolidElement.faces`: corners, then the middles of the edges from each to the next, then the middle."""
        number = {frozenset(edge): 4 + place for place, edge in enumerate(_EDGES.tolist())}
        return np.array([[*side, *(number[frozenset((side[i], side[(i + 1) % 3]))] for i in range(3)),
                          *([10 + place] if self.bubbles else [])] for place, side in enumerate(_SIDES.tolist())])

    @cached_property
    def face_corners(self) -> np.ndarray:
        return np.arange(3)

    @cached_property
    def face_shares(self) -> np.ndarray:
        """The integrals of the shape functions; without bubbles those of the corners vanish, and shares are those of
        the four triangles between the nodes."""
        if self.bubbles:
            return np.repeat([1 / 20, 2 / 15, 9 / 20], [3, 3, 1])
        return np.repeat([1 / 12, 1 / 4], 3)

    @cached_property
    def face_triangles(self) -> np.ndarray:
        if self.bubbles:
            ring = [0, 3, 1, 4, 2, 5]
            return np.array([(ring[i], ring[(i + 1) % 6], 6) for i in range(6)])
        return np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Points and weights; with bubbles exact for their divergence times a linear pressure, else for the stress of
        small deformations."""
        orbits = _DEGREE_5 if self.bubbles else _DEGREE_2
        places = [(place, weight / 6.0) for first, weight in orbits for place in sorted(set(permutations(first)))]
        return np.array([place[1:] for place, _ in places]), np.array([weight for _, weight in places])

    @cached_property
    def from_quadrature(self) -> np.ndarray:
        """See `SolidElement.from_quadrature`: of a quadratic polynomial near 14 points, a linear one through four."""
        points, _ = self.quadrature

        def powers(places: np.ndarray) -> np.ndarray:
            shares = _shares(places)
            return shares if len(points) < 10 else _quadratic(shares)

        return powers(self.reference_nodes) @ np.linalg.pinv(powers(points))

    def shape_functions(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (q, nodes) and reference gradients (q, nodes, 3) at reference points (q, 3)."""
        shares = _shares(points)
        # By each share as if the four were independent, then along the reference coordinates.
        slopes = self._slopes(shares)
        values = self._functions(shares) @ self._from_nodes
        return values, np.einsum("qmk,mn->qnk", slopes[..., 1:] - slopes[..., :1], self._from_nodes)

    def corner_functions(self, points: np.ndarray) -> np.ndarray:
        """The shares of the corners."""
        return _shares(points)

    @cached_property
    def _from_nodes(self) -> np.ndarray:
        """Coefficients of the shape functions in `_functions`, shape (nodes, nodes)."""
        return np.linalg.inv(self._functions(self._barycentric))

    def _factors(self) -> list[tuple[int, ...]]:
        """Of each polynomial of the basis the corners whose shares are multiplied."""
        factors = [(i, i) for i in range(4)] + [tuple(edge) for edge in _EDGES.tolist()]
        return factors + [tuple(side) for side in _SIDES.tolist()] + [(0, 1, 2, 3)] if self.bubbles else factors

    def _functions(self, shares: np.ndarray) -> np.ndarray:
        return np.stack([shares[:, list(factors)].prod(axis=1) for factors in self._factors()], axis=-1)

    def _slopes(self, shares: np.ndarray) -> np.ndarray:
        slopes = np.zeros((len(shares), self.nodes, 4))
        for number, factors in enumerate(self._factors()):
            for place, corner in enumerate(factors):
                others = [*factors[:place], *factors[place + 1:]]
                slopes[:, number, corner] += shares[:, others].prod(axis=1)
        return slopes


def _shares(points: np.ndarray) -> np.ndarray:
    """Of the four corners at reference points, shape (q, 4)."""
    return np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)


def _quadratic(shares: np.ndarray) -> np.ndarray:
    """Ten products that span the quadratic polynomials, shape (q, 10)."""
    return np.stack([shares[:, i] * shares[:, k] for i in range(4) for k in range(i + 1)], axis=-1)


#: Quadratic with bubbles of sides and interior and four discontinuous pressures: for truth (Crouzeix and Raviart,
#: R.A.I.R.O. 7 (1973) 33; Boffi, Brezzi and Fortin, Mixed Finite Element Methods and Applications, 2013, section 8.7).
TET15P1 = Tetrahedron("T15/P-1", order=2, pressure_modes=4, bubbles=True)
#: Ten nodes with one pressure, which is mean dilatation: for speed.
TET10P0 = Tetrahedron("T10/P0", order=2, pressure_modes=1)
