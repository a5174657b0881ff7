"""Controls of the scene: which test, which tool, and how it holds the tissue."""

from __future__ import annotations

from math import radians

import viser

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.frame import Commands, Frame
from scenes.viewer.page.notices import answer_to, set_value
from scenes.viewer.scene import Scene
from tissue_sim.experiment.interfaces import INTERFACES
from tissue_sim.experiment.tools.tool import TOOLS, shapes_without_file, tool_sizes
from tissue_sim.parameters import Declaration

_INTERFACES = (*INTERFACES, "friction")
#: Along which tissue slides, and the edge that a sharp tool gets then, m: round a sharp one no tissue can slide.
_SLIDING, _EDGE = ("frictionless", "friction"), 0.5e-3
#: Sizes of a needle that is chosen after a plate, by their unit; and friction that is chosen after none.
_SIZES, _FRICTION = {"m": 8e-3, "rad": radians(45.0)}, 0.3


class SceneControls:
    """The tab with the scene; nothing happens before its button is pressed, since another mesh takes seconds."""

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame):
        gui = server.gui
        self._titles = {scene.title: name for name, scene in SCENES.items()}
        self._scene = gui.add_dropdown("scene", tuple(self._titles), initial_value=frame.scene.kind.title)
        self._needles = tuple(shape for shape in shapes_without_file() if not TOOLS[shape].is_plate)
        self._shape = gui.add_dropdown("tool", self._needles, initial_value=self._needles[0])
        self._known = tool_sizes()
        self._sizes = {key: _size_control(gui, key, what) for key, (what, _, _) in self._known.items()}
        self._interface = gui.add_dropdown("tool's face", _INTERFACES, initial_value="bonded")
        self._friction = gui.add_number("friction", _FRICTION, min=0.0, max=2.0, step=0.01)
        self._apply = gui.add_button("Apply", icon=viser.Icon.CHECK)
        self._shown: Scene | None = None
        self.show(frame)

        for handle in (self._shape, self._interface):
            @handle.on_update
            def _(event: viser.GuiEvent) -> None:
                if event.client is not None:
                    self._fit()
                self._offer()

        @self._scene.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._hold(SCENES[self._titles[self._scene.value]].face.usual)
                self._fit()
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
        if SCENES[scene].require_tool().is_plate:
            return None
        shape = self._shape.value
        return ts.Tool(shape, **{name: self._sizes[key].value * what.factor
                                 for key, (what, name, shapes) in self._known.items() if shape in shapes})

    def _fit(self) -> None:
        """Change what does not fit what was chosen: only flat faces are bonded, and no tissue slides round an edge."""
        tool = self._asked_tool()
        if tool is None:
            return
        if tool.face_radius == 0 and self._interface.value == "bonded":
            set_value(self._interface, "stick")
        if tool.sharp_edge and self._interface.value in _SLIDING:
            for key, (what, name, _) in self._known.items():
                if name == "edge_radius":
                    set_value(self._sizes[key], _EDGE / what.factor)

    def _offer(self) -> None:
        """Show what matters to what is chosen."""
        tool = self._asked_tool()
        flat = tool is None or tool.face_radius != 0
        self._interface.options = _INTERFACES if flat else tuple(each for each in _INTERFACES if each != "bonded")
        needle = not SCENES[self._titles[self._scene.value]].require_tool().is_plate
        self._shape.visible = needle
        for key, (_, _, shapes) in self._known.items():
            self._sizes[key].visible = needle and self._shape.value in shapes
        self._friction.visible = self._interface.value == "friction"

    def _asked_tool(self) -> ts.Tool | None:
        """The tool that is asked for; None for plates, and where its sizes make none: applying it says so."""
        try:
            return self._tool(self._titles[self._scene.value])
        except ts.InputError:
            return None

    def show(self, frame: Frame) -> None:
        """Follow a scene that somebody else has chosen."""
        scene = frame.scene
        if self._shown is not None and self._shown.experiment is scene.experiment:
            return
        self._shown = scene
        tool, friction = scene.experiment.tool, scene.experiment.friction
        set_value(self._scene, scene.kind.title)
        if tool.shape in self._needles:
            set_value(self._shape, tool.shape)
            for key, (what, name, shapes) in self._known.items():
                if tool.shape in shapes:
                    set_value(self._sizes[key], getattr(tool, name) / what.factor)
        self._hold(friction)
        self._offer()

    def _hold(self, friction: str | float) -> None:
        """Show how the tool's face holds the tissue."""
        set_value(self._interface, friction if isinstance(friction, str) else "friction")
        if not isinstance(friction, str):
            set_value(self._friction, friction)


def _size_control(gui: viser.GuiApi, key: str, what: Declaration) -> viser.GuiInputHandle[float]:
    """A number in the unit of the size's key; a step is a hundredth of what is usual."""
    words, _, unit = key.replace("_", " ").rpartition(" ")
    usual = _SIZES[what.unit] / what.factor
    low = 0.0 if what.absent == 0 else max(what.bounds[0] / what.factor, 0.01 * usual)
    high = what.bounds[1] / what.factor
    return gui.add_number(f"{words} [{unit}]", usual if what.absent is None else what.absent / what.factor, min=low,
                          max=high, step=round(0.01 * usual, 2))
