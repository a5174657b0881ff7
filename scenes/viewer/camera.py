"""Where to look from."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin, tan

import numpy as np

from scenes.viewer.tool_picture import PLATE_RADIUS, plate_thickness
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.specimen import Specimen

#: Vertical field of view, rad, and the share of the view that the picture leaves free.
FIELD_OF_VIEW, _MARGIN = radians(30.0), 1.08


@dataclass(frozen=True, eq=False)
class CameraPose:
    """A point of view in the frame of the scene, m."""

    position: np.ndarray
    look_at: np.ndarray


#: Name -> azimuth (0: along +x, the cut opens towards -y) and elevation, degrees.
PRESETS = {"iso": (-62.0, 24.0), "front": (-90.0, 0.0), "top": (-90.0, 89.0), "contact": (-72.0, 12.0)}


def camera_pose(preset: str, specimen: Specimen, tool: Tool, depth: float, above: float,
                aspect: float = 1.0, turn: float = 0.0, aside: tuple[float, float] = (0.0, 0.0)) -> CameraPose:
    """The pose of a preset: everything in view, or with ``contact`` what surrounds the tool's end.

    Args:
        preset: a name in `PRESETS`.
        depth: of the tool, m.
        above: height of the picture above the undeformed top, m.
        aspect: width over height of the view.
        turn: of what is cut open, degrees: one looks into it all the same.
        aside: x and y of the tool, m.
    """
    azimuth, elevation = (radians(angle) for angle in PRESETS[preset])
    azimuth += radians(turn)
    toward = np.array([cos(elevation) * cos(azimuth), cos(elevation) * sin(azimuth), sin(elevation)])
    right = np.array([-sin(azimuth), cos(azimuth), 0.0])
    up = np.cross(toward, right)
    if preset == "contact":
        width = 1.6 * (tool.radius or specimen.outer_radius)
        radius, bottom, top = width, -depth - 0.9 * width, -depth + 0.7 * width
        middle = aside
    else:
        thickness = plate_thickness(specimen)
        radius, bottom, top = PLATE_RADIUS * specimen.outer_radius, -specimen.height - thickness, above
        middle = (0.0, 0.0)
    centre = np.array([*middle, 0.5 * (bottom + top)])
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # Narrow at the top, where the arrow is, unless the view is of the contact.
    rings = ((radius, bottom), (radius, thickness if preset != "contact" else top), (0.3 * radius, top))
    points = np.concatenate([np.column_stack([r * ring + middle, np.full(len(ring), z)]) for r, z in rings]) - centre
    half = tan(0.5 * FIELD_OF_VIEW)
    # So far that every point is within the view: |across| <= half (distance - nearness).
    across = np.maximum(np.abs(points @ up), np.abs(points @ right) / max(aspect, 1e-3))
    distance = float(np.max(across * _MARGIN / half + points @ toward))
    return CameraPose(centre + distance * toward, centre)

