"""Scene and material tabs of the page: choose test, tool and interface; choose, upload, edit and save a material."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from math import radians
from pathlib import Path

import viser

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.frame import CommandReceiver, SessionFrame
from scenes.viewer.material_files import (
    SUFFIX,
    compute_parameter_slider_ranges,
    format_parameter_values_by_path,
    list_material_files,
    read_uploaded_material,
)
from scenes.viewer.page.readouts import (
    FAILED,
    assign_control_value,
    make_browser_reply_function,
    notify_browser_unless_none,
    send_download,
)
from scenes.viewer.scene import Scene
from tissue_sim.experiment.contact_law import INTERFACES
from tissue_sim.experiment.tools.tool import TOOLS, list_all_tool_sizes_by_key, list_shapes_without_file
from tissue_sim.parameters import Declaration, parameter_values

_NONE = "(no file)"
#: Number of calls of `update_controls` between two readings of the folder.
_LIST_INTERVAL = 20


class MaterialControls:
    """Tab with the file of the material and a slider for each parameter.

    Args:
        server: Server of the page.
        session: Receives the commands.
        frame: First frame.
        folder: Folder from which material files are listed and into which they are saved.
    """

    def __init__(self, server: viser.ViserServer, session: CommandReceiver, frame: SessionFrame, folder: Path):
        self._gui, self._session, self._folder = server.gui, session, folder
        gui = server.gui
        self._file = gui.add_dropdown("file", (_NONE,), initial_value=_NONE, hint=f"*{SUFFIX} in {folder}")
        self._upload = gui.add_upload_button("Upload material", icon=viser.Icon.UPLOAD, mime_type="application/json")
        self._law = gui.add_markdown("")
        self._parameters = gui.add_folder("parameters")
        self._sliders: dict[str, viser.GuiSliderHandle] = {}
        self._factors: dict[str, float] = {}
        self._shown: tuple[ts.Material, str] | None = None
        #: Number of values that users have entered, and number of them that the session has applied or refused.
        self._entered = self._answered = 0
        self._structure: tuple = ()
        self._shows = 0
        with gui.add_folder("save as a new file"):
            self._name = gui.add_text("name", "edited", hint=f"without {SUFFIX}")
            self._save = gui.add_button("Save material", icon=viser.Icon.DEVICE_FLOPPY)
        self._update_file_list()
        self.update_controls(frame)

        @self._file.on_update
        def handle_file_choice_by_loading_material(event: viser.GuiEvent) -> None:
            """Load the chosen material file; changes that the program makes are ignored."""
            if event.client is not None and self._file.value != _NONE:
                self._load_and_post_material(self._folder / self._file.value, event)

        @self._upload.on_upload
        def use_material_on_upload(event: viser.GuiEvent) -> None:
            """Read the uploaded material file, and post its material; show the message of a file that is refused."""
            file = self._upload.value
            try:
                material = read_uploaded_material(file.name, file.content)
            except ts.InputError as error:
                make_browser_reply_function(event)(f"{error} The material is unchanged.")
                return
            session.post("use_material",
                         reply=make_browser_reply_function(event, f"The material of {file.name} is in use."),
                         material=material, source=file.name)

        @self._save.on_click
        def save_material_on_click(event: viser.GuiEvent) -> None:
            """Post the command that writes the edited material into the folder."""
            name = self._name.value

            def reply_update_list_and_download_if_saved(problem: str | None) -> None:
                """Show the problem; without a problem, update the file list and send the file to the browser."""
                make_browser_reply_function(event, f"Saved as {name}{SUFFIX} in {folder}.")(problem)
                if problem is None:
                    self._update_file_list()
                    send_download(event.client, f"{name}{SUFFIX}", (folder / f"{name}{SUFFIX}").read_bytes())

            session.post("save_material", reply=reply_update_list_and_download_if_saved, folder=folder, name=name)

    def _load_and_post_material(self, path: Path, event: viser.GuiEvent) -> None:
        """Read a material file and post its material to the session."""
        try:
            material = ts.load_material(path)
        except ts.InputError as error:
            notify_browser_unless_none(event.client, FAILED, f"{error} The material is unchanged.", "red")
            return
        self._session.post("use_material", reply=make_browser_reply_function(event), material=material,
                           source=path.name)

    def _update_file_list(self) -> None:
        """Update the choices of the dropdown to the material files in the folder."""
        names = tuple(path.name for path in list_material_files(self._folder))
        if self._file.options != (_NONE, *names):
            self._file.options = (_NONE, *names)

    def update_controls(self, frame: SessionFrame) -> None:
        """Update the sliders if the material has changed, and the list of files at intervals."""
        self._shows += 1
        if self._shows % _LIST_INTERVAL == 0:
            with suppress(ts.InputError):  # the folder was removed: keep the list
                self._update_file_list()
        material, source = frame.scene.material, frame.scene.source
        # A value that the session has not answered yet is newer than the frame.
        if self._shown == (material, source) or self._entered != self._answered:
            return
        self._shown = material, source
        assign_control_value(self._file, source if source in self._file.options else _NONE)
        values = parameter_values(material)
        # The sliders round to their step; this text shows the full values.
        exact = ", ".join(f"{name} {text}" for name, text in format_parameter_values_by_path(material).items())
        self._law.content = f"**{material.energy_law.title}**, from {source}: {exact}"
        structure = (material.law, tuple(values), source)
        if structure != self._structure:
            self._structure = structure
            self._replace_sliders(material)
        for name, slider in self._sliders.items():
            value = _round_to_step_multiple_in_range(values[name] * self._factors[name], slider.min, slider.max,
                                                     slider.step)
            # A typed number outside of the range may still be incomplete: do not overwrite it.
            if abs(_round_to_step_multiple_in_range(slider.value, slider.min, slider.max,
                                                    slider.step) - value) > 0.01 * slider.step:
                assign_control_value(slider, value)

    def _replace_sliders(self, material: ts.Material) -> None:
        """Remove all sliders, and add a slider for each parameter that can change."""
        for slider in self._sliders.values():
            slider.remove()
        self._sliders, self._factors = {}, {}
        values = parameter_values(material)
        with self._parameters:
            for name, limits in compute_parameter_slider_ranges(material).items():
                if limits.high <= limits.low:
                    continue
                unit = f" [{limits.unit}]" if limits.unit else ""
                value = _round_to_step_multiple_in_range(values[name] * limits.factor, limits.low, limits.high,
                                                         limits.step)
                slider = self._gui.add_slider(f"{name}{unit}", min=limits.low, max=limits.high, step=limits.step,
                                              initial_value=value)
                self._sliders[name], self._factors[name] = slider, limits.factor
                slider.on_update(self._make_slider_callback(name, slider, limits.factor))

    def _make_slider_callback(self, name: str, slider: viser.GuiSliderHandle,
                              factor: float) -> Callable[[viser.GuiEvent], Coroutine]:
        """Return the callback that posts the value of a slider; `factor` is displayed value over SI value."""
        # viser runs a coroutine before it writes another value.
        async def post_slider_value(event: viser.GuiEvent) -> None:
            """Post the value of the slider in SI units; ignore changes that the program makes."""
            if event.client is None:
                return
            notify_problem = make_browser_reply_function(event)

            def count_answer_and_show_refusal(problem: str | None) -> None:
                """Count the executed or refused command; for a refused value show the problem and reset the slider."""
                self._answered += 1
                if problem is not None:
                    self._shown = None  # resets the slider in the next frame
                notify_problem(problem)

            self._entered += 1
            entered = min(max(slider.value, slider.min), slider.max)
            self._session.post("set_parameters", reply=count_answer_and_show_refusal, values={name: entered / factor})

        return post_slider_value


def _round_to_step_multiple_in_range(value: float, low: float, high: float, step: float) -> float:
    """Round a value to the nearest step of a slider within its range."""
    return min(max(float(f"{round(value / step) * step:.9g}"), low), high)


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
