"""Files from the page: the curve, the picture, the run."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import viser

from scenes.field_labels import LABELS
from scenes.provenance import recording_provenance
from scenes.viewer.frame import Frame
from scenes.viewer.measurement import branches_on_grid
from scenes.viewer.page.look_controls import LookControls
from scenes.viewer.page.notices import answer_to, notify, send_file
from scenes.viewer.page.solid import Solid
from scenes.viewer.picture_file import Curve, compose_png
from scenes.viewer.plots import LIGHT, depth_grid
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace, recording_files

#: How long a browser may take to draw the picture that is saved, s, and how often it is asked: a busy one sometimes
#: leaves a request unanswered.
_PATIENCE, _ATTEMPTS = 8.0, 3
#: Most pixels of a saved picture, along a side.
_LARGEST = 1600
#: Longest replay, s; a minute of motion has some 15 MB.
LONGEST_REPLAY = 60.0


class Saving:
    """The tab with what can be saved.

    Args:
        later: runs a function in the thread that shows frames, where the trace stands still.
    """

    def __init__(self, server: viser.ViserServer, solid: Solid, look: LookControls,
                 later: Callable[[Callable[[], None]], None]):
        gui = server.gui
        self._server, self._solid, self._look = server, solid, look
        self._frame: Frame | None = None
        self._recorder: viser.infra.StateSerializer | None = None
        self._recorded, self._last = 0.0, 0.0
        #: A replay that waits to be fetched.
        self._finished: bytes | None = None
        curve = gui.add_button("Save curve (CSV)", icon=viser.Icon.DOWNLOAD,
                               hint="and beside it, as JSON, which test it is: keep the two in one folder")
        picture = gui.add_button("Save picture (PNG)", icon=viser.Icon.PHOTO)
        self._replay = gui.add_button("Record replay", icon=viser.Icon.PLAYER_RECORD,
                                      hint="a page of its own that plays the picture without a server")

        @curve.on_click
        def _(event: viser.GuiEvent) -> None:
            later(lambda: self._save_curve(event))

        @picture.on_click
        def _(event: viser.GuiEvent) -> None:
            self._save_picture(event)

        @self._replay.on_click
        def _(event: viser.GuiEvent) -> None:
            later(lambda: self._toggle_replay(event))

    def show(self, frame: Frame) -> None:
        """Remember what there is to save, and go on with a replay; a long one ends by itself."""
        self._frame = frame
        if self._recorder is None:
            return
        now = time.monotonic()
        self._recorder.insert_sleep(now - self._last)
        self._recorded, self._last = self._recorded + now - self._last, now
        if self._recorded >= LONGEST_REPLAY:
            self._finish_replay(self._recorder)
        label = f"Save replay ({self._recorded:.0f} s)"
        if self._replay.label != label:
            self._replay.label = label

    def _save_curve(self, event: viser.GuiEvent) -> None:
        frame = self._frame
        trace = None if frame is None else frame.curves.trace
        if frame is None or trace is None or len(trace) < 5:
            answer_to(event)("nothing was felt yet; move the tool first")
            return
        for name, content in curve_files(frame.scene, trace).items():
            send_file(event.client, name, content)

    def _save_picture(self, event: viser.GuiEvent) -> None:
        frame, client = self._frame, event.client
        if frame is None or client is None:
            return
        camera = client.camera
        width, height = (min(size, _LARGEST) for size in (camera.image_width, camera.image_height))
        render = _rendered(client, height, width)
        if render is None:
            notify(client, "That did not work", "the browser drew no picture; try again", "red")
            return
        scene, now = frame.scene, frame.readouts
        caption = [f"{scene.kind.title}, {scene.material.energy_law.title} ({scene.source})"]
        if now is not None:
            caption.append(f"{now.force:.3f} N at {now.depth * 1e3:.2f} mm")
        label, _ = LABELS[self._look.look.field]
        content = compose_png(render, self._solid.levels, np.array(self._solid.colours, dtype=np.uint8), label, caption,
                              now=None if now is None else (now.depth, now.force), **_drawn_curves(frame))
        send_file(client, f"{scene.kind.name}.png", content)

    def _toggle_replay(self, event: viser.GuiEvent) -> None:
        if self._recorder is None and self._finished is None:
            self._recorder = self._server.get_scene_serializer()
            self._recorded, self._last = 0.0, time.monotonic()
            return
        if self._recorder is not None:
            self._finish_replay(self._recorder)
        if self._finished is not None:
            send_file(event.client, "replay.html", self._finished)
        self._finished, self._replay.label = None, "Record replay"

    def _finish_replay(self, recorder: viser.infra.StateSerializer) -> None:
        self._finished, self._recorder = recorder.as_html(dark_mode=False).encode(), None


def curve_files(scene: Scene, trace: Trace) -> dict[str, bytes]:
    """Name -> content of the recording of what was felt, and of its sidecar, which says what `simulate -o` says.

    Raises:
        InputError: fewer than two points were felt.
    """
    name = scene.kind.name
    about = {"name": name, **recording_provenance(name, scene.experiment), "material": scene.source, "simulated": True}
    return recording_files(trace.recording(about), name)


def _rendered(client: viser.ClientHandle, height: int, width: int) -> np.ndarray | None:
    """What a browser sees, shape (height, width, 4); None where it does not answer."""
    for _ in range(_ATTEMPTS):
        with suppress(TimeoutError, RuntimeError):
            return client.get_render(height, width, transport_format="png", timeout=_PATIENCE)
    return None


def _drawn_curves(frame: Frame) -> dict[str, Any]:
    """Model, measurement and what was felt, for `compose_png`."""
    curves, measured, band = frame.curves, frame.curves.measurement, None
    grid = depth_grid(frame.scene.deepest)
    pairs = []
    if measured is not None:
        band = (measured.depth, measured.load.low, measured.load.high)
        pairs.append(("measured", "measured", measured.depth,
                      (measured.load.mean, None if measured.unload is None else measured.unload.mean)))
    if curves.before is not None:
        pairs.append(("before", curves.before[0], grid, branches_on_grid(curves.before[1], grid)))
    if curves.model is not None:
        pairs.append(("model", "model", grid, branches_on_grid(curves.model, grid)))
    if curves.trace is not None and len(curves.trace):
        pairs.append(("live", "live", grid, curves.trace.newest_passes(grid)))
    shown = [Curve(depth, force, name if force is branches[0] else "", LIGHT[role], dashed=force is not branches[0])
             for role, name, depth, branches in pairs for force in branches
             if force is not None and np.isfinite(force).any()]
    return {"curves": shown, "band": band}
