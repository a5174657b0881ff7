"""Display options of the picture, and its colours, lights and resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PictureOptions:
    """Display options of the picture.

    Attributes:
        field: Displayed field, a key of `scenes.field_labels.LABELS`.
        cut: Angle of the removed wedge, degrees.
        turn: Rotation of the wedge about the tool's axis, degrees; 0 opens the wedge towards -y.
        ahead: Distance of the edge of the wedge from the tool's axis towards the opening, for a solid in 3D, mm.
        mesh_lines: Whether to draw the element edges.
        outline: Whether to draw the outline of the undeformed specimen.
        hold: Whether to keep the present colour levels.
    """

    field: str = "von_mises"
    cut: float = 120.0
    turn: float = 0.0
    ahead: float = 0.0
    mesh_lines: bool = False
    outline: bool = True
    hold: bool = False


@dataclass(frozen=True)
class PictureColours:
    """Colours of the parts of the picture, RGB, 0 to 255.

    Attributes:
        tool: Tool.
        base: Base plate.
        arrow: Force arrow.
        contact: Contact lines.
        tissue: Tissue without fields.
        mesh_lines: Element edges.
        outline: Outline of the undeformed specimen.
        scale_bar: Scale bar.
    """

    tool: tuple[int, int, int] = (176, 184, 194)
    base: tuple[int, int, int] = (120, 126, 134)
    arrow: tuple[int, int, int] = (213, 94, 0)
    contact: tuple[int, int, int] = (230, 20, 110)
    tissue: tuple[int, int, int] = (204, 150, 135)
    mesh_lines: tuple[int, int, int] = (255, 255, 255)
    outline: tuple[int, int, int] = (128, 128, 128)
    scale_bar: tuple[int, int, int] = (20, 20, 20)


@dataclass(frozen=True)
class LightSettings:
    """Lights of the picture: an ambient light, and a directional one that comes from the side on which the cut opens.

    Attributes:
        full: Total intensity on a section face, in which the face has exactly its own colour (pi in three.js).
        directional: Intensity of the directional light, which shows the shape of the surfaces.
        horizontal: Horizontal component of the direction towards the directional light.
        vertical: Vertical component of that direction.
    """

    full: float = np.pi
    directional: float = 1.1
    horizontal: float = 0.8
    vertical: float = 0.6


@dataclass(frozen=True)
class PictureResolutionSettings:
    """Resolution of the surfaces and of the force arrow; larger numbers give a finer picture and more data per frame.

    Attributes:
        segments: Segments of the tissue in a full turn about the axis.
        low_graphics_segments: The same for a browser without a graphics card.
        static_segments: The same for parts that are sent once, such as the tool.
        arrow_lengths: Number of different lengths of the force arrow.
        arrow_directions: Number of different values of each lateral component of its direction.
    """

    segments: int = 48
    low_graphics_segments: int = 32
    static_segments: int = 96
    arrow_lengths: int = 60
    arrow_directions: int = 40


#: Colours of the picture.
COLOURS = PictureColours()
#: Lights of the picture.
LIGHTS = LightSettings()
#: Resolution of the picture.
RESOLUTION = PictureResolutionSettings()
