"""Subdivide solid elements into tetrahedra and their faces into triangles, for figures and sections."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np

#: Compression of the nodes along their main diagonal before the Delaunay triangulation. The triangulation of a lattice
#: is then unique, and neighbours divide their common face in the same way (Freudenthal, Annals of Mathematics 43
#: (1942) 580).
_COMPRESSION = 0.5
#: Displacement of the nodes by the squares of their coordinates, which moves four nodes out of a common plane.
_SEPARATION = 1e-5 * np.array([[0.3, 0.7, -0.2], [0.5, -0.4, 0.9], [-0.8, 0.6, 0.1]])
#: Volume (area) below which a tetrahedron (triangle) is degenerate, as a fraction of the largest one.
_FLAT = 1e-9


class DivisibleElement(Protocol):
    """Properties of a solid element that the subdivision requires."""

    def __hash__(self) -> int:
        """Return a hash, under which the subdivision is cached."""

    @property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates of a convex body, shape (nodes, 3)."""

    @property
    def local_face_node_indices(self) -> np.ndarray:
        """Local node indices of each face, in the same order with outward orientation, shape (faces, face nodes)."""


@cache
def subdivide_into_tetrahedra(element: DivisibleElement) -> np.ndarray:
    """Subdivide an element into tetrahedra between its nodes.

    Returns:
        Local node indices in the element, shape (t, 4), read-only. Volumes are positive; a volume inside the reference
        element may be zero up to rounding if four nodes lie in a plane.
    """
    nodes = element.reference_nodes
    middle = _find_central_node(nodes)
    if middle is None:
        return _compute_conforming_tetrahedra(element)
    # From the central node to the triangles of all faces, so that neighbours divide their common face equally.
    triangles = element.local_face_node_indices[:, subdivide_face_into_triangles(element)].reshape(-1, 3)
    cells = np.column_stack([np.full(len(triangles), middle), triangles])
    edges = nodes[cells[:, 1:]] - nodes[cells[:, :1]]
    volumes = np.linalg.det(edges)
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [0, 2, 1, 3]]
    cells = cells[np.abs(volumes) > _FLAT * np.abs(volumes).max()]
    cells.flags.writeable = False
    return cells


@cache
def subdivide_face_into_triangles(element: DivisibleElement) -> np.ndarray:
    """Subdivide a face of an element into triangles between its nodes.

    Returns:
        Indices among the nodes of a row of `local_face_node_indices`, shape (k, 3), read-only; the normals point
        outwards.
    """
    nodes = element.reference_nodes[element.local_face_node_indices[0]]
    # Two coordinates are sufficient, because a reference face is plane.
    normal = np.abs(np.linalg.svd(nodes - nodes.mean(axis=0))[2][2])
    kept = np.delete(np.arange(3), int(np.argmax(normal)))
    middle = _find_central_node(nodes)
    if middle is None:
        triangles = _compute_delaunay_triangles(nodes[:, kept])
    else:
        # Triangles around the central node do not depend on the node at which the face of a neighbour begins.
        x, y = (nodes[:, kept] - nodes[middle, kept]).T
        around = np.argsort(np.arctan2(y, x))
        around = around[around != middle]
        triangles = np.column_stack([np.full(around.size, middle), around, np.roll(around, -1)])
    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    inwards = (normals * (nodes.mean(axis=0) - element.reference_nodes.mean(axis=0))).sum(axis=1) < 0.0
    triangles[inwards] = triangles[inwards][:, [0, 2, 1]]
    areas = np.linalg.norm(normals, axis=1)
    triangles = triangles[areas > _FLAT * areas.max()]
    triangles.flags.writeable = False
    return triangles


@cache
def find_outline_edges_of_face(element: DivisibleElement) -> np.ndarray:
    """Return the outline edges of a face, shape (k, 2), read-only.

    The entries are indices among the nodes of a row of `SolidElement.local_face_node_indices`.
    """
    triangles = subdivide_face_into_triangles(element)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    different, times = np.unique(edges, axis=0, return_counts=True)
    around: np.ndarray = different[times == 1]
    around.flags.writeable = False
    return around


def triangulate_surface_faces(element: DivisibleElement, sides: np.ndarray) -> np.ndarray:
    """Subdivide faces of elements into triangles with outward normals.

    Args:
        element: element type.
        sides: node numbers of the faces in the order of the element, shape (m, nodes of a face).

    Returns:
        Node numbers, shape (m k, 3); the triangles of a face are successive.
    """
    return np.take(sides, subdivide_face_into_triangles(element), axis=1).reshape(-1, 3)


def _compute_conforming_tetrahedra(element: DivisibleElement) -> np.ndarray:
    """Return the Delaunay tetrahedra of an element without central node; read-only.

    Four nodes of one plane inside the element may form a tetrahedron without volume. In a deformed element it has a
    volume, and its neighbours would not meet without it. A small quadratic displacement of the nodes decides about its
    presence and orientation.
    """
    from scipy.spatial import Delaunay

    nodes = element.reference_nodes
    moved = _compress_along_diagonal(nodes) + nodes**2 @ _SEPARATION
    cells = np.array(Delaunay(moved).simplices, dtype=np.intp)
    on_face = np.zeros((len(element.local_face_node_indices), len(nodes)), dtype=bool)
    np.put_along_axis(on_face, element.local_face_node_indices, True, axis=1)
    cells = cells[~on_face[:, cells].all(axis=2).any(axis=0)]
    inverted = np.linalg.det(moved[cells[:, 1:]] - moved[cells[:, :1]]) < 0.0
    cells[inverted] = cells[inverted][:, [0, 2, 1, 3]]
    cells.flags.writeable = False
    return cells


def _find_central_node(nodes: np.ndarray) -> int | None:
    """Return the index of a node at the centroid of all nodes, or None."""
    distance = np.linalg.norm(nodes - nodes.mean(axis=0), axis=1)
    nearest = int(np.argmin(distance))
    return nearest if distance[nearest] < 0.1 * distance.max() else None


def _compute_delaunay_triangles(nodes: np.ndarray) -> np.ndarray:
    """Return the Delaunay triangles of nodes as node indices, in any orientation; unique for nodes on a lattice."""
    from scipy.spatial import Delaunay

    return np.array(Delaunay(_compress_along_diagonal(nodes)).simplices, dtype=np.intp)


def _compress_along_diagonal(nodes: np.ndarray) -> np.ndarray:
    return nodes - _COMPRESSION * nodes.mean(axis=1, keepdims=True)
