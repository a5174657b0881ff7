"""A mesh of hexahedra moved to a specimen, a tool and a place of another size, element by element the same."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tissue_sim.mesh.solid import SolidMesh


class Circle(NamedTuple):
    """On the top, which rings of elements lie about: radius and centre, m."""

    radius: float
    centre: tuple[float, float]


class RingedCylinder(NamedTuple):
    """A cylinder with a circle on its top, whose mesh is an O-grid about the circle: sizes and the circle's centre, m.
    """

    radius: float
    height: float
    face_radius: float
    centre: tuple[float, float]


def moved_solid(mesh: SolidMesh, before: RingedCylinder, after: RingedCylinder) -> SolidMesh:
    """The mesh of one cylinder on another: the circle goes to the circle, the side to the side, straight rays between
    them to such rays; a smooth map of both sizes."""
    if before == after:
        return mesh
    old, new = np.array(before.centre), np.array(after.centre)
    from_centre = mesh.nodes[:, :2] - old
    distance = np.linalg.norm(from_centre, axis=1)
    plane = new + from_centre * after.face_radius / before.face_radius
    # Beside the circle a node is at (1 - s) c + ((1 - s) a + s R) e, with a unit vector e: that gives its s.
    widening = before.radius - before.face_radius
    beyond = distance > before.face_radius
    p = from_centre[beyond]
    a = old @ old - widening**2
    b = p @ old - before.face_radius * widening
    c = (p**2).sum(axis=1) - before.face_radius**2
    s = np.clip(-c / (b - np.sqrt(b * b - a * c)), 0.0, 1.0)
    ray = p + s[:, None] * old
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    at = after.face_radius + s * (after.radius - after.face_radius)
    plane[beyond] = (1.0 - s)[:, None] * new + at[:, None] * ray
    nodes = np.column_stack([plane, mesh.nodes[:, 2] * after.height / before.height])
    return replace(mesh, nodes=nodes)


def moved_block(mesh: SolidMesh, sizes: tuple[np.ndarray, np.ndarray], circles: tuple[Circle, Circle]) -> SolidMesh:
    """The mesh of one block on another: along each axis the sides go to the sides, and what the circle spans to what
    the other one spans, straight in between.

    Args:
        mesh: of the first. sizes: of both along x, y and z, m, shapes (3,). circles: on the tops of both.
    """
    nodes = mesh.nodes.copy()
    for axis in range(2):
        old, new = (np.array([-0.5 * size[axis], circle.centre[axis] - circle.radius,
                              circle.centre[axis] + circle.radius, 0.5 * size[axis]])
                    for size, circle in zip(sizes, circles, strict=True))
        nodes[:, axis] = np.interp(nodes[:, axis], old, new)
    nodes[:, 2] *= sizes[1][2] / sizes[0][2]
    return replace(mesh, nodes=nodes)
