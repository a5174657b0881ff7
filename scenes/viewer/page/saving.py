"""Save tab of the page: download the curve, a picture, or a replay.

The picture is one PNG with the view of a browser, the colour bar, a caption and the force curves.
"""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from calibration.report.png import render_png
from scenes.catalogue import make_kind_specimen_tool_metadata
from scenes.field_labels import LABELS
from scenes.viewer.frame import SessionFrame
from scenes.viewer.measurement import interpolate_loading_and_unloading
from scenes.viewer.page.readouts import FAILED, make_browser_reply_function, notify_browser_unless_none, send_download
from scenes.viewer.page.solid import ScenePicture
from scenes.viewer.page.view_controls import ViewControls
from scenes.viewer.plots import LIGHT, make_depth_grid
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace, make_csv_and_sidecar_bytes_by_name
from tissue_sim.errors import InputError

#: Resolution of the file, dots per inch; one pixel of the rendered view is one pixel of the file.
DPI = 150


@dataclass(frozen=True)
class PictureLayout:
    """Dimensions of the picture file, inches.

    Attributes:
        curve: Width of the force curves.
        bar: Width of the colour bar with its numbers.
        line: Height of a line of the caption.
        margin: Width of the margins.
        smallest: Smallest width and height of the view.
        letters: Largest number of letters per inch of the caption; longer lines are wrapped.
    """

    curve: float = 4.0
    bar: float = 1.1
    line: float = 0.24
    margin: float = 0.18
    smallest: float = 2.0
    letters: int = 10


_LAYOUT = PictureLayout()


@dataclass(frozen=True, eq=False)
class DrawnForceCurve:
    """Force curve next to the view.

    Attributes:
        depth: Depths, m, shape (n,).
        force: Forces, N, shape (n,); NaN are not drawn.
        label: Label in the legend; empty: no label.
        colour: Colour in a notation of matplotlib.
        dashed: Whether the line is dashed, as for unloading.
    """

    depth: np.ndarray
    force: np.ndarray
    label: str
    colour: str
    dashed: bool = False


def compose_picture_png(render: np.ndarray, levels: Sequence[float] | np.ndarray | None, colours: Sequence | np.ndarray,
                        label: str,
                        caption: Sequence[str], *, curves: Sequence[DrawnForceCurve] = (),
                        band: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
                        now: tuple[float, float] | None = None) -> bytes:
    """Compose the picture and return it as a PNG.

    Args:
        render: Rendered view, shape (h, w, 3) or (h, w, 4), uint8; transparent pixels become white.
        levels: Ascending levels between the bands of the colour bar in the unit of `label`, shape (n + 1,); None: no
            colour bar.
        colours: Colours of the n bands in a notation of matplotlib, or rows of 3 or 4 numbers, uint8 or from 0 to 1.
        label: Name and unit of the field, for the colour bar.
        caption: Lines above the view; the first one is the title.
        curves: Force curves; empty: the picture has no plot.
        band: Depth, m, smallest and largest force, N, of the replicates, each of shape (m,).
        now: Depth, m, and force, N, of the view.

    Returns:
        Content of the PNG file.

    Raises:
        InputError: The array of the view is not an image, or the numbers of levels and colours do not agree.
    """
    from matplotlib.figure import Figure

    view = _blend_with_white(render)
    bands = None if levels is None else _check_and_convert_colour_bands(levels, colours)
    margin, bar = _LAYOUT.margin, _LAYOUT.bar if bands else 0.0
    height, width = (max(side / DPI, _LAYOUT.smallest) for side in view.shape[:2])
    wide = width + bar + (_LAYOUT.curve if curves else 0.0) + 3 * margin
    caption = [part for line in caption for part in textwrap.wrap(line, int(_LAYOUT.letters * (wide - 2 * margin)))]
    size = (wide, height + _LAYOUT.line * len(caption) + 2 * margin)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")

    def add_axes_at_inches(left: float, bottom: float, wide: float, high: float):
        return figure.add_axes((left / size[0], bottom / size[1], wide / size[0], high / size[1]))

    picture = add_axes_at_inches(margin, margin, width, height)
    picture.imshow(view, interpolation="nearest")
    picture.set_axis_off()
    for number, line in enumerate(caption):
        figure.text(margin / size[0], 1.0 - (0.5 * margin + _LAYOUT.line * number) / size[1], line, va="top",
                    fontsize=11 if number == 0 else 9, fontweight="bold" if number == 0 else "normal",
                    color="0.1" if number == 0 else "0.3", parse_math=False)
    if bands is not None:
        _draw_colour_bar(add_axes_at_inches(width + 2 * margin, margin + 0.1 * height, 0.2, 0.8 * height), *bands,
                         label)
    if curves:
        left = width + bar + 2 * margin + 0.6
        high = min(height - 0.5, 3.2)
        curve = add_axes_at_inches(left, margin + 0.5 * (height - high + 0.4), _LAYOUT.curve - 0.6, high)
        _draw_force_curves(curve, curves, band, now)
    return render_png(figure, DPI)


def _blend_with_white(render: np.ndarray) -> np.ndarray:
    """Blend a transparent image with a white background; return it with shape (h, w, 3), uint8."""
    render = np.asarray(render)
    if render.dtype != np.uint8 or render.ndim != 3 or render.shape[2] not in (3, 4) or not render.size:
        raise InputError(f"must have shape (height, width, 3 or 4) and type uint8; got {render.shape} and "
                         f"{render.dtype}", field="render")
    if render.shape[2] == 3:
        return render
    opacity = render[:, :, 3:] / 255.0
    return np.round(render[:, :, :3] * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)


def _check_and_convert_colour_bands(levels: Sequence[float] | np.ndarray,
                                    colours: Sequence | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check levels and colours; return the levels, shape (n + 1,), and the colours, RGBA from 0 to 1, shape (n, 4)."""
    from matplotlib.colors import to_rgba_array

    edges = np.asarray(levels, dtype=float)
    if edges.ndim != 1 or edges.size < 2 or not np.isfinite(edges).all() or not (np.diff(edges) > 0).all():
        raise InputError(f"must be two or more ascending finite numbers; got {edges.tolist()}", field="levels")
    array = np.asarray(colours)
    if array.dtype == np.uint8:
        array = array / 255.0
    palette = to_rgba_array(array if array.dtype.kind == "f" else list(colours))
    if len(palette) != edges.size - 1:
        raise InputError(f"must be one per band; got {len(palette)} for {edges.size - 1} bands", field="colours")
    return edges, palette


def _draw_colour_bar(axes, levels: np.ndarray, palette: np.ndarray, label: str) -> None:
    """Draw a colour bar whose bands all have the same height."""
    n = len(palette)
    axes.imshow(palette[:, None, :], origin="lower", aspect="auto", extent=(0, 1, 0, n), interpolation="nearest")
    every = max(1, -(-n // 10))
    labelled = list(range(0, n + 1, every))
    axes.set_yticks(labelled, [_format_level(levels[i]) for i in labelled], fontsize=8)
    axes.yaxis.tick_right()
    axes.yaxis.set_label_position("right")
    axes.set_ylabel(label, fontsize=9, parse_math=False)
    axes.set_xticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)


def _format_level(value: float) -> str:
    """Format a level with three significant digits and a typographic minus sign."""
    return f"{value:.3g}".replace("-", "−") if value else "0"


def _draw_force_curves(axes, curves: Sequence[DrawnForceCurve], band, now) -> None:
    """Draw force over depth in mm: the band of the replicates, the curves, and the present point `now`."""
    if band is not None:
        depth, low, high = band
        axes.fill_between(np.asarray(depth) * 1e3, low, high, color="0.5", alpha=0.28, linewidth=0)
    for curve in curves:
        axes.plot(np.asarray(curve.depth) * 1e3, curve.force, color=curve.colour, linewidth=1.8,
                  linestyle=(0, (4, 2.5)) if curve.dashed else "-", label=curve.label or None)
    if now is not None:
        axes.plot(now[0] * 1e3, now[1], "o", color="#D55E00", markersize=7)
    axes.set_xlabel("depth [mm]", fontsize=9)
    axes.set_ylabel("force [N]", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if any(curve.label for curve in curves):
        axes.legend(frameon=False, fontsize=8)


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
