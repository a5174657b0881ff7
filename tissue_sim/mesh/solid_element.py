"""Interface of a solid element: shape functions, quadrature and faces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
