"""Camera positions of the preset views."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin, tan

import numpy as np

from scenes.viewer.tool_picture import SETTINGS, compute_plate_thickness
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.specimen import Specimen

#: Vertical field of view, rad.
FIELD_OF_VIEW = radians(30.0)
#: Size of the view over the size of the picture in it; larger than 1 leaves a margin.
_MARGIN = 1.08


@dataclass(frozen=True, eq=False)
class CameraPositionAndTarget:
    """Position of the camera and the point at which it is aimed, in the frame of the scene, m, shape (3,)."""

    position: np.ndarray
    look_at: np.ndarray


#: Name of a view -> azimuth and elevation of the camera, degrees; azimuth 0 is +x, and the cut opens towards -y.
PRESETS = {"iso": (-62.0, 24.0), "front": (-90.0, 0.0), "top": (-90.0, 89.0), "contact": (-72.0, 12.0)}


def compute_preset_camera_pose(preset: str, specimen: Specimen, tool: Tool, depth: float, above: float,
                               aspect: float = 1.0,
                               turn: float = 0.0, lateral: tuple[float, float] = (0.0, 0.0)) -> CameraPositionAndTarget:
    """Return the camera of a preset view, which shows the whole scene or, for ``contact``, the end of the tool.

    Args:
        preset: A key of `PRESETS`.
        specimen: The specimen.
        tool: The tool.
        depth: Depth of the tool, m.
        above: Height of the picture above the undeformed top, m.
        aspect: Width over height of the view.
        turn: Rotation of the cut about the axis, degrees; the camera rotates with the cut.
        lateral: x and y of the tool, m.
    """
    azimuth, elevation = (radians(angle) for angle in PRESETS[preset])
    azimuth += radians(turn)
    toward = np.array([cos(elevation) * cos(azimuth), cos(elevation) * sin(azimuth), sin(elevation)])
    right = np.array([-sin(azimuth), cos(azimuth), 0.0])
    up = np.cross(toward, right)
    if preset == "contact":
        width = 1.6 * (tool.radius or specimen.outer_radius)
        radius, bottom, top = width, -depth - 0.9 * width, -depth + 0.7 * width
        middle = lateral
    else:
        thickness = compute_plate_thickness(specimen)
        radius, bottom, top = SETTINGS.plate_radius * specimen.outer_radius, -specimen.height - thickness, above
        middle = (0.0, 0.0)
    centre = np.array([*middle, 0.5 * (bottom + top)])
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # The bounding body is narrow at the top, where only the arrow is, except in the contact view.
    rings = ((radius, bottom), (radius, thickness if preset != "contact" else top), (0.3 * radius, top))
    points = np.concatenate([np.column_stack([r * ring + middle, np.full(len(ring), z)]) for r, z in rings]) - centre
    half = tan(0.5 * FIELD_OF_VIEW)
    # Every point p must satisfy |p @ up|, |p @ right| / aspect <= half * (distance - p @ toward).
    across = np.maximum(np.abs(points @ up), np.abs(points @ right) / max(aspect, 1e-3))
    distance = float(np.max(across * _MARGIN / half + points @ toward))
    return CameraPositionAndTarget(centre + distance * toward, centre)

