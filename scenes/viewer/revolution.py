"""Surfaces of revolution from which a wedge is removed, so that the section is visible."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from scenes.viewer.bands import renumber_triangles_for_band_meshes
from tissue_sim.errors import InputError

#: Angle between neighbouring lines or triangles above which they are shaded as a sharp edge, rad.
EDGE_ANGLE = np.radians(30.0)
#: Largest angle of the removed wedge, rad.
LARGEST_CUT = np.pi


class TriangulatedSurface(NamedTuple):
    """Triangulated surface in 3D.

    Attributes:
        vertices: Coordinates, shape (v, 3), float32.
        faces: Vertex numbers with outward normals, shape (f, 3), uint32.
    """

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class WedgeOpening:
    """Wedge that is removed from a solid of revolution, and angular resolution of the rest.

    Attributes:
        cut: Angle of the wedge, rad, from 0 (closed) to pi.
        facing: Azimuth of the middle of the wedge, rad; the default opens the wedge towards -y.
        segments: Number of segments in a full turn.

    Raises:
        InputError: An angle is outside its range.
    """

    cut: float = np.radians(120.0)
    facing: float = -np.pi / 2
    segments: int = 48

    def __post_init__(self):
        if not (np.isfinite(self.cut) and 0.0 <= self.cut <= LARGEST_CUT * (1 + 1e-9)):
            raise InputError(f"must be between 0 (closed) and 180 degrees; got {np.degrees(self.cut):g}", field="cut")
        if not np.isfinite(self.facing):
            raise InputError(f"must be a finite azimuth in rad; got {self.facing}", field="facing")

    @property
    def removes_nothing(self) -> bool:
        """Whether the angle of the wedge is zero, so that the whole solid is drawn."""
        return self.cut == 0.0

    @cached_property
    def segment_half_plane_azimuths(self) -> np.ndarray:
        """Azimuths of the half planes that divide the solid, rad, ascending.

        A closed solid lists its first half plane, which is also its last one, only once.
        """
        start, turn = self.facing + 0.5 * self.cut, 2.0 * np.pi - self.cut
        count = max(1, int(np.ceil(self.segments * turn / (2.0 * np.pi) - 1e-9)))
        return np.linspace(start, start + turn, count + 1)[: count if self.removes_nothing else count + 1]

    @cached_property
    def segment_half_plane_directions(self) -> np.ndarray:
        """Unit vectors (x, y) of `segment_half_plane_azimuths`, shape (angles, 2)."""
        return np.stack([np.cos(self.segment_half_plane_azimuths), np.sin(self.segment_half_plane_azimuths)], axis=-1)

    @cached_property
    def section_face_vectors(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Horizontal direction and outward normal (x, y) of both section faces; empty for a closed solid."""
        if self.removes_nothing:
            return []
        first, last = self.segment_half_plane_directions[[0, -1]]
        return [(first, np.array([first[1], -first[0]])), (last, np.array([-last[1], last[0]]))]

    def map_to_section_faces(self, points: np.ndarray, offset: float = 0.0) -> np.ndarray:
        """Map points of the half section to both section faces.

        Args:
            points: Points (r, z), shape (..., 2).
            offset: Distance in front of the faces, in the unit of the points.

        Returns:
            Points (x, y, z), shape (faces, ..., 3).
        """
        mapped = [np.concatenate([points[..., :1] * direction + offset * normal, points[..., 1:]], axis=-1)
                  for direction, normal in self.section_face_vectors]
        return np.array(mapped).reshape(len(mapped), *points.shape[:-1], 3)

    def make_arc_lines_outside_wedge(self, radius: float, z: float) -> np.ndarray:
        """Return the lines of a circle around the axis, without the part inside the wedge, shape (k, 2, 3)."""
        directions = self.segment_half_plane_directions
        ring = np.column_stack([radius * directions, np.full(len(directions), z)])
        after = np.roll(ring, -1, axis=0)
        lines = np.stack([ring, after], axis=1)
        return lines if self.removes_nothing else lines[:-1]


def make_section_surfaces_by_band(points: np.ndarray, triangles: np.ndarray, band: np.ndarray, bands: int,
                                  opening: WedgeOpening, offset: float = 0.0) -> list[TriangulatedSurface]:
    """Return both section faces, split into one surface per band.

    Args:
        points: Points (r, z) of the half section, shape (n, 2).
        triangles: Point numbers, anticlockwise in the (r, z) plane, sorted by band, shape (k, 3).
        band: Band of each triangle, ascending, shape (k,).
        bands: Number of bands.
        opening: Wedge between the faces; a closed solid has no faces.
        offset: Distance of the surfaces in front of the faces, in the unit of the points.
    """
    if opening.removes_nothing:
        return [_make_empty_surface()] * bands
    kept, numbers, slices = renumber_triangles_for_band_meshes(triangles, band, len(points), bands)
    first, last = opening.map_to_section_faces(points[kept], offset).astype(np.float32)
    numbers = numbers.astype(np.uint32)
    back = numbers[:, ::-1]
    return [TriangulatedSurface(np.concatenate([first[points_of], last[points_of]]),
                                np.concatenate([numbers[cut], back[cut] + np.uint32(points_of.stop - points_of.start)]))
            for points_of, cut in slices]


def revolve_polyline_by_band(points: np.ndarray, band: np.ndarray, bands: int,
                             opening: WedgeOpening) -> list[TriangulatedSurface]:
    """Revolve a polyline around the axis; return one surface per band.

    Args:
        points: Points (r, z) with the body on the right-hand side of the polyline, shape (n, 2).
        band: Band of each line, shape (n - 1,).
        bands: Number of bands.
        opening: Wedge that is removed.
    """
    direction = np.diff(points, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1), np.finfo(float).tiny)[:, None]
    cosine = np.einsum("ki,ki->k", direction[1:], direction[:-1])
    separate = (band[1:] != band[:-1]) | (cosine < np.cos(EDGE_ANGLE))
    # The lines of a run share vertices; the runs of a band are contiguous.
    run = np.concatenate([[0], np.cumsum(separate)])
    order = np.argsort(band, kind="stable")
    in_order = run[order]
    starts_run = np.concatenate([[True], in_order[1:] != in_order[:-1]])
    # A run of n lines has n + 1 vertices: line k of the order is preceded by k vertices plus one for each earlier run.
    vertex = np.arange(order.size) + np.cumsum(starts_run) - 1
    profile = np.empty((order.size + int(starts_run.sum()), 2))
    profile[vertex], profile[vertex + 1] = points[order], points[order + 1]
    first_line = np.searchsorted(band[order], np.arange(bands + 1))
    first_vertex = np.append(vertex, len(profile))[first_line]

    count = len(opening.segment_half_plane_azimuths)
    space = np.empty((len(profile), count, 3), dtype=np.float32)
    space[..., :2] = profile[:, :1, None] * opening.segment_half_plane_directions
    space[..., 2] = profile[:, 1:]
    segment = np.arange(count if opening.removes_nothing else count - 1)
    next_segment = (segment + 1) % count
    inner = ((vertex - first_vertex[band[order]]) * count)[:, None]
    outer = inner + count
    quads = np.empty((order.size, segment.size, 2, 3), dtype=np.uint32)
    quads[:, :, 0, 0] = quads[:, :, 1, 0] = inner + segment
    quads[:, :, 0, 1] = outer + segment
    quads[:, :, 0, 2] = quads[:, :, 1, 1] = outer + next_segment
    quads[:, :, 1, 2] = inner + next_segment
    # A quad with two vertices on the axis is a triangle: one of its halves has no area.
    r = profile[:, 0]
    flat = np.stack([r[vertex + 1] == 0.0, r[vertex] == 0.0], axis=-1)
    surfaces = []
    for k in range(bands):
        lines = slice(first_line[k], first_line[k + 1])
        faces = quads[lines]
        if flat[lines].any():
            faces = faces[np.broadcast_to(~flat[lines][:, None], faces.shape[:3])]
        surfaces.append(TriangulatedSurface(space[first_vertex[k] : first_vertex[k + 1]].reshape(-1, 3),
                                            faces.reshape(-1, 3)))
    return surfaces


def concatenate_surfaces(*surfaces: TriangulatedSurface) -> TriangulatedSurface:
    """Combine several surfaces into one without merging their vertices."""
    before = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)]).astype(np.uint32)
    return TriangulatedSurface(np.concatenate([surface.vertices for surface in surfaces]),
                               np.concatenate([surface.faces + first
                                               for surface, first in zip(surfaces, before, strict=False)]))


def _make_empty_surface() -> TriangulatedSurface:
    return TriangulatedSurface(np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint32))
