"""The tool and the base plate as bodies, the force on the tool as an arrow, and where tool and tissue touch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from scenes.viewer.cut_away import SurfaceLine
from scenes.viewer.revolution import Opening, Surface, joined, revolved_surfaces, section_surfaces
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.specimen import Specimen

#: Height of a needle above its deepest point, in heights of the specimen, and at least above its shoulder, in radii.
SHAFT, SHAFT_ABOVE_SHOULDER = 0.5, 1.0
#: Radius of a plate in radii of the specimen, which bulges; its thickness in heights.
PLATE_RADIUS, PLATE_THICKNESS = 1.2, 0.06
#: How far a drawn tool stays inside its outline, which the tissue shares, in radii, and its section faces behind those
#: of the tissue, whose curved edges reach into it by the error of the mesh, in radii of the specimen.
INSET, RECESS = 1e-3, 1e-3
#: Length of the arrow of a full force in heights of the specimen; its shaft's radius, its head's radius and length;
#: and the largest share of its length that its head has.
ARROW, ARROW_SHAFT, HEAD_RADIUS, HEAD_LENGTH, LARGEST_HEAD = 0.25, 0.012, 0.032, 0.085, 0.5
#: Forces below this share of the full scale have no arrow.
LEAST_FORCE = 5e-3
#: What is nearer than this, in radii of the tool, touches; lines of it lie so far in front of the tissue, in its radii.
TOUCH, LIFT = 1e-3, 2e-3


@dataclass(frozen=True, eq=False)
class Arrow:
    """A force in the frame of the tool.

    Attributes:
        surface: m.
        start, tip: where the arrow begins, and where it points, m, shape (3,).
    """

    surface: Surface
    start: np.ndarray
    tip: np.ndarray


@dataclass(frozen=True, eq=False)
class Contact:
    """Tissue that touches the tool.

    Attributes:
        lines: along the contact on both section faces, and around its rim, m, shape (k, 2, 3).
        radius: distance of its rim from the axis, m.
        area: of the tissue's deformed surface that touches, all around the axis, m2.
    """

    lines: np.ndarray
    radius: float
    area: float


@lru_cache(maxsize=16)
def tool_outline(tool: Tool, specimen: Specimen) -> np.ndarray:
    """What is drawn of a tool, (r, z), from the axis below to the axis above, m, shape (n, 2), read-only; z = 0 is its
    deepest point, from which it is drawn `INSET` away."""
    if tool.is_plate:
        radius, top = PLATE_RADIUS * specimen.outer_radius, plate_thickness(specimen)
        outline = np.array([[0.0, 0.0], [radius, 0.0], [radius, top]])
        inset = INSET * specimen.outer_radius
    else:
        profile, radius = tool.profile, tool.require_radius()
        # A ball ends by itself; the others have a shaft.
        top = max(SHAFT * specimen.height, profile.vertices[-2, 1] + SHAFT_ABOVE_SHOULDER * radius) if tool.has_shaft \
            else profile.vertices[-2, 1] + profile.rounding
        outline = profile.outline(top)
        inset = INSET * radius
    shrunk = outline * [1.0 - inset / outline[:, 0].max(), 1.0] + [0.0, inset]
    shrunk[:, 1] = np.minimum(shrunk[:, 1], top)
    shrunk[np.abs(shrunk[:, 0]) < 1e-9 * outline[:, 0].max(), 0] = 0.0
    if shrunk[-1, 0] > 0.0:
        shrunk = np.concatenate([shrunk, [[0.0, shrunk[-1, 1]]]])
    steps = np.linalg.norm(np.diff(shrunk, axis=0), axis=1)
    drawn = shrunk[np.concatenate([[True], steps > 1e-9 * top])]
    drawn.flags.writeable = False
    return drawn


def tool_mesh(tool: Tool, specimen: Specimen, opening: Opening) -> Surface:
    """A tool as a body, cut open as the specimen is.

    Args:
        tool: what is pushed in.
        specimen: its size tells how much of the tool is drawn.
        opening: what is cut out.

    Returns:
        Closed surface, m; the origin is the tool's deepest point.
    """
    return _body(tool_outline(tool, specimen), opening, RECESS * specimen.outer_radius)


def base_plate(specimen: Specimen, opening: Opening) -> Surface:
    """The plate under the specimen, whole, in as many segments as the specimen, m."""
    radius, top = PLATE_RADIUS * specimen.outer_radius, -specimen.height - INSET * specimen.outer_radius
    bottom = top - plate_thickness(specimen)
    outline = np.array([[0.0, bottom], [radius, bottom], [radius, top], [0.0, top]])
    return _body(outline, replace(opening, cut=0.0))


def picture_height(tool: Tool, specimen: Specimen) -> float:
    """How far tool and arrow reach above the tool's deepest point, m."""
    return float(tool_outline(tool, specimen)[:, 1].max()) + ARROW * specimen.height


def scale_bar(specimen: Specimen) -> tuple[np.ndarray, float]:
    """A bar of a round length on the base in front of the specimen, with its ends: lines, m, shape (3, 2, 3), and its
    length, m."""
    radius, tick = specimen.outer_radius, 0.03 * specimen.outer_radius
    power = 10.0 ** np.floor(np.log10(0.6 * radius))
    length = float(max(step for step in (1.0, 2.0, 5.0) if step * power <= 0.6 * radius * (1 + 1e-9)) * power)
    y, z = -1.12 * radius, -specimen.height + 0.01 * radius
    ends = np.array([[-0.5 * length, y, z], [0.5 * length, y, z]])
    across = np.array([0.0, tick, 0.0])
    return np.stack([ends, *(np.stack([end - across, end + across]) for end in ends)]), length


def force_arrow(force: float, full_scale: float, tool: Tool, specimen: Specimen) -> Arrow | None:
    """The force on the tool as an arrow over it: up where the tissue pushes back, down where it pulls.

    Args:
        force: N.
        full_scale: force of the longest arrow, N; larger ones are as long.
        tool: over which it stands.
        specimen: its height scales the arrow.

    Returns:
        The arrow, its length in proportion to the force; None below `LEAST_FORCE` of the full scale.
    """
    share = min(abs(force) / full_scale, 1.0)
    if not share >= LEAST_FORCE:
        return None
    size = specimen.height
    bottom = arrow_foot(tool, specimen)
    length = share * ARROW * size
    # The head of a short arrow is smaller, not blunter.
    head = min(HEAD_LENGTH * size, LARGEST_HEAD * length)
    wide, narrow = (width / HEAD_LENGTH * head for width in (HEAD_RADIUS, ARROW_SHAFT))
    outline = np.array([[0.0, 0.0], [narrow, 0.0], [narrow, length - head], [wide, length - head], [0.0, length]])
    ends = np.array([[0.0, 0.0, bottom], [0.0, 0.0, bottom + length]])
    if force < 0:
        outline = (outline * [1.0, -1.0] + [0.0, length])[::-1]
        ends = ends[::-1]
    return Arrow(_body(outline + ends[:, 1:].min(axis=0), Opening(0.0, segments=24)), *ends)


def arrow_foot(tool: Tool, specimen: Specimen) -> float:
    """Height of the lower end of the arrow of a force over the tool's deepest point, along its axis, m."""
    return float(tool_outline(tool, specimen)[:, 1].max()) + INSET * specimen.height


def turned_arrow(arrow: Arrow, aside: tuple[float, float]) -> Arrow:
    """An arrow along z that points as much aside, turned about its lower end.

    Args:
        arrow: of `force_arrow`.
        aside: shares of its direction along x and y.
    """
    foot = min(arrow.start, arrow.tip, key=lambda end: end[2])
    x, y = aside if arrow.tip[2] > arrow.start[2] else (-aside[0], -aside[1])
    share = min(float(np.hypot(x, y)), 1.0)
    cosine = (1.0 - share * share) ** 0.5
    # The rotation that takes z to the direction, the shortest way.
    axis = np.array([-y, x, 0.0]) / max(share, np.finfo(float).tiny)
    skew = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation = np.eye(3) + share * skew + (1.0 - cosine) * skew @ skew

    def turned(points: np.ndarray) -> np.ndarray:
        return (foot + (points - foot) @ rotation.T).astype(points.dtype)

    return Arrow(Surface(turned(arrow.surface.vertices), arrow.surface.faces), turned(arrow.start), turned(arrow.tip))


def contact_picture(surface: SurfaceLine, tool: Tool, depth: float, opening: Opening) -> Contact | None:
    """Where the tissue touches the tool: between two nodes, where the Gauss point between them does.

    The nodes themselves stand in front of a curved tool or in it by turns: the solver keeps the Gauss points on it.

    Args:
        surface: of the deformed tissue.
        tool: whose deepest point is at z = -depth.
        depth: m.
        opening: on whose section faces the lines are.

    Returns:
        The contact, or None where there is none.
    """
    width = float(surface.points[:, 0].max())
    near = TOUCH * min(width, tool.radius or width)
    touching = tool.profile.gap(surface.watched + np.array([0.0, depth])) <= near
    if not touching.any():
        return None
    lines = np.stack([surface.points[:-1], surface.points[1:]], axis=1)[touching]
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    area = float(np.pi * lines[..., 0].sum(axis=1) @ length)
    rim = lines.reshape(-1, 2)[np.argmax(lines[..., 0])]
    lift = LIFT * width
    return Contact(np.concatenate([opening.on_faces(lines, lift).reshape(-1, 2, 3),
                                   opening.circle(rim[0] + lift, rim[1])]), float(rim[0]), area)


def _body(outline: np.ndarray, opening: Opening, recess: float = 0.0) -> Surface:
    """A closed body of revolution.

    Args:
        outline: (r, z) from the axis below to the axis above, nowhere downwards, shape (n, 2).
        opening: what is cut out.
        recess: how far the section faces stay behind the cut.
    """
    # The body is to the right of a way that comes down.
    outside, = revolved_surfaces(outline[::-1], np.zeros(len(outline) - 1, dtype=int), 1, opening)
    if opening.closed:
        return outside
    count = len(outline)
    points = np.concatenate([outline, outline * [0.0, 1.0]])
    low = np.arange(count - 1)
    triangles = np.concatenate([np.stack([low + count, low, low + 1], axis=-1),
                                np.stack([low + count, low + 1, low + count + 1], axis=-1)])
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]
    triangles = triangles[area > 1e-12 * outline.max() ** 2]
    sections, = section_surfaces(points, triangles, np.zeros(len(triangles), dtype=int), 1, opening, -recess)
    return joined(sections, outside)


def plate_thickness(specimen: Specimen) -> float:
    """Of the plates above and below a specimen, m."""
    return PLATE_THICKNESS * max(specimen.height, 0.5 * specimen.outer_radius)
