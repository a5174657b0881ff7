"""Web page of a test bench: status, force and depth, force over depth and force over time."""

from __future__ import annotations

import json as json_format
import sys
import threading
import webbrowser
from html import escape
from typing import Any

import numpy as np

from haptics.recorder.live import UPDATE_INTERVAL
from scenes.stop_signals import call_stop_at_signals
from scenes.viewer.bench.sources import BenchSource, BenchState
from scenes.viewer.plots import keep_or_round_axis_range_with_zero, make_unconnected_sample_plot_options
from scenes.viewer.web_server import ViewerServer, describe_network_access, open_viewer_server


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
