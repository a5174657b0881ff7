"""Mixed displacement-pressure quadrilaterals of the axisymmetric solid.

Nodes shared with neighbours come first. An interior node comes last and is condensed, like the discontinuous pressure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.registry import Registry


def evaluate_equidistant_lagrange_and_slopes(x: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the one-dimensional Lagrange polynomials with order + 1 evenly spaced nodes in [-1, 1].

    Args:
        x: positions, shape (q,).
        order: polynomial order.

    Returns:
        Values and derivatives, each of shape (q, order + 1).
    """
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
class QuadrilateralElement:
    """Quadrilateral element type with tensor-product Lagrange polynomials.

    An element with other shape functions derives from this class and replaces `node_count`, `reference_nodes`,
    `evaluate_shape_functions_and_gradients` and, if needed, the quadrature. Each edge has order + 1 nodes, evenly
    spaced in the reference coordinates. `ELEMENTS` contains the element types by name.

    Attributes:
        name: name in the notation of the literature, such as ``Q9/P-1``.
        order: polynomial order in each direction, 1 or 2.
        pressure_modes: number of pressure modes, 1 (constant) or 3 (linear), discontinuous.
        boundary_nodes: number of nodes shared with neighbours.
    """

    name: str
    order: int
    pressure_modes: int
    boundary_nodes: int

    @property
    def node_count(self) -> int:
        """Number of nodes of the element."""
        return (self.order + 1) ** 2

    @cached_property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates in [-1, 1]^2, shape (nodes, 2): corners, then mid-sides, then the centre."""
        corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        if self.order == 1:
            return np.array(corners, dtype=float)
        return np.array([*corners, (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)], dtype=float)

    @property
    def local_edge_node_indices(self) -> tuple[tuple[int, ...], ...]:
        """Local node indices along each edge, in order; the first and the last index are the ends of the edge."""
        if self.order == 1:
            return (0, 1), (1, 2), (2, 3), (3, 0)
        return (0, 4, 1), (1, 5, 2), (2, 6, 3), (3, 7, 0)

    @cached_property
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss points, shape (q, 2), and weights, shape (q,), with order + 1 points in each direction."""
        x, w = leggauss(self.order + 1)
        points = np.array([(a, b) for b in x for a in x])
        return points, np.array([v * u for u in w for v in w])

    @cached_property
    def quadrature_extrapolation_matrix(self) -> np.ndarray:
        """Matrix that extrapolates values at the quadrature points to the nodes, shape (nodes, q); least squares."""
        shapes, _ = self.evaluate_shape_functions_and_gradients(self.quadrature[0])
        return np.linalg.inv(shapes) if shapes.shape[0] == shapes.shape[1] else np.linalg.pinv(shapes)

    def evaluate_shape_functions_and_gradients(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (q, nodes) and reference gradients (q, nodes, 2) at reference points (q, 2)."""
        (vx, sx), (vy,
                   sy) = (evaluate_equidistant_lagrange_and_slopes(points[:, axis], self.order) for axis in range(2))
        indices = np.rint((self.reference_nodes + 1.0) * 0.5 * self.order).astype(int)
        i, j = indices[:, 0], indices[:, 1]
        return vx[:, i] * vy[:, j], np.stack([sx[:, i] * vy[:, j], vx[:, i] * sy[:, j]], axis=-1)


#: Nine-node quadrilateral with three discontinuous pressures, the standard element (Bathe, Finite Element Procedures,
#: 2014, section 4.4.3).
Q9P1 = QuadrilateralElement("Q9/P-1", order=2, pressure_modes=3, boundary_nodes=8)
#: Four-node quadrilateral with one pressure (mean dilatation), for verification and benchmarks.
Q4P0 = QuadrilateralElement("Q4/P0", order=1, pressure_modes=1, boundary_nodes=4)
#: Largest number of nodes, and of quadrature points, for which the kernels reserve memory.
MAX_NODES = 9


def _fits_kernels(element: Any) -> bool:
    """Return whether the kernels of the axisymmetric solver can evaluate an element."""
    return (isinstance(element, QuadrilateralElement) and element.order in (1, 2) and element.pressure_modes in (1, 3)
            and max(element.node_count, element.quadrature[1].size) <= MAX_NODES
            and element.boundary_nodes in (element.node_count, element.node_count - 1))


#: Name -> element of the axisymmetric solver.
ELEMENTS: Registry[QuadrilateralElement] = Registry(
    "quadrilateral element", "tissue_sim.elements", {element.name: element for element in (Q9P1, Q4P0)},
    accepts=_fits_kernels,
    expected=f"a QuadrilateralElement of order 1 or 2 with at most {MAX_NODES} nodes and {MAX_NODES} quadrature "
             "points, 1 or 3 pressure modes, and at most one interior node")
