"""The wedge that is cut out of a solid in space, around the axis of the tool."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from scenes.viewer.revolution import Opening
from tissue_sim.mesh.sections import clip
from tissue_sim.pose import Pose

#: Places nearer to a cut than this, in units of the size of what is cut, lie on it.
_ON_CUT = 1e-9


@dataclass(frozen=True, eq=False)
class Wedge:
    """An opening whose axis is that of the tool.

    Attributes:
        opening: in the frame of the tool.
        pose: of the tool.
        ahead: how far the edge of the wedge is from the tool's axis, to where it opens, m.
        known: what a body has found of itself at this wedge, by the places for which that is.
    """

    opening: Opening
    pose: Pose
    ahead: float = 0.0
    known: dict[int, Any] = field(default_factory=dict)

    @cached_property
    def _rotation(self) -> np.ndarray:
        return np.array(self.pose.rotation)

    def into(self, points: np.ndarray) -> np.ndarray:
        """Points of the scene (n, 3) in the frame of the tool, m."""
        x, y, z = (points - np.array(self.pose.position)).T
        # Not as a product of matrices, whose library wakes other cores for it.
        return np.stack([x * u + y * v + z * w for u, v, w in self._rotation.T], axis=-1)

    def out_of(self, points: np.ndarray) -> np.ndarray:
        """Points of the tool's frame in the scene, shape (..., 3), m."""
        return np.array(self.pose.position) + points @ self._rotation.T

    def over_faces(self, local: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each section face: how high points of the tool's frame are above its plane, towards the wedge, and how far
        from its edge, m, each of shape (n,)."""
        size = _ON_CUT * float(np.abs(local).max(initial=0.0))
        facing = self.opening.facing
        edge = self.ahead * np.array([np.cos(facing), np.sin(facing)])
        faces = []
        for way, normal in self.opening.faces:
            heights = local[:, :2] @ normal - edge @ normal
            faces.append((np.where(np.abs(heights) < size, 0.0, heights), local[:, :2] @ way - edge @ way))
        return faces

    def removes(self, local: np.ndarray) -> np.ndarray:
        """Which points of the tool's frame lie in the wedge, shape (n,)."""
        inside = np.full(len(local), not self.opening.closed)
        for heights, _ in self.over_faces(local):
            inside &= heights > 0.0
        return inside

    def lines_left(self, lines: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Lines without what lies in the wedge.

        Args:
            lines: in the tool's frame, shape (l, 2, 3).
            drawn: where they are drawn, such as in front of what they are on, shape (l, 2, 3); these are cut alike.

        Returns:
            What is left of `drawn`, shape (m, 2, 3).
        """
        for number in range(len(self.opening.faces)):
            heights, _ = self.over_faces(lines.reshape(-1, 3))[number]
            start, end = heights.reshape(-1, 2).T
            cut = (start > 0.0) != (end > 0.0)
            share = (start[cut] / (start[cut] - end[cut]))[:, None]
            parts = []
            for each in (lines, drawn):
                between = each[cut, 0] + share * (each[cut, 1] - each[cut, 0])
                parts.append(np.concatenate([each[~cut], np.stack([each[cut, 0], between], axis=1),
                                             np.stack([between, each[cut, 1]], axis=1)]))
            lines, drawn = parts
        return drawn[~self.removes(lines.mean(axis=1)) & (lines[:, 0] != lines[:, 1]).any(axis=1)]

    def left_of(self, points: np.ndarray, triangles: np.ndarray,
                *carried: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Triangles without what lies in the wedge.

        Args:
            points: in the scene, shape (n, 3).
            triangles: shape (t, 3).
            carried: what is known of each point, shape (n, ...).

        Returns:
            Points, triangles, and what was carried along; points that no triangle has any more are left over.
        """
        if self.opening.closed:
            return points, triangles, list(carried)
        whole, rest = [], triangles
        everything = [points, *carried]
        for number in range(len(self.opening.faces)):
            heights, _ = self.over_faces(self.into(everything[0]))[number]
            crossings, below, rest = clip(rest, heights)
            everything = [crossings.extend(values) for values in everything]
            whole.append(below)
        return everything[0], np.concatenate(whole), everything[1:]
