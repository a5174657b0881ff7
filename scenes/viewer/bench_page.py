"""Web page of a test bench: status, force and depth, force over depth and force over time.

Its data sources only read: the folder of a running recorder, or a sensor and a stage.
"""

from __future__ import annotations

import contextlib
import json as json_format
import sys
import threading
import webbrowser
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from haptics.devices.contracts import DeviceError, ForceSensor, SampleStatus, Stage
from haptics.recorder.recorder import LIVE_FILE, UPDATE_INTERVAL
from haptics.recorder.run_folder import PARTIAL_SUFFIX, RUN_FILE
from scenes.viewer.plots import keep_or_round_axis_range_with_zero, make_unconnected_sample_plot_options
from scenes.viewer.web_server import ViewerServer, describe_network_access, open_viewer_server
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.signals import call_stop_at_signals


@dataclass(frozen=True)
class BenchCurveSettings:
    """Size of the drawn curves.

    Attributes:
        points: Approximate number of points of a curve; more points show shorter peaks and load the browser more.
        time_span: Time span of the samples of a sensor, s.
        compared_bytes: Number of bytes before the end of the last read by which a new file of the same name is
            recognised: about two rows, whose times and noisy forces differ.
    """

    points: int = 600
    time_span: float = 20.0
    compared_bytes: int = 64


#: Curves of every bench.
CURVE = BenchCurveSettings()


@dataclass(frozen=True)
class BenchState:
    """State of a test bench for display.

    Attributes:
        title: Present activity in one line.
        message: Problem and remedy; empty if there is none.
        force: Present force, N; None if not known.
        depth: Present depth, or position of the stage, mm; None if not known.
        progress: Progress of the present recording, 0 to 1; None if not known.
        time: Times of the present recording or of the last seconds, s, shape (n,).
        displacement: Displacements at these times, mm, shape (n,), NaN where not known.
        forces: Forces at these times, N, shape (n,).
    """

    title: str
    message: str = ""
    force: float | None = None
    depth: float | None = None
    progress: float | None = None
    time: np.ndarray = field(default_factory=lambda: np.empty(0))
    displacement: np.ndarray = field(default_factory=lambda: np.empty(0))
    forces: np.ndarray = field(default_factory=lambda: np.empty(0))


class BenchSource(ABC):
    """Source of the state of a test bench."""

    @abstractmethod
    def read(self) -> BenchState:
        """Return the present state at every call, without waiting for new data."""

    def close(self) -> None:
        """Release the devices; does nothing by default."""
        return


class RunFolderSource(BenchSource):
    """Source that reads the folder of a run of ``tissue-sim record``, which another process writes.

    Args:
        folder: Folder of the run; it need not exist yet.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._partial: Path | None = None
        self._last_read = b""
        self._rows: list[tuple[float, float, float]] = []
        self._read = 0

    def read(self) -> BenchState:
        """Return the state of the run, its newest recording and the live readings of the recorder."""
        state, live = self._read_json(RUN_FILE), self._read_json(LIVE_FILE)
        if state is None:
            return BenchState(f"No run in {self._folder} yet", "Start the run with: tissue-sim record PROTOCOL.toml -o "
                              f"{self._folder}")
        time, displacement, force = self._read_thinned_recording()
        done = len(state.get("done", []))
        messages = {"running": "The recorder does not respond. It may have been killed.", "complete": "", "new": ""}
        if live is None:
            stops = state.get("stops") or [{}]
            message = stops[-1].get("message", "") if state["state"] == "stopped" else messages.get(state["state"], "")
            return BenchState(f"{state['state']}: {done} recordings", message, time=time, displacement=displacement,
                              forces=force)
        replicate = f" {live['replicate']}" if live.get("replicate") else ""
        return BenchState(f"{live['test']}{replicate}: {live['phase']}; {done} recordings done", "",
                          live.get("force_N"), live.get("depth_mm", live.get("position_mm")), live.get("share"), time,
                          displacement, force)

    def _read_json(self, name: str) -> dict | None:
        """Return the content of a JSON file of the run; None if the file is missing or invalid."""
        with contextlib.suppress(OSError, ValueError):
            content = read_json_value(self._folder / name, "a file of the run")
            return content if isinstance(content, dict) else None
        return None

    def _read_thinned_recording(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the present recording so far, or else the last one, thinned to about `BenchCurveSettings.points` rows.

        Returns:
            Time, s, displacement, mm, and force, N, each of shape (n,).
        """
        partial = max(self._folder.glob(f"*{PARTIAL_SUFFIX}"), key=_modification_time_or_zero, default=None)
        if partial is not None and partial != self._partial:
            self._partial, self._rows, self._read, self._last_read = partial, [], 0, b""
        if self._partial is not None and self._partial.exists():
            with self._partial.open("rb") as file:
                # A recording that starts again has the name of the stopped one, but other rows.
                file.seek(self._read - len(self._last_read))
                if file.read(len(self._last_read)) != self._last_read:
                    self._rows, self._read, self._last_read = [], 0, b""
                file.seek(self._read)
                whole, newline, _ = file.read().rpartition(b"\n")
            self._read += len(whole) + len(newline)
            self._last_read = (whole + newline)[-CURVE.compared_bytes:] or self._last_read
            for line in whole.decode("utf-8", "replace").splitlines():
                cells = line.split(",")
                with contextlib.suppress(ValueError, IndexError):  # skips the header
                    self._rows.append((float(cells[0]), float(cells[1]), float(cells[2])))
        rows = np.array(self._rows[:: max(1, len(self._rows) // CURVE.points)]).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]


class ConnectedDevicesSource(BenchSource):
    """Source that reads a force sensor and the position of a stage.

    Args:
        sensor: Force sensor.
        stage: Stage; None: no stage.
        axis: Displayed channel of the sensor; ignored for a sensor with one channel.

    Raises:
        DeviceError: A device does not start.
        InputError: The sensor does not have the channel.
    """

    def __init__(self, sensor: ForceSensor, stage: Stage | None = None, axis: str = "Fz"):
        if axis not in sensor.channels and len(sensor.channels) > 1:
            raise InputError(f"must be one of {', '.join(sensor.channels)}; got {axis!r}", field="axis")
        self._sensor, self._stage = sensor, stage
        self._rows: deque[tuple[float, float, float]] = deque()
        sensor.start()
        try:
            if stage is not None:
                stage.start()
        except DeviceError:
            sensor.stop()
            raise
        self._axis = sensor.channels.index(axis) if axis in sensor.channels else 0

    def read(self) -> BenchState:
        """Read the new samples of the sensor and the position of the stage, and return their view."""
        message, position = "", np.nan
        try:
            samples = self._sensor.read()
            if self._stage is not None:
                position = 1e3 * self._stage.position().position
        except DeviceError as error:
            return self._make_bench_state(str(error))
        self._rows.extend((sample.received, position, sample.values[self._axis]) for sample in samples)
        while self._rows and self._rows[-1][0] - self._rows[0][0] > CURVE.time_span:
            self._rows.popleft()
        if any(sample.status & SampleStatus.SATURATED for sample in samples):
            message = "The sensor is at the limit of its range. Reduce the force."
        elif any(sample.status & SampleStatus.FAULT for sample in samples):
            message = "The sensor reports a fault. Check the sensor and its cable."
        return self._make_bench_state(message)

    def _make_bench_state(self, message: str) -> BenchState:
        """Return the view of the stored samples, thinned to about `BenchCurveSettings.points`, with a message."""
        rows = np.array(list(self._rows)[:: max(1, len(self._rows) // CURVE.points)]).reshape(-1, 3)
        last = self._rows[-1] if self._rows else None
        return BenchState("sensor" if self._stage is None else "sensor and stage", message or (
            "" if last else "The sensor has not sent a sample yet."), None if last is None else last[2],
            None if last is None or np.isnan(last[1]) else last[1], None,
            rows[:, 0] - (last[0] if last else 0.0), rows[:, 1], rows[:, 2])

    def close(self) -> None:
        """Stop stage and sensor."""
        if self._stage is not None:
            self._stage.stop()
        self._sensor.stop()


def _modification_time_or_zero(path: Path) -> float:
    """Return the modification time of a file, s; 0 if the file does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:  # the recorder has renamed the file
        return 0.0


class BenchPage:
    """Web page that displays the views of a bench source.

    Args:
        source: Source of the views.
        host, port, exposed, token: As in `scenes.viewer.web_server.open_viewer_server`.
        dark: Start with the dark colour scheme.
    """

    def __init__(self, source: BenchSource, host: str, port: int, *, exposed: bool = False, token: str = "",
                 dark: bool = False):
        self.source, self._dark = source, dark
        self.server: ViewerServer = open_viewer_server(host, port, exposed=exposed, title="tissue_sim: bench",
                                                       token=token)
        self.server.set_page_theme(dark_mode=dark, control_layout="fixed", control_width="large")
        gui, empty = self.server.gui, np.zeros(2)
        self._status = gui.add_html("")
        self._ranges: dict[str, tuple] = {}
        self._plots = {name: gui.add_uplot((empty, empty), **make_unconnected_sample_plot_options(
                           label, (0.0, 1.0), (0.0, 1.0), dark=dark))
                       for name, label in (("depth", "depth [mm]"), ("time", "time [s]"))}

    def show_bench_state(self, view: BenchState) -> None:
        """Update the texts and the plots of the page to a state of the bench."""
        self._status.content = make_bench_status_html(view)
        finite = np.isfinite(view.displacement)
        order = np.argsort(view.displacement[finite], kind="stable")
        self._draw_force_plot("depth", "depth [mm]", view.displacement[finite][order], view.forces[finite][order])
        self._plots["depth"].visible = bool(finite.any())
        self._draw_force_plot("time", "time [s]", view.time, view.forces)

    def _draw_force_plot(self, name: str, label: str, x: np.ndarray, force: np.ndarray) -> None:
        """Draw force over one quantity with rounded axis ranges; with fewer than two samples, draw nothing."""
        if x.size < 2:
            return
        ranges = (keep_or_round_axis_range_with_zero((float(x.min()), float(x.max())),
                                                     self._ranges.get(name, (None, None))[0]),
                  keep_or_round_axis_range_with_zero((float(force.min()), float(force.max())),
                                                     self._ranges.get(name, (None, None))[1]))
        plot = self._plots[name]
        if ranges != self._ranges.get(name):
            self._ranges[name] = ranges
            for key, value in make_unconnected_sample_plot_options(label, *ranges, dark=self._dark).items():
                setattr(plot, key, value)
        plot.data = (x, force)

    def run_until_stopped(self, stop: threading.Event, seconds: float | None = None) -> None:
        """Read the bench source and update the page at intervals of 0.2 s.

        Args:
            stop: Ends the run.
            seconds: Approximate duration, s; None: no limit.
        """
        waited = 0.0
        while not stop.is_set() and (seconds is None or waited < seconds):
            self.show_bench_state(self.source.read())
            stop.wait(UPDATE_INTERVAL)
            waited += UPDATE_INTERVAL

    def close(self) -> None:
        """Stop the web server and close the source."""
        self.server.stop()
        self.source.close()


def make_bench_status_html(view: BenchState) -> str:
    """Return HTML with the title, the progress, a message, and force and depth in large digits."""
    def format_value_html(key: str, label: str, value: float | None, decimals: int, unit: str) -> str:
        """Return HTML of a label and a value with its unit; a dash replaces None."""
        text = "–" if value is None else f"{round(value, decimals) + 0.0:.{decimals}f}"
        return (f'<div style="flex:1"><div style="font-size:0.75em;opacity:0.7">{label}</div>'
                f'<div style="font-size:1.7em;font-weight:600;font-variant-numeric:tabular-nums">'
                f'<span data-testid="{key}">{text}</span> <span style="font-size:0.6em">{unit}</span></div></div>')

    bar = "" if view.progress is None else (
        '<div style="height:4px;background:#8884;margin-top:0.4em">'
        f'<div style="height:4px;width:{100 * view.progress:.1f}%;background:#0072B2"></div></div>')
    message = "" if not view.message else (
        '<div data-testid="message" style="border-left:3px solid #D55E00;padding-left:0.6em;margin-top:0.4em;'
        f'font-size:0.85em">{escape(view.message)}</div>')
    return (f'<div style="padding:0.5em 0.75em"><div data-testid="doing" style="font-weight:600">{escape(view.title)}'
            f'</div>{bar}{message}<div style="display:flex;margin-top:0.4em">'
            f'{format_value_html("force", "force", view.force, 3, "N")}'
            f'{format_value_html("depth", "depth", view.depth, 3, "mm")}</div></div>')


def serve_bench_page_and_get_exit_code(source: BenchSource, page: dict[str, Any], *, seconds: float | None = None,
                                       json: bool = False) -> int:
    """Serve the page of a bench until Ctrl-C, SIGTERM or the end of a given time.

    Args:
        source: Source of the views; the function closes it at the end.
        page: Options of the page: ``host``, ``port``, ``exposed``, ``token``, ``dark``; and ``open``, whether to open a
            browser.
        seconds: Time after which the function returns, s; None: no limit.
        json: Print the address as a JSON object.

    Returns:
        Exit code.
    """
    shown = BenchPage(source, page["host"], page["port"], exposed=page["exposed"], token=page["token"],
                      dark=page["dark"])
    try:
        address = shown.server.make_page_address()
        print(json_format.dumps({"url": address}) if json else f"{address}   (Ctrl-C stops)", flush=True)
        if page["exposed"]:
            exposure = describe_network_access(page["host"], shown.server.get_port())
            print(f"tissue-sim: warning: {exposure}", file=sys.stderr)
        if page["open"]:
            webbrowser.open_new_tab(address)
        stop = threading.Event()
        with call_stop_at_signals(stop.set):
            shown.run_until_stopped(stop, seconds)
    finally:
        shown.close()
    return 0
