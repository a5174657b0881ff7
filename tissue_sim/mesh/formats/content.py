"""Content of a mesh file, independent of its format."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

#: Corners of the faces of a tetrahedron and a hexahedron: node order of VTK, counter-clockwise viewed from outside;
#: face order of Abaqus.
SIDES = {"tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
         "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (0, 4, 7, 3))}
#: Name of a volume element in meshio -> number of nodes.
SOLIDS = {"tetra": 4, "tetra10": 10, "hexahedron": 8, "hexahedron20": 20, "hexahedron27": 27}
#: Name of a surface element in meshio -> number of nodes.
FACES = {"triangle": 3, "triangle6": 6, "triangle7": 7, "quad": 4, "quad8": 8, "quad9": 9}
#: Prefixes of volume elements; those that are not in `SOLIDS` are rejected.
OTHER_SOLIDS = ("wedge", "pyramid", "tetra", "hexahedron", "voxel", "polyhedron")


class CellBlock(NamedTuple):
    """Elements of one kind in a mesh file.

    Attributes:
        kind: name in meshio, such as ``tetra10``.
        nodes: indices in the points of the file, in the order of VTK, shape (m, nodes).
        numbers: numbers of the elements in the file, shape (m,).
    """

    kind: str
    nodes: np.ndarray
    numbers: np.ndarray

    @property
    def cell_shape(self) -> str:
        """Shape of the elements, for volume elements ``tetra`` or ``hexahedron``."""
        return self.kind.rstrip("0123456789")

    @property
    def corner_nodes(self) -> np.ndarray:
        """Corners of each element in the order of VTK, shape (m, corners)."""
        count = {"tetra": 4, "hexahedron": 8, "triangle": 3, "quad": 4}[self.cell_shape]
        return self.nodes[:, :count]


@dataclass(frozen=True, eq=False)
class MeshContent:
    """Content of a mesh file in the unit of the file.

    Attributes:
        points: coordinates, shape (n, 3).
        point_numbers: numbers of the points in the file, shape (n,).
        cells: blocks of elements in the order of the file, each of one kind.
        point_sets: named sets of points as indices in `points`.
        cell_sets: named sets of elements as indices in each block of `cells`.
        side_sets: named sets of faces as rows (index of the block, index of the element in it, number of the face from
            0), shape (m, 3).
    """

    points: np.ndarray
    point_numbers: np.ndarray
    cells: list[CellBlock]
    point_sets: dict[str, np.ndarray] = field(default_factory=dict)
    cell_sets: dict[str, list[np.ndarray]] = field(default_factory=dict)
    side_sets: dict[str, np.ndarray] = field(default_factory=dict)
