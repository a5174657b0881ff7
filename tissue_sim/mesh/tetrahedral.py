"""Linear tetrahedra of a solid mesh, for programs that have no other elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.solid_element import Hexahedron


@dataclass(frozen=True, eq=False)
class TetrahedralMesh:
    """Mesh of linear tetrahedra.

    Attributes:
        nodes: coordinates, m, shape (n, 3).
        cells: node numbers, shape (m, 4); volumes are positive.
        sets: named node numbers; see `SolidMesh.sets`.
    """

    nodes: np.ndarray
    cells: np.ndarray
    sets: dict[str, np.ndarray]

    @property
    def surface(self) -> np.ndarray:
        """Numbers of the nodes of top and side."""
        return np.union1d(self.sets["top"], self.sets["side"])

    @property
    def volume(self) -> float:
        """Volume, m3."""
        corners = self.nodes[self.cells]
        return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum()) / 6.0


def make_tetrahedral_mesh(mesh: SolidMesh) -> TetrahedralMesh:
    """Return the linear tetrahedra between the corners of the elements of a mesh; other nodes are left out.

    A tetrahedron becomes one cell, a hexahedron six; see `cut_hexahedra_at_lowest_corners`.
    """
    corners = mesh.connectivity[:, mesh.element.local_corner_indices]
    if isinstance(mesh.element, Hexahedron):
        corners = np.take_along_axis(corners[:, None], cut_hexahedra_at_lowest_corners(mesh), axis=2).reshape(-1, 4)
    used, cells = np.unique(corners, return_inverse=True)
    sets = {name: np.flatnonzero(np.isin(used, numbers)) for name, numbers in mesh.sets.items()}
    return TetrahedralMesh(mesh.nodes[used], cells.reshape(-1, 4), sets)


def cut_hexahedra_at_lowest_corners(mesh: SolidMesh) -> np.ndarray:
    """Cut each hexahedron of a mesh into six tetrahedra, so that neighbours share faces.

    The corner with the lowest number is joined to the three faces that do not contain it. Each face is cut at its
    lowest corner (Dompierre et al., How to subdivide pyramids, prisms and hexahedra into tetrahedra, 8th International
    Meshing Roundtable, 1999).

    Returns:
        Indices of the corners of each element, shape (elements, 6, 4); volumes are positive.
    """
    element = mesh.element
    local = {node: index for index, node in enumerate(element.local_corner_indices.tolist())}
    sides = np.vectorize(local.get)(element.local_face_node_indices[:, element.corner_indices_within_face])
    cut = np.array([_cut_hexahedron(corners, sides) for corners in mesh.connectivity[:, element.local_corner_indices]])
    vertices = element.reference_nodes[element.local_corner_indices][cut]
    is_inverted = np.linalg.det(vertices[..., 1:, :] - vertices[..., :1, :]) < 0.0
    cut[is_inverted] = cut[is_inverted][:, [0, 2, 1, 3]]
    return cut


def _cut_hexahedron(corners: np.ndarray, sides: np.ndarray) -> list[list[int]]:
    """Return the six tetrahedra of a hexahedron as indices of its corners; `corners` are their node numbers."""
    lowest = int(np.argmin(corners))
    found = []
    for side in sides:
        if lowest not in side:
            a, b, c, d = np.roll(side, -int(np.argmin(corners[side]))).tolist()
            found += [[lowest, a, b, c], [lowest, a, c, d]]
    return found
