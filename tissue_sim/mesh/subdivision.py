"""Elements in space as tetrahedra, and their sides as triangles, between their nodes: for pictures and sections."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np

#: Nodes are pressed together along their main diagonal by this share before they are divided: then no choice is left
#: for those on a lattice, and neighbours on one lattice divide their common side alike (Freudenthal, Annals of
#: Mathematics 43 (1942) 580).
_PRESSED = 0.5
#: Volumes (areas) below this share of the largest one are none.
_FLAT = 1e-9


class DivisibleElement(Protocol):
    """What is asked of an element in space."""

    def __hash__(self) -> int:
        """It is divided once."""

    @property
    def reference_nodes(self) -> np.ndarray:
        """Reference coordinates, of a convex body, shape (nodes, 3)."""

    @property
    def faces(self) -> np.ndarray:
        """Nodes of each side, all numbered by one pattern that turns outwards, shape (sides, nodes of a side)."""


@cache
def tetrahedra(element: DivisibleElement) -> np.ndarray:
    """An element as tetrahedra between its nodes.

    Returns:
        Numbers of the element's nodes, shape (t, 4), read-only; each tetrahedron has a positive volume.
    """
    places = element.reference_nodes
    middle = _middle(places)
    if middle is None:
        cells = _divided(places)
    else:
        # From a node inside to the triangles of all sides, so that neighbours divide their common side alike.
        triangles = element.faces[:, side_triangles(element)].reshape(-1, 3)
        cells = np.column_stack([np.full(len(triangles), middle), triangles])
    edges = places[cells[:, 1:]] - places[cells[:, :1]]
    volumes = np.linalg.det(edges)
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [0, 2, 1, 3]]
    cells = cells[np.abs(volumes) > _FLAT * np.abs(volumes).max()]
    cells.flags.writeable = False
    return cells


@cache
def side_triangles(element: DivisibleElement) -> np.ndarray:
    """A side of an element as triangles between its nodes.

    Returns:
        Numbers among the nodes of a row of `faces`, shape (k, 3), read-only; their normals point outwards.
    """
    places = element.reference_nodes[element.faces[0]]
    # Two coordinates are enough: a side lies in a plane.
    normal = np.abs(np.linalg.svd(places - places.mean(axis=0))[2][2])
    kept = np.delete(np.arange(3), int(np.argmax(normal)))
    middle = _middle(places)
    if middle is None:
        triangles = _divided(places[:, kept])
    else:
        # Round a node inside: whatever the side of the neighbour begins with, it has the same ones.
        x, y = (places[:, kept] - places[middle, kept]).T
        around = np.argsort(np.arctan2(y, x))
        around = around[around != middle]
        triangles = np.column_stack([np.full(around.size, middle), around, np.roll(around, -1)])
    a, b, c = np.moveaxis(places[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    inwards = (normals * (places.mean(axis=0) - element.reference_nodes.mean(axis=0))).sum(axis=1) < 0.0
    triangles[inwards] = triangles[inwards][:, [0, 2, 1]]
    areas = np.linalg.norm(normals, axis=1)
    triangles = triangles[areas > _FLAT * areas.max()]
    triangles.flags.writeable = False
    return triangles


@cache
def side_edges(element: DivisibleElement) -> np.ndarray:
    """The lines around a side of an element, numbers among the nodes of a row of `faces`, shape (k, 2), read-only."""
    triangles = side_triangles(element)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    different, times = np.unique(edges, axis=0, return_counts=True)
    around: np.ndarray = different[times == 1]
    around.flags.writeable = False
    return around


def surface_triangles(element: DivisibleElement, sides: np.ndarray) -> np.ndarray:
    """Sides of elements as triangles, normals outwards.

    Args:
        element: their type.
        sides: node numbers by its pattern, shape (m, nodes of a side).

    Returns:
        Node numbers, shape (m k, 3), the triangles of a side behind each other.
    """
    return np.take(sides, side_triangles(element), axis=1).reshape(-1, 3)


def _middle(places: np.ndarray) -> int | None:
    """Number of the node that stands in the middle of others, if one does."""
    away = np.linalg.norm(places - places.mean(axis=0), axis=1)
    best = int(np.argmin(away))
    return best if away[best] < 0.1 * away.max() else None


def _divided(places: np.ndarray) -> np.ndarray:
    from scipy.spatial import Delaunay

    pressed = places - _PRESSED * places.mean(axis=1, keepdims=True)
    return np.array(Delaunay(pressed).simplices, dtype=np.intp)
