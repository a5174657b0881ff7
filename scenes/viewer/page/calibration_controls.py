"""Controls of a calibration: upload recordings, fit the material to them, see and save what came out."""

from __future__ import annotations

from html import escape
from pathlib import Path

import viser

import tissue_sim as ts
from scenes.viewer.calibration_run import CalibrationState, Uploaded
from scenes.viewer.calibration_task import Calibrated
from scenes.viewer.frame import Commands, Frame
from scenes.viewer.material_files import SUFFIX
from scenes.viewer.page.notices import answer_to, send_file
from scenes.viewer.recording_upload import read_recording_upload
from scenes.viewer.scene import Scene
from tissue_sim.units import shown

_SMALL = "font-size:0.85em;padding:0.2em 0.75em"


class CalibrationControls:
    """The tab in which recordings become a material.

    Args:
        folder: where saved materials go.
    """

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame, folder: Path):
        gui = server.gui
        self._shown: tuple[CalibrationState, Scene] | None = None
        self._upload = gui.add_upload_button("Upload recording", icon=viser.Icon.UPLOAD, mime_type="*/*",
                                             hint="files of a test machine, or NAME.csv, and NAME.json that belongs to "
                                                  "it, one by one")
        self._begin = gui.add_button("Calibrate", icon=viser.Icon.ADJUSTMENTS,
                                     hint="fit the material, from its present parameters on, to the recordings")
        self._cancel = gui.add_button("Cancel calibration", icon=viser.Icon.X, color="red", visible=False)
        self._told = gui.add_html("")
        self._saving = gui.add_folder("save what was calibrated", visible=False)
        with self._saving:
            self._name = gui.add_text("new name", "calibrated", hint=f"without {SUFFIX}")
            self._save = gui.add_button("Save calibrated material", icon=viser.Icon.DEVICE_FLOPPY)
        # Below what came out, which is to be seen without scrolling.
        self._recordings = gui.add_html("")
        self._remove = gui.add_button("Remove all recordings", icon=viser.Icon.TRASH, color="gray")
        self.show(frame)

        @self._upload.on_upload
        def _(event: viser.GuiEvent) -> None:
            file = self._upload.value
            try:
                uploads = read_recording_upload(file.name, file.content)
            except ts.InputError as error:
                answer_to(event)(str(error))
                return
            done = f"{', '.join(upload.name for upload in uploads)} {'is' if len(uploads) == 1 else 'are'} read"
            session.post("add_recordings", reply=answer_to(event, done), uploads=uploads)

        for button, command in ((self._remove, "remove_recordings"), (self._begin, "calibrate"),
                                (self._cancel, "cancel_calibration")):
            self._post_on_click(session, button, command)

        @self._save.on_click
        def _(event: viser.GuiEvent) -> None:
            name = self._name.value.strip().removesuffix(SUFFIX)
            state = None if self._shown is None else self._shown[0]

            def reply(problem: str | None) -> None:
                answer_to(event, f"saved as {name}{SUFFIX} in {folder}")(problem)
                if problem is None and state is not None and state.result is not None:
                    send_file(event.client, f"{name}{SUFFIX}", state.result.file)

            session.post("save_calibration", reply=reply, folder=folder, name=name)

    def _post_on_click(self, session: Commands, button: viser.GuiButtonHandle, command: str) -> None:
        @button.on_click
        def _(event: viser.GuiEvent) -> None:
            session.post(command, reply=answer_to(event))

    def show(self, frame: Frame) -> None:
        """Write what has changed."""
        state, scene = frame.calibration, frame.scene
        if self._shown is not None and self._shown[0] is state and self._shown[1] is scene:
            return
        self._shown = state, scene
        running, some = state.told is not None, bool(state.recordings)
        for handle, visible in ((self._remove, some and not running), (self._begin, some and not running),
                                (self._upload, not running), (self._cancel, running),
                                (self._saving, state.result is not None and not running)):
            if handle.visible != visible:
                handle.visible = visible
        for html, content in ((self._recordings, recordings_html(state, scene)), (self._told, told_html(state))):
            if html.content != content:
                html.content = content


def recordings_html(state: CalibrationState, scene: Scene) -> str:
    """What was understood of each recording, and what does not fit the scene."""
    if not state.recordings:
        title = escape(scene.kind.title.lower())
        return (f'<div style="{_SMALL}" data-testid="recordings">Upload recordings of this test ({title}), made '
                "with the tool and the specimen of this scene, and calibrate its material with them.</div>")
    each_one = "".join(_recording(each, scene) for each in state.recordings)
    return f'<div style="{_SMALL}" data-testid="recordings">{each_one}</div>'


def _recording(each: Uploaded, scene: Scene) -> str:
    facts = [each.measured.kind or "kind not said", each.tool or "tool not said", f"{len(each.recording)} samples",
             f"to {each.depth * 1e3:.3g} mm and {each.recording.force.max():.3g} N"]
    if each.duration is not None:
        facts.append(f"{each.duration:.3g} s")
    warnings = "".join(f'<div style="color:#C0392B">{escape(said)}</div>' for said in each.warnings(scene))
    understood = "".join(f"<div>{escape(said)}</div>" for said in each.file.understood)
    return (f'<div style="margin-bottom:0.4em"><b>{escape(each.file.name)}</b><br>{escape(", ".join(facts))}'
            f"{understood}{warnings}</div>")


def told_html(state: CalibrationState) -> str:
    """How far the fit is, why there is none, and what came out of the last one."""
    parts = []
    if state.told is not None:
        told = state.told
        parts.append(f'<div data-testid="calibrating"><b>{escape(told.sentence)}</b></div>')
        if told.solves:
            numbers = ", ".join(_number(name, value, told.units.get(name, "1"))
                                for name, value in told.parameters.items())
            misfit = "" if told.rmse is None else f", misfit {told.rmse:.3g} N"
            parts.append(f"<div>iteration {told.solves}{misfit}<br>{escape(numbers)}</div>")
    if state.problem:
        parts.append(f'<div data-testid="calibration-problem" style="border-left:3px solid #D55E00;padding-left:0.6em">'
                     f"{escape(state.problem)}</div>")
    if state.result is not None and state.told is None:
        parts.append(_result(state.result))
    return f'<div style="{_SMALL}">{"".join(parts)}</div>' if parts else ""


def _number(name: str, value: float, si_unit: str) -> str:
    unit, factor = shown(si_unit)
    return f"{name} {factor * value:.5g} {unit}".rstrip()


def _result(result: Calibrated) -> str:
    rows = []
    for name, found in result.values.items():
        unit, factor = shown(found.unit)
        interval = "none" if found.interval is None else " to ".join(f"{factor * end:.4g}" for end in found.interval)
        note = f" ({found.note})" if found.note else ""
        rows.append(f"<tr><td>{escape(name)}</td><td>{factor * found.value:.4g} {escape(unit)}</td>"
                    f"<td>{escape(interval + note)}</td></tr>")
    rmse = "" if result.rmse is None else f"<div>RMSE {result.rmse:.3g} N</div>"
    warnings = "".join(f"<li>{escape(said)}</li>" for said in result.warnings)
    listed = f'<ul style="margin:0.3em 0;padding-left:1.2em">{warnings}</ul>' if warnings else ""
    return (f'<div data-testid="calibrated"><table style="width:100%;text-align:left"><tr><th></th><th>calibrated</th>'
            f"<th>95 % interval</th></tr>{''.join(rows)}</table>{rmse}{listed}</div>")
