"""Rigid bodies of revolution that a solid may touch, and the nearest points of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.experiment.tools.outline import OutlineLineColumn, Profile


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body of revolution (a part of the tool, or the base), and the nodes that may touch it.

    Attributes:
        profile: outline in the frame of the body.
        nodes: indices of the nodes in the mesh, shape (n,).
        friction: Coulomb coefficients of the face and of the shaft, 1; 0: frictionless; `STICK`: no slip.
        moves: whether the body moves with the tool; else it is at rest in the frame of the mesh.
        tied: whether nodes that touch the body at the first touch are held there without slip.
        stays: whether the contact also transmits tension, so that the nodes cannot lift off.
        first_line: index of the first segment of the profile that the nodes may touch.
        closed: whether a sharp shaft is extended downwards while the tool is pressed in, because the tissue that is
            held below an upright face occupies the space there.
    """

    profile: Profile
    nodes: np.ndarray
    friction: tuple[float, float]
    moves: bool = True
    tied: bool = False
    stays: bool = False
    first_line: int = 0
    closed: bool = True


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


def find_nearest_surface_geometry(body: RigidBody, points: np.ndarray, pressed_in: bool) -> NearestSurfaceGeometry:
    """Find the nearest points of a body's surface.

    Args:
        body: the body.
        points: in the frame of the body, m, shape (n, 3).
        pressed_in: whether the body is at its position of first touch, or deeper; see `RigidBody.closed`.
    """
    profile, first = body.profile, body.first_line
    closed = body.closed and pressed_in and first == profile.shaft and profile.rounding == 0.0
    r = np.hypot(points[:, 0], points[:, 1])
    line, distance, n2, bent = profile.compute_distances_to_polyline(np.stack([r, points[:, 2]], axis=-1), first,
                                                                     closed)
    outwards = np.where(r[:, None] > 0.0, points[:, :2] / np.where(r > 0.0, r, 1.0)[:, None], [1.0, 0.0])
    normal = np.concatenate([n2[:, :1] * outwards, n2[:, 1:]], axis=1)
    meridian = np.concatenate([-n2[:, 1:] * outwards, n2[:, :1]], axis=1)
    around = np.stack([-outwards[:, 1], outwards[:, 0], np.zeros(len(r))], axis=-1)
    # On the axis both principal curvatures are equal.
    length = profile.lines[first:, OutlineLineColumn.LENGTH]
    hoop = np.where(r > 1e-9 * length.max(initial=1.0), n2[:, 0] / np.where(r > 0.0, r, 1.0), bent)
    curvature = (bent[:, None, None] * meridian[:, :, None] * meridian[:, None]
                 + hoop[:, None, None] * around[:, :, None] * around[:, None])
    rounded = (bent != 0.0) & (profile.rounding > 0.0)
    return NearestSurfaceGeometry(distance - profile.rounding, normal, curvature, (line >= profile.shaft) & ~rounded,
                                  meridian)
