"""Signed distance of a point from a rigid body with a polygonal, rounded outline, as a Taichi function."""

from functools import cache

from tissue_sim.fem.axisymmetric.contact import OutlineSpanColumn
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


@cache
def make_closest_point_function():
    """Return the Taichi function that projects a point onto the outline of a rigid body.

    ``compute_gap_and_normal_at_closest_point(r, z, i, depth, surface) -> (gap, normal r, normal z,
    curvature, line)`` evaluates point i of `ContactPoints` at (r, z) in the frame of its body, with the tool at
    `depth`.
    """
    ti = get_initialised_taichi()
    far = 1e30

    @ti.func
    def compute_gap_and_normal_at_closest_point(r, z, i, depth, surface: ti.template()):
        """Return gap (m), outward normal, curvature (1/m) and index of the line segment closest to (r, z).

        While a tool with a sharp shaft is pressed in, the shaft is extended downwards: the tissue below the face
        occupies that region, so that tissue next to the tool cannot enter it.
        """
        first = surface.spans[i, OutlineSpanColumn.FIRST_LINE]
        closed = first == surface.spans[i, OutlineSpanColumn.SHAFT] and surface.rounding[i] == 0.0 and depth >= 0.0
        best, gap, nr, nz, curved, line = far, far, 0.0, 0.0, 0.0, first
        front_best = 0.0
        for s in range(first, surface.spans[i, OutlineSpanColumn.LAST_LINE] + 1):
            tr = surface.vertices[s + 1, 0] - surface.vertices[s, 0]
            tz = surface.vertices[s + 1, 1] - surface.vertices[s, 1]
            length = ti.sqrt(tr * tr + tz * tz)
            tr, tz = tr / length, tz / length
            dr, dz = r - surface.vertices[s, 0], z - surface.vertices[s, 1]
            along = dr * tr + dz * tz
            share = ti.min(along, length)
            if not (closed and s == first):
                share = ti.max(share, 0.0)
            dr, dz = dr - share * tr, dz - share * tz
            distance = ti.sqrt(dr * dr + dz * dz)
            front = dr * tz - dz * tr
            # At a vertex two segments are equally close: the one with the larger distance from its line decides.
            if distance < best - 1e-15 or (distance < best + 1e-15 and ti.abs(front) > ti.abs(front_best)):
                best, front_best, line = distance, front, s
                # The outline has no inside before its first vertex.
                inside = front < 0.0 and (closed or not (s == first and along < 0.0))
                sign = -1.0 if inside else 1.0
                gap = sign * distance - surface.rounding[i]
                beyond = share != along
                nr, nz, curved = tz, -tr, 0.0
                if beyond and distance > 0.0:
                    nr, nz = sign * dr / distance, sign * dz / distance
                    curved = 1.0 / distance
        return gap, nr, nz, curved, line

    return compute_gap_and_normal_at_closest_point
