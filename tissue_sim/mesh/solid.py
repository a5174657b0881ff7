"""Structured meshes of hexahedra: blocks, and cylinders whose elements are graded towards a tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.axisymmetric import growing_line
from tissue_sim.mesh.hexahedra import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.mesh.solid_element import SolidElement
from tissue_sim.mesh.tetrahedra import TET8P0, TET15P1

#: Elements of the solid by their names.
SOLID_ELEMENTS: dict[str, SolidElement] = {element.name: element for element in (HEX27P1, HEX8P0, TET15P1, TET8P0)}

#: Nodes nearer to each other than this share of the mesh's size are one.
_SAME = 1e-9
#: Share of the tool's radius to which the square core of a cylinder's mesh reaches, and how round its sides are: 0 of a
#: square, 1 of a circle.
_CORE, _ROUND = 0.5, 0.4
#: A map of two coordinates in [0, 1] to (x, y), m.
_Map = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """Elements in space; the undeformed top face is z = 0 and the base z = -height.

    Attributes:
        element: element type.
        nodes: coordinates, m, shape (n, 3).
        connectivity: node numbers in the element's order, shape (elements, nodes of the element).
        sets: named node numbers, sorted: ``base``, ``top``, ``side``; where a needle comes down also ``face``, what is
            under its flat face, and ``free``, the rest of the top, both with the nodes at the edge.
        faces: element sides on the surface, by the names ``base``, ``top`` and ``side``, as node numbers, shape (m,
            nodes of a side); see `SolidElement.faces`.
    """

    element: SolidElement
    nodes: np.ndarray
    connectivity: np.ndarray
    sets: dict[str, np.ndarray] = field(default_factory=dict)
    faces: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def node_areas(self) -> np.ndarray:
        """Of the surface that each node stands for, m2, shape (n,)."""
        areas = np.zeros(len(self.nodes))
        for faces in self.faces.values():
            corners = self.nodes[faces[:, self.element.face_corners]]
            area = 0.5 * np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1), axis=1)
            np.add.at(areas, faces, area[:, None] * self.element.face_shares)
        return areas


def block_mesh(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray,
               element: Hexahedron) -> SolidMesh:
    """A rectangular block.

    Args:
        x, y, z: element boundaries, ascending, m; z from the base to the top.
        element: element type.
    """
    x, y = (np.asarray(line, dtype=float) for line in (x, y))
    section = _Section(element.order)
    section.add(lambda s, t: np.stack([_between(x, s), _between(y, t)], axis=-1),
                np.linspace(0, 1, x.size), np.linspace(0, 1, y.size))
    return section.raised(np.asarray(z, dtype=float), element)


def cylinder_solid(radius: float, height: float, element: Hexahedron, *, around: int, inward: Sequence[float] |
                   np.ndarray, outward: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray,
                   face_radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> SolidMesh:
    """A cylinder with rings of elements round a circle on its top, and a square of them in the middle (an O-grid).

    Args:
        radius, height: m.
        element: element type.
        around: elements along a quarter of a ring.
        inward: radii of the rings from that of the square's end, ascending, to the circle, over its radius.
        outward: the same from the circle, 0, to the cylinder, 1.
        z: heights of the element boundaries, base first, m.
        face_radius: of the circle, m. centre: of it on the top, m.

    Raises:
        InputError: a circle that reaches beyond the cylinder, or a mesh with an element turned inside out.
    """
    if np.hypot(*centre) + face_radius >= radius:
        raise InputError(f"a circle of radius {face_radius:g} m about ({centre[0]:g}, {centre[1]:g}) m reaches beyond "
                         f"the cylinder, radius {radius:g} m", field="centre")
    inward, outward = np.asarray(inward, dtype=float), np.asarray(outward, dtype=float)
    section, origin, core = _Section(element.order), np.array(centre), inward[0] * face_radius
    # Even angles along the sides of the square.
    line = np.linspace(0, 1, around + 1)

    def square(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return origin + core * _rounded_square(*(np.sqrt(2.0) * np.sin(0.25 * np.pi * (2.0 * each - 1.0))
                                                 for each in (s, t)))

    section.add(square, line, line)
    for quarter in range(4):
        section.add(_ring(quarter, core, face_radius, origin, origin, inner_is_square=True),
                    (inward - inward[0]) / (1.0 - inward[0]), line)
        section.add(_ring(quarter, face_radius, radius, origin, np.zeros(2)), outward, line)
    mesh = section.raised(np.asarray(z, dtype=float), element)
    top = mesh.sets["top"]
    beside = np.hypot(*(mesh.nodes[top, :2] - origin).T) - face_radius
    slack = 1e-9 * radius
    mesh.sets.update(face=top[beside <= slack], free=top[beside >= -slack])
    return mesh


def needle_solid(radius: float, height: float, face_radius: float, element: Hexahedron, *, smallest: float,
                 growth: float, largest: float, around: int, centre: tuple[float, float] = (0.0, 0.0)) -> SolidMesh:
    """A cylinder under a flat-faced needle, fine towards the edge of the face.

    Args:
        radius, height, face_radius: m.
        element: element type.
        smallest, growth, largest: of the intervals that lead away from the edge, see `growing_line`.
        around: elements along a quarter of the edge.
        centre: of the face, m.
    """
    inward = growing_line((1.0 - _CORE) * face_radius, smallest, growth, largest)
    outward = growing_line(radius - face_radius, smallest, growth, largest)
    z = -growing_line(height, smallest, growth, largest)[::-1]
    return cylinder_solid(radius, height, element, around=around, inward=1.0 - inward[::-1] / face_radius,
                          outward=outward / outward[-1], z=z, face_radius=face_radius, centre=centre)


class _Section:
    """Quadrilaterals in the plane, patch by patch; nodes at one place are one.

    Args:
        order: of the elements.
    """

    def __init__(self, order: int):
        self._order = order
        self._nodes: list[np.ndarray] = []
        self._quads: list[np.ndarray] = []
        self._count = 0

    def add(self, place: _Map, first: np.ndarray, second: np.ndarray) -> None:
        """Add the elements between these boundaries, from 0 to 1, of a map."""
        s, t = (self._with_middles(line) for line in (first, second))
        grid = place(*np.meshgrid(s, t))  # [t, s]
        numbers = np.arange(s.size * t.size).reshape(t.size, s.size) + self._count
        order = self._order
        self._quads += [numbers[j : j + order + 1, i : i + order + 1].ravel()
                        for j in range(0, t.size - 1, order) for i in range(0, s.size - 1, order)]
        self._nodes.append(grid.reshape(-1, 2))
        self._count += numbers.size

    def _with_middles(self, line: np.ndarray) -> np.ndarray:
        if self._order == 1:
            return line
        return np.sort(np.concatenate([line, 0.5 * (line[1:] + line[:-1])]))

    def raised(self, z: np.ndarray, element: Hexahedron) -> SolidMesh:
        """Hexahedra over the section, between these heights, base first, m; the top comes to z = 0 by itself."""
        plane, quads = _joined(np.concatenate(self._nodes), np.array(self._quads))
        heights = self._with_middles(z)
        count, order = len(plane), self._order
        nodes = np.concatenate([np.column_stack([plane, np.full(count, height)]) for height in heights])
        connectivity = np.concatenate([np.concatenate([quads + (k + m) * count for m in range(order + 1)], axis=1)
                                       for k in range(0, heights.size - 1, order)])
        return with_surface(element, nodes, connectivity)


def with_surface(element: SolidElement, nodes: np.ndarray, connectivity: np.ndarray) -> SolidMesh:
    """A mesh whose surface is named by where it is: ``top``, ``base`` and the rest, ``side``.

    Args:
        element: element type.
        nodes: shape (n, 3), m. connectivity: shape (elements, nodes of the element).
    """
    sides = connectivity[:, element.faces].reshape(-1, element.faces.shape[1])
    _, first, times = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    outer = sides[np.sort(first[times == 1])]
    heights = nodes[outer, 2]
    low, high = nodes[:, 2].min(), nodes[:, 2].max()
    slack = 1e-9 * (high - low)
    base, top = (heights <= low + slack).all(axis=1), (heights >= high - slack).all(axis=1)
    faces = {"base": outer[base], "top": outer[top], "side": outer[~(base | top)]}
    return SolidMesh(element, nodes, connectivity, {name: np.unique(each) for name, each in faces.items()}, faces)


def _joined(places: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places without repetitions, and numbers of them."""
    from scipy.spatial import cKDTree

    first = np.arange(len(places))
    for a, b in sorted(cKDTree(places).query_pairs(_SAME * np.ptp(places))):
        first[b] = first[a]
    kept, inverse = np.unique(first, return_inverse=True)
    return places[kept], inverse[numbers]


def _between(line: np.ndarray, share: np.ndarray) -> np.ndarray:
    return np.interp(share, np.linspace(0, 1, line.size), line)


def _rounded_square(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[-1, 1]^2 as a square whose sides bulge outwards and whose corners are at a distance of 1 from the middle."""
    straight = np.stack([u, v], axis=-1) / np.sqrt(2.0)
    disc = np.stack([u * np.sqrt(1.0 - 0.5 * v**2), v * np.sqrt(1.0 - 0.5 * u**2)], axis=-1)
    share = _ROUND * np.maximum(np.abs(u), np.abs(v))[..., None]
    return (1.0 - share) * straight + share * disc


def _ring(quarter: int, inner: float, outer: float, start: np.ndarray, end: np.ndarray,
          inner_is_square: bool = False) -> _Map:
    """A quarter of the ring between two circles of these radii about these places, m; the first may be the square."""
    turn = 0.5 * np.pi * quarter

    def place(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        angle = 0.25 * np.pi * (2.0 * t - 1.0)
        ray = np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=-1)
        near = ray
        if inner_is_square:
            side = _rounded_square(np.ones_like(t), np.sqrt(2.0) * np.sin(angle))
            near = np.stack([np.cos(turn) * side[..., 0] - np.sin(turn) * side[..., 1],
                             np.sin(turn) * side[..., 0] + np.cos(turn) * side[..., 1]], axis=-1)
        share = s[..., None]
        return (1.0 - share) * (start + inner * near) + share * (end + outer * ray)

    return place
