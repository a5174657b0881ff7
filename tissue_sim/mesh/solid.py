"""Structured meshes of hexahedra: blocks, and cylinders whose elements are graded towards a tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.grading import CORE, PLATE_RING, Grading
from tissue_sim.mesh.hexahedra import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.mesh.section import Section, arc
from tissue_sim.mesh.solid_element import SolidElement
from tissue_sim.mesh.tetrahedra import TET8P0, TET15P1

#: Elements of the solid by their names.
SOLID_ELEMENTS: dict[str, SolidElement] = {element.name: element for element in (HEX27P1, HEX8P0, TET15P1, TET8P0)}

#: How elements of a cylinder between plates grow away from the circle in it.
_PLATE_GROWTH = 1.3


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """Elements in space; the undeformed top face is z = 0 and the base z = -height.

    Attributes:
        element: element type.
        nodes: coordinates, m, shape (n, 3).
        connectivity: node numbers in the element's order, shape (elements, nodes of the element).
        sets: named node numbers, sorted: ``base``, ``top``, ``side``; where a needle comes down also ``face``, what is
            under its flat face, and ``free``, the rest of the top, both with the nodes at the edge.
        regions: named element numbers, no element in two; what may have a material of its own.
        depths: of the middles of the elements below the top, m, shape (elements,); None: along z.
        faces: element sides on the surface, by the names ``base``, ``top`` and ``side``, as node numbers, shape (m,
            nodes of a side); see `SolidElement.faces`.
    """

    element: SolidElement
    nodes: np.ndarray
    connectivity: np.ndarray
    sets: dict[str, np.ndarray] = field(default_factory=dict)
    faces: dict[str, np.ndarray] = field(default_factory=dict)
    regions: dict[str, np.ndarray] = field(default_factory=dict)
    depths: np.ndarray | None = None

    def stretched(self, factor: float) -> SolidMesh:
        """The same mesh, this many times as high."""
        return replace(self, nodes=self.nodes * [1.0, 1.0, factor],
                       depths=None if self.depths is None else factor * self.depths)

    @property
    def element_depths(self) -> np.ndarray:
        """How deep the middle of each element is below the top, m, shape (elements,)."""
        if self.depths is not None:
            return self.depths
        return -self.nodes[self.connectivity, 2].mean(axis=1)

    @property
    def node_areas(self) -> np.ndarray:
        """Of the surface that each node stands for, m2, shape (n,)."""
        return self.areas(*self.faces)

    def areas(self, *names: str) -> np.ndarray:
        """Of the named parts of the surface that each node stands for, m2, shape (n,)."""
        areas = np.zeros(len(self.nodes))
        for name in names:
            faces = self.faces[name]
            np.add.at(areas, faces, self._side_areas(faces)[:, None] * self.element.face_shares)
        return areas

    def _side_areas(self, faces: np.ndarray) -> np.ndarray:
        """Of sides, or of what flat ones nearest to them would have, m2, shape (m,): half of the integral of x cross dx
        round them, by Simpson's rule, which is exact on quadratic edges."""
        start = self.nodes[faces[:, self.element.face_corners]]
        end = np.roll(start, -1, axis=1)
        middles = self.element.face_middles
        middle = self.nodes[faces[:, middles]] if middles.size else 0.5 * (start + end)
        round_it = (np.cross(start, 4.0 * middle - 3.0 * start - end) + 4.0 * np.cross(middle, end - start)
                    + np.cross(end, start - 4.0 * middle + 3.0 * end)).sum(axis=1) / 6.0
        return 0.5 * np.linalg.norm(round_it, axis=1)


def block_mesh(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray,
               element: Hexahedron) -> SolidMesh:
    """A rectangular block.

    Args:
        x, y, z: element boundaries, ascending, m; z from the base to the top.
        element: element type.
    """
    section = Section(element.order)
    section.add_rectangle(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    return raised(section, z, element)


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
    section = Section(element.order)
    section.add_disc(centre, face_radius, np.asarray(inward, dtype=float), around)
    for quarter in range(4):
        section.add_ring(arc(quarter, face_radius, centre), arc(quarter, radius), np.asarray(outward, dtype=float),
                         around)
    return with_tool_sets(raised(section, z, element), face_radius, centre)


def needle_solid(radius: float, height: float, face_radius: float, element: Hexahedron, *, smallest: float,
                 growth: float, largest: float, around: int, centre: tuple[float, float] = (0.0, 0.0),
                 interfaces: Sequence[float] | np.ndarray = ()) -> SolidMesh:
    """A cylinder under a flat-faced needle, fine towards the edge of the face.

    Args:
        radius, height, face_radius: m.
        element: element type.
        smallest, growth, largest: of the intervals that lead away from the edge, see `growing_line`.
        around: elements along a quarter of the edge.
        centre: of the face, m.
        interfaces: depths at which element boundaries lie, ascending, m.
    """
    return graded_cylinder(radius, height, Grading(element, smallest, growth, largest, around, radius=face_radius,
                                                   centre=centre, interfaces=tuple(interfaces)))


def graded_cylinder(radius: float, height: float, grading: Grading) -> SolidMesh:
    """A cylinder under a needle, or a plate, for which a circle between its axis and its side takes the needle's place.

    Args:
        radius, height: m. grading: of its elements.
    """
    face = grading.radius
    if face is None:
        face, share = PLATE_RING * radius, PLATE_RING
        grading = replace(grading, growth=_PLATE_GROWTH, smallest=0.6 * share * grading.smallest,
                          largest=0.3 * share * grading.largest)
    outward, z = grading.line(radius - face), -grading.line(height)[::-1]
    return cylinder_solid(radius, height, grading.element, around=grading.around, inward=inward_of(grading, face),
                          outward=outward / outward[-1], z=grading.with_interfaces(z, height), face_radius=face,
                          centre=grading.centre)


def inward_of(grading: Grading, radius: float) -> np.ndarray:
    """Radii of the rings from the square in the middle to a circle of this radius, m, over it, ascending."""
    inward = grading.line((1.0 - CORE) * radius)
    return 1.0 - inward[::-1] / radius


def with_tool_sets(mesh: SolidMesh, radius: float, centre: tuple[float, float]) -> SolidMesh:
    """The mesh with the sets ``face`` and ``free`` of its top, seen from above in and beyond a circle, m."""
    top = mesh.sets["top"]
    beside = np.hypot(*(mesh.nodes[top, :2] - np.array(centre)).T) - radius
    slack = 1e-9 * float(np.ptp(mesh.nodes[:, :2]))
    return replace(mesh, sets={**mesh.sets, "face": top[beside <= slack], "free": top[beside >= -slack]})


def raised(section: Section, z: Sequence[float] | np.ndarray, element: Hexahedron) -> SolidMesh:
    """Hexahedra over a section, between these heights, base first, m."""
    return with_surface(element, *section.raised(np.asarray(z, dtype=float)))


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
