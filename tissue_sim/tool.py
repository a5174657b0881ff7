"""Rigid tools and their profiles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, nearest, require_length

#: How far a shaft reaches above the face, in tool radii: farther than any tissue.
SHAFT_LENGTH = 1e3


@dataclass(frozen=True, eq=False)
class Profile:
    """Outline of a rigid body of revolution: a chain of straight lines, thickened by a rounding radius.

    The frame is the tool's: r from the axis, z out of the tissue, origin at the deepest point. The chain runs from the
    axis outwards and upwards with the body on its left.

    Attributes:
        vertices: (r, z), m, shape (n, 2).
        rounding: m; the surface lies this far outside the chain.
        shaft: index of the first line that belongs to the shaft; those before are the face.
    """

    vertices: np.ndarray
    rounding: float
    shaft: int

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 2) from the surface, m, positive outside, shape (n,)."""
        points = np.asarray(points, dtype=float)
        start, way = self.vertices[:-1], np.diff(self.vertices, axis=0)
        offset = points[:, None] - start
        share = np.clip(np.einsum("nsi,si->ns", offset, way) / np.einsum("si,si->s", way, way), 0.0, 1.0)
        arrow = offset - share[..., None] * way
        distance = np.linalg.norm(arrow, axis=-1)
        normal = np.stack([way[:, 1], -way[:, 0]], axis=-1)
        # Where two lines are equally near, at a vertex, the one that the point stands farther in front of decides.
        front = np.einsum("nsi,si->ns", arrow, normal / np.linalg.norm(normal, axis=1)[:, None])
        closest = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
        rows = np.arange(len(points))
        return np.copysign(distance[rows, closest], front[rows, closest]) - self.rounding

    def outline(self, height: float) -> np.ndarray:
        """Points (r, z) of the surface from the axis up to `height`, m, for drawing, shape (n, 2)."""
        way = np.diff(self.vertices, axis=0)
        angle = np.arctan2(-way[:, 0], way[:, 1])  # of the outward normal
        points = []
        for k, vertex in enumerate(self.vertices):
            turn = np.linspace(angle[max(k - 1, 0)], angle[min(k, len(angle) - 1)], 25)
            points.append(vertex + self.rounding * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
        points = np.concatenate(points)
        points[:, 1] = np.minimum(points[:, 1], height)
        return points


def _flat(tool: Tool) -> Profile:
    a, rounding = tool.radius, tool.edge_radius
    return Profile(np.array([[0.0, rounding], [a - rounding, rounding], [a - rounding, SHAFT_LENGTH * a]]), rounding, 1)


#: Shape -> what makes its profile; a plate covers the whole top face and has none.
SHAPES: dict[str, Callable[[Tool], Profile] | None] = {"plate": None, "flat": _flat}


@dataclass(frozen=True)
class Tool:
    """A rigid body that is moved into the specimen.

    Attributes:
        shape: ``"plate"`` covers the whole top face; ``"flat"`` is a flat-tipped needle with a straight shaft.
        radius: of the shaft, m; a plate has none.
        edge_radius: of the rounding between face and shaft, m.

    Raises:
        InputError: unknown shape, a needle without radius, an edge radius that is not smaller than the radius.
    """

    shape: str = "plate"
    radius: float | None = None
    edge_radius: float = 0.0

    def __post_init__(self):
        if self.shape not in SHAPES:
            raise InputError(f"tool shape {self.shape!r} is not available in this version"
                             f"{nearest(self.shape, SHAPES)}", field="tool")
        if self.shape == "plate":
            if self.radius is not None or self.edge_radius:
                raise InputError("a plate covers the whole top face and has no radius; leave it out",
                                 field="tool.radius")
            return
        if self.radius is None:
            raise InputError(f"a {self.shape} tool needs a radius", field="tool.radius")
        require_length(self.radius, "tool.radius")
        if not (np.isfinite(self.edge_radius) and 0 <= self.edge_radius < self.radius):
            raise InputError(f"an edge radius of {self.edge_radius:g} m does not fit a tool of radius "
                             f"{self.radius:g} m; give 0 or more and less than the radius", field="tool.edge_radius")

    @property
    def profile(self) -> Profile | None:
        """The outline that the tissue meets; None for a plate."""
        make = SHAPES[self.shape]
        return make(self) if make else None

    @property
    def face_radius(self) -> float | None:
        """Radius of the flat part of the face, m; None for a plate."""
        return None if self.radius is None else self.radius - self.edge_radius
