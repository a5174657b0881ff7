"""Save tab of the page: download the curve, a picture, or a replay."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from scenes.field_labels import LABELS
from scenes.provenance import make_kind_specimen_tool_metadata
from scenes.viewer.frame import SessionFrame
from scenes.viewer.measurement import interpolate_loading_and_unloading
from scenes.viewer.page.notices import FAILED, make_browser_reply_function, notify_browser_unless_none, send_download
from scenes.viewer.page.solid import ScenePicture
from scenes.viewer.page.view_controls import ViewControls
from scenes.viewer.picture_file import DrawnForceCurve, compose_picture_png
from scenes.viewer.plots import LIGHT, make_depth_grid
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace, make_csv_and_sidecar_bytes_by_name
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class SavedFileLimits:
    """Limits of saved pictures and replays.

    Attributes:
        render_timeout: time that a browser may take to render the picture that is saved, s.
        render_attempts: number of render requests, because a busy browser sometimes leaves one unanswered.
        max_picture_size: largest width and height of a saved picture, pixels.
        longest_replay: longest replay, s; one minute of motion takes about 15 MB.
    """

    render_timeout: float = 8.0
    render_attempts: int = 3
    max_picture_size: int = 1600
    longest_replay: float = 60.0


#: Limits of every page.
SAVING = SavedFileLimits()


class SaveControls:
    """Tab with the buttons that save the curve, the picture and the replay.

    Args:
        server: Server of the page.
        solid: Picture of the scene.
        view: Controls of the display options.
        run_later: Runs a function in the thread that shows the frames, in which the trace does not change.
    """

    def __init__(self, server: viser.ViserServer, solid: ScenePicture, view: ViewControls,
                 run_later: Callable[[Callable[[], None]], None]):
        gui = server.gui
        self._server, self._solid, self._view = server, solid, view
        self._frame: SessionFrame | None = None
        self._recorder: viser.infra.StateSerializer | None = None
        self._recorded, self._last = 0.0, 0.0
        #: HTML page of a finished replay that has not been downloaded yet.
        self._finished: bytes | None = None
        curve = gui.add_button("Save curve (CSV)", icon=viser.Icon.DOWNLOAD,
                               hint="saves two files: the curve as CSV and the description of the test as JSON. Keep "
                               "both in one folder")
        picture = gui.add_button("Save picture (PNG)", icon=viser.Icon.PHOTO)
        self._replay = gui.add_button("Record replay", icon=viser.Icon.PLAYER_RECORD,
                                      hint="records an HTML file that plays the moving picture without a server")

        @curve.on_click
        def send_curve_files_on_click(event: viser.GuiEvent) -> None:
            run_later(lambda: self._send_curve_files(event))

        @picture.on_click
        def send_picture_file_on_click(event: viser.GuiEvent) -> None:
            self._send_picture_file(event)

        @self._replay.on_click
        def start_or_send_replay_on_click(event: viser.GuiEvent) -> None:
            run_later(lambda: self._start_or_send_replay(event))

    def keep_frame_and_record_replay(self, frame: SessionFrame) -> None:
        """Store the newest frame for saving, and add it to a replay that is being recorded.

        A replay that has lasted `SavedFileLimits.longest_replay` is finished and kept for download.
        """
        self._frame = frame
        if self._recorder is None:
            return
        now = time.monotonic()
        self._recorder.insert_sleep(now - self._last)
        self._recorded, self._last = self._recorded + now - self._last, now
        if self._recorded >= SAVING.longest_replay:
            self._store_finished_replay_html(self._recorder)
        label = f"Save replay ({self._recorded:.0f} s)"
        if self._replay.label != label:
            self._replay.label = label

    def _send_curve_files(self, event: viser.GuiEvent) -> None:
        """Send the curve (CSV and JSON) to the browser of an event, or the reason why there is no curve."""
        frame = self._frame
        trace = None if frame is None else frame.curves.trace
        if frame is None or trace is None or len(trace) < 5:
            make_browser_reply_function(event)("There is no curve yet. Move the tool first.")
            return
        try:
            files = make_trace_file_bytes_by_name(frame.scene, trace)
        except InputError as error:
            # This runs in the thread that shows the frames, which an exception would end.
            make_browser_reply_function(event)(f"The curve {error.problem}")
            return
        for name, content in files.items():
            send_download(event.client, name, content)

    def _send_picture_file(self, event: viser.GuiEvent) -> None:
        """Send the picture (PNG) to the browser of an event; notify it if it does not render the picture."""
        frame, client = self._frame, event.client
        if frame is None or client is None:
            return
        camera = client.camera
        width, height = (min(size, SAVING.max_picture_size) for size in (camera.image_width, camera.image_height))
        render = _request_browser_image_or_none(client, height, width)
        if render is None:
            notify_browser_unless_none(client, FAILED, "The browser did not render the picture. Try again.", "red")
            return
        scene, now = frame.scene, frame.readouts
        caption = [f"{scene.kind.title}, {scene.material.energy_law.title} ({scene.source})"]
        if now is not None:
            caption.append(f"{now.force:.3f} N at {now.depth * 1e3:.2f} mm")
        label, _ = LABELS[self._view.options.field]
        content = compose_picture_png(render, self._solid.levels, np.array(self._solid.colours, dtype=np.uint8), label,
                                      caption,
                                      now=None if now is None else (now.depth, now.force),
                                      **_make_drawn_curve_arguments(frame))
        send_download(client, f"{scene.kind.name}.png", content)

    def _start_or_send_replay(self, event: viser.GuiEvent) -> None:
        """Start to record a replay; if a replay exists already, finish it and send it to the browser of the event."""
        if self._recorder is None and self._finished is None:
            self._recorder = self._server.get_scene_serializer()
            self._recorded, self._last = 0.0, time.monotonic()
            return
        if self._recorder is not None:
            self._store_finished_replay_html(self._recorder)
        if self._finished is not None:
            send_download(event.client, "replay.html", self._finished)
        self._finished, self._replay.label = None, "Record replay"

    def _store_finished_replay_html(self, recorder: viser.infra.StateSerializer) -> None:
        """End the recording of a replay and keep its HTML page for download."""
        self._finished, self._recorder = recorder.as_html(dark_mode=False).encode(), None


def make_trace_file_bytes_by_name(scene: Scene, trace: Trace) -> dict[str, bytes]:
    """Return the files of a trace: the recording (CSV) and its sidecar (JSON), which has the keys of ``simulate -o``.

    Args:
        scene: Scene in which the trace was recorded.
        trace: Motion and force since the last reset.

    Returns:
        File name -> content.

    Raises:
        InputError: The trace has fewer than two equilibria.
    """
    name = scene.kind.name
    about = {"name": name, **make_kind_specimen_tool_metadata(name, scene.experiment), "material": scene.source,
             "simulated": True}
    return make_csv_and_sidecar_bytes_by_name(trace.make_equilibrium_recording(about), name)


def _request_browser_image_or_none(client: viser.ClientHandle, height: int, width: int) -> np.ndarray | None:
    """Return the view of a browser as an image, shape (height, width, 4); None if the browser does not answer."""
    for _ in range(SAVING.render_attempts):
        with suppress(TimeoutError, RuntimeError):
            return client.get_render(height, width, transport_format="png", timeout=SAVING.render_timeout)
    return None


def _make_drawn_curve_arguments(frame: SessionFrame) -> dict[str, Any]:
    """Return the keyword arguments ``curves`` and ``band`` of `compose_picture_png` for a frame.

    ``curves`` holds the mean measurement, the curve kept for comparison, the model curve and the live curve; ``band``
    is the band of the replicates, None without a measurement.
    """
    curves, measured, band = frame.curves, frame.curves.measurement, None
    grid = make_depth_grid(frame.scene.max_tool_displacement)
    pairs = []
    if measured is not None:
        band = (measured.depth, measured.load.low, measured.load.high)
        pairs.append(("measured", "measured", measured.depth,
                      (measured.load.mean, None if measured.unload is None else measured.unload.mean)))
    if curves.compared is not None:
        pairs.append(("compared", curves.compared[0], grid,
                      interpolate_loading_and_unloading(curves.compared[1], grid)))
    if curves.model is not None:
        pairs.append(("model", "model", grid, interpolate_loading_and_unloading(curves.model, grid)))
    if curves.trace is not None and len(curves.trace):
        pairs.append(("live", "live", grid, curves.trace.interpolate_newest_force_at_each_depth(grid)))
    shown = [DrawnForceCurve(depth, force, name if force is branches[0] else "", LIGHT[role],
                             dashed=force is not branches[0])
             for role, name, depth, branches in pairs for force in branches
             if force is not None and np.isfinite(force).any()]
    return {"curves": shown, "band": band}
