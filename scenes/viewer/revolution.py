"""Picture of a deformed axisymmetric specimen: a solid of revolution with a wedge cut out, coloured by a field.

The wedge makes the section visible.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from scenes.viewer.bands import (
    TriangleConnectivity,
    insert_polyline_points_at_levels,
    renumber_triangles_for_band_meshes,
)
from tissue_sim.errors import InputError
from tissue_sim.fem.result_views import HalfSectionGeometry

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


#: Distance of lines in front of a surface, in radii of the specimen, so that the surface does not hide the lines.
LINE_OFFSET = 1e-3


@dataclass(frozen=True, eq=False)
class PossibleContactBoundary:
    """Part of the half section's boundary that can touch the tool: the top from the axis outwards, then the side.

    Attributes:
        points: Nodes (r, z), m, shape (n, 2).
        gauss_points: Points (r, z) at which the solver enforces contact, one between two neighbouring nodes, m,
            shape (n - 1, 2).
    """

    points: np.ndarray
    gauss_points: np.ndarray


@dataclass(frozen=True, eq=False)
class TriangulatedHalfSection:
    """Pictures of a half section whose division into triangles stays the same from frame to frame.

    Attributes:
        geometry: The half section.
    """

    geometry: HalfSectionGeometry

    @cached_property
    def triangulation(self) -> TriangleConnectivity:
        """Triangles between the points, anticlockwise in the (r, z) plane."""
        return TriangleConnectivity(self.geometry.triangles)

    @cached_property
    def outline(self) -> np.ndarray:
        """Point numbers from the axis along the top, down the side and along the base back to the axis, shape (m,)."""
        return self.geometry.outline

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              opening: WedgeOpening) -> list[TriangulatedSurface]:
        """Return the surface of the solid in each band: its part of the section faces and of the outer surface.

        Args:
            positions: Deformed positions (r, z) of the nodes, shape (nodes, 2).
            values: Field at the nodes, shape (nodes,).
            levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
                above the last level to the last band.
            opening: Wedge that is removed.

        Returns:
            One surface per band in the unit of `positions`; empty if no tissue lies in the band. Section faces and
            outer surface share no vertices.
        """
        points, at_points = self._interpolate_nodal_positions(positions), self.geometry.interpolate_at_points(values)
        bands = len(levels) - 1
        line, band_of_line = insert_polyline_points_at_levels(points[self.outline], at_points[self.outline], levels)
        outside = revolve_polyline_by_band(line, band_of_line, bands, opening)
        if opening.removes_nothing:
            return outside
        pieces = self.triangulation.cut_at_levels(points, at_points, levels)
        sections = make_section_surfaces_by_band(pieces.points, pieces.triangles, pieces.band, bands, opening)
        return [concatenate_surfaces(*both) for both in zip(sections, outside, strict=True)]

    def compute_element_edge_lines(self, positions: np.ndarray, opening: WedgeOpening) -> np.ndarray:
        """Return the element edges on both section faces, shape (lines, 2, 3); a closed solid has none.

        Args:
            positions: Deformed positions (r, z) of the nodes, shape (nodes, 2).
            opening: Wedge that is removed.
        """
        offset = LINE_OFFSET * self.specimen_radius
        return opening.map_to_section_faces(self._interpolate_nodal_positions(positions)[self.geometry.edges],
                                            offset).reshape(-1, 2, 3)

    def make_undeformed_outline(self, opening: WedgeOpening, dashes: int = 40,
                                tool: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Return the dashed outline of the undeformed specimen: section faces and rims, shape (lines, 2, 3).

        Args:
            opening: Wedge that is removed; a closed solid shows four lines along its side instead of section faces.
            dashes: Number of dashes along the height; all dashes have the same length.
            tool: Radius and largest depth of the tool, m; the outline leaves out lines that the tool would cross.
        """
        radius, height = self.specimen_radius, self.specimen_height
        length = 0.5 * height / dashes
        inside, deepest = tool
        covered = inside >= radius
        rims = [_split_polyline_into_dashes(np.concatenate([circle[:, 0], circle[-1:, 1]]), length) for circle in
                (opening.make_arc_lines_outside_wedge(radius, z) for z in ((-height,) if covered else (0.0, -height)))]
        side = np.array([[radius, -deepest if covered else 0.0], [radius, -height], [0.0, -height]])
        corners = side if covered else np.concatenate([[[inside, 0.0]], side])
        if opening.removes_nothing:
            quarter = opening.segment_half_plane_directions[:: max(1, len(opening.segment_half_plane_directions) // 4)]
            lines = [np.concatenate([radius * np.stack([direction, direction]), [[side[0, 1]], [-height]]], axis=1)
                     for direction in quarter]
        else:
            lines = [*opening.map_to_section_faces(corners, LINE_OFFSET * radius),
                     np.array([[0.0, 0.0, -deepest], [0.0, 0.0, -height]])]
        return np.concatenate([*rims, *(_split_polyline_into_dashes(line, length) for line in lines)])

    def compute_possible_contact_boundary(self, positions: np.ndarray) -> PossibleContactBoundary:
        """Return the deformed boundary line that can touch the tool.

        Args:
            positions: Deformed positions (r, z) of the nodes, shape (nodes, 2).
        """
        geometry = self.geometry
        return PossibleContactBoundary(geometry.select_surface_nodes(positions),
                                       geometry.interpolate_at_contact_points(positions))

    @property
    def specimen_radius(self) -> float:
        """Radius of the undeformed specimen, m."""
        return float(self.geometry.nodes[:, 0].max())

    @property
    def specimen_height(self) -> float:
        """Height of the undeformed specimen, m."""
        return float(-self.geometry.nodes[:, 1].min())

    def _interpolate_nodal_positions(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate nodal positions to the points, shape (points, 2)."""
        points = self.geometry.interpolate_at_points(positions)
        # Rounding errors at r = 0 would give thin triangles around the axis.
        r = np.where(np.abs(points[:, 0]) < 1e-9 * self.specimen_radius, 0.0, points[:, 0])
        return np.column_stack([r, points[:, 1]])


def _split_polyline_into_dashes(line: np.ndarray, length: float) -> np.ndarray:
    """Return dashes along a polyline (n, 3), shape (k, 2, 3); gaps are as long as dashes, and both ends are dashes."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = 2 * max(1, round(along[-1] / length / 2)) + 1
    marks = np.linspace(0.0, along[-1], count + 1)
    ends = np.stack([np.interp(marks, along, line[:, k]) for k in range(3)], axis=-1)
    return np.stack([ends[:-1:2], ends[1::2]], axis=1)
