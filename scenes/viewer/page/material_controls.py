"""Material tab of the page: choose, upload, edit and save a material."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path

import viser

import tissue_sim as ts
from scenes.viewer.frame import Commands, Frame
from scenes.viewer.material_files import SUFFIX, exact_values, list_materials, parameter_ranges, read_upload
from scenes.viewer.page.notices import FAILED, notify, reply_to, send_file, set_value
from tissue_sim.parameters import parameter_values

_NONE = "(no file)"
#: Number of calls of `show` between two readings of the folder.
_LIST_INTERVAL = 20


class MaterialControls:
    """Tab with the file of the material and a slider for each parameter.

    Args:
        server: Server of the page.
        session: Receives the commands.
        frame: First frame.
        folder: Folder from which material files are listed and into which they are saved.
    """

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame, folder: Path):
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
        self._list_files()
        self.show(frame)

        @self._file.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None and self._file.value != _NONE:
                self._load(self._folder / self._file.value, event)

        @self._upload.on_upload
        def _(event: viser.GuiEvent) -> None:
            file = self._upload.value
            try:
                material = read_upload(file.name, file.content)
            except ts.InputError as error:
                reply_to(event)(f"{error} The material is unchanged.")
                return
            session.post("use_material", reply=reply_to(event, f"The material of {file.name} is in use."),
                         material=material, source=file.name)

        @self._save.on_click
        def _(event: viser.GuiEvent) -> None:
            name = self._name.value

            def reply(problem: str | None) -> None:
                reply_to(event, f"Saved as {name}{SUFFIX} in {folder}.")(problem)
                if problem is None:
                    self._list_files()
                    send_file(event.client, f"{name}{SUFFIX}", (folder / f"{name}{SUFFIX}").read_bytes())

            session.post("save_material", reply=reply, folder=folder, name=name)

    def _load(self, path: Path, event: viser.GuiEvent) -> None:
        """Read a material file and post its material to the session."""
        try:
            material = ts.load_material(path)
        except ts.InputError as error:
            notify(event.client, FAILED, f"{error} The material is unchanged.", "red")
            return
        self._session.post("use_material", reply=reply_to(event), material=material, source=path.name)

    def _list_files(self) -> None:
        names = tuple(path.name for path in list_materials(self._folder))
        if self._file.options != (_NONE, *names):
            self._file.options = (_NONE, *names)

    def show(self, frame: Frame) -> None:
        """Update the sliders if the material has changed, and the list of files at intervals."""
        self._shows += 1
        if self._shows % _LIST_INTERVAL == 0:
            with suppress(ts.InputError):  # the folder was removed: keep the list
                self._list_files()
        material, source = frame.scene.material, frame.scene.source
        # A value that the session has not answered yet is newer than the frame.
        if self._shown == (material, source) or self._entered != self._answered:
            return
        self._shown = material, source
        set_value(self._file, source if source in self._file.options else _NONE)
        values = parameter_values(material)
        # The sliders round to their step; this text shows the full values.
        exact = ", ".join(f"{name} {text}" for name, text in exact_values(material).items())
        self._law.content = f"**{material.energy_law.title}**, from {source}: {exact}"
        structure = (material.law, tuple(values), source)
        if structure != self._structure:
            self._structure = structure
            self._make_sliders(material)
        for name, slider in self._sliders.items():
            value = _on_slider(values[name] * self._factors[name], slider.min, slider.max, slider.step)
            # A typed number outside of the range may still be incomplete: do not overwrite it.
            if abs(_on_slider(slider.value, slider.min, slider.max, slider.step) - value) > 0.01 * slider.step:
                set_value(slider, value)

    def _make_sliders(self, material: ts.Material) -> None:
        for slider in self._sliders.values():
            slider.remove()
        self._sliders, self._factors = {}, {}
        values = parameter_values(material)
        with self._parameters:
            for name, limits in parameter_ranges(material).items():
                if limits.high <= limits.low:
                    continue
                unit = f" [{limits.unit}]" if limits.unit else ""
                slider = self._gui.add_slider(f"{name}{unit}", min=limits.low, max=limits.high, step=limits.step,
                                              initial_value=_on_slider(values[name] * limits.factor, limits.low,
                                                                       limits.high, limits.step))
                self._sliders[name], self._factors[name] = slider, limits.factor
                slider.on_update(self._edit_handler(name, slider, limits.factor))

    def _edit_handler(self, name: str, slider: viser.GuiSliderHandle,
                      factor: float) -> Callable[[viser.GuiEvent], Coroutine]:
        """Return the callback that posts the value of a slider; `factor` is displayed value over SI value."""
        async def edit(event: viser.GuiEvent) -> None:  # viser runs a coroutine before it writes another value
            if event.client is None:
                return
            notify_problem = reply_to(event)

            def reply(problem: str | None) -> None:
                self._answered += 1
                if problem is not None:
                    self._shown = None  # resets the slider in the next frame
                notify_problem(problem)

            self._entered += 1
            entered = min(max(slider.value, slider.min), slider.max)
            self._session.post("set_parameters", reply=reply, values={name: entered / factor})

        return edit


def _on_slider(value: float, low: float, high: float, step: float) -> float:
    """Round a value to the nearest step of a slider within its range."""
    return min(max(float(f"{round(value / step) * step:.9g}"), low), high)
