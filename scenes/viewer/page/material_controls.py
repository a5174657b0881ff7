"""Controls of the material: choose, upload, edit, save."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path

import viser

import tissue_sim as ts
from scenes.viewer.frame import Commands, Frame
from scenes.viewer.material_files import SUFFIX, exact_values, list_materials, parameter_ranges, read_upload
from scenes.viewer.page.notices import answer_to, notify, send_file, set_value
from tissue_sim.parameters import parameter_values

_NONE = "(no file)"
#: How often the folder is looked at, in calls of `show`.
_LIST_EVERY = 20


class MaterialControls:
    """The tab with the material's file and its parameters.

    Args:
        folder: where the files to choose from are, and where new ones go.
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
        #: Values that people have entered, and those of them that the session has obeyed or refused.
        self._entered = self._obeyed = 0
        self._structure: tuple = ()
        self._shows = 0
        with gui.add_folder("save as a new file"):
            self._name = gui.add_text("name", "edited", hint=f"without {SUFFIX}")
            self._save = gui.add_button("Save material", icon=viser.Icon.DEVICE_FLOPPY)
        self._list()
        self.show(frame)

        @self._file.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None and self._file.value != _NONE:
                self._use(self._folder / self._file.value, event)

        @self._upload.on_upload
        def _(event: viser.GuiEvent) -> None:
            file = self._upload.value
            try:
                material = read_upload(file.name, file.content)
            except ts.InputError as error:
                answer_to(event)(f"{error} The material stays as it was.")
                return
            session.post("use_material", reply=answer_to(event, f"{file.name} is shown"), material=material,
                         source=file.name)

        @self._save.on_click
        def _(event: viser.GuiEvent) -> None:
            name = self._name.value

            def reply(problem: str | None) -> None:
                answer_to(event, f"saved as {name}{SUFFIX} in {folder}")(problem)
                if problem is None:
                    self._list()
                    send_file(event.client, f"{name}{SUFFIX}", (folder / f"{name}{SUFFIX}").read_bytes())

            session.post("save_material", reply=reply, folder=folder, name=name)

    def _use(self, path: Path, event: viser.GuiEvent) -> None:
        try:
            material = ts.load_material(path)
        except ts.InputError as error:
            notify(event.client, "That did not work", f"{error} The material stays as it was.", "red")
            return
        self._session.post("use_material", reply=answer_to(event), material=material, source=path.name)

    def _list(self) -> None:
        names = tuple(path.name for path in list_materials(self._folder))
        if self._file.options != (_NONE, *names):
            self._file.options = (_NONE, *names)

    def show(self, frame: Frame) -> None:
        """Follow a material that somebody else has changed, and the files in the folder."""
        self._shows += 1
        if self._shows % _LIST_EVERY == 0:
            with suppress(ts.InputError):  # somebody has removed the folder: what is on the list stays
                self._list()
        material, source = frame.scene.material, frame.scene.source
        # What was entered a moment ago is newer than the frame.
        if self._shown == (material, source) or self._entered != self._obeyed:
            return
        self._shown = material, source
        set_value(self._file, source if source in self._file.options else _NONE)
        values = parameter_values(material)
        # Sliders have few places; what is felt has all digits.
        exact = ", ".join(f"{name} {text}" for name, text in exact_values(material).items())
        self._law.content = f"**{material.energy_law.title}**, from {source}: {exact}"
        structure = (material.law, tuple(values), source)
        if structure != self._structure:
            self._structure = structure
            self._make_sliders(material)
        for name, slider in self._sliders.items():
            value = _on_slider(values[name] * self._factors[name], slider.min, slider.max, slider.step)
            # One outside of the range may lack its last digit.
            if abs(_on_slider(slider.value, slider.min, slider.max, slider.step) - value) > 0.01 * slider.step:
                set_value(slider, value)

    def _make_sliders(self, material: ts.Material) -> None:
        for slider in self._sliders.values():
            slider.remove()
        self._sliders, self._factors = {}, {}
        values = parameter_values(material)
        with self._parameters:
            for name, reach in parameter_ranges(material).items():
                if reach.high <= reach.low:
                    continue
                unit = f" [{reach.unit}]" if reach.unit else ""
                slider = self._gui.add_slider(f"{name}{unit}", min=reach.low, max=reach.high, step=reach.step,
                                              initial_value=_on_slider(values[name] * reach.factor, reach.low,
                                                                       reach.high, reach.step))
                self._sliders[name], self._factors[name] = slider, reach.factor
                slider.on_update(self._edit(name, slider, reach.factor))

    def _edit(self, name: str, slider: viser.GuiSliderHandle,
              factor: float) -> Callable[[viser.GuiEvent], Coroutine]:
        async def edit(event: viser.GuiEvent) -> None:  # a coroutine: it runs before another value is written
            if event.client is None:
                return
            answer = answer_to(event)

            def reply(problem: str | None) -> None:
                self._obeyed += 1
                if problem is not None:
                    self._shown = None  # the slider goes back
                answer(problem)

            self._entered += 1
            entered = min(max(slider.value, slider.min), slider.max)
            self._session.post("set_parameters", reply=reply, values={name: entered / factor})

        return edit


def _on_slider(value: float, low: float, high: float, step: float) -> float:
    """The place of the slider that is nearest to a value; the material keeps the value itself."""
    return min(max(float(f"{round(value / step) * step:.9g}"), low), high)
