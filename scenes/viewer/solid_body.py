"""A deformed solid in space with a wedge cut out at the tool, in the colours of a field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scenes.viewer.bands import Triangulation, by_band
from scenes.viewer.revolution import EDGE_ANGLE, Surface
from scenes.viewer.wedge import Wedge
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.fields import extrapolate
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.mesh.sections import clip, section, section_lines
from tissue_sim.mesh.subdivision import side_edges, surface_triangles, tetrahedra

#: How far lines lie in front of a surface, in sizes of the body.
LIFT = 1e-3
#: What is nearer to the tool than this, in its radii, touches it.
TOUCH = 1e-3
#: Along the longest side of a body, with the gaps between them.
_DASHES = 60
#: Most quadrature points that are looked at for a picture, and most elements for the range of its colours: of a larger
#: body elements are seen in their mean, and some of them stand for all.
MOST_POINTS, MOST_OF_RANGE = 40_000, 3000


@dataclass(frozen=True, eq=False)
class SolidBody:
    """What does not change from frame to frame.

    Attributes:
        mesh: undeformed; see `tissue_sim.mesh.solid.SolidMesh`.
        cells: tetrahedra of each element, node numbers, shape (elements, t, 4).
        nodes: of the points of the surface, shape (p,): a node has one for each smooth piece of surface that it is on.
        triangles: of the surface, numbers of points, shape (k, 3).
        lines: element edges on the surface, numbers of points, shape (l, 2).
        sharp: edges of the undeformed body, numbers of points, shape (e, 2).
        at_surface: elements that have a node on the surface, shape (m,).
        for_range: elements that stand for all in the range of the colours, shape (r,).
        corners: the nodes of the elements, one row for each of their places, shape (nodes of an element, elements).
    """

    mesh: Any
    cells: np.ndarray
    nodes: np.ndarray
    triangles: np.ndarray
    lines: np.ndarray
    sharp: np.ndarray
    at_surface: np.ndarray
    for_range: np.ndarray
    corners: np.ndarray
    _means: dict[int, tuple[np.ndarray, SolidFields]] = field(default_factory=dict)

    @classmethod
    def of(cls, mesh: Any) -> SolidBody:
        """Divide the elements of a mesh in space."""
        element, sides = mesh.element, np.concatenate(list(mesh.faces.values()))
        triangles = surface_triangles(element, sides)
        nodes, numbers, sharp = _smooth_pieces(mesh.nodes, triangles)
        per_side = len(triangles) // len(sides)
        # Of each side the point at each of its nodes: they are those of its first triangle's piece, and of the others.
        known = dict(zip(zip(np.repeat(np.arange(len(sides)), 3 * per_side).tolist(), triangles.ravel().tolist(),
                             strict=True), numbers.ravel().tolist(), strict=True))
        around = sides[:, side_edges(element)]
        lines = np.array([[known[side, node] for node in pair] for side, pairs in enumerate(around.tolist())
                          for pair in pairs])
        _, first = np.unique(np.sort(nodes[lines], axis=1), axis=0, return_index=True)
        on_surface = np.zeros(len(mesh.nodes), dtype=bool)
        on_surface[sides] = True
        at_surface = np.flatnonzero(on_surface[mesh.connectivity].any(axis=1))
        count = len(mesh.connectivity)
        return cls(mesh, mesh.connectivity[:, tetrahedra(element)], nodes, numbers, lines[first], sharp, at_surface,
                   np.arange(0, count, -(-count // MOST_OF_RANGE)), np.ascontiguousarray(mesh.connectivity.T))

    @property
    def size(self) -> float:
        """Longest extent of the undeformed body, m."""
        return float(np.ptp(self.mesh.nodes, axis=0).max())

    def values(self, fields: SolidFields, name: str, place: np.ndarray,
               wedge: Wedge) -> tuple[np.ndarray, np.ndarray, SolidFields]:
        """A field where it is seen.

        Args:
            fields: of this body.
            name: of the field.
            place: of the nodes, m, shape (nodes, 3).
            wedge: that is cut out.

        Returns:
            At the nodes that are seen, shape (nodes,); at points that stand for the whole body; and the fields there.
        """
        whole = fields.weights.size <= MOST_POINTS
        means = fields if whole else self._mean_of(fields)
        few = fields if whole else means.part(self.for_range)
        at_points = few.at_points(name)
        if name == "displacement":
            return fields.at_nodes(name), at_points, few
        if whole:
            return extrapolate(self.mesh, at_points), at_points, few
        seen = np.zeros(len(self.mesh.connectivity), dtype=bool)
        seen[self.at_surface] = True
        at_cut = np.zeros(len(self.mesh.nodes), dtype=bool)
        for _, _, elements in self._cut(place, wedge):
            at_cut[self.mesh.connectivity[elements]] = True
        # All that share a node with these, since a node has the mean of its elements.
        seen |= _any(at_cut, self.corners)
        return means.part(np.flatnonzero(seen)).at_nodes(name), at_points, few

    def _mean_of(self, fields: SolidFields) -> SolidFields:
        """`SolidFields.means`, with what does not change from frame to frame kept."""
        known = self._means.get(0)
        if known is None or known[0] is not fields.gradients:
            known = self._means[0] = fields.gradients, fields.means()
        if fields.stresses is not None:
            return fields.means()
        mean = known[1]
        return replace(fields, gradients=mean.gradients, pressure_modes=mean.pressure_modes, weights=mean.weights)

    def bands(self, place: np.ndarray, values: np.ndarray, levels: np.ndarray, wedge: Wedge) -> list[Surface]:
        """The solid, one surface a band: section faces and outer surface, which share no vertices.

        Args:
            place: of the nodes in the deformed state, m, shape (nodes, 3).
            values: of the field at the nodes, shape (nodes,).
            levels: ascending, shape (bands + 1,). The first and the last band also take what lies beyond them.
            wedge: what is cut out.

        Returns:
            For each band its surface, m; empty where no tissue is in the band.
        """
        points, triangles, (carried,) = wedge.left_of(place[self.nodes], self.triangles, values[self.nodes])
        all_points, all_triangles, all_values = [points], [triangles], [carried]
        before = len(points)
        for corners, between, at in self._faces(place, values, wedge):
            all_points.append(corners)
            all_triangles.append(between + before)
            all_values.append(at)
            before += len(corners)
        bands = len(levels) - 1
        pieces = Triangulation(np.concatenate(all_triangles)).cut(np.concatenate(all_points),
                                                                 np.concatenate(all_values), levels)
        kept, numbers, slices = by_band(pieces.triangles, pieces.band, len(pieces.points), bands)
        space, numbers = pieces.points[kept].astype(np.float32), numbers.astype(np.uint32)
        return [Surface(space[points_of], numbers[cut]) for points_of, cut in slices]

    def mesh_lines(self, place: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Element edges on the surface and on the section faces, m, shape (lines, 2, 3)."""
        lift = LIFT * self.size
        points = place[self.nodes]
        raised = points + lift * _normals(points, self.triangles)
        on_surface = wedge.into(points)[self.lines]
        lines = [wedge.lines_left(on_surface, raised[self.lines])]
        element, local = self.mesh.element, wedge.into(place)
        for (heights, along, elements), (_, normal) in zip(self._cut(place, wedge), wedge.opening.faces, strict=True):
            sides = self.mesh.connectivity[elements][:, element.faces].reshape(-1, element.faces.shape[1])
            ends = section_lines(surface_triangles(element, sides), heights)
            kept = (ends.carry(along).reshape(-1, 2) >= 0.0).all(axis=1)
            flat = ends.carry(local).reshape(-1, 2, 3)[kept] + lift * np.append(normal, 0.0)
            lines.append(wedge.out_of(flat))
        return np.concatenate(lines)

    def outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Dashes along the edges of the undeformed body, whatever is cut out and wherever the tool is, in the frame of
        the mesh, m, shape (dashes, 2, 3)."""
        length, dashes = self.size / _DASHES, []
        ends = self.mesh.nodes[self.nodes[self.sharp]]
        for start, end in ends:
            count = max(1, round(float(np.linalg.norm(end - start)) / (2.0 * length)))
            at = (np.arange(count)[:, None] + [0.25, 0.75]) / count
            dashes.append(start + at[..., None] * (end - start))
        return np.concatenate(dashes) if dashes else np.empty((0, 2, 3))

    def contact_lines(self, place: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Around the tissue that touches the tool, and where section faces meet it, m, shape (lines, 2, 3); None where
        none touches."""
        points = place[self.nodes]
        local = wedge.into(points)
        near = TOUCH * (tool.radius or self.size)
        gaps = tool.profile.gap(np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]]))
        touches = (gaps <= near)[self.triangles].all(axis=1)
        if not touches.any():
            return None
        touching = self.triangles[touches]
        lift = 2.0 * LIFT * self.size
        edges = np.sort(touching[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        different, times = np.unique(edges, axis=0, return_counts=True)
        rim = local[different[times == 1]]
        away = np.linalg.norm(rim[..., :2], axis=-1, keepdims=True)
        raised = rim * np.concatenate([np.repeat(1.0 + lift / np.maximum(away, lift), 2, axis=-1),
                                       np.ones_like(away)], axis=-1)
        lines = [wedge.out_of(wedge.lines_left(rim, raised))]
        for (heights, along), (_, normal) in zip(wedge.over_faces(local), wedge.opening.faces, strict=True):
            ends = section_lines(touching, heights)
            kept = (ends.carry(along).reshape(-1, 2) >= 0.0).all(axis=1)
            lines.append(wedge.out_of(ends.carry(local).reshape(-1, 2, 3)[kept] + lift * np.append(normal, 0.0)))
        return np.concatenate(lines)

    def _cut(self, place: np.ndarray, wedge: Wedge) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of each section face: heights of the nodes over its plane, how far they are from its edge, and the elements
        that may have a part of it."""
        known = wedge.known.get(id(place))
        if known is None:
            known = []
            for heights, along in wedge.over_faces(wedge.into(place)):
                above = heights > 0.0
                crossed = _any(above, self.corners) & _any(~above, self.corners) & _any(along >= 0.0, self.corners)
                known.append((heights, along, np.flatnonzero(crossed)))
            wedge.known[id(place)] = known
        return known

    def _faces(self, place: np.ndarray, values: np.ndarray,
               wedge: Wedge) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Points, triangles and values of each section face."""
        for heights, along, elements in self._cut(place, wedge):
            crossings, triangles = section(self.cells[elements].reshape(-1, 4), heights)
            edge, _, kept = clip(triangles, crossings.carry(along))
            yield edge.extend(crossings.carry(place)), kept, edge.extend(crossings.carry(values))


def _any(of_nodes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Which elements have a node of which this is true; by rows, which is quicker than by elements."""
    found = of_nodes[corners[0]]
    for nodes in corners[1:]:
        found |= of_nodes[nodes]
    return found


def _smooth_pieces(place: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A surface in pieces that are bent by no more than `EDGE_ANGLE` between two triangles: the node of each point, the
    triangles between points, and the lines where pieces meet, numbers of points, shape (e, 2)."""
    a, b, c = np.moveaxis(place[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = np.sort(ends, axis=1) @ [len(place), 1]
    order = np.argsort(keys, kind="stable")
    pair = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    first, second = order[pair], order[pair + 1]
    bent = np.einsum("ti,ti->t", normals[first // 3], normals[second // 3]) < np.cos(EDGE_ANGLE)
    links = coo_array((np.ones((~bent).sum()), (first[~bent] // 3, second[~bent] // 3)), shape=(len(triangles),) * 2)
    _, piece = connected_components(links, directed=False)
    points, numbers = np.unique(piece[:, None].astype(np.int64) * len(place) + triangles, return_inverse=True)
    numbers = numbers.reshape(-1, 3)
    sharp = numbers[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)[first[bent]]
    return points % len(place), numbers, sharp


def _normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals at the points, shape (n, 3)."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    each = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = np.column_stack([np.bincount(triangles.ravel(), each[:, axis], len(points)) for axis in range(3)])
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(float).tiny)
