"""Calibration tab of the page: upload recordings, fit the material to them, display and save the result."""

from __future__ import annotations

from html import escape
from pathlib import Path

import viser

import tissue_sim as ts
from scenes.viewer.calibration_run import CalibrationState, UploadedRecording
from scenes.viewer.calibration_task import CalibrationResult
from scenes.viewer.frame import CommandReceiver, SessionFrame
from scenes.viewer.material_files import SUFFIX
from scenes.viewer.measurement import read_uploaded_recordings_or_sidecar
from scenes.viewer.page.readouts import make_browser_reply_function, send_download
from scenes.viewer.scene import Scene
from tissue_sim.units import get_display_unit_and_factor

_SMALL = "font-size:0.85em;padding:0.2em 0.75em"


class CalibrationControls:
    """Tab that calibrates the material of the scene from uploaded recordings.

    Args:
        server: Server of the page.
        session: Receives the commands.
        frame: First frame.
        folder: Folder into which calibrated materials are saved.
    """

    def __init__(self, server: viser.ViserServer, session: CommandReceiver, frame: SessionFrame, folder: Path):
        gui = server.gui
        self._shown: tuple[CalibrationState, Scene] | None = None
        self._upload = gui.add_upload_button("Upload recording", icon=viser.Icon.UPLOAD, mime_type="*/*",
                                             hint="one file at a time: a file of a test machine, a recording NAME.csv, "
                                             "or its description NAME.json")
        self._begin = gui.add_button("Calibrate", icon=viser.Icon.ADJUSTMENTS,
                                     hint="fit the material to the recordings, starting from its present parameters")
        self._cancel = gui.add_button("Cancel calibration", icon=viser.Icon.X, color="red", visible=False)
        self._status = gui.add_html("")
        self._saving = gui.add_folder("save the calibrated material", visible=False)
        with self._saving:
            self._name = gui.add_text("new name", "calibrated", hint=f"without {SUFFIX}")
            self._save = gui.add_button("Save calibrated material", icon=viser.Icon.DEVICE_FLOPPY)
        # Placed below the result, so that the result is visible without scrolling.
        self._recordings = gui.add_html("")
        self._remove = gui.add_button("Remove all recordings", icon=viser.Icon.TRASH, color="gray")
        self.update_controls(frame)

        @self._upload.on_upload
        def add_recordings_on_upload(event: viser.GuiEvent) -> None:
            """Read the uploaded file, and post its recordings; show the message of a file that is refused."""
            file = self._upload.value
            try:
                uploads = read_uploaded_recordings_or_sidecar(file.name, file.content)
            except ts.InputError as error:
                make_browser_reply_function(event)(str(error))
                return
            done = f"Read {', '.join(upload.name for upload in uploads)}."
            session.post("add_recordings", reply=make_browser_reply_function(event, done), uploads=uploads)

        for button, command in ((self._remove, "remove_recordings"), (self._begin, "calibrate"),
                                (self._cancel, "cancel_calibration")):
            self._bind_button_to_command(session, button, command)

        @self._save.on_click
        def save_material_on_click(event: viser.GuiEvent) -> None:
            """Post the command that writes the calibrated material into the folder."""
            name = self._name.value.strip().removesuffix(SUFFIX)
            state = None if self._shown is None else self._shown[0]

            def reply_and_download_if_saved(problem: str | None) -> None:
                """Show the problem, or without a problem the success, and send the saved file to the browser."""
                make_browser_reply_function(event, f"Saved as {name}{SUFFIX} in {folder}.")(problem)
                if problem is None and state is not None and state.result is not None:
                    send_download(event.client, f"{name}{SUFFIX}", state.result.file)

            session.post("save_calibration", reply=reply_and_download_if_saved, folder=folder, name=name)

    def _bind_button_to_command(self, session: CommandReceiver, button: viser.GuiButtonHandle, command: str) -> None:
        """Post a command without arguments at each click of a button."""
        @button.on_click
        def post_command_of_button(event: viser.GuiEvent) -> None:
            """Post the command; its problem is shown in the browser."""
            session.post(command, reply=make_browser_reply_function(event))

    def update_controls(self, frame: SessionFrame) -> None:
        """Update the tab if the calibration or the scene has changed."""
        state, scene = frame.calibration, frame.scene
        if self._shown is not None and self._shown[0] is state and self._shown[1] is scene:
            return
        self._shown = state, scene
        running, has_recordings = state.status is not None, bool(state.recordings)
        for handle, visible in ((self._remove, has_recordings and not running),
                                (self._begin, has_recordings and not running),
                                (self._upload, not running), (self._cancel, running),
                                (self._saving, state.result is not None and not running)):
            if handle.visible != visible:
                handle.visible = visible
        for html, content in ((self._recordings, recordings_html(state, scene)),
                              (self._status, calibration_html(state))):
            if html.content != content:
                html.content = content


def recordings_html(state: CalibrationState, scene: Scene) -> str:
    """Return HTML that describes each uploaded recording, with warnings where a recording does not fit the scene."""
    if not state.recordings:
        title = escape(scene.kind.title.lower())
        return (f'<div style="{_SMALL}" data-testid="recordings">Upload recordings of this test ({title}) that were '
                "measured with the tool and the specimen of this scene. Then calibrate the material.</div>")
    listed = "".join(_describe_recording_html(each, scene) for each in state.recordings)
    return f'<div style="{_SMALL}" data-testid="recordings">{listed}</div>'


def _describe_recording_html(uploaded: UploadedRecording, scene: Scene) -> str:
    """Return HTML of one recording: file, kind of test, tool, depth, force, duration and warnings."""
    facts = [uploaded.measured.stated_test_kind or "kind of test not stated",
             uploaded.stated_tool_text or "tool not stated", f"{len(uploaded.recording)} samples",
             f"maximum depth {uploaded.max_displacement * 1e3:.3g} mm, "
             f"maximum force {uploaded.recording.force.max():.3g} N"]
    if uploaded.recording_duration_or_none is not None:
        facts.append(f"duration {uploaded.recording_duration_or_none:.3g} s")
    warnings = "".join(f'<div style="color:#C0392B">{escape(warning)}</div>'
                       for warning in uploaded.list_scene_mismatches(scene))
    understood = "".join(f"<div>{escape(line)}</div>" for line in uploaded.file.understood)
    return (f'<div style="margin-bottom:0.4em"><b>{escape(uploaded.file.name)}</b><br>{escape(", ".join(facts))}'
            f"{understood}{warnings}</div>")


def calibration_html(state: CalibrationState) -> str:
    """Return HTML with the progress of the running fit, the last problem and the last result."""
    parts = []
    if state.status is not None:
        status = state.status
        parts.append(f'<div data-testid="calibrating"><b>{escape(status.sentence)}</b></div>')
        if status.solves:
            numbers = ", ".join(_format_name_value_and_unit(name, value, status.units.get(name, "1"))
                                for name, value in status.parameters.items())
            misfit = "" if status.rmse is None else f", RMSE {status.rmse:.3g} N"
            parts.append(f"<div>iteration {status.solves}{misfit}<br>{escape(numbers)}</div>")
    if state.problem:
        parts.append(f'<div data-testid="calibration-problem" style="border-left:3px solid #D55E00;padding-left:0.6em">'
                     f"{escape(state.problem)}</div>")
    if state.result is not None and state.status is None:
        parts.append(_fit_result_html(state.result))
    return f'<div style="{_SMALL}">{"".join(parts)}</div>' if parts else ""


def _format_name_value_and_unit(name: str, value: float, si_unit: str) -> str:
    """Return name, value and display unit of a parameter as text; `value` is in SI."""
    unit, factor = get_display_unit_and_factor(si_unit)
    return f"{name} {factor * value:.5g} {unit}".rstrip()


def _fit_result_html(result: CalibrationResult) -> str:
    """Return HTML with a table of the fitted parameters and their 95 % intervals, then RMSE and warnings."""
    rows = []
    for name, found in result.values.items():
        unit, factor = get_display_unit_and_factor(found.unit)
        interval = "none" if found.interval is None else " to ".join(f"{factor * end:.4g}" for end in found.interval)
        note = f" ({found.note})" if found.note else ""
        rows.append(f"<tr><td>{escape(name)}</td><td>{factor * found.value:.4g} {escape(unit)}</td>"
                    f"<td>{escape(interval + note)}</td></tr>")
    rmse = "" if result.rmse is None else f"<div>RMSE {result.rmse:.3g} N</div>"
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in result.warnings)
    listed = f'<ul style="margin:0.3em 0;padding-left:1.2em">{warnings}</ul>' if warnings else ""
    return (f'<div data-testid="calibrated"><table style="width:100%;text-align:left"><tr><th></th><th>calibrated</th>'
            f"<th>95 % interval</th></tr>{''.join(rows)}</table>{rmse}{listed}</div>")
