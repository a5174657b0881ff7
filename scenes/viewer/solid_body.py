"""Picture of a deformed solid in 3D: its surface with a wedge cut out at the tool, coloured by a field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scenes.viewer.bands import TriangleConnectivity, renumber_triangles_for_band_meshes
from scenes.viewer.revolution import EDGE_ANGLE, TriangulatedSurface, WedgeOpening
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.result_views import DrawableFields, SolidGeometry, SubsampledFields
from tissue_sim.mesh.sections import (
    intersect_tetrahedra_at_zero_level,
    intersect_triangles_at_zero_level,
    split_triangles_below_and_above,
)
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


@dataclass(frozen=True)
class SolidPictureAccuracySettings:
    """Accuracy of the picture of a solid.

    Attributes:
        line_offset: Distance of lines in front of a surface, in sizes of the body, so that the surface does not hide
            the lines.
        contact_gap: Largest gap of a point in contact, in radii of the tool.
        dashes: Number of dashes and gaps of the outline along the longest side of the body.
        max_points: Largest number of quadrature points at which fields are evaluated; a body with more points shows
            one mean value per element.
        max_range_elements: Largest number of elements from which the colour range of such a body is computed.
    """

    line_offset: float = 1e-3
    contact_gap: float = 1e-3
    dashes: int = 60
    max_points: int = 40_000
    max_range_elements: int = 3000


#: Settings of the viewer.
SETTINGS = SolidPictureAccuracySettings()


@dataclass(frozen=True, eq=False)
class ThreeDimensionalMeshBody:
    """Surface, edges and cells of a solid in 3D that stay the same from frame to frame.

    A point of the surface is a node on one smooth piece of the surface; a node on a sharp edge has several points.

    Attributes:
        geometry: Geometry of the undeformed solid.
        nodes: Node of each point, shape (p,).
        triangles: Triangles of the surface, point numbers, shape (k, 3).
        lines: Element edges on the surface, point numbers, shape (l, 2).
        sharp: Sharp edges of the undeformed body, point numbers, shape (e, 2).
        at_surface: Elements with a node on the surface, shape (m,).
        for_range: Sample of the elements that represents the body in the colour range, shape (r,).
        corners: Transposed connectivity, node numbers, shape (nodes per element, elements).
    """

    geometry: SolidGeometry
    nodes: np.ndarray
    triangles: np.ndarray
    lines: np.ndarray
    sharp: np.ndarray
    at_surface: np.ndarray
    for_range: np.ndarray
    corners: np.ndarray
    _means: dict[str, SubsampledFields] = field(default_factory=dict)

    @classmethod
    def from_geometry(cls, geometry: SolidGeometry) -> ThreeDimensionalMeshBody:
        """Split the surface into smooth pieces, and find the cells at the surface."""
        triangles, faces, cells = geometry.surface_triangles, geometry.faces, geometry.cells
        nodes, numbers, sharp = _split_surface_at_sharp_edges(geometry.nodes, triangles)
        # (face, node) -> point.
        point_of = dict(zip(zip(np.repeat(np.arange(len(faces)), 3 * faces.shape[1]).tolist(),
                                triangles.ravel().tolist(), strict=True), numbers.ravel().tolist(), strict=True))
        lines = np.array([[point_of[face, node] for node in pair]
                          for face, pairs in enumerate(geometry.face_edges.tolist()) for pair in pairs],
                         dtype=int).reshape(-1, 2)
        _, first = np.unique(np.sort(nodes[lines], axis=1), axis=0, return_index=True)
        on_surface = np.zeros(len(geometry.nodes), dtype=bool)
        on_surface[triangles] = True
        return cls(geometry, nodes, numbers, lines[first], sharp, np.flatnonzero(on_surface[cells].any(axis=1)),
                   np.arange(0, len(cells), max(1, -(-len(cells) // SETTINGS.max_range_elements))),
                   np.ascontiguousarray(cells.T))

    @property
    def longest_extent(self) -> float:
        """Longest extent of the undeformed body, m."""
        return float(np.ptp(self.geometry.nodes, axis=0).max())

    def evaluate_field_at_nodes_and_samples(self, fields: DrawableFields, name: str, positions: np.ndarray,
                                            wedge: Wedge) -> tuple[np.ndarray, np.ndarray, DrawableFields]:
        """Evaluate a field at the visible nodes and at points that represent the body.

        Args:
            fields: Fields of this body.
            name: Name of the field.
            positions: Deformed positions of the nodes, m, shape (nodes, 3).
            wedge: Wedge that is removed.

        Returns:
            Values at the nodes, valid at the visible ones, shape (nodes,); values at quadrature points that represent
            the whole body, shape (elements, q); and the fields to which these points belong.
        """
        if fields.weights.size <= SETTINGS.max_points or not isinstance(fields, SubsampledFields):
            at_points = fields.at_points(name)
            return fields.at_nodes(name, at_points=at_points), at_points, fields
        means = self._means["last"] = fields.with_one_mean_point_per_element(self._means.get("last"))
        sample = means.with_selected_elements(self.for_range)
        at_points = sample.at_points(name)
        if name == "displacement":
            return fields.at_nodes(name), at_points, sample
        cells = self.geometry.cells
        visible = np.zeros(len(cells), dtype=bool)
        visible[self.at_surface] = True
        at_cut = np.zeros(len(self.geometry.nodes), dtype=bool)
        for _, _, elements in self._find_elements_cut_by_section_faces(positions, wedge):
            at_cut[cells[elements]] = True
        # The value of a node is the mean over its elements, so all elements at these nodes are needed.
        visible |= _find_elements_with_flagged_node(at_cut, self.corners)
        return means.with_selected_elements(np.flatnonzero(visible)).at_nodes(name), at_points, sample

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              wedge: Wedge) -> list[TriangulatedSurface]:
        """Return the surface of the solid in each band: its part of the section faces and of the outer surface.

        Args:
            positions: Deformed positions of the nodes, m, shape (nodes, 3).
            values: Field at the nodes, shape (nodes,).
            levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
                above the last level to the last band.
            wedge: Wedge that is removed.

        Returns:
            One surface per band, m; empty if no tissue lies in the band. Section faces and outer surface share no
            vertices.
        """
        points, triangles, (at_points,) = wedge.clip_triangles_at_wedge(positions[self.nodes], self.triangles,
                                                                        values[self.nodes])
        all_points, all_triangles, all_values = [points], [triangles], [at_points]
        before = len(points)
        for face_points, face_triangles, face_values in self._iterate_section_face_triangles(positions, values, wedge):
            all_points.append(face_points)
            all_triangles.append(face_triangles + before)
            all_values.append(face_values)
            before += len(face_points)
        bands = len(levels) - 1
        pieces = TriangleConnectivity(np.concatenate(all_triangles)).cut_at_levels(
            np.concatenate(all_points), np.concatenate(all_values), levels)
        kept, numbers, slices = renumber_triangles_for_band_meshes(pieces.triangles, pieces.band, len(pieces.points),
                                                                   bands)
        space, numbers = pieces.points[kept].astype(np.float32), numbers.astype(np.uint32)
        return [TriangulatedSurface(space[points_of], numbers[cut]) for points_of, cut in slices]

    def compute_element_edge_lines(self, positions: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Return the element edges on the surface and on the section faces, m, shape (lines, 2, 3).

        Args:
            positions: Deformed positions of the nodes, m, shape (nodes, 3).
            wedge: Wedge that is removed.
        """
        offset = SETTINGS.line_offset * self.longest_extent
        points = positions[self.nodes]
        raised = points + offset * _compute_vertex_normals(points, self.triangles)
        on_surface = wedge.transform_scene_to_tool(points)[self.lines]
        lines = [wedge.clip_lines_at_wedge(on_surface, raised[self.lines])]
        local = wedge.transform_scene_to_tool(positions)
        cuts = self._find_elements_cut_by_section_faces(positions, wedge)
        for (heights, along, elements), (_, normal) in zip(cuts, wedge.opening.section_face_vectors, strict=True):
            ends = intersect_triangles_at_zero_level(self.geometry.list_side_triangles(elements), heights)
            kept = (ends.interpolate_nodal_values(along).reshape(-1, 2) >= 0.0).all(axis=1)
            on_face = ends.interpolate_nodal_values(local).reshape(-1, 2, 3)[kept] + offset * np.append(normal, 0.0)
            lines.append(wedge.transform_tool_to_scene(on_face))
        return np.concatenate(lines)

    def make_undeformed_outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Return dashes along the sharp edges of the undeformed body, m, shape (dashes, 2, 3).

        The dashes are in the frame of the mesh. They do not depend on `wedge` and `tool`, which are part of the
        interface `DrawableTissue`.
        """
        length, dashes = self.longest_extent / SETTINGS.dashes, []
        ends = self.geometry.nodes[self.nodes[self.sharp]]
        for start, end in ends:
            count = max(1, round(float(np.linalg.norm(end - start)) / (2.0 * length)))
            at = (np.arange(count)[:, None] + [0.25, 0.75]) / count
            dashes.append(start + at[..., None] * (end - start))
        return np.concatenate(dashes) if dashes else np.empty((0, 2, 3))

    def find_contact_lines_or_none(self, positions: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Return lines around the tissue in contact with the tool and along its sections, m, shape (lines, 2, 3).

        Args:
            positions: Deformed positions of the nodes, m, shape (nodes, 3).
            tool: The tool.
            wedge: Wedge that is removed.

        Returns:
            The lines; None without contact.
        """
        points = positions[self.nodes]
        local = wedge.transform_scene_to_tool(points)
        largest_gap = SETTINGS.contact_gap * (tool.radius or self.longest_extent)
        gaps = tool.profile.gap(np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]]))
        touches = (gaps <= largest_gap)[self.triangles].all(axis=1)
        if not touches.any():
            return None
        touching = self.triangles[touches]
        offset = 2.0 * SETTINGS.line_offset * self.longest_extent
        edges = np.sort(touching[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique_edges, counts = np.unique(edges, axis=0, return_counts=True)
        rim = local[unique_edges[counts == 1]]
        radius = np.linalg.norm(rim[..., :2], axis=-1, keepdims=True)
        raised = rim * np.concatenate([np.repeat(1.0 + offset / np.maximum(radius, offset), 2, axis=-1),
                                       np.ones_like(radius)], axis=-1)
        lines = [wedge.transform_tool_to_scene(wedge.clip_lines_at_wedge(rim, raised))]
        for (heights, along), (_, normal) in zip(wedge.compute_height_and_edge_distance_per_face(local),
                                                 wedge.opening.section_face_vectors, strict=True):
            ends = intersect_triangles_at_zero_level(touching, heights)
            kept = (ends.interpolate_nodal_values(along).reshape(-1, 2) >= 0.0).all(axis=1)
            on_face = ends.interpolate_nodal_values(local).reshape(-1, 2, 3)[kept] + offset * np.append(normal, 0.0)
            lines.append(wedge.transform_tool_to_scene(on_face))
        return np.concatenate(lines)

    def _find_elements_cut_by_section_faces(self, positions: np.ndarray,
                                            wedge: Wedge) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Find the elements that each section face cuts.

        Returns:
            For each section face the heights of the nodes above its plane, m, shape (nodes,), the distances of the
            nodes from its edge, m, shape (nodes,), and the numbers of the elements that the face may cut.
        """
        cached = wedge.cache.get(id(positions))
        if cached is None:
            cached = []
            in_tool_frame = wedge.transform_scene_to_tool(positions)
            for heights, along in wedge.compute_height_and_edge_distance_per_face(in_tool_frame):
                above = heights > 0.0
                crossed = (_find_elements_with_flagged_node(above, self.corners)
                           & _find_elements_with_flagged_node(~above, self.corners)
                           & _find_elements_with_flagged_node(along >= 0.0, self.corners))
                cached.append((heights, along, np.flatnonzero(crossed)))
            wedge.cache[id(positions)] = cached
        return cached

    def _iterate_section_face_triangles(self, positions: np.ndarray, values: np.ndarray,
                                        wedge: Wedge) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield points, triangles and values of each section face."""
        for heights, along, elements in self._find_elements_cut_by_section_faces(positions, wedge):
            crossings, triangles = intersect_tetrahedra_at_zero_level(
                self.geometry.list_tetrahedra(elements), heights)
            edge, _, kept = split_triangles_below_and_above(triangles, crossings.interpolate_nodal_values(along))
            points, at_points = (edge.append_interpolated_values(crossings.interpolate_nodal_values(each))
                                 for each in (positions, values))
            yield points, kept, at_points


def _find_elements_with_flagged_node(of_nodes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which elements have at least one node with a true flag; loops over rows, which is faster in memory."""
    found = of_nodes[corners[0]]
    for nodes in corners[1:]:
        found |= of_nodes[nodes]
    return found


def _split_surface_at_sharp_edges(positions: np.ndarray,
                                  triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split a surface into smooth pieces along edges whose triangles meet at more than `EDGE_ANGLE`.

    Args:
        positions: Positions of the nodes, shape (nodes, 3).
        triangles: Node numbers, shape (k, 3).

    Returns:
        The node of each point, shape (p,); the triangles in point numbers, shape (k, 3); and the sharp edges in point
        numbers, shape (e, 2).
    """
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = np.sort(ends, axis=1) @ [len(positions), 1]
    order = np.argsort(keys, kind="stable")
    pair = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    first, second = order[pair], order[pair + 1]
    bent = np.einsum("ti,ti->t", normals[first // 3], normals[second // 3]) < np.cos(EDGE_ANGLE)
    links = coo_array((np.ones((~bent).sum()), (first[~bent] // 3, second[~bent] // 3)), shape=(len(triangles),) * 2)
    _, piece = connected_components(links, directed=False)
    points, numbers = np.unique(piece[:, None].astype(np.int64) * len(positions) + triangles, return_inverse=True)
    numbers = numbers.reshape(-1, 3)
    sharp = numbers[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)[first[bent]]
    return points % len(positions), numbers, sharp


def _compute_vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the area-weighted unit normals at the points, shape (n, 3)."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    normals = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = np.column_stack([np.bincount(triangles.ravel(), normals[:, axis], len(points)) for axis in range(3)])
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(float).tiny)
