"""Controls of the scene: which test, which tool, and how it holds the tissue."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians

import viser

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.frame import Commands, Frame
from scenes.viewer.page.notices import answer_to
from scenes.viewer.setup import Setup
from tissue_sim.experiment.tools.tool import SHAPES

#: Shapes that need no file.
_SHAPES = tuple(shape for shape in SHAPES if shape not in ("plate", "profile"))
_INTERFACES = ("bonded", "stick", "frictionless", "friction")
#: Of a needle that is chosen after a plate, m and rad; and of friction that is chosen after none.
_HALF_ANGLE, _FRICTION = radians(45.0), 0.3


class SceneControls:
    """The tab with the scene; nothing happens before its button is pressed, since another mesh takes seconds."""

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame):
        gui = server.gui
        self._titles = {scene.title: name for name, scene in SCENES.items()}
        self._scene = gui.add_dropdown("scene", tuple(self._titles), initial_value=frame.setup.scene.title)
        self._shape = gui.add_dropdown("tool", _SHAPES, initial_value=_SHAPES[0])
        self._radius = gui.add_number("tool radius [mm]", 8.0, min=0.1, step=0.1)
        self._edge = gui.add_number("edge radius [mm]", 0.0, min=0.0, step=0.05,
                                    hint="a flat face that slides needs one")
        self._angle = gui.add_number("half angle [°]", 45.0, min=1.0, max=89.0, step=1.0)
        self._interface = gui.add_dropdown("tool's face", _INTERFACES, initial_value="bonded")
        self._friction = gui.add_number("friction", _FRICTION, min=0.0, max=2.0, step=0.01)
        self._apply = gui.add_button("Apply", icon=viser.Icon.CHECK)
        self._shown: Setup | None = None
        self.show(frame)

        for handle in (self._shape, self._interface):
            handle.on_update(lambda event: self._offer())

        @self._scene.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._hold(SCENES[self._titles[self._scene.value]].friction)
            self._offer()

        @self._apply.on_click
        def _(event: viser.GuiEvent) -> None:
            name = self._titles[self._scene.value]
            reply = answer_to(event)
            try:
                tool, friction = self._tool(name), self._friction.value
            except ts.InputError as error:
                reply(str(error))
                return
            session.post("use_scene", reply=reply, name=name, tool=tool,
                         friction=friction if self._interface.value == "friction" else self._interface.value)

    def _tool(self, scene: str) -> ts.Tool | None:
        """The tool that is asked for; None for plates."""
        if SCENES[scene].tool.shape == "plate":
            return None
        shape = self._shape.value
        tool = ts.Tool(shape, radius=self._radius.value * 1e-3, half_angle=_HALF_ANGLE if shape == "cone" else None)
        if shape == "flat":
            return replace(tool, edge_radius=self._edge.value * 1e-3)
        return replace(tool, half_angle=radians(self._angle.value)) if shape == "cone" else tool

    def _offer(self) -> None:
        """Show what matters to what is chosen."""
        needle = SCENES[self._titles[self._scene.value]].tool.shape != "plate"
        shape = self._shape.value
        for handle, matters in ((self._shape, needle), (self._radius, needle), (self._edge, needle and shape == "flat"),
                                (self._angle, needle and shape == "cone"),
                                (self._friction, self._interface.value == "friction")):
            handle.visible = matters

    def show(self, frame: Frame) -> None:
        """Follow a scene that somebody else has chosen."""
        setup = frame.setup
        if self._shown is not None and self._shown.experiment is setup.experiment:
            return
        self._shown = setup
        tool, friction = setup.experiment.tool, setup.experiment.friction
        self._scene.value = setup.scene.title
        if tool.shape in _SHAPES:
            self._shape.value, self._radius.value = tool.shape, tool.radius * 1e3
            self._edge.value = tool.edge_radius * 1e3
            if tool.half_angle:
                self._angle.value = degrees(tool.half_angle)
        self._hold(friction)
        self._offer()

    def _hold(self, friction: str | float) -> None:
        """Show how the tool's face holds the tissue."""
        self._interface.value = friction if isinstance(friction, str) else "friction"
        if not isinstance(friction, str):
            self._friction.value = friction
