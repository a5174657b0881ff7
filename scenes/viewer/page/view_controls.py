"""View tab of the page: displayed field, cut-away, lines, and camera positions of the preset views."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from math import cos, radians, sin, tan

import numpy as np
import viser

from scenes.field_labels import LABELS
from scenes.viewer.frame import SessionFrame
from scenes.viewer.page.readouts import assign_control_value
from scenes.viewer.page.solid import PictureOptions
from scenes.viewer.tool_picture import SETTINGS, compute_height_of_tool_with_longest_arrow, compute_plate_thickness
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


class ViewControls:
    """Tab with the display options of the picture; all browsers share the options, each has its own camera.

    Args:
        server: Server of the page.
        frame: First frame.
        scale: Browser units per metre.

    Attributes:
        options: The present display options.
    """

    def __init__(self, server: viser.ViserServer, frame: SessionFrame, scale: float):
        gui = server.gui
        self.options, self._frame, self._scale = PictureOptions(), frame, scale
        fields = {label: name for name, (label, _) in LABELS.items()}
        self._field = field = gui.add_dropdown("colour", tuple(fields), initial_value=LABELS[self.options.field][0])
        hold = gui.add_checkbox("keep colour range", False)
        cut = gui.add_slider("cut-away [°]", min=0, max=180, step=5, initial_value=round(self.options.cut),
                             hint="angle of the wedge that is removed from the picture")
        turn = gui.add_slider("cut turned [°]", min=-180, max=180, step=5, initial_value=round(self.options.turn),
                              hint="rotates the removed wedge about the tool's axis")
        half_width = round(1e3 * frame.scene.specimen_outer_radius)
        self._ahead = ahead = gui.add_slider("cut moved [mm]", min=-half_width, max=half_width, step=0.5,
                                             initial_value=0.0, visible=False,
                                             hint="moves the removed wedge away from the tool's axis")
        mesh_lines = gui.add_checkbox("mesh lines", self.options.mesh_lines)
        outline = gui.add_checkbox("undeformed outline", self.options.outline)
        camera = gui.add_button_group("camera", tuple(name.capitalize() for name in PRESETS))
        dark = gui.add_checkbox("dark page", False)

        def store_options_on_update(_: viser.GuiEvent) -> None:
            # A browser may request a field from an outdated list.
            name = fields[field.value] if field.value in field.options else self.options.field
            self.options = PictureOptions(name, float(cut.value), float(turn.value), float(ahead.value),
                                          mesh_lines.value, outline.value, hold.value)

        for handle in (field, hold, cut, turn, ahead, mesh_lines, outline):
            handle.on_update(store_options_on_update)

        @camera.on_click
        def move_camera_on_click(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.move_camera_to_preset(event.client, camera.value.lower())

        self.on_dark: Callable[[bool], None] = lambda _: None

        @dark.on_update
        def forward_dark_choice_on_update(_: viser.GuiEvent) -> None:
            self.on_dark(dark.value)

        self._dark = dark
        pose = self._compute_preset_eye_and_target("iso", 1.0)
        initial = server.initial_camera
        initial.up, initial.fov = (0.0, 0.0, 1.0), FIELD_OF_VIEW
        initial.position, initial.look_at = pose

    def set_colour_scheme(self, dark: bool) -> None:
        """Switch the page to the dark or the light colour scheme."""
        assign_control_value(self._dark, dark)
        self.on_dark(dark)

    def update_controls(self, frame: SessionFrame) -> None:
        """Update the list of fields, and keep the frame for the camera presets."""
        self._frame = frame
        in_space = frame.snapshot is not None and frame.snapshot.is_three_dimensional
        if self._ahead.visible != in_space:
            self._ahead.visible = in_space
        shown = None if frame.snapshot is None else frame.snapshot.drawable_fields
        if shown is not None:
            self._update_colour_field_list(shown.names)

    def _update_colour_field_list(self, names: Collection[str]) -> None:
        """List only the fields that the solver computes; if the chosen field is missing, choose the first one."""
        labels = tuple(label for name, (label, _) in LABELS.items() if name in names)
        if labels and labels != self._field.options:
            self._field.options = labels
        if self.options.field not in names and labels:
            names_of = {label: name for name, (label, _) in LABELS.items()}
            self.options = replace(self.options, field=names_of[labels[0]])

    def move_camera_to_preset(self, client: viser.ClientHandle, preset: str) -> None:
        """Move the camera of one browser to a preset view, a key of `scenes.viewer.page.view_controls.PRESETS`."""
        position, look_at = self._compute_preset_eye_and_target(preset, client.camera.aspect)
        with client.atomic():
            client.camera.fov = FIELD_OF_VIEW
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position, client.camera.look_at = position, look_at

    def _compute_preset_eye_and_target(self, preset: str, aspect: float):
        """Return the position and the target of the camera of a preset view, each in browser units, shape (3,)."""
        experiment, snapshot = self._frame.scene.experiment, self._frame.snapshot
        tool_pose = experiment.tool_pose(0.0) if snapshot is None else snapshot.pose
        above = compute_height_of_tool_with_longest_arrow(experiment.tool, experiment.specimen)
        pose = compute_preset_camera_pose(preset, experiment.specimen, experiment.tool, tool_pose.depth, above, aspect,
                                          self.options.turn, tool_pose.position[:2])
        return pose.position * self._scale, pose.look_at * self._scale
