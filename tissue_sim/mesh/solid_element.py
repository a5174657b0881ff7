"""What an element of the solid is to the solver: shape functions, quadrature, sides."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class SolidElement(ABC):
    """An element with discontinuous pressures.

    Attributes:
        name: as the field writes it.
        order: polynomial order of its displacements, 1 or 2.
        pressure_modes: 1 (constant) or 4 (linear), discontinuous.
    """

    name: str
    order: int
    pressure_modes: int

    @property
    def nodes(self) -> int:
        """Of an element."""
        return len(self.reference_nodes)

    @property
    @abstractmethod
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates, shape (nodes, 3)."""

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """Numbers of the nodes that are vertices."""

    @property
    @abstractmethod
    def faces(self) -> np.ndarray:
        """Nodes of each side, shape (sides, nodes of a side); corners go round counter-clockwise from outside."""

    @property
    @abstractmethod
    def face_corners(self) -> np.ndarray:
        """Places of the corners among the nodes of a side, going round it."""

    @property
    @abstractmethod
    def face_middles(self) -> np.ndarray:
        """Places of the middles of a side's edges among its nodes, from each of the `face_corners` to the next; none of
        elements whose edges are straight."""

    @property
    @abstractmethod
    def face_shares(self) -> np.ndarray:
        """Share of a side's area that each of its nodes stands for, all positive, shape (nodes of a side,)."""

    @property
    @abstractmethod
    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (q, 3) and weights (q,)."""

    @property
    @abstractmethod
    def from_quadrature(self) -> np.ndarray:
        """Weights of the quadrature points in the nodes, of a polynomial through or near them, shape (nodes, q)."""

    @abstractmethod
    def shape_functions(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (q, nodes) and reference gradients (q, nodes, 3) at reference points (q, 3)."""

    @abstractmethod
    def corner_functions(self, points: np.ndarray) -> np.ndarray:
        """Values (q, corners) of the functions of lowest order, one for each corner."""

    @cached_property
    def corner_shares(self) -> np.ndarray:
        """Of the corners in the place of each node, shape (nodes, corners)."""
        return self.corner_functions(self.reference_nodes)
