"""What a file of a mesh holds, whatever its format."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

#: Corners of the sides of a tetrahedron and a hexahedron, in the order of VTK, counter-clockwise from outside; by the
#: numbers that Abaqus gives them.
SIDES = {"tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
         "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (0, 4, 7, 3))}
#: Nodes of each kind of element, by meshio's names.
SOLIDS = {"tetra": 4, "tetra10": 10, "hexahedron": 8, "hexahedron20": 20, "hexahedron27": 27}
FACES = {"triangle": 3, "triangle6": 6, "triangle7": 7, "quad": 4, "quad8": 8, "quad9": 9}
#: What else fills a volume, and is refused.
OTHER_SOLIDS = ("wedge", "pyramid", "tetra", "hexahedron", "voxel", "polyhedron")


class Cells(NamedTuple):
    """Elements of one kind.

    Attributes:
        kind: meshio's name: ``tetra10``. nodes: places in the file's points, in the order of VTK, shape (m, nodes).
        numbers: of the elements in the file, shape (m,).
    """

    kind: str
    nodes: np.ndarray
    numbers: np.ndarray

    @property
    def shape(self) -> str:
        """``tetra`` or ``hexahedron``, of a solid."""
        return self.kind.rstrip("0123456789")

    @property
    def corners(self) -> np.ndarray:
        """Of each element, in the order of VTK."""
        count = {"tetra": 4, "hexahedron": 8, "triangle": 3, "quad": 4}[self.shape]
        return self.nodes[:, :count]


@dataclass(frozen=True, eq=False)
class MeshContent:
    """The content of a file, in its own unit.

    Attributes:
        points: shape (n, 3). point_numbers: of the points in the file, shape (n,).
        cells: elements, a block for each kind in the order of the file.
        point_sets: name -> places of points.
        cell_sets: name -> for each block of `cells` the places of elements in it.
        side_sets: name -> (block of `cells`, place in it, number of the side from 0), shape (m, 3).
    """

    points: np.ndarray
    point_numbers: np.ndarray
    cells: list[Cells]
    point_sets: dict[str, np.ndarray] = field(default_factory=dict)
    cell_sets: dict[str, list[np.ndarray]] = field(default_factory=dict)
    side_sets: dict[str, np.ndarray] = field(default_factory=dict)
