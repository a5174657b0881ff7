"""Meshes of half shells between two ellipsoids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.grading import PLATE_RING, Grading
from tissue_sim.mesh.section import Curve, Section, arc
from tissue_sim.mesh.solid import SolidMesh, inward_of, raised, with_tool_sets


def ellipsoid_shell(semi_axes: tuple[float, float, float], thickness: float, grading: Grading) -> SolidMesh:
    """The upper half of a shell, the apex of its outer surface in the origin, with rings of elements about a circle on
    that surface; the inner surface is the base.

    A section in a disc of radius 1, in which the distance from the middle is the polar angle, is laid on ellipsoids
    whose semi-axes become shorter from the outer to the inner one.

    Args:
        semi_axes: of the outer surface along x, y, z, m. thickness: along the axes, m.
        grading: of its elements; the circle is one seen from above.

    Raises:
        InputError: a circle that reaches beyond the rim.
    """
    a, b, c = semi_axes
    radius = PLATE_RING * min(a, b) if grading.radius is None else grading.radius
    centre = np.array(grading.centre)

    def on_disc(places: np.ndarray) -> np.ndarray:
        """Of places seen from above, m, shape (..., 2)."""
        shares = places / [a, b]
        sine = np.hypot(shares[..., 0], shares[..., 1])[..., None]
        return shares * np.where(sine > 0.0, 2.0 / np.pi * np.arcsin(np.minimum(sine, 1.0)) / np.where(
            sine > 0.0, sine, 1.0), 2.0 / np.pi)

    def circle(quarter: int) -> Curve:
        return lambda t: on_disc(arc(quarter, radius, centre)(t))

    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    if (np.hypot(*((centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)) / [a, b]).T) >= 1.0).any():
        raise InputError(f"a circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m reaches beyond the "
                         "rim of the shell", field="centre")
    section = Section(grading.element.order)
    section.add_disc(centre, radius, inward_of(grading, radius), grading.around, through=on_disc)
    outward = grading.line(0.25 * np.pi * (max(a, b) + c) - radius)
    for quarter in range(4):
        section.add_ring(circle(quarter), arc(quarter, 1.0), outward / outward[-1], grading.around)
    flat = raised(section, grading.with_interfaces(-grading.line(thickness)[::-1], thickness), grading.element)
    u, v, z = flat.nodes.T
    angle, theta = np.arctan2(v, u), 0.5 * np.pi * np.minimum(np.hypot(u, v), 1.0)
    nodes = np.column_stack([(a + z) * np.sin(theta) * np.cos(angle), (b + z) * np.sin(theta) * np.sin(angle),
                             (c + z) * np.cos(theta) - c])
    return with_tool_sets(replace(flat, nodes=nodes, depths=flat.element_depths), radius, grading.centre)
