"""Outlines of rigid bodies of revolution, distance of tissue from them, and sizes that several shapes share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

from tissue_sim.parameters import parameter

if TYPE_CHECKING:
    import numpy as np

#: Smallest and largest radius in a fit, m.
_RADII = (1e-6, 1.0)


def radius() -> Any:
    """Declare the field `radius` of a tool: radius of the shaft, or of the ball, m."""
    return parameter("a", "m", key="tool_radius_mm", factor=1e-3, bounds=_RADII, shapes_mesh=True)


def edge_radius() -> Any:
    """Declare the field `edge_radius` of a tool: radius of the rounding between a flat face and the shaft, m."""
    return parameter("r_e", "m", key="edge_radius_mm", factor=1e-3, bounds=(0.0, _RADII[1]), absent=0.0,
                     shapes_mesh=True, default=0.0)


#: Length of a shaft in radii of the tool; longer than any specimen.
SHAFT_LENGTH = 1e3


class OutlineLineColumn(IntEnum):
    """Columns of `Profile.lines`, one row for each line segment.

    Attributes:
        R, Z: first point, m.
        DIRECTION_R, DIRECTION_Z: unit vector to the second point.
        LENGTH: length, m.
    """

    R = 0
    Z = 1
    DIRECTION_R = 2
    DIRECTION_Z = 3
    LENGTH = 4


class PolylineDistances(NamedTuple):
    """Distances and normals at the closest points of a polyline.

    Attributes:
        line: index of the line segment, shape (n,).
        distance: signed distance, m, negative inside of the body, shape (n,).
        normal: outward unit normal (r, z), shape (n, 2).
        curvature: curvature of the offset curve through the point, 1/m, shape (n,): 1 / distance if a vertex is
            closest, otherwise 0.
    """

    line: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True, eq=False)
class Profile:
    """Outline of a rigid body of revolution: a polyline thickened by a rounding radius.

    The frame is the tool's: r from the axis, z out of the tissue, origin at the deepest point. The polyline runs from
    the axis outwards and upwards with the body on its left.

    Args:
        points: the vertices, (r, z), m.

    Attributes:
        vertices: (r, z), m, shape (n, 2).
        rounding: distance between the polyline and the surface outside of it, m.
        shaft: index of the first segment that belongs to the shaft; the segments before form the face.
    """

    points: InitVar[np.ndarray | Sequence[tuple[float, float]]]
    rounding: float
    shaft: int
    vertices: np.ndarray = field(init=False)

    def __post_init__(self, points: np.ndarray | Sequence[tuple[float, float]]):
        # Local import: the command line's help knows the shapes and must not import numpy.
        import numpy as np

        object.__setattr__(self, "vertices", np.asarray(points, dtype=float))

    @cached_property
    def lines(self) -> np.ndarray:
        """Line segments of the polyline, with the columns `OutlineLineColumn`, shape (n - 1, 5)."""
        import numpy as np

        segment = np.diff(self.vertices, axis=0)
        length = np.linalg.norm(segment, axis=1)
        return np.column_stack([self.vertices[:-1], segment / length[:, None], length])

    def compute_distances_to_polyline(self, points: np.ndarray, first_line: int = 0,
                                      is_endless: bool = False) -> PolylineDistances:
        """Compute distances and normals at the closest points of the polyline, without its rounding.

        `tissue_sim.fem.contact.surface_geometry` is the same algorithm for kernels.

        Args:
            points: (r, z), m, shape (n, 2).
            first_line: index of the first line segment.
            is_endless: whether the first line segment is extended without end before its first point.
        """
        import numpy as np

        lines = self.lines[first_line:]
        start, t, length = lines[:, :2], lines[:, 2:4], lines[:, OutlineLineColumn.LENGTH]
        offset = np.asarray(points, dtype=float)[:, None] - start
        along = np.einsum("nsi,si->ns", offset, t)
        lower = np.where(is_endless & (np.arange(len(length)) == 0), -np.inf, 0.0)
        share = np.maximum(np.minimum(along, length), lower)
        arrow = offset - share[..., None] * t
        distance = np.linalg.norm(arrow, axis=-1)
        front = arrow[..., 0] * t[:, 1] - arrow[..., 1] * t[:, 0]
        # At a vertex two segments are equally close; the one with the larger normal distance determines the sign.
        best = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
        rows = np.arange(len(points))
        distance, front, share, along, arrow = (each[rows, best] for each in (distance, front, share, along, arrow))
        # Points before the start of the polyline are outside.
        inside = (front < 0.0) & (is_endless | ~((best == 0) & (along < 0.0)))
        sign = np.where(inside, -1.0, 1.0)
        beyond = (share != along) & (distance > 0.0)
        safe = np.where(distance > 0.0, distance, 1.0)
        normal = np.where(beyond[:, None], (sign / safe)[:, None] * arrow, np.stack([t[best, 1], -t[best, 0]], axis=-1))
        return PolylineDistances(best + first_line, sign * distance, normal, np.where(beyond, sign / safe, 0.0))

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance of points from the surface, m, positive outside, shape (n,).

        Args:
            points: (r, z), m, shape (n, 2).
        """
        return self.compute_distances_to_polyline(points).distance - self.rounding

    def sample_outline_up_to_height(self, height: float) -> np.ndarray:
        """Return points (r, z), m, on the surface from the axis up to `height`, m, for drawing, shape (n, 2)."""
        import numpy as np

        segment = np.diff(self.vertices, axis=0)
        angle = np.arctan2(-segment[:, 0], segment[:, 1])  # of the outward normal
        # The surface begins on the axis, under the first vertex.
        angle = np.concatenate([[-np.pi / 2], angle, [np.pi / 2 if self.vertices[-1, 1] < height else angle[-1]]])
        turns = np.linspace(angle[:-1], angle[1:], 25, axis=1)
        normals = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        points = (self.vertices[:, None] + self.rounding * normals).reshape(-1, 2)
        points[:, 1] = np.minimum(points[:, 1], height)
        return points
