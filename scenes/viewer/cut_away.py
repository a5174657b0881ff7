"""The deformed specimen as a solid with a wedge cut out, in the colours of a field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.sparse import csr_array

from scenes.viewer.bands import Triangulation, split_polyline
from scenes.viewer.revolution import Opening, Surface, joined, revolved_surfaces, section_surfaces
from tissue_sim.mesh import Mesh

#: Parts of an element's edge that are drawn straight: so many that a section has about `CELLS` of them, within reason.
CELLS, FEWEST, MOST = 350, 2, 5
#: How far lines lie in front of a surface, in radii of the specimen.
LIFT = 1e-3


@dataclass(frozen=True, eq=False)
class SurfaceLine:
    """What of the half section may meet the tool: the top from the axis outwards, then the side.

    Attributes:
        points: nodes, (r, z), shape (n, 2).
        watched: where the solver watches for contact: a Gauss point between each two of them, shape (n - 1, 2).
    """

    points: np.ndarray
    watched: np.ndarray


@dataclass(frozen=True, eq=False)
class CutAway:
    """What does not change from frame to frame: the half section as small triangles between points of the elements.

    Attributes:
        mesh: undeformed mesh.
        weights: of the nodes in each point, by the elements' shape functions, shape (points, nodes).
        triangulation: of the points, anticlockwise in the (r, z) plane.
        outline: points from the axis along the top, down the side and along the base back to the axis, shape (m,).
        surface: nodes of the top from the axis outwards, then of the side, shape (n,).
        watched: of the nodes in the Gauss points between them, shape (n - 1, nodes).
        edges: lines of the element edges, point numbers, shape (k, 2).
    """

    mesh: Mesh
    weights: csr_array
    triangulation: Triangulation
    outline: np.ndarray
    surface: np.ndarray
    watched: csr_array
    edges: np.ndarray

    @classmethod
    def of(cls, mesh: Mesh, divisions: int | None = None) -> CutAway:
        """Divide the elements.

        Args:
            mesh: quadrilaterals in the (r, z) half plane.
            divisions: parts of each element's edge; None: as many as `CELLS` says.
        """
        if divisions is None:
            divisions = min(max(round((CELLS / len(mesh.connectivity)) ** 0.5), FEWEST), MOST)
        line = np.linspace(-1.0, 1.0, divisions + 1)
        shapes, _ = mesh.element.shape_functions(np.array([(a, b) for b in line for a in line]))
        # Elements that share a point make it of the same nodes with the same weights.
        points: dict[tuple, int] = {}
        number = np.array([[points.setdefault(key, len(points)) for key in _recipes(nodes, shapes)]
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

        place = matrix @ mesh.nodes
        top, side, base = (_on(mesh.sets[name], points) for name in ("top", "side", "base"))
        top, side = top[np.argsort(place[top, 0])], side[np.argsort(-place[side, 1])]
        base = base[np.argsort(-place[base, 0])]
        outline = np.concatenate([top, side[1:], base[1:]])
        return cls(mesh, matrix, Triangulation(triangles), outline, *_surface(mesh), edges)

    def bands(self, place: np.ndarray, values: np.ndarray, levels: np.ndarray, opening: Opening) -> list[Surface]:
        """The solid, one surface a band: section faces and outer surface, which share no vertices.

        Args:
            place: of the nodes in the deformed state, (r, z), shape (nodes, 2).
            values: of the field at the nodes, shape (nodes,).
            levels: ascending, shape (bands + 1,). The first and the last band also take what lies beyond them.
            opening: what is cut out.

        Returns:
            For each band its surface, in the unit of `place`; empty where no tissue is in the band.
        """
        points, at_points = self._at_points(place), self.weights @ values
        bands = len(levels) - 1
        line, band_of_line = split_polyline(points[self.outline], at_points[self.outline], levels)
        outside = revolved_surfaces(line, band_of_line, bands, opening)
        if opening.closed:
            return outside
        pieces = self.triangulation.cut(points, at_points, levels)
        sections = section_surfaces(pieces.points, pieces.triangles, pieces.band, bands, opening)
        return [joined(*both) for both in zip(sections, outside, strict=True)]

    def mesh_lines(self, place: np.ndarray, opening: Opening) -> np.ndarray:
        """Element edges on both section faces, shape (lines, 2, 3); none on a closed solid."""
        return opening.on_faces(self._at_points(place)[self.edges], LIFT * self.radius).reshape(-1, 2, 3)

    def undeformed_outline(self, opening: Opening, dashes: int = 40,
                           tool: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Dashed outline of the undeformed specimen: both section faces and the rims, shape (lines, 2, 3).

        Args:
            opening: what is cut out; a closed solid shows four lines down its side.
            dashes: along its height; dashes are equally long everywhere.
            tool: radius and largest depth of a tool that comes in, m: no line runs across it.
        """
        radius, height = self.radius, self.height
        length = 0.5 * height / dashes
        inside, deepest = tool
        covered = inside >= radius
        rims = [_dashed(np.concatenate([circle[:, 0], circle[-1:, 1]]), length) for circle in
                (opening.circle(radius, z) for z in ((-height,) if covered else (0.0, -height)))]
        side = np.array([[radius, -deepest if covered else 0.0], [radius, -height], [0.0, -height]])
        corners = side if covered else np.concatenate([[[inside, 0.0]], side])
        if opening.closed:
            quarter = opening.directions[:: max(1, len(opening.directions) // 4)]
            lines = [np.concatenate([radius * np.stack([way, way]), [[side[0, 1]], [-height]]], axis=1)
                     for way in quarter]
        else:
            lines = [*opening.on_faces(corners, LIFT * radius), np.array([[0.0, 0.0, -deepest], [0.0, 0.0, -height]])]
        return np.concatenate([*rims, *(_dashed(line, length) for line in lines)])

    def surface_line(self, place: np.ndarray) -> SurfaceLine:
        """The deformed line that may meet the tool.

        Args:
            place: of the nodes, (r, z), shape (nodes, 2).
        """
        return SurfaceLine(place[self.surface], self.watched @ place)

    @property
    def radius(self) -> float:
        """Of the undeformed specimen, m."""
        return float(self.mesh.nodes[:, 0].max())

    @property
    def height(self) -> float:
        """Of the undeformed specimen, m."""
        return float(-self.mesh.nodes[:, 1].min())

    def _at_points(self, place: np.ndarray) -> np.ndarray:
        points = self.weights @ place
        # The axis stays where it is; rounding would leave slivers around it.
        points[np.abs(points[:, 0]) < 1e-9 * self.radius, 0] = 0.0
        return points


def _recipes(nodes: list[int], shapes: np.ndarray) -> Iterator[tuple]:
    """Of every point of an element, which nodes it is made of and with which weights."""
    for row in shapes.tolist():
        yield tuple(sorted((node, round(weight, 9)) for node, weight in zip(nodes, row, strict=True)
                           if abs(weight) > 1e-9))


def _on(nodes: np.ndarray, points: dict[tuple, int]) -> np.ndarray:
    """Points that are made of these nodes only."""
    among = set(nodes.tolist())
    return np.array([number for key, number in points.items() if all(node in among for node, _ in key)])


def _surface(mesh: Mesh) -> tuple[np.ndarray, csr_array]:
    """Nodes of top and side in order, and what the Gauss points between them are made of."""
    top, side, order = mesh.sets["top"], mesh.sets["side"], mesh.element.order
    nodes = np.concatenate([top[np.argsort(mesh.nodes[top, 0])], side[np.argsort(-mesh.nodes[side, 1])][1:]])
    along, _ = leggauss(order)
    shapes, _ = mesh.element.shape_functions(np.column_stack([along, np.full(order, -1.0)]))
    shares = shapes[:, list(mesh.element.edges[0])]
    of_edge = nodes[np.arange(0, nodes.size - 1, order)[:, None] + np.arange(order + 1)]
    columns = np.repeat(of_edge, order, axis=0)
    rows = np.broadcast_to(np.arange(len(columns))[:, None], columns.shape)
    weights = np.tile(shares, (len(of_edge), 1))
    return nodes, csr_array((weights.ravel(), (rows.ravel(), columns.ravel())), shape=(len(columns), len(mesh.nodes)))


def _dashed(line: np.ndarray, length: float) -> np.ndarray:
    """Dashes along a polyline (n, 3), as long as the gaps between them, shape (k, 2, 3); it starts and ends on one."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = 2 * max(1, round(along[-1] / length / 2)) + 1
    marks = np.linspace(0.0, along[-1], count + 1)
    ends = np.stack([np.interp(marks, along, line[:, k]) for k in range(3)], axis=-1)
    return np.stack([ends[:-1:2], ends[1::2]], axis=1)
