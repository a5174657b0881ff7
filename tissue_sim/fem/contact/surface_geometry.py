"""Nearest points of rigid bodies of revolution, in the plane and in space, for arrays and for kernels.

In the plane through the axis and the point, the nearest point is that of the outline (`make_closest_point_function`).
The principal curvatures of the offset surface through the point belong to the meridian and to the circumference.

The plane function is shared by the axisymmetric, reduced and condensed solvers;
`tissue_sim.experiment.tools.tool.Profile.compute_distances_to_polyline` is the same algorithm for NumPy arrays.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from tissue_sim.experiment.tools.tool import OutlineLineColumn, PolylineDistances
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Line segments whose distances differ by less are equally close, m.
DISTANCE_TOLERANCE = 1e-15


@cache
def make_closest_point_function():
    """Return the Taichi function that projects a point onto a polyline.

    ``find_closest_outline_point(r, z, first, end, is_endless, lines)`` returns the index of the closest of the line
    segments `first` to `end` - 1, the signed distance (m, negative inside of the body), the outward normal (r, z), and
    the curvature (1/m) of the offset curve through the point: 1 / distance if a vertex is closest, otherwise 0.
    `lines` has the columns `OutlineLineColumn`. If `is_endless` is 1, the first segment is extended without end before
    its first point.
    """
    ti = get_initialised_taichi()

    @ti.func
    def find_closest_outline_point(r, z, first, end, is_endless, lines: ti.template()):
        """Return line segment, signed distance, normal and curvature of the closest point of a polyline."""
        best, distance, front, along, share, away_r, away_z = first, 1e30, 0.0, 0.0, 0.0, 0.0, 0.0
        for line in range(first, end):
            t_r, t_z = lines[line, OutlineLineColumn.DIRECTION_R], lines[line, OutlineLineColumn.DIRECTION_Z]
            d_r, d_z = r - lines[line, OutlineLineColumn.R], z - lines[line, OutlineLineColumn.Z]
            position = d_r * t_r + d_z * t_z
            part = ti.min(position, lines[line, OutlineLineColumn.LENGTH])
            if not (is_endless == 1 and line == first):
                part = ti.max(part, 0.0)
            a_r, a_z = d_r - part * t_r, d_z - part * t_z
            d, f = ti.sqrt(a_r * a_r + a_z * a_z), a_r * t_z - a_z * t_r
            # At a vertex two segments are equally close: the one with the larger normal distance determines
            # the sign.
            if d < distance - DISTANCE_TOLERANCE or (d < distance + DISTANCE_TOLERANCE and ti.abs(f) > ti.abs(front)):
                best, distance, front, along, share, away_r, away_z = line, d, f, position, part, a_r, a_z
        # The polyline has no inside before its first vertex.
        inside = front < 0.0 and (is_endless == 1 or not (best == first and along < 0.0))
        sign = -1.0 if inside else 1.0
        n_r, n_z = lines[best, OutlineLineColumn.DIRECTION_Z], -lines[best, OutlineLineColumn.DIRECTION_R]
        curvature = 0.0
        if share != along and distance > 0.0:
            n_r, n_z, curvature = sign * away_r / distance, sign * away_z / distance, sign / distance
        return best, sign * distance, n_r, n_z, curvature

    return find_closest_outline_point


@dataclass(frozen=True)
class NearestSurfaceGeometry:
    """Nearest points of a body's surface to given points, in the frame of the body.

    Attributes:
        gap: signed distance, m, shape (n,).
        normal: outward normal, shape (n, 3).
        curvature: derivative of the normal with respect to position, 1/m, shape (n, 3, 3).
        on_shaft: whether the nearest point belongs to the shaft, shape (n,).
        meridian: unit tangent of the outline, shape (n, 3).
    """

    gap: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray
    on_shaft: np.ndarray
    meridian: np.ndarray


def find_nearest_surface_geometry(pair: ContactPair, points: np.ndarray, pressed_in: bool) -> NearestSurfaceGeometry:
    """Find the nearest points of a body's surface.

    Args:
        pair: contact pair of the body.
        points: in the frame of the body, m, shape (n, 3).
        pressed_in: whether the body is at its position of first touch, or deeper; see `ContactPair.closed`.
    """
    profile, r = pair.profile, np.hypot(points[:, 0], points[:, 1])
    line, distance, n2, bent = _compute_outline_distances(pair, points, pressed_in)
    outwards = np.where(r[:, None] > 0.0, points[:, :2] / np.where(r > 0.0, r, 1.0)[:, None], [1.0, 0.0])
    normal = np.concatenate([n2[:, :1] * outwards, n2[:, 1:]], axis=1)
    meridian = np.concatenate([-n2[:, 1:] * outwards, n2[:, :1]], axis=1)
    around = np.stack([-outwards[:, 1], outwards[:, 0], np.zeros(len(r))], axis=-1)
    # On the axis both principal curvatures are equal.
    length = profile.lines[pair.first_line:, OutlineLineColumn.LENGTH]
    hoop = np.where(r > 1e-9 * length.max(initial=1.0), n2[:, 0] / np.where(r > 0.0, r, 1.0), bent)
    curvature = (bent[:, None, None] * meridian[:, :, None] * meridian[:, None]
                 + hoop[:, None, None] * around[:, :, None] * around[:, None])
    rounded = (bent != 0.0) & (profile.rounding > 0.0)
    return NearestSurfaceGeometry(distance - profile.rounding, normal, curvature, (line >= profile.shaft) & ~rounded,
                                  meridian)


def _compute_outline_distances(pair: ContactPair, points: np.ndarray, pressed_in: bool) -> PolylineDistances:
    """Compute distances and normals of points, m, shape (n, 3), in the half plane of the outline; without rounding."""
    profile, first = pair.profile, pair.first_line
    closed = pair.closed and pressed_in and first == profile.shaft and profile.rounding == 0.0
    plane = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)
    return profile.compute_distances_to_polyline(plane, first, closed)


def differentiate_gap_and_normal_by_outline(pair: ContactPair, points: np.ndarray, pressed_in: bool,
                                            vertices: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate gap and normal at constant positions with respect to one parameter of the outline.

    The gap changes by minus the normal velocity of the nearest point of the surface. The derivative of the normal is
    one-sided between a segment and a rounded vertex.

    Args:
        pair: contact pair of the body.
        points: in the frame of the body, m, shape (n, 3).
        pressed_in: see `find_nearest_surface_geometry`.
        vertices: derivatives of the vertices of the outline, (r, z), m per unit of the parameter, shape (vertices, 2).
        rounding: derivative of the rounding, m per unit.

    Returns:
        Derivatives of the gap, m per unit, shape (n,), and of the component of the normal along the meridian, 1 per
        unit, shape (n,).
    """
    line, distance, normal, bent = _compute_outline_distances(pair, points, pressed_in)
    lines = pair.profile.lines[line]
    start, t, length = lines[:, :2], lines[:, 2:4], lines[:, OutlineLineColumn.LENGTH]
    plane = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)
    part = np.einsum("ni,ni->n", plane - distance[:, None] * normal - start, t) / length
    turned = vertices[line + 1] - vertices[line]
    velocity = vertices[line] + part[:, None] * turned
    meridian = np.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    tilt = np.where(bent != 0.0, -bent * np.einsum("ni,ni->n", meridian, velocity),
                    -np.einsum("ni,ni->n", normal, turned) / length)
    return -np.einsum("ni,ni->n", normal, velocity) - rounding, tilt


@cache
def make_surface_geometry_function():
    """Return the Taichi function of the nearest point of a body's surface.

    ``find_surface_geometry(at, first, end, is_endless, shaft, rounding, axis_radius, lines)`` returns gap (m), outward
    normal, unit tangents along meridian and circumference, curvatures along both (1/m), and 1 if the nearest point
    belongs to the shaft, else 0. `at` is the position in the frame of the body, m, and `shaft` the first line segment
    of the shaft. Nearer to the axis than `axis_radius`, m, both curvatures are equal. `rounding` is the radius of the
    edges, m; the other arguments are those of `make_closest_point_function`.
    """
    ti = get_initialised_taichi()
    find_closest_outline_point = make_closest_point_function()

    @ti.func
    def find_surface_geometry(at, first, end, is_endless, shaft, rounding, axis_radius, lines: ti.template()):
        """Return gap, normal, two tangents, two curvatures, and whether the shaft is nearest."""
        r = ti.sqrt(at[0] * at[0] + at[1] * at[1])
        line, distance, n_r, n_z, bent = find_closest_outline_point(r, at[2], first, end, is_endless, lines)
        out, up, hoop = ti.Vector([1.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 1.0]), bent
        if r > 0.0:
            out = ti.Vector([at[0] / r, at[1] / r, 0.0])
        if r > axis_radius:
            hoop = n_r / r
        # Rounded edges have the friction of the face.
        on_shaft = 1 if line >= shaft and not (bent != 0.0 and rounding > 0.0) else 0
        around = ti.Vector([-out[1], out[0], 0.0])
        return distance - rounding, n_r * out + n_z * up, n_r * up - n_z * out, around, bent, hoop, on_shaft

    return find_surface_geometry
