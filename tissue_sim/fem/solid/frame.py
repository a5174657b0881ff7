"""Frame of the tool relative to the mesh."""

from __future__ import annotations

import numpy as np

from tissue_sim.pose import Pose


class ToolFrame:
    """Rotation and position of the tool in the frame of the mesh.

    Args:
        pose: pose of the tool in the frame of the scene.
        datum: height of the scene's origin in the frame of the mesh, m.

    Attributes:
        rotation: rotation matrix from the frame of the tool to that of the mesh, shape (3, 3).
        origin: position of the tool's deepest point, m, shape (3,).
    """

    def __init__(self, pose: Pose, datum: float):
        w, x, y, z = pose.orientation
        self.rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        x0, y0, z0 = pose.position
        self.origin = np.array([x0, y0, z0 + datum])

    def compute_origin_and_matrix_change_from(self, first: ToolFrame) -> np.ndarray:
        """Return displacement, m, and change of the rotation matrix, row by row, from another frame, shape (12,)."""
        return np.concatenate([self.origin - first.origin, (self.rotation - first.rotation).ravel()])

    def transform_to_tool(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the mesh to that of the tool, m, shape (n, 3)."""
        return (points - self.origin) @ self.rotation

    def transform_to_mesh(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the tool to that of the mesh, m, shape (n, 3)."""
        return points @ self.rotation.T + self.origin

    def differentiate_points(self, points: np.ndarray) -> np.ndarray:
        """Differentiate points fixed to the tool with respect to its position and a rotation about its deepest point.

        Args:
            points: positions in the frame of the mesh, m, shape (n, 3).

        Returns:
            Derivatives by displacement (columns 0 to 2, 1) and rotation vector (columns 3 to 5, m), shape (n, 3, 6).
        """
        rates = differentiate_rotated_forces(points - self.origin)
        rates[:, 0, 0] = rates[:, 1, 1] = rates[:, 2, 2] = 1.0
        return rates


def differentiate_rotated_forces(forces: np.ndarray) -> np.ndarray:
    """Differentiate forces, N, shape (n, 3), that rotate with a body, with respect to its pose, shape (n, 3, 6)."""
    rates = np.zeros((*forces.shape, 6))
    x, y, z = forces.T
    rates[:, 0, 4], rates[:, 0, 5] = z, -y
    rates[:, 1, 3], rates[:, 1, 5] = -z, x
    rates[:, 2, 3], rates[:, 2, 4] = y, -x
    return rates


def differentiate_torque_by_levers(motions: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Differentiate the torque of constant forces whose points move relative to the tool, N and N m, shape (3, 6).

    Args:
        motions: derivatives of the points with respect to the pose of the tool, shape (n, 3, 6).
        forces: forces at the points, N, shape (n, 3).
    """
    apart = motions - np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    return np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
