"""Mixed displacement-pressure elements of the solid: interface, hexahedra and tetrahedra.

Nodes of tetrahedra are in the order of VTK, Abaqus and CalculiX: corners, then the midpoints of the edges 01, 12, 20,
03, 13, 23 (quadratic elements), then the centres of the faces in the order of `Tetrahedron.local_face_node_indices`,
then the centre of the element.

A node at the centre of each face (bubble function) changes the volume of the adjacent elements independently of other
nodes. Elements with constant pressure need this for inf-sup stability; without it they lock or their pressures
oscillate, as with ten nodes and one pressure. Numbers are in docs/tetrahedra.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.mesh.elements import evaluate_equidistant_lagrange_and_slopes

#: Largest number of nodes, and of quadrature points, for which the kernels reserve memory.
MAX_NODES = 27


@dataclass(frozen=True)
class SolidElement(ABC):
    """Solid element with discontinuous pressures; `tissue_sim.mesh.solid.SOLID_ELEMENTS` contains them by name.

    All faces of an element have the same number of nodes. On a face, the displacement depends on the nodes of that face
    only, so that neighbours are continuous.

    Attributes:
        name: name in the notation of the literature, such as ``H27/P-1``.
        order: polynomial order of the displacements, 1 or 2.
        pressure_modes: number of pressure modes, 1 (constant) or 4 (linear), discontinuous.
    """

    name: str
    order: int
    pressure_modes: int

    @property
    def node_count(self) -> int:
        """Number of nodes of the element."""
        return len(self.reference_nodes)

    @property
    @abstractmethod
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates, shape (nodes, 3)."""

    @property
    @abstractmethod
    def local_corner_indices(self) -> np.ndarray:
        """Local indices in the element of the nodes that are vertices, shape (corners,)."""

    @property
    @abstractmethod
    def local_face_node_indices(self) -> np.ndarray:
        """Local node indices of each face, shape (faces, nodes of a face); corners counter-clockwise from outside."""

    @property
    @abstractmethod
    def corner_indices_within_face(self) -> np.ndarray:
        """Indices of the corners among the nodes of one face, in circumferential order, shape (corners of a face,)."""

    @property
    @abstractmethod
    def edge_midpoint_indices_within_face(self) -> np.ndarray:
        """Indices of the edge midpoints among the nodes of a face.

        Each is the midpoint from a corner of `corner_indices_within_face` to the next. The array is empty for
        elements with straight edges.
        """

    @property
    @abstractmethod
    def face_area_fractions_by_node(self) -> np.ndarray:
        """Fraction of the area of a face that belongs to each of its nodes, positive, shape (nodes of a face,)."""

    @property
    @abstractmethod
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature points, shape (q, 3), and weights, shape (q,)."""

    @property
    @abstractmethod
    def quadrature_extrapolation_matrix(self) -> np.ndarray:
        """Matrix that extrapolates values at the quadrature points to the nodes, shape (nodes, q)."""

    @abstractmethod
    def evaluate_shape_functions_and_gradients(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (q, nodes) and reference gradients (q, nodes, 3) at reference points (q, 3)."""

    @abstractmethod
    def evaluate_corner_functions(self, points: np.ndarray) -> np.ndarray:
        """Return the values (q, corners) of the lowest-order shape functions, one for each corner."""

    @cached_property
    def corner_functions_at_nodes(self) -> np.ndarray:
        """Values of the corner functions at the nodes, shape (nodes, corners)."""
        return self.evaluate_corner_functions(self.reference_nodes)


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


#: Corners of each edge.
_EDGES = np.array([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])
#: Corners of each face, counter-clockwise viewed from outside.
_SIDES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
#: Quadrature rule of degree 5 with 14 points (Walkington, Quadrature on simplices of arbitrary dimension, CMU 2000):
#: barycentric coordinates of a point, and the weight of each of its permutations as a fraction of the volume.
_DEGREE_5 = (((*3 * (0.31088591926330060980,), 0.06734224221009817060), 0.11268792571801585080),
             ((*3 * (0.092735250310891226402,), 0.72179424906732632079), 0.073493043116361949544),
             ((*2 * (0.045503704125649649492,), *2 * (0.45449629587435035051,)), 0.042546020777081466438))


@dataclass(frozen=True)
class Tetrahedron(SolidElement):
    """Tetrahedron with linear or quadratic polynomials, enriched with bubble functions.

    Each face has a cubic bubble; the quadratic element also has a quartic bubble in the interior. The reference
    coordinates are the barycentric coordinates of the corners 1, 2 and 3.
    """

    @cached_property
    def _node_barycentric_coordinates(self) -> np.ndarray:
        """Barycentric coordinates of the nodes, shape (nodes, 4)."""
        corners = np.eye(4)
        if self.order == 1:
            return np.concatenate([corners, corners[_SIDES].mean(axis=1)])
        return np.concatenate([corners, corners[_EDGES].mean(axis=1), corners[_SIDES].mean(axis=1),
                               np.full((1, 4), 0.25)])

    @cached_property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates, shape (nodes, 3)."""
        return self._node_barycentric_coordinates[:, 1:]

    @cached_property
    def local_corner_indices(self) -> np.ndarray:
        """Local indices of the corner nodes in the element, shape (4,)."""
        return np.arange(4)

    @cached_property
    def local_face_node_indices(self) -> np.ndarray:
        """Local node indices of each face, (4, face nodes): corners, edge midpoints in the same order, centre."""
        if self.order == 1:
            return np.column_stack([_SIDES, np.arange(4, 8)])
        number = {frozenset(edge): 4 + index for index, edge in enumerate(_EDGES.tolist())}
        edges = [[number[frozenset((side[i], side[(i + 1) % 3]))] for i in range(3)] for side in _SIDES.tolist()]
        return np.column_stack([_SIDES, edges, np.arange(10, 14)])

    @cached_property
    def corner_indices_within_face(self) -> np.ndarray:
        """Indices of the corners among the nodes of a face, shape (3,)."""
        return np.arange(3)

    @cached_property
    def edge_midpoint_indices_within_face(self) -> np.ndarray:
        """Indices of the midpoints of the edges among the nodes of a face, shape (3,); empty for order 1."""
        return np.arange(3, 6) if self.order == 2 else np.zeros(0, dtype=np.intp)

    @cached_property
    def face_area_fractions_by_node(self) -> np.ndarray:
        """Fraction of the area of a face that belongs to each of its nodes, shape (nodes of a face,).

        The fractions are integrals of the shape functions; they are positive, unlike those of a six-node triangle.
        """
        return np.repeat(*((11 / 60, 9 / 20), (3, 1)) if self.order == 1 else ((1 / 20, 2 / 15, 9 / 20), (3, 3, 1)))

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature points, shape (14, 3), and weights, shape (14,).

        The rule integrates the product of divergence and pressure of a straight element exactly (degree 2 or 4). Four
        points would be sufficient for small deformations of the linear element, but its bubbles then become unstable
        under pressure.
        """
        points = [(point, weight / 6.0) for first, weight in _DEGREE_5 for point in sorted(set(permutations(first)))]
        return np.array([point[1:] for point, _ in points]), np.array([weight for _, weight in points])

    @cached_property
    def quadrature_extrapolation_matrix(self) -> np.ndarray:
        """Matrix that extrapolates values at the quadrature points to the nodes, shape (nodes, q).

        The values are fitted by a polynomial of the element's order (least squares).
        """
        powers = _barycentric_coordinates_of_reference_points if self.order == 1 else _evaluate_barycentric_products
        return powers(self.reference_nodes) @ np.linalg.pinv(powers(self.quadrature[0]))

    def evaluate_shape_functions_and_gradients(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (q, nodes) and reference gradients (q, nodes, 3) at reference points (q, 3)."""
        barycentric = _barycentric_coordinates_of_reference_points(points)
        # Derivatives by the four barycentric coordinates, taken as independent, then by the reference coordinates.
        slopes = self._differentiate_basis_by_barycentric(barycentric)
        values = self._evaluate_basis_polynomials(barycentric) @ self._shape_function_coefficients
        return values, np.einsum("qmk,mn->qnk", slopes[..., 1:] - slopes[..., :1], self._shape_function_coefficients)

    def evaluate_corner_functions(self, points: np.ndarray) -> np.ndarray:
        """Return the barycentric coordinates at reference points, shape (q, 4)."""
        return _barycentric_coordinates_of_reference_points(points)

    @cached_property
    def _shape_function_coefficients(self) -> np.ndarray:
        """Coefficients of the shape functions in the basis `_evaluate_basis_polynomials`, shape (nodes, nodes)."""
        return np.linalg.inv(self._evaluate_basis_polynomials(self._node_barycentric_coordinates))

    @cached_property
    def _basis_factor_indices(self) -> list[tuple[int, ...]]:
        """Indices of the barycentric coordinates whose product is each polynomial of the basis."""
        sides = [tuple(side) for side in _SIDES.tolist()]
        if self.order == 1:
            return [*((i,) for i in range(4)), *sides]
        return [*((i, i) for i in range(4)), *(tuple(edge) for edge in _EDGES.tolist()), *sides, (0, 1, 2, 3)]

    def _evaluate_basis_polynomials(self, barycentric: np.ndarray) -> np.ndarray:
        """Return the polynomials of the basis, shape (q, nodes)."""
        return np.stack([barycentric[:, list(factors)].prod(axis=1) for factors in self._basis_factor_indices], axis=-1)

    def _differentiate_basis_by_barycentric(self, barycentric: np.ndarray) -> np.ndarray:
        """Return the derivatives of the basis with respect to the barycentric coordinates, shape (q, nodes, 4)."""
        slopes = np.zeros((len(barycentric), self.node_count, 4))
        for number, factors in enumerate(self._basis_factor_indices):
            for index, corner in enumerate(factors):
                others = [*factors[:index], *factors[index + 1:]]
                slopes[:, number, corner] += barycentric[:, others].prod(axis=1)
        return slopes


def _barycentric_coordinates_of_reference_points(points: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates at reference points, shape (q, 4)."""
    return np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)


def _evaluate_barycentric_products(points: np.ndarray) -> np.ndarray:
    """Return ten products that span the quadratic polynomials at reference points, shape (q, 10)."""
    barycentric = _barycentric_coordinates_of_reference_points(points)
    return np.stack([barycentric[:, i] * barycentric[:, k] for i in range(4) for k in range(i + 1)], axis=-1)


def evaluate_ten_node_functions(points: np.ndarray) -> np.ndarray:
    """Return the shape functions of the ten-node tetrahedron of mesh files at reference points, shape (q, 10)."""
    barycentric = _barycentric_coordinates_of_reference_points(points)
    return np.concatenate([barycentric * (2.0 * barycentric - 1.0), 4.0 * barycentric[:, _EDGES].prod(axis=-1)],
                          axis=1)


#: Quadratic tetrahedron with bubbles and four discontinuous pressures, for accuracy (Crouzeix and Raviart, R.A.I.R.O. 7
#: (1973) 33; Boffi, Brezzi and Fortin, Mixed Finite Element Methods and Applications, 2013, chapter 8).
TET15P1 = Tetrahedron("T15/P-1", order=2, pressure_modes=4)
#: Linear tetrahedron with face bubbles and one pressure, for speed (Bernardi and Raugel, Math. Comput. 44 (1985) 71).
TET8P0 = Tetrahedron("T8/P0", order=1, pressure_modes=1)
