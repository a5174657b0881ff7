"""Controls of the picture: field, cut, lines, camera."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import viser

from scenes.field_labels import LABELS
from scenes.viewer.camera import FIELD_OF_VIEW, PRESETS, camera_pose
from scenes.viewer.frame import Frame
from scenes.viewer.page.notices import set_value
from scenes.viewer.page.solid import Look
from scenes.viewer.tool_picture import picture_height


class LookControls:
    """The tab with what the picture shows; the same for everybody but for the camera.

    Attributes:
        look: as it is now.
    """

    def __init__(self, server: viser.ViserServer, frame: Frame, scale: float):
        gui = server.gui
        self.look, self._frame, self._scale = Look(), frame, scale
        fields = {label: name for name, (label, _) in LABELS.items()}
        self._field = field = gui.add_dropdown("colour", tuple(fields), initial_value=LABELS[self.look.field][0])
        hold = gui.add_checkbox("hold the colours' range", False)
        cut = gui.add_slider("cut-away [°]", min=0, max=180, step=5, initial_value=round(self.look.cut))
        turn = gui.add_slider("cut turned [°]", min=-180, max=180, step=5, initial_value=round(self.look.turn),
                              hint="about the tool's axis")
        reach = round(1e3 * frame.scene.half_width)
        self._ahead = ahead = gui.add_slider("cut moved [mm]", min=-reach, max=reach, step=0.5, initial_value=0.0,
                                             visible=False, hint="from the tool's axis, to where it opens")
        mesh_lines = gui.add_checkbox("mesh lines", self.look.mesh_lines)
        outline = gui.add_checkbox("undeformed outline", self.look.outline)
        camera = gui.add_button_group("camera", tuple(name.capitalize() for name in PRESETS))
        dark = gui.add_checkbox("dark page", False)

        def change(_: viser.GuiEvent) -> None:
            # A browser may still ask for a field that is not offered any more.
            name = fields[field.value] if field.value in field.options else self.look.field
            self.look = Look(name, float(cut.value), float(turn.value), float(ahead.value),
                             mesh_lines.value, outline.value, hold.value)

        for handle in (field, hold, cut, turn, ahead, mesh_lines, outline):
            handle.on_update(change)

        @camera.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.place_camera(event.client, camera.value.lower())

        self.on_dark: Callable[[bool], None] = lambda _: None

        @dark.on_update
        def _(_: viser.GuiEvent) -> None:
            self.on_dark(dark.value)

        self._dark = dark
        pose = self._pose("iso", 1.0)
        first = server.initial_camera
        first.up, first.fov = (0.0, 0.0, 1.0), FIELD_OF_VIEW
        first.position, first.look_at = pose

    def set_dark(self, dark: bool) -> None:
        """Make the page dark or light."""
        set_value(self._dark, dark)
        self.on_dark(dark)

    def show(self, frame: Frame) -> None:
        """Remember what there is to look at."""
        self._frame = frame
        in_space = frame.snapshot is not None and frame.snapshot.in_space
        if self._ahead.visible != in_space:
            self._ahead.visible = in_space
        shown = None if frame.snapshot is None else frame.snapshot.fields
        if shown is not None:
            self._offer(shown.names)

    def _offer(self, names: Collection[str]) -> None:
        """The fields that the solver knows, alone."""
        labels = tuple(label for name, (label, _) in LABELS.items() if name in names)
        if labels and labels != self._field.options:
            self._field.options = labels
        if self.look.field not in names and labels:
            names_of = {label: name for name, (label, _) in LABELS.items()}
            self.look = replace(self.look, field=names_of[labels[0]])

    def place_camera(self, client: viser.ClientHandle, preset: str) -> None:
        """Let one browser look from a preset."""
        position, look_at = self._pose(preset, client.camera.aspect)
        with client.atomic():
            client.camera.fov = FIELD_OF_VIEW
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position, client.camera.look_at = position, look_at

    def _pose(self, preset: str, aspect: float):
        experiment, snapshot = self._frame.scene.experiment, self._frame.snapshot
        place = experiment.tool_pose(0.0) if snapshot is None else snapshot.pose
        above = picture_height(experiment.tool, experiment.specimen)
        pose = camera_pose(preset, experiment.specimen, experiment.tool, place.depth, above, aspect, self.look.turn,
                           place.position[:2])
        return pose.position * self._scale, pose.look_at * self._scale
