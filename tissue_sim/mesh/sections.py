"""Cut tetrahedra and triangles by the zero level of a scalar field at the nodes.

The scalar is, for example, the height above a plane. A node with the value zero counts as below, so that a triangle in
the surface belongs to one of its two neighbours only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
