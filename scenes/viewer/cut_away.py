"""Picture of a deformed axisymmetric specimen: a solid of revolution with a wedge cut out, coloured by a field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.sparse import csr_array

from scenes.viewer.bands import TriangleConnectivity, insert_polyline_points_at_levels
from scenes.viewer.revolution import (
    TriangulatedSurface,
    WedgeOpening,
    concatenate_surfaces,
    make_section_surfaces_by_band,
    revolve_polyline_by_band,
)
from tissue_sim.mesh import Mesh


@dataclass(frozen=True)
class HalfSectionDivisionSettings:
    """Resolution of the picture of a half section.

    Attributes:
        cells: Desired number of cells into which the elements are divided; more cells draw curved edges more smoothly.
        min_divisions: Smallest number of straight parts of an element edge.
        max_divisions: Largest number of straight parts of an element edge.
        line_offset: Distance of lines in front of a surface, in radii of the specimen, so that the surface does not
            hide the lines.
    """

    cells: int = 350
    min_divisions: int = 2
    max_divisions: int = 5
    line_offset: float = 1e-3


#: Settings of the viewer.
SETTINGS = HalfSectionDivisionSettings()


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
    """Half section divided into small triangles; the division stays the same from frame to frame.

    Attributes:
        mesh: Undeformed mesh.
        weights: Shape functions that interpolate from the nodes to the points, shape (points, nodes).
        triangulation: Triangles between the points, anticlockwise in the (r, z) plane.
        outline: Point numbers from the axis along the top, down the side and along the base back to the axis,
            shape (m,).
        surface: Node numbers of the top from the axis outwards, then of the side, shape (n,).
        gauss_weights: Shape functions that interpolate from the nodes to the Gauss points between the nodes of
            `surface`, shape (n - 1, nodes).
        edges: Lines along the element edges, point numbers, shape (k, 2).
    """

    mesh: Mesh
    weights: csr_array
    triangulation: TriangleConnectivity
    outline: np.ndarray
    surface: np.ndarray
    gauss_weights: csr_array
    edges: np.ndarray

    @classmethod
    def from_mesh(cls, mesh: Mesh, divisions: int | None = None) -> TriangulatedHalfSection:
        """Divide the elements of a mesh into small triangles.

        Args:
            mesh: Quadrilaterals in the (r, z) half plane.
            divisions: Number of straight parts of each element edge; None: as `HalfSectionDivisionSettings` states.
        """
        if divisions is None:
            divisions = min(max(round((SETTINGS.cells / len(mesh.connectivity)) ** 0.5), SETTINGS.min_divisions),
                            SETTINGS.max_divisions)
        line = np.linspace(-1.0, 1.0, divisions + 1)
        shapes, _ = mesh.element.evaluate_shape_functions_and_gradients(np.array([(a, b) for b in line for a in line]))
        # A point is identified by its nodes and weights, which are the same in all elements that share the point.
        points: dict[tuple, int] = {}
        number = np.array([[points.setdefault(key, len(points)) for key in _iterate_point_interpolations(nodes, shapes)]
                           for nodes in mesh.connectivity.tolist()])
        rows = np.repeat(np.arange(len(points)), [len(key) for key in points])
        nodes, weights = np.array([entry for key in points for entry in key]).T
        matrix = csr_array((weights, (rows, nodes.astype(int))), shape=(len(points), len(mesh.nodes)))

        grid = number.reshape(-1, divisions + 1, divisions + 1)
        low, right, left, high = (grid[:, :-1, :-1], grid[:, :-1, 1:], grid[:, 1:, :-1], grid[:, 1:, 1:])
        triangles = np.concatenate([np.stack([low, right, high], axis=-1).reshape(-1, 3),
                                    np.stack([low, high, left], axis=-1).reshape(-1, 3)])
        rim = np.concatenate([grid[:, 0], grid[:, -1], grid[:, :, 0], grid[:, :, -1]])
        edges = np.unique(np.sort(np.stack([rim[:, :-1], rim[:, 1:]], axis=-1).reshape(-1, 2), axis=1), axis=0)

        coordinates = matrix @ mesh.nodes
        top, side, base = (_select_points_on_node_set(mesh.sets[name], points)
                           for name in ("top", "side", "base"))
        top, side = top[np.argsort(coordinates[top, 0])], side[np.argsort(-coordinates[side, 1])]
        base = base[np.argsort(-coordinates[base, 0])]
        outline = np.concatenate([top, side[1:], base[1:]])
        return cls(mesh, matrix, TriangleConnectivity(triangles), outline,
                   *_find_surface_nodes_and_gauss_shape_functions(mesh), edges)

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
        points, at_points = self._interpolate_nodal_positions(positions), self.weights @ values
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
        offset = SETTINGS.line_offset * self.specimen_radius
        return opening.map_to_section_faces(self._interpolate_nodal_positions(positions)[self.edges],
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
            lines = [*opening.map_to_section_faces(corners, SETTINGS.line_offset * radius),
                     np.array([[0.0, 0.0, -deepest], [0.0, 0.0, -height]])]
        return np.concatenate([*rims, *(_split_polyline_into_dashes(line, length) for line in lines)])

    def compute_possible_contact_boundary(self, positions: np.ndarray) -> PossibleContactBoundary:
        """Return the deformed boundary line that can touch the tool.

        Args:
            positions: Deformed positions (r, z) of the nodes, shape (nodes, 2).
        """
        return PossibleContactBoundary(positions[self.surface], self.gauss_weights @ positions)

    @property
    def specimen_radius(self) -> float:
        """Radius of the undeformed specimen, m."""
        return float(self.mesh.nodes[:, 0].max())

    @property
    def specimen_height(self) -> float:
        """Height of the undeformed specimen, m."""
        return float(-self.mesh.nodes[:, 1].min())

    def _interpolate_nodal_positions(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate nodal positions to the points, shape (points, 2)."""
        points = self.weights @ positions
        # Rounding errors at r = 0 would give thin triangles around the axis.
        points[np.abs(points[:, 0]) < 1e-9 * self.specimen_radius, 0] = 0.0
        return points


def _iterate_point_interpolations(nodes: list[int], shapes: np.ndarray) -> Iterator[tuple]:
    """Yield for each point of an element the nodes and weights that define the point."""
    for row in shapes.tolist():
        yield tuple(sorted((node, round(weight, 9)) for node, weight in zip(nodes, row, strict=True)
                           if abs(weight) > 1e-9))


def _select_points_on_node_set(nodes: np.ndarray, points: dict[tuple, int]) -> np.ndarray:
    """Return the numbers of the points that depend on the given nodes only."""
    members = set(nodes.tolist())
    return np.array([number for key, number in points.items() if all(node in members for node, _ in key)])


def _find_surface_nodes_and_gauss_shape_functions(mesh: Mesh) -> tuple[np.ndarray, csr_array]:
    """Return the nodes of top and side in order, and the shape functions at the Gauss points between them."""
    top, side, order = mesh.sets["top"], mesh.sets["side"], mesh.element.order
    nodes = np.concatenate([top[np.argsort(mesh.nodes[top, 0])], side[np.argsort(-mesh.nodes[side, 1])][1:]])
    along, _ = leggauss(order)
    shapes, _ = mesh.element.evaluate_shape_functions_and_gradients(np.column_stack([along, np.full(order, -1.0)]))
    edge_shapes = shapes[:, list(mesh.element.local_edge_node_indices[0])]
    edge_nodes = nodes[np.arange(0, nodes.size - 1, order)[:, None] + np.arange(order + 1)]
    columns = np.repeat(edge_nodes, order, axis=0)
    rows = np.broadcast_to(np.arange(len(columns))[:, None], columns.shape)
    weights = np.tile(edge_shapes, (len(edge_nodes), 1))
    return nodes, csr_array((weights.ravel(), (rows.ravel(), columns.ravel())), shape=(len(columns), len(mesh.nodes)))


def _split_polyline_into_dashes(line: np.ndarray, length: float) -> np.ndarray:
    """Return dashes along a polyline (n, 3), shape (k, 2, 3); gaps are as long as dashes, and both ends are dashes."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = 2 * max(1, round(along[-1] / length / 2)) + 1
    marks = np.linspace(0.0, along[-1], count + 1)
    ends = np.stack([np.interp(marks, along, line[:, k]) for k in range(3)], axis=-1)
    return np.stack([ends[:-1:2], ends[1::2]], axis=1)
