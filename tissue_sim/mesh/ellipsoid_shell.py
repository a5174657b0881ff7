"""Generate meshes of half shells between two ellipsoids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.grading import O_GRID, Grading
from tissue_sim.mesh.section import Curve, PlanarMesh, make_quarter_circle
from tissue_sim.mesh.solid import (
    SolidMesh,
    add_face_and_free_node_sets,
    compute_inner_ring_radius_fractions,
    extrude_section_to_mesh,
)


def create_half_ellipsoid_shell_mesh(semi_axes: tuple[float, float, float], thickness: float,
                                     grading: Grading) -> SolidMesh:
    """Create the mesh of the upper half of an ellipsoidal shell with rings of elements around a circle.

    The apex of the outer surface is the origin and the inner surface is the base. A plane section in the unit disc, in
    which the distance from the centre is the normalised polar angle, is mapped to ellipsoids whose semi-axes decrease
    from the outer to the inner surface.

    Args:
        semi_axes: semi-axes of the outer surface along x, y, z, m.
        thickness: thickness along the axes, m.
        grading: sizes of the elements; the circle is given in the projection along z.

    Raises:
        InputError: the circle is not inside the rim.
    """
    a, b, c = semi_axes
    radius = O_GRID.plate_ring * min(a, b) if grading.radius is None else grading.radius
    centre = np.array(grading.centre)

    def map_shell_surface_to_unit_disc(points: np.ndarray) -> np.ndarray:
        """Map (x, y) of points on the outer surface, m, shape (..., 2), to the unit disc."""
        scaled = points / [a, b]
        sine = np.hypot(scaled[..., 0], scaled[..., 1])[..., None]
        return scaled * np.where(sine > 0.0, 2.0 / np.pi * np.arcsin(np.minimum(sine, 1.0)) / np.where(
            sine > 0.0, sine, 1.0), 2.0 / np.pi)

    def make_quarter_circle_in_unit_disc(quarter: int) -> Curve:
        """Return a quarter of the circle on the shell as a curve in the unit disc."""
        return lambda t: map_shell_surface_to_unit_disc(make_quarter_circle(quarter, radius, centre)(t))

    angles = np.linspace(0.0, 2.0 * np.pi, 73)
    if (np.hypot(*((centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)) / [a, b]).T) >= 1.0).any():
        raise InputError(f"the circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m must be inside the "
                         "rim of the shell", field="centre")
    section = PlanarMesh(grading.element.order)
    section.add_disc(centre, radius, compute_inner_ring_radius_fractions(grading, radius), grading.around,
                     through=map_shell_surface_to_unit_disc)
    outward = grading.divide_line(0.25 * np.pi * (max(a, b) + c) - radius)
    for quarter in range(4):
        section.add_elements_between_curves(make_quarter_circle_in_unit_disc(quarter),
                                            make_quarter_circle(quarter, 1.0), outward / outward[-1], grading.around)
    flat = extrude_section_to_mesh(section,
                                   grading.insert_interface_heights(-grading.divide_line(thickness)[::-1], thickness),
                                   grading.element)
    u, v, z = flat.nodes.T
    angle, theta = np.arctan2(v, u), 0.5 * np.pi * np.minimum(np.hypot(u, v), 1.0)
    nodes = np.column_stack([(a + z) * np.sin(theta) * np.cos(angle), (b + z) * np.sin(theta) * np.sin(angle),
                             (c + z) * np.cos(theta) - c])
    return add_face_and_free_node_sets(replace(flat, nodes=nodes, depths=flat.element_depths), radius, grading.centre)
