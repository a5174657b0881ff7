"""Distance and normal at the closest point of the outline of a rigid body of revolution, as a Taichi function.

The axisymmetric, reduced and condensed solvers use it.

`tissue_sim.experiment.tools.outline.Profile.compute_distances_to_polyline` is the same algorithm for NumPy arrays.
"""

from functools import cache

from tissue_sim.experiment.tools.outline import OutlineLineColumn
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
