"""Wedge around the axis of the tool that is removed from the picture of a solid in 3D."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from scenes.viewer.revolution import WedgeOpening
from tissue_sim.mesh.sections import split_triangles_below_and_above
from tissue_sim.pose import Pose

#: Distance from a cutting plane below which a point counts as on the plane, in sizes of the body.
_PLANE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Wedge:
    """Wedge between two half planes that meet in a line parallel to the axis of the tool.

    Attributes:
        opening: Angles of the wedge in the frame of the tool.
        pose: Pose of the tool.
        ahead: Distance of the edge of the wedge from the tool's axis towards the opening, m.
        cache: Results that a body stores for this wedge, by the ``id`` of the array of nodal positions.
    """

    opening: WedgeOpening
    pose: Pose
    ahead: float = 0.0
    cache: dict[int, Any] = field(default_factory=dict)

    @cached_property
    def _tool_to_scene_rotation(self) -> np.ndarray:
        """Rotation from the frame of the tool to the frame of the scene, shape (3, 3)."""
        return np.array(self.pose.rotation_matrix)

    def transform_scene_to_tool(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the scene to the frame of the tool, m, shape (n, 3)."""
        x, y, z = (points - np.array(self.pose.position)).T
        # A matrix product would start the threads of BLAS on other cores.
        return np.stack([x * u + y * v + z * w for u, v, w in self._tool_to_scene_rotation.T], axis=-1)

    def transform_tool_to_scene(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the tool to the frame of the scene, m, shape (..., 3)."""
        return np.array(self.pose.position) + points @ self._tool_to_scene_rotation.T

    def compute_height_and_edge_distance_per_face(self, local: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the positions of points relative to each section face.

        Args:
            local: Points in the frame of the tool, m, shape (n, 3).

        Returns:
            For each section face the heights of the points above its plane, positive towards the wedge, and their
            horizontal distances from the edge of the wedge along the face, m, both of shape (n,).
        """
        tolerance = _PLANE_TOLERANCE * float(np.abs(local).max(initial=0.0))
        facing = self.opening.facing
        edge = self.ahead * np.array([np.cos(facing), np.sin(facing)])
        faces = []
        for direction, normal in self.opening.section_face_vectors:
            heights = local[:, :2] @ normal - edge @ normal
            faces.append((np.where(np.abs(heights) < tolerance, 0.0, heights),
                          local[:, :2] @ direction - edge @ direction))
        return faces

    def are_tool_frame_points_inside(self, local: np.ndarray) -> np.ndarray:
        """Return whether each point, shape (n, 3), m, in the frame of the tool, lies inside the wedge; shape (n,)."""
        inside = np.full(len(local), not self.opening.removes_nothing)
        for heights, _ in self.compute_height_and_edge_distance_per_face(local):
            inside &= heights > 0.0
        return inside

    def clip_lines_at_wedge(self, lines: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Remove the parts of lines that lie inside the wedge.

        Args:
            lines: True positions in the frame of the tool, which decide about the parts, m, shape (l, 2, 3).
            drawn: Drawn positions of the same lines, for example in front of a surface, shape (l, 2, 3).

        Returns:
            The remaining parts of `drawn`, shape (m, 2, 3).
        """
        for number in range(len(self.opening.section_face_vectors)):
            heights, _ = self.compute_height_and_edge_distance_per_face(lines.reshape(-1, 3))[number]
            start, end = heights.reshape(-1, 2).T
            cut = (start > 0.0) != (end > 0.0)
            fraction = (start[cut] / (start[cut] - end[cut]))[:, None]
            parts = []
            for each in (lines, drawn):
                crossing = each[cut, 0] + fraction * (each[cut, 1] - each[cut, 0])
                parts.append(np.concatenate([each[~cut], np.stack([each[cut, 0], crossing], axis=1),
                                             np.stack([crossing, each[cut, 1]], axis=1)]))
            lines, drawn = parts
        return drawn[~self.are_tool_frame_points_inside(lines.mean(axis=1)) & (lines[:, 0] != lines[:, 1]).any(axis=1)]

    def clip_triangles_at_wedge(self, points: np.ndarray, triangles: np.ndarray,
                                *values: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Remove the parts of triangles that lie inside the wedge.

        Args:
            points: Points in the frame of the scene, m, shape (n, 3).
            triangles: Point numbers, shape (t, 3).
            values: Values at the points, which are interpolated to new points, each of shape (n, ...).

        Returns:
            Points, remaining triangles, and the values at the points. Points without a triangle are kept.
        """
        if self.opening.removes_nothing:
            return points, triangles, list(values)
        parts, rest = [], triangles
        at_points = [points, *values]
        for number in range(len(self.opening.section_face_vectors)):
            in_tool_frame = self.transform_scene_to_tool(at_points[0])
            heights, _ = self.compute_height_and_edge_distance_per_face(in_tool_frame)[number]
            crossings, below, rest = split_triangles_below_and_above(rest, heights)
            at_points = [crossings.append_interpolated_values(each) for each in at_points]
            parts.append(below)
        return at_points[0], np.concatenate(parts), at_points[1:]
