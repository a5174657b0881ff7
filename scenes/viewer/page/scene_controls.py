"""Scene tab of the page: choose the test, the tool and the interface between tool and tissue."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import viser

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.frame import CommandReceiver, SessionFrame
from scenes.viewer.page.notices import assign_control_value, make_browser_reply_function
from scenes.viewer.scene import Scene
from tissue_sim.experiment.contact_law import INTERFACES
from tissue_sim.experiment.tools.tool import TOOLS, list_all_tool_sizes_by_key, list_shapes_without_file
from tissue_sim.parameters import Declaration

_INTERFACES = (*INTERFACES, "friction")
#: Interfaces along which tissue slides; tissue cannot slide far around a sharp edge.
_SLIDING = ("frictionless", "friction")


@dataclass(frozen=True)
class SlidingInterfaceDefaults:
    """Values that the page fills in when an interface that slides is chosen.

    Attributes:
        edge_radius: edge radius of a sharp tool, m.
        friction: initial friction coefficient if the scene has none, 1.
    """

    edge_radius: float = 0.5e-3
    friction: float = 0.3


_SLIDING_DEFAULTS = SlidingInterfaceDefaults()
#: Initial sizes of a needle that is chosen after a plate, by their SI unit.
_DEFAULT_SIZES = {"m": 8e-3, "rad": radians(45.0)}


class SceneControls:
    """Tab with test, tool and interface; changes apply when the user presses Apply, because a new mesh takes seconds.

    Args:
        server: Server of the page.
        session: Receives the commands.
        frame: First frame.
    """

    def __init__(self, server: viser.ViserServer, session: CommandReceiver, frame: SessionFrame):
        gui = server.gui
        self._titles = {scene.title: name for name, scene in SCENES.items()}
        self._scene = gui.add_dropdown("scene", tuple(self._titles), initial_value=frame.scene.kind.title)
        self._needles = tuple(shape for shape in list_shapes_without_file() if not TOOLS[shape].is_plate)
        self._shape = gui.add_dropdown("tool", self._needles, initial_value=self._needles[0])
        self._declared_sizes = list_all_tool_sizes_by_key()
        self._sizes = {key: _add_size_field_in_key_unit(gui, key, declaration)
                       for key, (declaration, _, _) in self._declared_sizes.items()}
        self._interface = gui.add_dropdown("tool's face", _INTERFACES, initial_value="bonded",
                                           hint="interface between tool and tissue")
        self._friction = gui.add_number("friction", _SLIDING_DEFAULTS.friction, min=0.0, max=2.0, step=0.01,
                                        hint="friction coefficient")
        self._apply = gui.add_button("Apply", icon=viser.Icon.CHECK)
        self._shown: Scene | None = None
        self.update_controls(frame)

        for handle in (self._shape, self._interface):
            @handle.on_update
            def adapt_controls_to_tool_on_update(event: viser.GuiEvent) -> None:
                if event.client is not None:
                    self._replace_unsuitable_interface_and_edge()
                self._update_control_visibility()

        @self._scene.on_update
        def adapt_controls_to_scene_on_update(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._display_contact_interface(SCENES[self._titles[self._scene.value]].face.usual)
                self._replace_unsuitable_interface_and_edge()
            self._update_control_visibility()

        @self._apply.on_click
        def apply_scene_on_click(event: viser.GuiEvent) -> None:
            name = self._titles[self._scene.value]
            reply = make_browser_reply_function(event)
            try:
                tool, friction = self._build_tool_or_none_for_plates(name), self._friction.value
            except ts.InputError as error:
                reply(str(error))
                return
            session.post("use_scene", reply=reply, name=name, tool=tool,
                         friction=friction if self._interface.value == "friction" else self._interface.value)

    def _build_tool_or_none_for_plates(self, scene: str) -> ts.Tool | None:
        """Return the tool with the chosen shape and sizes; None if the scene uses plates."""
        if SCENES[scene].require_tool().is_plate:
            return None
        shape = self._shape.value
        return ts.Tool(shape, **{name: self._sizes[key].value * declaration.factor
                                 for key, (declaration, name, shapes) in self._declared_sizes.items()
                                 if shape in shapes})

    def _replace_unsuitable_interface_and_edge(self) -> None:
        """Adapt the interface and the edge radius to the tool: only flat faces bond, and sliding needs a round edge."""
        tool = self._build_valid_tool_or_none()
        if tool is None:
            return
        if tool.face_radius == 0 and self._interface.value == "bonded":
            assign_control_value(self._interface, "stick")
        if tool.has_sharp_edge and self._interface.value in _SLIDING:
            for key, (declaration, name, _) in self._declared_sizes.items():
                if name == "edge_radius":
                    assign_control_value(self._sizes[key], _SLIDING_DEFAULTS.edge_radius / declaration.factor)

    def _update_control_visibility(self) -> None:
        """Show only the controls and interfaces that apply to the chosen scene and tool."""
        tool = self._build_valid_tool_or_none()
        flat = tool is None or tool.face_radius != 0
        self._interface.options = _INTERFACES if flat else tuple(each for each in _INTERFACES if each != "bonded")
        needle = not SCENES[self._titles[self._scene.value]].require_tool().is_plate
        self._shape.visible = needle
        for key, (_, _, shapes) in self._declared_sizes.items():
            self._sizes[key].visible = needle and self._shape.value in shapes
        self._friction.visible = self._interface.value == "friction"

    def _build_valid_tool_or_none(self) -> ts.Tool | None:
        """Return the chosen tool; None for plates and for invalid sizes, which Apply reports."""
        try:
            return self._build_tool_or_none_for_plates(self._titles[self._scene.value])
        except ts.InputError:
            return None

    def update_controls(self, frame: SessionFrame) -> None:
        """Update the controls if another browser or a command has changed the scene."""
        scene = frame.scene
        if self._shown is not None and self._shown.experiment is scene.experiment:
            return
        self._shown = scene
        tool, friction = scene.experiment.tool, scene.experiment.friction
        assign_control_value(self._scene, scene.kind.title)
        if tool.shape in self._needles:
            assign_control_value(self._shape, tool.shape)
            for key, (declaration, name, shapes) in self._declared_sizes.items():
                if tool.shape in shapes:
                    assign_control_value(self._sizes[key], getattr(tool, name) / declaration.factor)
        self._display_contact_interface(friction)
        self._update_control_visibility()

    def _display_contact_interface(self, friction: str | float) -> None:
        """Display an interface: its name, or "friction" and the coefficient."""
        assign_control_value(self._interface, friction if isinstance(friction, str) else "friction")
        if not isinstance(friction, str):
            assign_control_value(self._friction, friction)


def _add_size_field_in_key_unit(gui: viser.GuiApi, key: str, size: Declaration) -> viser.GuiInputHandle[float]:
    """Add a number field for a tool size in the unit of its key; the step is 1 % of the default size."""
    words, _, unit = key.replace("_", " ").rpartition(" ")
    default = _DEFAULT_SIZES[size.unit] / size.factor
    low = 0.0 if size.absent == 0 else max(size.bounds[0] / size.factor, 0.01 * default)
    high = size.bounds[1] / size.factor
    return gui.add_number(f"{words} [{unit}]", default if size.absent is None else size.absent / size.factor, min=low,
                          max=high, step=round(0.01 * default, 2))
