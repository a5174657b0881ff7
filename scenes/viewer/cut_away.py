"""Picture of a deformed axisymmetric specimen: a solid of revolution with a wedge cut out, coloured by a field."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scenes.viewer.bands import TriangleConnectivity, insert_polyline_points_at_levels
from scenes.viewer.revolution import (
    TriangulatedSurface,
    WedgeOpening,
    concatenate_surfaces,
    make_section_surfaces_by_band,
    revolve_polyline_by_band,
)
from tissue_sim.fem.result_views import HalfSectionGeometry

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
