"""Where the tool is, as the solid sees it."""

from __future__ import annotations

import numpy as np

from tissue_sim.pose import Pose


class Frame:
    """Where the tool is: its rotation, shape (3, 3), and the place of its deepest point in the frame of the mesh, m.

    Args:
        pose: in the frame of the scene. datum: height of its origin in the frame of the mesh, m.
    """

    def __init__(self, pose: Pose, datum: float):
        w, x, y, z = pose.orientation
        self.rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        x0, y0, z0 = pose.position
        self.origin = np.array([x0, y0, z0 + datum])

    def motion_from(self, first: Frame) -> np.ndarray:
        """The way from another frame, m, and how the entries of the rotation changed, row by row, shape (12,)."""
        return np.concatenate([self.origin - first.origin, (self.rotation - first.rotation).ravel()])

    def into(self, points: np.ndarray) -> np.ndarray:
        """Points of the mesh, (n, 3), in the frame of the tool."""
        return (points - self.origin) @ self.rotation

    def out_of(self, points: np.ndarray) -> np.ndarray:
        """Points of the frame of the tool, (n, 3), in that of the mesh."""
        return points @ self.rotation.T + self.origin

    def rates(self, points: np.ndarray) -> np.ndarray:
        """How points fixed to the tool, in the frame of the mesh, m, (n, 3), move with its position and a rotation
        about its deepest point, shape (n, 3, 6)."""
        rates = np.zeros((len(points), 3, 6))
        rates[:, 0, 0] = rates[:, 1, 1] = rates[:, 2, 2] = 1.0
        x, y, z = (points - self.origin).T
        rates[:, 0, 4], rates[:, 0, 5] = z, -y
        rates[:, 1, 3], rates[:, 1, 5] = -z, x
        rates[:, 2, 3], rates[:, 2, 4] = y, -x
        return rates


def turned_with(forces: np.ndarray) -> np.ndarray:
    """How forces (n, 3) change with the place and the rotation of what they are fixed to, shape (n, 3, 6)."""
    rates = np.zeros((*forces.shape, 6))
    x, y, z = forces.T
    rates[:, 0, 4], rates[:, 0, 5] = z, -y
    rates[:, 1, 3], rates[:, 1, 5] = -z, x
    rates[:, 2, 3], rates[:, 2, 4] = y, -x
    return rates
