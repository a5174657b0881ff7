"""Position of the tool at its first touch of the tissue, and the bonds of the contact points there."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.axisymmetric import contact_kernels
from tissue_sim.fem.axisymmetric.contact import ContactPoints
from tissue_sim.fem.contact.pairs import ContactPairs
from tissue_sim.mesh import Mesh

#: Number of linearisations of the gap along the path of a point until it touches; one is exact at a plane face.
TOUCH_ITERATIONS = 3
#: Smallest decrease of a gap over the motion of the point that is divided by, 1.
LEAST_CLOSING = 1e-3


def bind_at_first_touch_and_get_height(mesh: Mesh, contact: ContactPairs, surface: ContactPoints,
                                       displacement: np.ndarray) -> float:
    """Place the tool at its first touch of the surface, and bind the points that touch a body.

    Args:
        mesh: undeformed mesh.
        contact: contact pairs.
        surface: contact points; `anchors` are changed, under a plate also `places`.
        displacement: displacements of the nodes, m, shape (n, 2).

    Returns:
        z of the tool's deepest point at the first touch, m.
    """
    positions, datum = surface.deformed_positions(displacement), 0.0
    if surface.moves.any():
        datum = _find_first_touch_height(mesh, contact, displacement, positions[surface.moves])
    positions[surface.moves, 1] -= datum
    if contact.level:
        _shift_points_to_level_top_in_place(mesh, surface, displacement, positions, datum)
    touches = surface.signed_gaps(positions) <= 1e-9 * np.ptp(mesh.nodes[:, 1])
    untouched = touches & (surface.anchors[:, 0] == contact_kernels.FREE)
    surface.anchors[untouched, 0] = np.where(surface.tied[untouched], contact_kernels.HELD, contact_kernels.TOUCHED)
    surface.anchors[untouched, 1:] = (positions - surface.places)[untouched]
    return datum


def bind_points_reached_in_half_increment(surface: ContactPoints, displacement: np.ndarray, lift: float,
                                          descent: float) -> None:
    """Bind the contact points with friction that the tool reaches in the first half of an increment.

    Points under a face without slip are left to `bind_no_slip_points_where_they_touch`.

    A point is bound to the position on the tool that would reach the point if the tissue did not move. Points that the
    tool reaches later slide freely until the end of the increment, so that the errors of both halves have opposite
    signs.

    Args:
        surface: contact points; `anchors` are changed.
        displacement: displacements of the nodes at the beginning of the increment, m, shape (n, 2).
        lift: difference between z in the frame of the tool and z, m.
        descent: downward motion of the tool in the increment, m.
    """
    free = (surface.anchors[:, 0] == contact_kernels.FREE) & surface.moves & surface.friction.any(axis=1)
    free[surface.face] = False
    points = np.flatnonzero(free)
    if descent <= 0.0 or not points.size:
        return
    positions = surface.deformed_positions(displacement, points)
    positions[:, 1] += lift
    way = _estimate_point_distances_to_touch(surface, points, positions, np.array([0.0, 1.0]))
    meets = way <= 0.5 * descent
    points, positions = points[meets], positions[meets]
    positions[:, 1] += way[meets]
    surface.anchors[points, 0] = contact_kernels.TOUCHED
    surface.anchors[points, 1:] = positions - surface.places[points]


def bind_no_slip_points_where_they_touch(surface: ContactPoints, points: np.ndarray, now: np.ndarray,
                                         predicted: np.ndarray, lift: float, descent: float) -> None:
    """Bind the points under a face without slip that the tool reaches in an increment to the positions of their touch.

    A point that touches within an increment and is not bound slides without friction until the end of the increment,
    and may slide around the edge of the face. The path of a point until the touch is the straight line to its predicted
    position; if the tool reaches the point only where the tissue does not move, the point rests until the touch.

    Args:
        surface: contact points; `initial` is changed.
        points: numbers of the points that are not bound.
        now: displacements of the nodes at the beginning of the increment, m, shape (n, 2).
        predicted: predicted displacements of the nodes at the end of the increment, m, shape (n, 2).
        lift: difference between z in the frame of the tool and z at the beginning, m.
        descent: downward motion of the tool in the increment, m.
    """
    start, end = surface.deformed_positions(now, points), surface.deformed_positions(predicted, points)
    start[:, 1] += lift
    end[:, 1] += lift + descent
    resting = start.copy()
    resting[:, 1] += descent
    end = np.where((surface.signed_gaps(end, points) < 0.0)[:, None], end, resting)
    reached = surface.signed_gaps(end, points) < 0.0
    points, start, end = points[reached], start[reached], end[reached]
    length = np.maximum(np.linalg.norm(end - start, axis=1), np.finfo(float).tiny)
    direction, way = (end - start) / length[:, None], np.zeros(points.size)
    for _ in range(TOUCH_ITERATIONS):
        here = start + way[:, None] * direction
        way = np.minimum(way + _estimate_point_distances_to_touch(surface, points, here, direction), length)
    surface.initial[points, 0] = contact_kernels.TOUCHED
    surface.initial[points, 1:] = start + way[:, None] * direction - surface.places[points]


def _estimate_point_distances_to_touch(surface: ContactPoints, points: np.ndarray, positions: np.ndarray,
                                       direction: np.ndarray) -> np.ndarray:
    """Return the distances that points move in straight lines until they touch, from a linearised gap, m.

    The gap is linearised over half of its size, where the point stays at the same face of the body, so that edges have
    no influence.

    Args:
        surface: contact points.
        points: numbers of the points.
        positions: (r, z) of these points in the frames of their bodies, m, shape (points, 2).
        direction: unit vectors of the motions, shape (points, 2) or (2,).
    """
    gap = np.maximum(surface.signed_gaps(positions, points), 0.0)
    closes = gap - surface.signed_gaps(positions + 0.5 * gap[:, None] * direction, points)
    least = LEAST_CLOSING * gap + np.finfo(float).tiny
    return np.where(gap > 0.0, 0.5 * gap**2 / np.maximum(closes, least), 0.0)


def _shift_points_to_level_top_in_place(mesh: Mesh, surface: ContactPoints, displacement: np.ndarray,
                                        positions: np.ndarray, datum: float) -> None:
    """Shift the points so that a plate touches the whole unevenly settled top at once, as if the top were cut level.

    Without the shift a plate would touch the highest ring first.
    """
    top = mesh.sets["top"]
    lift = np.interp(surface.places[..., 0], mesh.nodes[top, 0], (mesh.nodes + displacement)[top, 1] - datum)
    lift[~surface.moves] = 0.0
    surface.places[..., 1] -= lift
    positions[..., 1] -= lift


def _find_first_touch_height(mesh: Mesh, contact: ContactPairs, displacement: np.ndarray, points: np.ndarray) -> float:
    """Return z of the tool's deepest point at the first touch of the top nodes or of further points (n, 2), m."""
    profile = contact.tool_profile
    positions = np.concatenate([(mesh.nodes + displacement)[mesh.sets["top"]], points])

    def find_smallest_gap(datum):
        """Return the smallest gap of all positions, m, if the tool's deepest point is at the height `datum`, m."""
        return profile.gap(positions - [0.0, datum]).min()

    high = positions[:, 1].max()
    if find_smallest_gap(high) <= 0.0:
        return high
    from scipy.optimize import brentq

    # The bracket grows from a small step: far below the surface a ball is inside the tissue and touches nothing.
    step = 1e-6 * np.ptp(mesh.nodes[:, 1])
    while find_smallest_gap(high - step) > 0.0:
        step *= 2.0
    return brentq(find_smallest_gap, high - step, high, xtol=1e-15)
