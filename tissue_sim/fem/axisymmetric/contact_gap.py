"""Gap between a contact point and its rigid body with a rounded outline, as a Taichi function."""

from functools import cache

from tissue_sim.fem.axisymmetric.contact import OutlineSpanColumn
from tissue_sim.fem.contact.closest_point import make_closest_point_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


@cache
def make_gap_function():
    """Return the Taichi function of the gap of a contact point.

    ``compute_gap_and_normal(r, z, i, depth, surface) -> (gap, normal r, normal z, curvature, line)`` evaluates point i
    of `ContactPoints` at (r, z) in the frame of its body, with the tool at `depth`.
    """
    ti = get_initialised_taichi()
    find_closest_outline_point = make_closest_point_function()

    @ti.func
    def compute_gap_and_normal(r, z, i, depth, surface: ti.template()):
        """Return gap (m), outward normal, absolute curvature (1/m) and index of the line segment closest to (r, z).

        If the edge between face and shaft is sharp and the tool is pressed in, the line of the shaft is extended below
        the face for points that can touch the shaft only. These points cannot move under the face, where other tissue
        is.
        """
        first, is_endless = surface.spans[i, OutlineSpanColumn.FIRST_LINE], 0
        if first == surface.spans[i, OutlineSpanColumn.SHAFT] and surface.rounding[i] == 0.0 and depth >= 0.0:
            is_endless = 1
        line, distance, nr, nz, curvature = find_closest_outline_point(
            r, z, first, surface.spans[i, OutlineSpanColumn.END_LINE], is_endless, surface.lines)
        return distance - surface.rounding[i], nr, nz, ti.abs(curvature), line

    return compute_gap_and_normal
