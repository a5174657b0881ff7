"""Drawable parts of the picture: tool, base plate, force arrow, contact, and tissue in 2D and 3D.

The tissue has surfaces in bands of a field, element edges, contact lines and an outline.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from scenes.viewer.revolution import (
    PossibleContactBoundary,
    TriangulatedHalfSection,
    TriangulatedSurface,
    WedgeOpening,
    concatenate_surfaces,
    make_section_surfaces_by_band,
    revolve_polyline_by_band,
)
from scenes.viewer.solid_body import ThreeDimensionalMeshBody, Wedge
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.result_views import DrawableFields, HalfSectionGeometry, SolidGeometry, TissueGeometry
from tissue_sim.specimen import Specimen


@dataclass(frozen=True)
class ToolPictureSettings:
    """Proportions of the drawn tool and plates, of the force arrow and of the contact lines.

    Attributes:
        shaft_height: Height of a needle above its deepest point, in heights of the specimen.
        shaft_above_shoulder: Smallest height of the shaft above the shoulder of the needle, in radii of the tool.
        plate_radius: Radius of the plates, in radii of the specimen; larger than 1 because the specimen bulges.
        plate_thickness: Thickness of the plates, in heights of the specimen.
        inset: Distance of the drawn tool inside its true outline, in radii of the tool, so that the tool does not hide
            the tissue that touches it.
        recess: Distance of the tool's section faces behind those of the tissue, in radii of the specimen, so that they
            do not hide curved edges of the tissue that overlap the tool by the error of the mesh.
        arrow_length: Length of the arrow at full scale, in heights of the specimen.
        arrow_radius: Radius of its shaft, in heights of the specimen.
        head_radius: Radius of its head, in heights of the specimen.
        head_length: Length of its head, in heights of the specimen.
        largest_head: Largest length of the head as a fraction of the arrow.
        smallest_force: Smallest force with an arrow, as a fraction of the full scale.
        contact_gap: Largest gap of tissue in contact, in radii of the tool.
        line_offset: Distance of the contact lines in front of the tissue, in radii of the specimen.
    """

    shaft_height: float = 0.5
    shaft_above_shoulder: float = 1.0
    plate_radius: float = 1.2
    plate_thickness: float = 0.06
    inset: float = 1e-3
    recess: float = 1e-3
    arrow_length: float = 0.25
    arrow_radius: float = 0.012
    head_radius: float = 0.032
    head_length: float = 0.085
    largest_head: float = 0.5
    smallest_force: float = 5e-3
    contact_gap: float = 1e-3
    line_offset: float = 2e-3


#: Settings of the viewer.
SETTINGS = ToolPictureSettings()


@dataclass(frozen=True, eq=False)
class ForceArrow:
    """Force arrow in the frame of the tool.

    Attributes:
        surface: Surface of the arrow, m.
        start: Tail of the arrow, m, shape (3,).
        tip: Tip of the arrow, m, shape (3,).
    """

    surface: TriangulatedSurface
    start: np.ndarray
    tip: np.ndarray


@dataclass(frozen=True, eq=False)
class ToolContactLinesAndArea:
    """Contact between an axisymmetric specimen and the tool.

    Attributes:
        lines: Lines along the contact on both section faces and around its rim, m, shape (k, 2, 3).
        radius: Distance of the rim from the axis, m.
        area: Area of the deformed surface in contact, over the full turn, m2.
    """

    lines: np.ndarray
    radius: float
    area: float


@lru_cache(maxsize=16)
def make_drawn_tool_outline(tool: Tool, specimen: Specimen) -> np.ndarray:
    """Return the drawn outline of a tool, (r, z), m, shape (n, 2), read-only.

    The outline runs from the axis at the bottom to the axis at the top. The deepest point of the true tool is at z = 0.
    The drawn outline lies inside the true one, so the lowest drawn point is at z = inset: `ToolPictureSettings.inset`
    times the radius of the tool, for a plate times the radius of the specimen.
    """
    if tool.is_plate:
        radius, top = SETTINGS.plate_radius * specimen.outer_radius, compute_plate_thickness(specimen)
        outline = np.array([[0.0, 0.0], [radius, 0.0], [radius, top]])
        inset = SETTINGS.inset * specimen.outer_radius
    else:
        profile, radius = tool.profile, tool.require_radius()
        # A sphere has no shaft.
        top = max(SETTINGS.shaft_height * specimen.height,
                  profile.vertices[-2, 1] + SETTINGS.shaft_above_shoulder * radius) if tool.has_shaft \
            else profile.vertices[-2, 1] + profile.rounding
        outline = profile.sample_outline_up_to_height(top)
        inset = SETTINGS.inset * radius
    shrunk = outline * [1.0 - inset / outline[:, 0].max(), 1.0] + [0.0, inset]
    shrunk[:, 1] = np.minimum(shrunk[:, 1], top)
    shrunk[np.abs(shrunk[:, 0]) < 1e-9 * outline[:, 0].max(), 0] = 0.0
    if shrunk[-1, 0] > 0.0:
        shrunk = np.concatenate([shrunk, [[0.0, shrunk[-1, 1]]]])
    steps = np.linalg.norm(np.diff(shrunk, axis=0), axis=1)
    drawn = shrunk[np.concatenate([[True], steps > 1e-9 * top])]
    drawn.flags.writeable = False
    return drawn


def make_drawn_tool_surface(tool: Tool, specimen: Specimen, opening: WedgeOpening) -> TriangulatedSurface:
    """Return the surface of a tool from which the same wedge as from the specimen is removed.

    Args:
        tool: The tool.
        specimen: The specimen, whose height sets the drawn length of the shaft.
        opening: Wedge that is removed.

    Returns:
        Closed surface, m; the origin is the deepest point of the tool.
    """
    return _revolve_outline_outside_wedge(make_drawn_tool_outline(tool, specimen), opening,
                                          SETTINGS.recess * specimen.outer_radius)


def make_base_plate(specimen: Specimen, opening: WedgeOpening) -> TriangulatedSurface:
    """Return the surface of the plate under the specimen, m; the plate is not cut open.

    Args:
        specimen: The specimen.
        opening: Opening whose number of segments is used.
    """
    radius = SETTINGS.plate_radius * specimen.outer_radius
    top = -specimen.height - SETTINGS.inset * specimen.outer_radius
    bottom = top - compute_plate_thickness(specimen)
    outline = np.array([[0.0, bottom], [radius, bottom], [radius, top], [0.0, top]])
    return _revolve_outline_outside_wedge(outline, replace(opening, cut=0.0))


def compute_height_of_tool_with_longest_arrow(tool: Tool, specimen: Specimen) -> float:
    """Return the height of tool and full-scale arrow above the deepest point of the tool, m."""
    return float(make_drawn_tool_outline(tool, specimen)[:, 1].max()) + SETTINGS.arrow_length * specimen.height


def make_scale_bar_lines_and_length(specimen: Specimen) -> tuple[np.ndarray, float]:
    """Return a scale bar of a round length on the base in front of the specimen.

    Returns:
        Lines of the bar and of its two end marks, m, shape (3, 2, 3), and the length of the bar, m.
    """
    radius, tick = specimen.outer_radius, 0.03 * specimen.outer_radius
    power = 10.0 ** np.floor(np.log10(0.6 * radius))
    length = float(max(step for step in (1.0, 2.0, 5.0) if step * power <= 0.6 * radius * (1 + 1e-9)) * power)
    y, z = -1.12 * radius, -specimen.height + 0.01 * radius
    ends = np.array([[-0.5 * length, y, z], [0.5 * length, y, z]])
    across = np.array([0.0, tick, 0.0])
    return np.stack([ends, *(np.stack([end - across, end + across]) for end in ends)]), length


def make_force_arrow_or_none(force: float, full_scale: float, tool: Tool, specimen: Specimen) -> ForceArrow | None:
    """Return the arrow above the tool that shows the force on the tool.

    The arrow points upwards if the tissue pushes the tool back, and downwards if the tissue pulls the tool.

    Args:
        force: Force on the tool along its axis, N.
        full_scale: Force of the longest arrow, N; larger forces have the same length.
        tool: The tool.
        specimen: The specimen, whose height scales the arrow.

    Returns:
        The arrow, whose length is proportional to the force; None below `ToolPictureSettings.smallest_force`.
    """
    fraction = min(abs(force) / full_scale, 1.0)
    if not fraction >= SETTINGS.smallest_force:
        return None
    size = specimen.height
    bottom = compute_arrow_foot_above_tool_tip(tool, specimen)
    length = fraction * SETTINGS.arrow_length * size
    # A short arrow has a smaller head of the same proportions.
    head = min(SETTINGS.head_length * size, SETTINGS.largest_head * length)
    wide, narrow = (width / SETTINGS.head_length * head for width in (SETTINGS.head_radius, SETTINGS.arrow_radius))
    outline = np.array([[0.0, 0.0], [narrow, 0.0], [narrow, length - head], [wide, length - head], [0.0, length]])
    ends = np.array([[0.0, 0.0, bottom], [0.0, 0.0, bottom + length]])
    if force < 0:
        outline = (outline * [1.0, -1.0] + [0.0, length])[::-1]
        ends = ends[::-1]
    return ForceArrow(_revolve_outline_outside_wedge(outline + ends[:, 1:].min(axis=0), WedgeOpening(0.0, segments=24)),
                      *ends)


def compute_arrow_foot_above_tool_tip(tool: Tool, specimen: Specimen) -> float:
    """Return the height of the lower end of the force arrow above the deepest point of the tool, m."""
    return float(make_drawn_tool_outline(tool, specimen)[:, 1].max()) + SETTINGS.inset * specimen.height


def rotate_force_arrow(arrow: ForceArrow, lateral: tuple[float, float]) -> ForceArrow:
    """Rotate an arrow along +z or -z about its lower end, so that its direction has the given lateral components.

    The sign of the z component of the direction stays.

    Args:
        arrow: Arrow of `make_force_arrow_or_none`.
        lateral: x and y components of the unit vector of the new direction.
    """
    foot = min(arrow.start, arrow.tip, key=lambda end: end[2])
    x, y = lateral if arrow.tip[2] > arrow.start[2] else (-lateral[0], -lateral[1])
    sine = min(float(np.hypot(x, y)), 1.0)
    cosine = (1.0 - sine * sine) ** 0.5
    # Rodrigues' formula for the smallest rotation from z to the direction.
    axis = np.array([-y, x, 0.0]) / max(sine, np.finfo(float).tiny)
    skew = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation = np.eye(3) + sine * skew + (1.0 - cosine) * skew @ skew

    def rotate_points_about_foot(points: np.ndarray) -> np.ndarray:
        return (foot + (points - foot) @ rotation.T).astype(points.dtype)

    return ForceArrow(TriangulatedSurface(rotate_points_about_foot(arrow.surface.vertices), arrow.surface.faces),
                      rotate_points_about_foot(arrow.start),
                      rotate_points_about_foot(arrow.tip))


def find_tool_contact(surface: PossibleContactBoundary, tool: Tool, depth: float,
                      opening: WedgeOpening) -> ToolContactLinesAndArea | None:
    """Find the part of an axisymmetric surface that touches the tool.

    A line between two nodes touches if its Gauss point touches: the solver enforces contact at the Gauss points, while
    the nodes lie alternately outside and inside a curved tool.

    Args:
        surface: Boundary of the deformed tissue.
        tool: The tool, whose deepest point is at z = -depth.
        depth: Depth of the tool, m.
        opening: Wedge on whose section faces the contact lines are drawn.

    Returns:
        The contact; None if nothing touches.
    """
    width = float(surface.points[:, 0].max())
    largest_gap = SETTINGS.contact_gap * min(width, tool.radius or width)
    touching = tool.profile.gap(surface.gauss_points + np.array([0.0, depth])) <= largest_gap
    if not touching.any():
        return None
    lines = np.stack([surface.points[:-1], surface.points[1:]], axis=1)[touching]
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    area = float(np.pi * lines[..., 0].sum(axis=1) @ length)
    rim = lines.reshape(-1, 2)[np.argmax(lines[..., 0])]
    offset = SETTINGS.line_offset * width
    return ToolContactLinesAndArea(np.concatenate([opening.map_to_section_faces(lines, offset).reshape(-1, 2, 3),
                                                   opening.make_arc_lines_outside_wedge(rim[0] + offset, rim[1])]),
                                   float(rim[0]), area)


def _revolve_outline_outside_wedge(outline: np.ndarray, opening: WedgeOpening,
                                   recess: float = 0.0) -> TriangulatedSurface:
    """Return the closed surface of a body of revolution.

    Args:
        outline: Points (r, z) from the axis at the bottom to the axis at the top with ascending z, shape (n, 2).
        opening: Wedge that is removed.
        recess: Distance of the section faces behind the cut, in the unit of the outline.
    """
    # `revolve_polyline_by_band` expects the body on the right-hand side, hence the outline from top to bottom.
    outside, = revolve_polyline_by_band(outline[::-1], np.zeros(len(outline) - 1, dtype=int), 1, opening)
    if opening.removes_nothing:
        return outside
    count = len(outline)
    points = np.concatenate([outline, outline * [0.0, 1.0]])
    low = np.arange(count - 1)
    triangles = np.concatenate([np.stack([low + count, low, low + 1], axis=-1),
                                np.stack([low + count, low + 1, low + count + 1], axis=-1)])
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]
    triangles = triangles[area > 1e-12 * outline.max() ** 2]
    sections, = make_section_surfaces_by_band(points, triangles, np.zeros(len(triangles), dtype=int), 1, opening,
                                              -recess)
    return concatenate_surfaces(sections, outside)


def compute_plate_thickness(specimen: Specimen) -> float:
    """Return the thickness of the plates above and below a specimen, m."""
    return SETTINGS.plate_thickness * max(specimen.height, 0.5 * specimen.outer_radius)


class DrawableTissue(Protocol):
    """Interface of tissue that the page can draw, from an axisymmetric or a 3D geometry.

    In all methods, `positions` are the deformed positions of the nodes as `Snapshot.node_positions` gives them, and
    `wedge` is the wedge that is removed from the picture. Lengths are in m.
    """

    def evaluate_field_at_nodes_and_samples(self, fields: DrawableFields, name: str, positions: np.ndarray,
                                            wedge: Wedge) -> tuple[np.ndarray, np.ndarray, DrawableFields]:
        """Evaluate a field for the picture.

        Returns:
            Values at the nodes, of which the visible ones are valid, shape (nodes,); values at quadrature points that
            represent the whole body, shape (elements, q); and the fields to which these points belong.
        """

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              wedge: Wedge) -> list[TriangulatedSurface]:
        """Return the visible surface of each band between two levels."""

    def compute_element_edge_lines(self, positions: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Return the visible element edges, shape (lines, 2, 3)."""

    def find_contact_lines_or_none(self, positions: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Return lines along the contact with the tool, shape (lines, 2, 3); None without contact."""

    def make_undeformed_outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Return a dashed outline of the undeformed tissue, shape (lines, 2, 3).

        Args:
            wedge: Wedge that is removed from the picture.
            tool: Radius and largest depth of the tool, m.
        """


@dataclass(frozen=True, eq=False)
class RevolvedBody:
    """Body of revolution of a half section.

    Attributes:
        cut_away: Half section of the body.
    """

    cut_away: TriangulatedHalfSection

    def evaluate_field_at_nodes_and_samples(self, fields: DrawableFields, name: str, positions: np.ndarray,
                                            wedge: Wedge) -> tuple[np.ndarray, np.ndarray, DrawableFields]:
        """Return nodal values, values at the quadrature points, and `fields`; shapes as in `DrawableTissue`."""
        at_points = fields.at_points(name)
        return fields.at_nodes(name, at_points=at_points), at_points, fields

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              wedge: Wedge) -> list[TriangulatedSurface]:
        """Return the surface of each colour band between two levels: section faces and outer surface."""
        return self.cut_away.compute_band_surfaces(positions, values, levels, wedge.opening)

    def compute_element_edge_lines(self, positions: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Return the element edges on both section faces, shape (lines, 2, 3)."""
        return self.cut_away.compute_element_edge_lines(positions, wedge.opening)

    def find_contact_lines_or_none(self, positions: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Return lines along the contact on both section faces and around its rim; None without contact."""
        contact = find_tool_contact(self.cut_away.compute_possible_contact_boundary(positions), tool, wedge.pose.depth,
                                    wedge.opening)
        return None if contact is None else contact.lines

    def make_undeformed_outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Return the dashed outline of the undeformed body, m, shape (lines, 2, 3)."""
        return self.cut_away.make_undeformed_outline(wedge.opening, tool=tool)


def make_drawable_body(geometry: TissueGeometry) -> DrawableTissue:
    """Return the drawable body of a half section or of a solid in 3D.

    Raises:
        InputError: The fields of a solver return an object of another type.
    """
    if isinstance(geometry, SolidGeometry):
        return ThreeDimensionalMeshBody.from_geometry(geometry)
    if isinstance(geometry, HalfSectionGeometry):
        return RevolvedBody(TriangulatedHalfSection(geometry))
    raise InputError(f"geometry() of the fields must return a HalfSectionGeometry or a SolidGeometry; got "
                     f"{type(geometry).__name__}")
