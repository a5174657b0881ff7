"""Outlines of rigid bodies of revolution, and the distance of tissue from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

#: Length of a shaft in radii of the tool; longer than any specimen.
SHAFT_LENGTH = 1e3


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

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points, shape (n, 2), from the surface, m, positive outside, shape (n,)."""
        import numpy as np

        points = np.asarray(points, dtype=float)
        start, segment = self.vertices[:-1], np.diff(self.vertices, axis=0)
        offset = points[:, None] - start
        along = np.einsum("nsi,si->ns", offset, segment) / np.einsum("si,si->s", segment, segment)
        share = np.clip(along, 0.0, 1.0)
        arrow = offset - share[..., None] * segment
        distance = np.linalg.norm(arrow, axis=-1)
        normal = np.stack([segment[:, 1], -segment[:, 0]], axis=-1)
        # At a vertex two segments are equally near; the one with the larger normal distance determines the sign.
        front = np.einsum("nsi,si->ns", arrow, normal / np.linalg.norm(normal, axis=1)[:, None])
        # Points before the start of the polyline are outside.
        front[:, 0] = np.where(along[:, 0] < 0.0, np.abs(front[:, 0]), front[:, 0])
        closest = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
        rows = np.arange(len(points))
        return np.copysign(distance[rows, closest], front[rows, closest]) - self.rounding

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
