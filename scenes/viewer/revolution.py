"""Surfaces of revolution that stand open on one side, so that one looks at the section."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from scenes.viewer.bands import by_band
from tissue_sim.errors import InputError

#: Lines that meet at a larger angle are an edge and are shaded so.
EDGE_ANGLE = np.radians(30.0)
LARGEST_CUT = np.pi


class Surface(NamedTuple):
    """Triangles in space.

    Attributes:
        vertices: shape (v, 3), float32.
        faces: vertex numbers, their normals outwards, shape (f, 3), uint32.
    """

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Opening:
    """The wedge that is left out of a solid of revolution, and how finely the rest is divided.

    Attributes:
        cut: angle of the wedge, rad, 0 (closed) to pi.
        facing: azimuth of its middle, rad; the default opens it towards -y.
        segments: of a whole turn.

    Raises:
        InputError: an angle out of range.
    """

    cut: float = np.radians(120.0)
    facing: float = -np.pi / 2
    segments: int = 48

    def __post_init__(self):
        if not (np.isfinite(self.cut) and 0.0 <= self.cut <= LARGEST_CUT * (1 + 1e-9)):
            raise InputError(f"a cut of {np.degrees(self.cut):g} degrees; give 0 (closed) to 180", field="cut")
        if not np.isfinite(self.facing):
            raise InputError("the direction that the cut faces is not a number; give an azimuth", field="facing")

    @property
    def closed(self) -> bool:
        return self.cut == 0.0

    @cached_property
    def angles(self) -> np.ndarray:
        """Azimuths of the half planes that divide the solid, rad, ascending. Those of a closed solid leave out the last
        one, which is the first."""
        start, turn = self.facing + 0.5 * self.cut, 2.0 * np.pi - self.cut
        count = max(1, int(np.ceil(self.segments * turn / (2.0 * np.pi) - 1e-9)))
        return np.linspace(start, start + turn, count + 1)[: count if self.closed else count + 1]

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors of `angles`, shape (angles, 2)."""
        return np.stack([np.cos(self.angles), np.sin(self.angles)], axis=-1)

    @cached_property
    def faces(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """In-plane direction and outward normal, (x, y), of both section faces; none where it is closed."""
        if self.closed:
            return []
        first, last = self.directions[[0, -1]]
        return [(first, np.array([first[1], -first[0]])), (last, np.array([-last[1], last[0]]))]

    def on_faces(self, points: np.ndarray, lift: float = 0.0) -> np.ndarray:
        """Points (..., 2) of the half section on both section faces, shape (faces, ..., 3).

        Args:
            points: (r, z).
            lift: how far in front of the faces, in the unit of the points.
        """
        lifted = [np.concatenate([points[..., :1] * way + lift * normal, points[..., 1:]], axis=-1)
                  for way, normal in self.faces]
        return np.array(lifted).reshape(len(lifted), *points.shape[:-1], 3)

    def circle(self, radius: float, z: float) -> np.ndarray:
        """Lines of the part of a circle around the axis that the solid has, shape (k, 2, 3)."""
        ring = np.column_stack([radius * self.directions, np.full(len(self.directions), z)])
        after = np.roll(ring, -1, axis=0)
        lines = np.stack([ring, after], axis=1)
        return lines if self.closed else lines[:-1]


def section_surfaces(points: np.ndarray, triangles: np.ndarray, band: np.ndarray, bands: int,
                     opening: Opening, lift: float = 0.0) -> list[Surface]:
    """Both section faces, one surface a band.

    Args:
        points: (r, z) of the half section, shape (n, 2).
        triangles: anticlockwise in the (r, z) plane, sorted by band, shape (k, 3).
        band: of each triangle, ascending, shape (k,).
        bands: number of bands.
        opening: where the faces are; a closed solid has none.
        lift: how far in front of that they are.
    """
    if opening.closed:
        return [_nothing()] * bands
    kept, numbers, slices = by_band(triangles, band, len(points), bands)
    first, last = opening.on_faces(points[kept], lift).astype(np.float32)
    numbers = numbers.astype(np.uint32)
    back = numbers[:, ::-1]
    return [Surface(np.concatenate([first[points_of], last[points_of]]),
                    np.concatenate([numbers[cut], back[cut] + np.uint32(points_of.stop - points_of.start)]))
            for points_of, cut in slices]


def revolved_surfaces(points: np.ndarray, band: np.ndarray, bands: int, opening: Opening) -> list[Surface]:
    """A polyline revolved around the axis, one surface a band.

    Args:
        points: (r, z), with the body to the right of the way along it, shape (n, 2).
        band: of each of its lines, shape (n - 1,).
        bands: number of bands.
        opening: what is left out.
    """
    way = np.diff(points, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1), np.finfo(float).tiny)[:, None]
    apart = (band[1:] != band[:-1]) | (np.einsum("ki,ki->k", way[1:], way[:-1]) < np.cos(EDGE_ANGLE))
    # A run of lines shares its vertices; the runs of a band come one after the other.
    run = np.concatenate([[0], np.cumsum(apart)])
    order = np.argsort(band, kind="stable")
    in_order = run[order]
    starts_run = np.concatenate([[True], in_order[1:] != in_order[:-1]])
    # Before line k of the order stand k lines, each with one vertex of its own, and one more vertex a run.
    vertex = np.arange(order.size) + np.cumsum(starts_run) - 1
    place = np.empty((order.size + int(starts_run.sum()), 2))
    place[vertex], place[vertex + 1] = points[order], points[order + 1]
    first_line = np.searchsorted(band[order], np.arange(bands + 1))
    first_vertex = np.append(vertex, len(place))[first_line]

    count = len(opening.angles)
    space = np.empty((len(place), count, 3), dtype=np.float32)
    space[..., :2] = place[:, :1, None] * opening.directions
    space[..., 2] = place[:, 1:]
    here = np.arange(count if opening.closed else count - 1)
    beside = (here + 1) % count
    inner = ((vertex - first_vertex[band[order]]) * count)[:, None]
    outer = inner + count
    quads = np.empty((order.size, here.size, 2, 3), dtype=np.uint32)
    quads[:, :, 0, 0] = quads[:, :, 1, 0] = inner + here
    quads[:, :, 0, 1] = outer + here
    quads[:, :, 0, 2] = quads[:, :, 1, 1] = outer + beside
    quads[:, :, 1, 2] = inner + beside
    # On the axis one half of each quad has no area.
    r = place[:, 0]
    flat = np.stack([r[vertex + 1] == 0.0, r[vertex] == 0.0], axis=-1)
    surfaces = []
    for k in range(bands):
        lines = slice(first_line[k], first_line[k + 1])
        faces = quads[lines]
        if flat[lines].any():
            faces = faces[np.broadcast_to(~flat[lines][:, None], faces.shape[:3])]
        surfaces.append(Surface(space[first_vertex[k] : first_vertex[k + 1]].reshape(-1, 3), faces.reshape(-1, 3)))
    return surfaces


def joined(*surfaces: Surface) -> Surface:
    """Several surfaces as one; no vertices are shared between them."""
    before = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)]).astype(np.uint32)
    return Surface(np.concatenate([surface.vertices for surface in surfaces]),
                   np.concatenate([surface.faces + first for surface, first in zip(surfaces, before, strict=False)]))


def _nothing() -> Surface:
    return Surface(np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint32))
