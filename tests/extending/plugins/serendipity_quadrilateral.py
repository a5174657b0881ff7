"""An element of the axisymmetric solver in one file: the eight-node quadrilateral with one pressure.

Quadratic serendipity displacements and a constant pressure (Bathe, Finite Element Procedures, 2014, section 4.4.3, the
8/1 element).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tissue_sim.mesh.elements import QuadrilateralElement


@dataclass(frozen=True)
class SerendipityQuadrilateral(QuadrilateralElement):
    """Quadrilateral with nodes at the corners and at the middle of the edges; no node is inside the element."""

    @property
    def node_count(self):
        return 8

    @cached_property
    def reference_nodes(self):
        return super().reference_nodes[:8]

    def evaluate_shape_functions_and_gradients(self, points):
        x, y = points[:, :1], points[:, 1:]
        a, b = self.reference_nodes.T
        u, v = 1.0 + a * x, 1.0 + b * y
        values, slopes = np.empty((len(points), 8)), np.empty((len(points), 8, 2))
        corner, on_x, on_y = a * b != 0.0, a == 0.0, b == 0.0
        values[:, corner] = (0.25 * u * v * (a * x + b * y - 1.0))[:, corner]
        slopes[:, corner, 0] = (0.25 * a * v * (2.0 * a * x + b * y))[:, corner]
        slopes[:, corner, 1] = (0.25 * b * u * (a * x + 2.0 * b * y))[:, corner]
        values[:, on_x] = (0.5 * (1.0 - x**2) * v)[:, on_x]
        slopes[:, on_x, 0] = (-x * v)[:, on_x]
        slopes[:, on_x, 1] = (0.5 * (1.0 - x**2) * b)[:, on_x]
        values[:, on_y] = (0.5 * (1.0 - y**2) * u)[:, on_y]
        slopes[:, on_y, 0] = (0.5 * (1.0 - y**2) * a)[:, on_y]
        slopes[:, on_y, 1] = (-y * u)[:, on_y]
        return values, slopes


Q8P0 = SerendipityQuadrilateral("Q8/P0", order=2, pressure_modes=1, boundary_nodes=8)
