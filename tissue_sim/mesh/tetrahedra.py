"""Mixed displacement-pressure tetrahedra of the solid.

Nodes stand in the order of VTK, Abaqus and CalculiX: corners, then the middles of the edges 01, 12, 20, 03, 13, 23,
where there are any; then the middles of the sides in the order of `Tetrahedron.faces`, then that of the element.

A node in the middle of each side lets the volume of the elements beside it change apart from everything else, which is
what pressures that are constant in an element need so that they neither lock nor oscillate. Ten nodes with one pressure
have none, and their pressures oscillate: docs/tetrahedra.md has the numbers.
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
#: A rule of degree 5 with 14 points (Walkington, Quadrature on simplices of arbitrary dimension, CMU 2000): barycentric
#: coordinates of a point, and the weight of each of its permutations as a share of the volume.
_DEGREE_5 = (((*3 * (0.31088591926330060980,), 0.06734224221009817060), 0.11268792571801585080),
             ((*3 * (0.092735250310891226402,), 0.72179424906732632079), 0.073493043116361949544),
             ((*2 * (0.045503704125649649492,), *2 * (0.45449629587435035051,)), 0.042546020777081466438))


@dataclass(frozen=True)
class Tetrahedron(SolidElement):
    """A tetrahedron of linear or quadratic polynomials, enriched with a cubic one for each side, and the quadratic one
    with a quartic one for the interior; reference coordinates are the shares of the corners 1, 2 and 3."""

    @cached_property
    def _barycentric(self) -> np.ndarray:
        """Of the nodes, shape (nodes, 4)."""
        corners = np.eye(4)
        if self.order == 1:
            return np.concatenate([corners, corners[_SIDES].mean(axis=1)])
        return np.concatenate([corners, corners[_EDGES].mean(axis=1), corners[_SIDES].mean(axis=1),
                               np.full((1, 4), 0.25)])

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
        if self.order == 1:
            return np.column_stack([_SIDES, np.arange(4, 8)])
        number = {frozenset(edge): 4 + place for place, edge in enumerate(_EDGES.tolist())}
        edges = [[number[frozenset((side[i], side[(i + 1) % 3]))] for i in range(3)] for side in _SIDES.tolist()]
        return np.column_stack([_SIDES, edges, np.arange(10, 14)])

    @cached_property
    def face_corners(self) -> np.ndarray:
        return np.arange(3)

    @cached_property
    def face_middles(self) -> np.ndarray:
        return np.arange(3, 6) if self.order == 2 else np.zeros(0, dtype=np.intp)

    @cached_property
    def face_shares(self) -> np.ndarray:
        """The integrals of the shape functions; all positive, which those of six nodes are not."""
        return np.repeat(*((11 / 60, 9 / 20), (3, 1)) if self.order == 1 else ((1 / 20, 2 / 15, 9 / 20), (3, 3, 1)))

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Points and weights, exact for the divergence of all displacements times all pressures of a straight element,
        of degree 2 or 4. With four points, enough for small deformations of the linear one, its bubbles lose their
        stability under pressures."""
        places = [(place, weight / 6.0) for first, weight in _DEGREE_5 for place in sorted(set(permutations(first)))]
        return np.array([place[1:] for place, _ in places]), np.array([weight for _, weight in places])

    @cached_property
    def from_quadrature(self) -> np.ndarray:
        """See `SolidElement.from_quadrature`: of the polynomial of the element's order nearest to the points."""
        powers = _shares if self.order == 1 else _quadratic
        return powers(self.reference_nodes) @ np.linalg.pinv(powers(self.quadrature[0]))

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

    @cached_property
    def _factors(self) -> list[tuple[int, ...]]:
        """Of each polynomial of the basis the corners whose shares are multiplied."""
        sides = [tuple(side) for side in _SIDES.tolist()]
        if self.order == 1:
            return [*((i,) for i in range(4)), *sides]
        return [*((i, i) for i in range(4)), *(tuple(edge) for edge in _EDGES.tolist()), *sides, (0, 1, 2, 3)]

    def _functions(self, shares: np.ndarray) -> np.ndarray:
        return np.stack([shares[:, list(factors)].prod(axis=1) for factors in self._factors], axis=-1)

    def _slopes(self, shares: np.ndarray) -> np.ndarray:
        slopes = np.zeros((len(shares), self.nodes, 4))
        for number, factors in enumerate(self._factors):
            for place, corner in enumerate(factors):
                others = [*factors[:place], *factors[place + 1:]]
                slopes[:, number, corner] += shares[:, others].prod(axis=1)
        return slopes


def _shares(points: np.ndarray) -> np.ndarray:
    """Of the four corners at reference points, shape (q, 4)."""
    return np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)


def _quadratic(points: np.ndarray) -> np.ndarray:
    """Ten products that span the quadratic polynomials, at reference points, shape (q, 10)."""
    shares = _shares(points)
    return np.stack([shares[:, i] * shares[:, k] for i in range(4) for k in range(i + 1)], axis=-1)


def ten_node_functions(points: np.ndarray) -> np.ndarray:
    """Shape functions of the plain quadratic tetrahedron, in which files have them, at reference points, (q, 10)."""
    shares = _shares(points)
    return np.concatenate([shares * (2.0 * shares - 1.0), 4.0 * shares[:, _EDGES].prod(axis=-1)], axis=1)


#: Quadratic with bubbles and four discontinuous pressures: for truth (Crouzeix and Raviart, R.A.I.R.O. 7 (1973) 33;
#: Boffi, Brezzi and Fortin, Mixed Finite Element Methods and Applications, 2013, chapter 8).
TET15P1 = Tetrahedron("T15/P-1", order=2, pressure_modes=4)
#: Linear with bubbles of the sides and one pressure: for speed (Bernardi and Raugel, Math. Comput. 44 (1985) 71).
TET8P0 = Tetrahedron("T8/P0", order=1, pressure_modes=1)
