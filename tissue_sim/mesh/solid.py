"""Solid meshes, and structured meshes of hexahedra: blocks, cylinders, and half shells between two ellipsoids.

`Grading` states the sizes of the elements and the position of the smallest ones, under a tool or at the edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.axisymmetric import divide_into_growing_intervals, insert_interfaces_and_refine_layers
from tissue_sim.mesh.section import Curve, PlanarMesh, make_quarter_circle, make_rectangle_side
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, MAX_NODES, TET8P0, TET15P1, Hexahedron, SolidElement
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.registry import Registry


@dataclass(frozen=True)
class OGridSettings:
    """Proportions of an O-grid: rings of elements around a square core.

    Attributes:
        plate_ring: radius of the circle of the O-grid under a plate, as a fraction of the radius of the specimen, 1.
        core: size of the square core, as a fraction of the radius of the tool, 1.
    """

    plate_ring: float = 0.6
    core: float = 0.5


#: Proportions of every O-grid.
O_GRID = OGridSettings()


@dataclass(frozen=True)
class Grading:
    """Sizes of elements: smallest at the edge of the tool's face, or of a specimen under a plate, growing from there.

    Attributes:
        element: element type; a mesh from a file uses its own shape of element with the same order.
        smallest: length of the smallest interval, m; see `divide_into_growing_intervals`.
        growth: ratio of successive intervals.
        largest: limit of the length of an interval, m.
        around: number of elements along a quarter of the edge of a needle's face.
        radius: radius of the circle under a needle, m; None: a plate covers the whole top.
        centre: (x, y) of the centre of the circle, m.
        interfaces: depths below the top of required element boundaries, ascending, m.
        least: minimum number of elements between two interfaces.
    """

    element: Hexahedron
    smallest: float
    growth: float
    largest: float
    around: int
    radius: float | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    interfaces: tuple[float, ...] = ()
    least: int = 1

    def divide_line(self, length: float) -> np.ndarray:
        """Divide a line of `length`, m, into intervals that grow from its start; return their boundaries from 0, m."""
        return divide_into_growing_intervals(length, self.smallest, self.growth, self.largest)

    def divide_line_from_both_ends(self, length: float) -> np.ndarray:
        """Divide a line of `length`, m, with small intervals at both ends; return their boundaries from 0, m."""
        half = self.divide_line(0.5 * length)
        return np.concatenate([half, length - half[-2::-1]])

    def insert_interface_heights(self, heights: np.ndarray, height: float) -> np.ndarray:
        """Return the heights of element boundaries with the interfaces added, ascending to 0, m.

        Args:
            heights: heights of element boundaries, ascending to 0, m.
            height: height of the specimen, m.

        Raises:
            InputError: the layers are thicker than the specimen.
        """
        if not self.interfaces:
            return heights
        if self.interfaces[-1] >= height * (1.0 - 1e-9):
            raise InputError(f"the layers must be thinner than the specimen, height {height * 1e3:g} mm; got "
                             f"{self.interfaces[-1] * 1e3:g} mm", field="layers")
        return insert_interfaces_and_refine_layers(heights, [-depth for depth in self.interfaces], self.least)


def _fits_kernels(element: Any) -> bool:
    """Return whether the kernels of the solid solver can evaluate an element."""
    return (isinstance(element, SolidElement) and element.pressure_modes in (1, 4)
            and max(element.node_count, element.quadrature[1].size) <= MAX_NODES)


#: Name -> element of the three-dimensional solver.
SOLID_ELEMENTS: Registry[SolidElement] = Registry(
    "solid element", "tissue_sim.solid_elements",
    {element.name: element for element in (HEX27P1, HEX8P0, TET15P1, TET8P0)}, accepts=_fits_kernels,
    expected=f"a SolidElement with at most {MAX_NODES} nodes and {MAX_NODES} quadrature points, and 1 or 4 pressure "
             "modes")

#: Ratio of successive elements of a cylinder between plates, away from the circle of the O-grid.
_PLATE_GROWTH = 1.3


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """Three-dimensional mesh; the undeformed top is z = 0 and the base is z = -height.

    Attributes:
        element: element type.
        nodes: coordinates, m, shape (n, 3).
        connectivity: node numbers in the order of the element, shape (elements, nodes of the element).
        sets: named node numbers, sorted: ``base``, ``top``, ``side``. A mesh under a needle also has ``face``, the part
            of the top under the flat face of the needle, and ``free``, the rest of the top; both include the nodes at
            the edge.
        faces: element faces on the surface by the names ``base``, ``top`` and ``side``, as node numbers, shape (m,
            nodes of a face); see `SolidElement.local_face_node_indices`.
        regions: disjoint sets of element numbers by name, which may have separate materials.
        depths: depth of the centre of each element below the top, m, shape (elements,); None: computed from z.
    """

    element: SolidElement
    nodes: np.ndarray
    connectivity: np.ndarray
    sets: dict[str, np.ndarray] = field(default_factory=dict)
    faces: dict[str, np.ndarray] = field(default_factory=dict)
    regions: dict[str, np.ndarray] = field(default_factory=dict)
    depths: np.ndarray | None = None

    def scale_height(self, factor: float) -> SolidMesh:
        """Return a copy of the mesh with all heights z multiplied by `factor`."""
        return replace(self, nodes=self.nodes * [1.0, 1.0, factor],
                       depths=None if self.depths is None else factor * self.depths)

    @property
    def element_depths(self) -> np.ndarray:
        """Depth of the centre of each element below the top, m, shape (elements,)."""
        if self.depths is not None:
            return self.depths
        return -self.nodes[self.connectivity, 2].mean(axis=1)

    @property
    def surface_node_areas(self) -> np.ndarray:
        """Tributary area of each node on the whole surface, m2, shape (n,); 0 for nodes in the interior."""
        return self.compute_node_areas_of_named_faces(*self.faces)

    def compute_node_areas_of_named_faces(self, *names: str) -> np.ndarray:
        """Return the tributary area of each node on the faces with these names, m2, shape (n,); 0 elsewhere."""
        areas = np.zeros(len(self.nodes))
        for name in names:
            faces = self.faces[name]
            np.add.at(areas, faces, self._compute_face_areas(faces)[:, None] * self.element.face_area_fractions_by_node)
        return areas

    def _compute_face_areas(self, faces: np.ndarray) -> np.ndarray:
        """Return the areas of faces, for curved faces of the plane projection with the largest area, m2, shape (m,).

        The area is half of the norm of the contour integral of x cross dx, computed with Simpson's rule, which is exact
        on quadratic edges.
        """
        start = self.nodes[faces[:, self.element.corner_indices_within_face]]
        end = np.roll(start, -1, axis=1)
        middles = self.element.edge_midpoint_indices_within_face
        middle = self.nodes[faces[:, middles]] if middles.size else 0.5 * (start + end)
        contour = (np.cross(start, 4.0 * middle - 3.0 * start - end) + 4.0 * np.cross(middle, end - start)
                   + np.cross(end, start - 4.0 * middle + 3.0 * end)).sum(axis=1) / 6.0
        return 0.5 * np.linalg.norm(contour, axis=1)


def create_block_mesh_from_boundaries(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray,
                                      z: Sequence[float] | np.ndarray, element: Hexahedron) -> SolidMesh:
    """Create the mesh of a rectangular block from its element boundaries.

    Args:
        x: element boundaries along x, ascending, m.
        y: element boundaries along y, ascending, m.
        z: element boundaries along z, base first, m.
        element: element type.

    Examples:
        >>> from tissue_sim.mesh.solid_element import HEX8P0
        >>> cube = create_block_mesh_from_boundaries([0.0, 0.01], [0.0, 0.01], [-0.01, 0.0], HEX8P0)
        >>> cube.nodes.shape, sorted(cube.sets)
        ((8, 3), ['base', 'side', 'top'])
    """
    section = PlanarMesh(element.order)
    section.add_rectangle(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    return extrude_section_to_mesh(section, z, element)


def create_cylinder_mesh(radius: float, height: float, element: Hexahedron, *, around: int, inward: Sequence[float] |
                         np.ndarray, outward: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray,
                         face_radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> SolidMesh:
    """Create the O-grid of a cylinder: rings of elements around a circle on its top, and a square core.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        element: element type.
        around: number of elements along a quarter of a ring.
        inward: radii of the ring boundaries from the core to the circle, ascending to 1, as fractions of its radius.
        outward: positions of the ring boundaries from the circle (0) to the side of the cylinder (1).
        z: heights of the element boundaries, base first, m.
        face_radius: radius of the circle, m.
        centre: (x, y) of the centre of the circle, m.

    Raises:
        InputError: the circle is not inside the top of the cylinder.
    """
    if np.hypot(*centre) + face_radius >= radius:
        raise InputError(f"the circle of radius {face_radius:g} m about ({centre[0]:g}, {centre[1]:g}) m must be "
                         f"inside the cylinder of radius {radius:g} m", field="centre")
    section = PlanarMesh(element.order)
    section.add_disc(centre, face_radius, np.asarray(inward, dtype=float), around)
    for quarter in range(4):
        section.add_elements_between_curves(make_quarter_circle(quarter, face_radius, centre),
                                            make_quarter_circle(quarter, radius),
                                            np.asarray(outward, dtype=float), around)
    return add_face_and_free_node_sets(extrude_section_to_mesh(section, z, element), face_radius, centre)


def create_cylinder_mesh_under_needle(radius: float, height: float, face_radius: float, element: Hexahedron, *,
                                      smallest: float,
                                      growth: float, largest: float, around: int,
                                      centre: tuple[float, float] = (0.0, 0.0),
                                      interfaces: Sequence[float] | np.ndarray = ()) -> SolidMesh:
    """Create the mesh of a cylinder under a flat needle with small elements at the edge of the needle's face.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        face_radius: radius of the face of the needle, m.
        element: element type.
        smallest: length of the intervals at the edge, m; see `divide_into_growing_intervals`.
        growth: ratio of successive intervals away from the edge.
        largest: limit of the length of an interval, m.
        around: number of elements along a quarter of the edge.
        centre: (x, y) of the centre of the face, m.
        interfaces: depths of required element boundaries, ascending, m.
    """
    return create_graded_cylinder_mesh(radius, height,
                                       Grading(element, smallest, growth, largest, around, radius=face_radius,
                                               centre=centre, interfaces=tuple(interfaces)))


def create_graded_cylinder_mesh(radius: float, height: float, grading: Grading) -> SolidMesh:
    """Create the O-grid of a cylinder under a needle, or under a plate with a circle inside the top as its edge.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        grading: sizes of the elements, and circle of the needle.
    """
    face = grading.radius
    if face is None:
        face, factor = O_GRID.plate_ring * radius, O_GRID.plate_ring
        grading = replace(grading, growth=_PLATE_GROWTH, smallest=0.6 * factor * grading.smallest,
                          largest=0.3 * factor * grading.largest)
    outward, z = grading.divide_line(radius - face), -grading.divide_line(height)[::-1]
    return create_cylinder_mesh(radius, height, grading.element, around=grading.around,
                                inward=compute_inner_ring_radius_fractions(grading, face),
                                outward=outward / outward[-1], z=grading.insert_interface_heights(z, height),
                                face_radius=face,
                                centre=grading.centre)


def compute_inner_ring_radius_fractions(grading: Grading, radius: float) -> np.ndarray:
    """Return the radii of the ring boundaries from the core to a circle, as fractions of its radius `radius`, m."""
    inward = grading.divide_line((1.0 - O_GRID.core) * radius)
    return 1.0 - inward[::-1] / radius


def add_face_and_free_node_sets(mesh: SolidMesh, radius: float, centre: tuple[float, float]) -> SolidMesh:
    """Return the mesh with the node sets ``face`` (top inside a circle, m, in projection along z) and ``free``."""
    top = mesh.sets["top"]
    distance = np.hypot(*(mesh.nodes[top, :2] - np.array(centre)).T) - radius
    slack = 1e-9 * float(np.ptp(mesh.nodes[:, :2]))
    return replace(mesh, sets={**mesh.sets, "face": top[distance <= slack], "free": top[distance >= -slack]})


def extrude_section_to_mesh(section: PlanarMesh, z: Sequence[float] | np.ndarray, element: Hexahedron) -> SolidMesh:
    """Extrude a section to hexahedra with these heights of element boundaries, base first, m."""
    return create_mesh_with_surface_sets(element, *section.extrude_to_hexahedra(np.asarray(z, dtype=float)))


def create_mesh_with_surface_sets(element: SolidElement, nodes: np.ndarray, connectivity: np.ndarray) -> SolidMesh:
    """Create a mesh and name its surface: ``top`` and ``base`` at the extreme heights, ``side`` for the rest.

    Args:
        element: element type.
        nodes: coordinates, m, shape (n, 3).
        connectivity: node numbers, shape (elements, nodes of the element).
    """
    sides = connectivity[:, element.local_face_node_indices].reshape(-1, element.local_face_node_indices.shape[1])
    _, first, times = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    outer = sides[np.sort(first[times == 1])]
    heights = nodes[outer, 2]
    low, high = nodes[:, 2].min(), nodes[:, 2].max()
    slack = 1e-9 * (high - low)
    base, top = (heights <= low + slack).all(axis=1), (heights >= high - slack).all(axis=1)
    faces = {"base": outer[base], "top": outer[top], "side": outer[~(base | top)]}
    return SolidMesh(element, nodes, connectivity, {name: np.unique(each) for name, each in faces.items()}, faces)


__getattr__ = make_getattr_for_old_names(__name__, {"block_under_plate": "create_block_mesh_under_plate",
                                                    "block_under_tool": "create_block_mesh_under_tool"})


@dataclass(frozen=True)
class BlockMeshSettings:
    """Proportions of the mesh of a block.

    Attributes:
        box: minimum half width of the box around a tool that contains the rings of elements, in radii of the tool, 1.
        near: distance of a side of the block from the tool, in half widths of the box, below which the side of the
            block is also a side of the box, 1.
        edge_size: size of the elements at the edges of a block between plates, as a fraction of the size at the edge
            of a tool's face, 1.
        edge_growth: minimum ratio of successive elements in a block between plates, 1.
    """

    box: float = 2.0
    near: float = 1.6
    edge_size: float = 0.7
    edge_growth: float = 1.8


_MESH = BlockMeshSettings()


def create_block_mesh_under_plate(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """Create the mesh of a block between plates that cover its top and base, with small elements at all edges.

    Args:
        length: length along x, m.
        width: width along y, m.
        height: height along z, m.
        grading: sizes of the elements.
    """
    grading = replace(grading, smallest=_MESH.edge_size * grading.smallest,
                      growth=max(grading.growth, _MESH.edge_growth))
    x, y, z = (grading.divide_line_from_both_ends(size) for size in (length, width, height))
    return create_block_mesh_from_boundaries(x - 0.5 * length, y - 0.5 * width,
                                             grading.insert_interface_heights(z - height, height), grading.element)


def create_block_mesh_under_tool(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """Create the mesh of a block under a tool: an O-grid around the tool in a box, and rectangles outside of the box.

    Args:
        length: length along x, m.
        width: width along y, m.
        height: height along z, m.
        grading: sizes of the elements, and circle of the tool.

    Raises:
        InputError: the circle of the tool is not inside the top of the block.
    """
    radius, centre = grading.radius or 0.0, np.array(grading.centre)
    ends = np.array([[-0.5, 0.5]]) * np.array([[length], [width]])
    distances = np.abs(ends - centre[:, None])  # from the tool to the sides
    if (ends[:, 0] >= centre).any() or (centre >= ends[:, 1]).any() or distances.min() <= radius:
        raise InputError(f"the circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m must be inside the "
                         f"block of {length:g} x {width:g} m", field="centre")
    reach = max(_MESH.box * radius, distances.min())
    half_widths = np.where(distances < _MESH.near * reach, distances, reach)
    low, high = centre - half_widths[:, 0], centre + half_widths[:, 1]
    section = PlanarMesh(grading.element.order)
    section.add_disc(centre, radius, compute_inner_ring_radius_fractions(grading, radius), grading.around)
    outward = grading.divide_line(float(half_widths.max()) - radius)
    for quarter in range(4):
        section.add_elements_between_curves(make_quarter_circle(quarter, radius, centre),
                                            make_rectangle_side(quarter, low, high, centre),
                                            outward / outward[-1], grading.around)
    last = min(max(outward[-1] - outward[-2], grading.smallest) * grading.growth, grading.largest)
    parts = []
    for axis in range(2):
        sides = replace(grading, smallest=last)
        before, after = (sides.divide_line(float(distance - box)) if distance > box else np.zeros(1)
                         for distance, box in zip(distances[axis], half_widths[axis], strict=True))
        within = np.interp(np.linspace(0.0, 1.0, grading.around + 1), [0.0, 0.5, 1.0],
                           [low[axis], centre[axis], high[axis]])
        parts.append((low[axis] - before[::-1], within, high[axis] + after))
    for i, x in enumerate(parts[0]):
        for j, y in enumerate(parts[1]):
            if (i, j) != (1, 1) and x.size > 1 and y.size > 1:
                section.add_rectangle(x, y)
    mesh = extrude_section_to_mesh(section, grading.insert_interface_heights(-grading.divide_line(height)[::-1],
                                                                             height), grading.element)
    return add_face_and_free_node_sets(mesh, radius, grading.centre)


def create_half_ellipsoid_shell_mesh(semi_axes: tuple[float, float, float], thickness: float,
                                     grading: Grading) -> SolidMesh:
    """Create the mesh of the upper half of an ellipsoidal shell with rings of elements around a circle.

    The apex of the outer surface is the origin and the inner surface is the base. A plane section in the unit disc, in
    which the distance from the centre is the normalised polar angle, is mapped to ellipsoids whose semi-axes decrease
    from the outer to the inner surface.

    Args:
        semi_axes: semi-axes of the outer surface along x, y, z, m.
        thickness: thickness along the axes, m.
        grading: sizes of the elements; the circle is given in the projection along z.

    Raises:
        InputError: the circle is not inside the rim.
    """
    a, b, c = semi_axes
    radius = O_GRID.plate_ring * min(a, b) if grading.radius is None else grading.radius
    centre = np.array(grading.centre)

    def map_shell_surface_to_unit_disc(points: np.ndarray) -> np.ndarray:
        """Map (x, y) of points on the outer surface, m, shape (..., 2), to the unit disc."""
        scaled = points / [a, b]
        sine = np.hypot(scaled[..., 0], scaled[..., 1])[..., None]
        return scaled * np.where(sine > 0.0, 2.0 / np.pi * np.arcsin(np.minimum(sine, 1.0)) / np.where(
            sine > 0.0, sine, 1.0), 2.0 / np.pi)

    def make_quarter_circle_in_unit_disc(quarter: int) -> Curve:
        """Return a quarter of the circle on the shell as a curve in the unit disc."""
        return lambda t: map_shell_surface_to_unit_disc(make_quarter_circle(quarter, radius, centre)(t))

    angles = np.linspace(0.0, 2.0 * np.pi, 73)
    if (np.hypot(*((centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)) / [a, b]).T) >= 1.0).any():
        raise InputError(f"the circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m must be inside the "
                         "rim of the shell", field="centre")
    section = PlanarMesh(grading.element.order)
    section.add_disc(centre, radius, compute_inner_ring_radius_fractions(grading, radius), grading.around,
                     through=map_shell_surface_to_unit_disc)
    outward = grading.divide_line(0.25 * np.pi * (max(a, b) + c) - radius)
    for quarter in range(4):
        section.add_elements_between_curves(make_quarter_circle_in_unit_disc(quarter),
                                            make_quarter_circle(quarter, 1.0), outward / outward[-1], grading.around)
    flat = extrude_section_to_mesh(section,
                                   grading.insert_interface_heights(-grading.divide_line(thickness)[::-1], thickness),
                                   grading.element)
    u, v, z = flat.nodes.T
    angle, theta = np.arctan2(v, u), 0.5 * np.pi * np.minimum(np.hypot(u, v), 1.0)
    nodes = np.column_stack([(a + z) * np.sin(theta) * np.cos(angle), (b + z) * np.sin(theta) * np.sin(angle),
                             (c + z) * np.cos(theta) - c])
    return add_face_and_free_node_sets(replace(flat, nodes=nodes, depths=flat.element_depths), radius, grading.centre)
