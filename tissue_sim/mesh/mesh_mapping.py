"""Map the nodes of a structured solid mesh to another size of specimen and tool, with unchanged connectivity."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tissue_sim.mesh.solid import SolidMesh


class Circle(NamedTuple):
    """Circle on the top of a specimen around which rings of elements lie.

    Attributes:
        radius: radius, m.
        centre: (x, y) of the centre, m.
    """

    radius: float
    centre: tuple[float, float]


class CylinderWithTopCircle(NamedTuple):
    """Cylinder with a circle on its top, meshed with an O-grid around the circle.

    Attributes:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        face_radius: radius of the circle, m.
        centre: (x, y) of the centre of the circle, m.
    """

    radius: float
    height: float
    face_radius: float
    centre: tuple[float, float]


def map_cylinder(mesh: SolidMesh, before: CylinderWithTopCircle, after: CylinderWithTopCircle) -> SolidMesh:
    """Map the mesh of a cylinder to another cylinder; the nodes depend smoothly on the sizes.

    The circle is mapped to the circle, the side to the side, and straight lines between them to straight lines.

    Args:
        mesh: mesh of the cylinder `before`.
        before: sizes of the meshed cylinder.
        after: sizes of the new cylinder.
    """
    if before == after:
        return mesh
    old, new = np.array(before.centre), np.array(after.centre)
    from_centre = mesh.nodes[:, :2] - old
    distance = np.linalg.norm(from_centre, axis=1)
    plane = new + from_centre * after.face_radius / before.face_radius
    # A node outside the circle is at (1 - s) c + ((1 - s) a + s R) e with a unit vector e: solve |e| = 1 for s.
    widening = before.radius - before.face_radius
    beyond = distance > before.face_radius
    p = from_centre[beyond]
    a = old @ old - widening**2
    b = p @ old - before.face_radius * widening
    c = (p**2).sum(axis=1) - before.face_radius**2
    s = np.clip(-c / (b - np.sqrt(b * b - a * c)), 0.0, 1.0)
    ray = p + s[:, None] * old
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    radii = after.face_radius + s * (after.radius - after.face_radius)
    plane[beyond] = (1.0 - s)[:, None] * new + radii[:, None] * ray
    nodes = np.column_stack([plane, mesh.nodes[:, 2] * after.height / before.height])
    return replace(mesh, nodes=nodes)


def map_block(mesh: SolidMesh, sizes: tuple[np.ndarray, np.ndarray], circles: tuple[Circle, Circle]) -> SolidMesh:
    """Map the mesh of a block to another block.

    Along each axis the sides are mapped to the sides and the ends of the circle to the ends of the other circle, with
    linear interpolation in between.

    Args:
        mesh: mesh of the first block.
        sizes: sizes of both blocks along x, y and z, m, each of shape (3,).
        circles: circles on the tops of both blocks.
    """
    nodes = mesh.nodes.copy()
    for axis in range(2):
        old, new = (np.array([-0.5 * size[axis], circle.centre[axis] - circle.radius,
                              circle.centre[axis] + circle.radius, 0.5 * size[axis]])
                    for size, circle in zip(sizes, circles, strict=True))
        nodes[:, axis] = np.interp(nodes[:, axis], old, new)
    nodes[:, 2] *= sizes[1][2] / sizes[0][2]
    return replace(mesh, nodes=nodes)
