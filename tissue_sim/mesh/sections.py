"""Subdivide solid elements into tetrahedra and triangles, cut them by a level, and project surfaces vertically.

The scalar of a cut is, for example, the height above a plane. A node with the value zero counts as below, so that a
triangle in the surface belongs to one of its two neighbours only.
"""

from __future__ import annotations

from dataclasses import dataclass
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


#: Tolerance of equal heights, as a fraction of the height of the body.
_FLAT_TRIANGLE = 1e-6


class VerticalProjection:
    """Vertical projection of the top and of the surface of a body with plane faces.

    Args:
        points: corners, m, shape (n, 3).
        top: faces of the top as numbers of their corners in circumferential order, shape (m, corners).
        base: faces of the base.
        surface: all faces of the surface.

    Attributes:
        is_flat: whether top and base are horizontal planes and the base is the lower one.
    """

    def __init__(self, points: np.ndarray, top: np.ndarray, base: np.ndarray, surface: np.ndarray):
        slack = _FLAT_TRIANGLE * float(np.ptp(points[:, 2]))
        self.is_flat = bool(np.ptp(points[top, 2]) <= slack and points[base, 2].max() <= points[:, 2].min() + slack)
        self._points = points
        self._top, self._surface = (_split_into_triangles(sides) for sides in (top, surface))
        edges = np.stack([top, np.roll(top, -1, axis=1)], axis=-1).reshape(-1, 2)
        _, first, times = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
        self._rim = edges[first[times == 1]]

    def compute_distance_inside_top_rim(self, x: float, y: float) -> float:
        """Return the horizontal distance from (x, y), m, to the rim of the top, m; negative outside of the top."""
        a, b = self._points[self._rim[:, 0], :2], self._points[self._rim[:, 1], :2]
        position, edge = np.array([x, y]), b - a
        length2 = np.einsum("ei,ei->e", edge, edge)
        fraction = np.clip(np.einsum("ei,ei->e", position - a, edge) / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
        distance = float(np.linalg.norm(a + fraction[:, None] * edge - position, axis=1).min())
        return distance if self._find_crossing_heights(self._top, x, y).size else -distance

    def vertical_thickness(self, x: float, y: float) -> float:
        """Return the height difference of the extreme surface points on the vertical line at (x, y), m; 0 outside."""
        heights = self._find_crossing_heights(self._surface, x, y)
        return float(np.ptp(heights)) if heights.size else 0.0

    @property
    def outer_radius(self) -> float:
        """Largest horizontal distance of the surface from the axis x = y = 0, m."""
        return float(np.hypot(*self._points[np.unique(self._surface), :2].T).max())

    def _find_crossing_heights(self, triangles: np.ndarray, x: float, y: float) -> np.ndarray:
        """Return the heights at which a vertical line meets triangles, m."""
        corners = self._points[triangles]
        a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        is_projected = np.abs(area) > 0.0
        a, u, v, area = a[is_projected], u[is_projected], v[is_projected], area[is_projected]
        dx, dy = x - a[:, 0], y - a[:, 1]
        s, t = (dx * v[:, 1] - dy * v[:, 0]) / area, (u[:, 0] * dy - u[:, 1] * dx) / area
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1.0 + 1e-9)
        return (a[:, 2] + s * u[:, 2] + t * v[:, 2])[inside]


def _split_into_triangles(sides: np.ndarray) -> np.ndarray:
    """Return triangles, shape (k, 3), from faces with three or four corners."""
    return sides if sides.shape[1] == 3 else np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])


#: Number of nodes above -> corners of the section of a tetrahedron, as pairs of its nodes, the first one below. The
#: nodes are sorted, those below first; for a positive volume the normal of the section points upwards.
_CORNERS = {3: ((0, 1), (0, 2), (0, 3)), 1: ((0, 3), (1, 3), (2, 3)), 2: ((0, 2), (0, 3), (1, 3), (1, 2))}


@dataclass(frozen=True, eq=False)
class EdgeCrossings:
    """Points at which edges between nodes cross a plane.

    Attributes:
        ends: node numbers, the node below first, shape (m, 2); a node on the surface is both ends.
        share: position between the first (0) and the second node (1), shape (m,).
    """

    ends: np.ndarray
    share: np.ndarray

    def interpolate_nodal_values(self, values: np.ndarray) -> np.ndarray:
        """Interpolate nodal values, shape (nodes, ...), linearly to the crossing points, shape (m, ...)."""
        first, second = values[self.ends[:, 0]], values[self.ends[:, 1]]
        return first + self.share.reshape(-1, *(1,) * (values.ndim - 1)) * (second - first)

    def append_interpolated_values(self, values: np.ndarray) -> np.ndarray:
        """Return the nodal values followed by the values at the crossing points, shape (nodes + m, ...)."""
        return np.concatenate([values, self.interpolate_nodal_values(values)])


def intersect_tetrahedra_at_zero_level(cells: np.ndarray, heights: np.ndarray) -> tuple[EdgeCrossings, np.ndarray]:
    """Return the plane section of tetrahedra at height zero as triangles.

    Args:
        cells: node numbers of tetrahedra with positive volume, shape (t, 4).
        heights: heights of the nodes, shape (nodes,).

    Returns:
        The corners of the section; and triangles as indices of these corners, shape (k, 3), with upward normals.
    """
    above = heights[cells] > 0.0
    count = above.sum(axis=1)
    pairs, corners, before = [], [], 0
    for number, of_nodes in _CORNERS.items():
        cut = np.flatnonzero(count == number)
        order = np.argsort(above[cut], axis=1, kind="stable")
        nodes = np.take_along_axis(cells[cut], order, axis=1)
        ends = nodes[:, np.array(of_nodes)]
        numbers = before + np.arange(ends.shape[0] * ends.shape[1]).reshape(ends.shape[:2])
        odd = _is_odd_permutation(order)
        numbers[odd] = numbers[odd][:, ::-1]
        pairs.append(ends.reshape(-1, 2))
        corners += [numbers[:, [0, k, k + 1]] for k in range(1, len(of_nodes) - 1)]
        before += numbers.size
    crossings, point = _find_distinct_crossings_and_indices(np.concatenate(pairs), heights)
    return crossings, _drop_triangles_with_repeated_nodes(point[np.concatenate(corners)])


def intersect_triangles_at_zero_level(triangles: np.ndarray, heights: np.ndarray) -> EdgeCrossings:
    """Return the k line segments at which triangles cross height zero: 2 k points, two successive ones for each."""
    _, pairs = _find_cut_triangles_and_edges(triangles, heights)
    crossings, number = _find_distinct_crossings_and_indices(pairs, heights)
    lines = number.reshape(-1, 2)
    lines = lines[lines[:, 0] != lines[:, 1]].ravel()
    return EdgeCrossings(crossings.ends[lines], crossings.share[lines])


def split_triangles_below_and_above(triangles: np.ndarray,
                                    heights: np.ndarray) -> tuple[EdgeCrossings, np.ndarray, np.ndarray]:
    """Cut triangles at height zero into triangles below and above.

    Args:
        triangles: node numbers, shape (t, 3).
        heights: heights of the nodes, shape (nodes,).

    Returns:
        The crossing points of edges, which are numbered after the nodes; and the triangles below and above, with the
        orientation of the given triangles.
    """
    nodes = len(heights)
    count = (heights[triangles] > 0.0).sum(axis=1)
    turned, pairs = _find_cut_triangles_and_edges(triangles, heights)
    crossings, number = _find_distinct_crossings_and_indices(pairs, heights)
    p, q = (nodes + number).reshape(-1, 2).T
    # A crossing at a node is replaced by the node.
    at_node = np.concatenate([np.arange(nodes), np.where(crossings.share == 0.0, crossings.ends[:, 0],
                                                         nodes + np.arange(len(crossings.share)))])
    alone, b, c = turned.T
    tip = at_node[np.stack([alone, p, q], axis=-1)]
    rest = at_node[np.concatenate([np.stack([p, b, c], axis=-1), np.stack([p, c, q], axis=-1)])]
    tip_is_above = heights[alone] > 0.0
    twice = np.concatenate([tip_is_above, tip_is_above])
    below = np.concatenate([triangles[count == 0], tip[~tip_is_above], rest[twice]])
    above = np.concatenate([triangles[count == 3], tip[tip_is_above], rest[~twice]])
    return crossings, _drop_triangles_with_repeated_nodes(below), _drop_triangles_with_repeated_nodes(above)


def _find_cut_triangles_and_edges(triangles: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles that cross height zero, and the edges of these triangles that cross height zero.

    Returns:
        Triangles with the node that is alone on its side first, shape (k, 3); and the two edges from this node, as
        pairs with the node below first, shape (2 k, 2).
    """
    above = heights[triangles] > 0.0
    count = above.sum(axis=1)
    cut = np.flatnonzero((count == 1) | (count == 2))
    is_alone = above[cut] == (count[cut] == 1)[:, None]
    turn = (np.argmax(is_alone, axis=1)[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles[cut], turn, axis=1)
    pairs = np.stack([turned[:, [0, 1]], turned[:, [0, 2]]], axis=1)
    falls = count[cut] == 1
    pairs[falls] = pairs[falls][..., ::-1]
    return turned, pairs.reshape(-1, 2)


def _find_distinct_crossings_and_indices(pairs: np.ndarray, heights: np.ndarray) -> tuple[EdgeCrossings, np.ndarray]:
    """Return the distinct crossing points of edges, given as node pairs, and for each pair the index of its point."""
    low, high = heights[pairs[:, 0]], heights[pairs[:, 1]]
    ends = np.where((low == 0.0)[:, None], pairs[:, :1], pairs)
    _, first, number = np.unique(ends[:, 0].astype(np.int64) * len(heights) + ends[:, 1], return_index=True,
                                 return_inverse=True)
    share = (-low / np.where(low == 0.0, 1.0, high - low))[first]
    return EdgeCrossings(ends[first], share), number.reshape(-1)


def _is_odd_permutation(order: np.ndarray) -> np.ndarray:
    """Return whether each permutation, shape (n, k), is odd."""
    first, second = np.triu_indices(order.shape[1], 1)
    return (order[:, first] > order[:, second]).sum(axis=1) % 2 == 1


def _drop_triangles_with_repeated_nodes(triangles: np.ndarray) -> np.ndarray:
    """Return the triangles without those in which a node occurs twice, shape (k, 3)."""
    a, b, c = triangles.T
    return triangles[(a != b) & (b != c) & (c != a)]
