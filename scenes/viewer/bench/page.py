"""The page itself: what goes on, two numbers, two curves."""

from __future__ import annotations

import json as json_format
import sys
import threading
import webbrowser
from html import escape
from typing import Any

import numpy as np

from scenes.stop_signals import stopped_by_signals
from scenes.viewer.bench.sources import BenchSource, BenchView
from scenes.viewer.plots import curve_options, settled_range
from scenes.viewer.web_server import ViewerServer, exposure, open_server

#: s between two looks.
_EVERY = 0.2


class BenchPage:
    """Shows what a source sees.

    Args:
        source: of the numbers.
        host, port, exposed, token: as in `scenes.viewer.web_server.open_server`.
        dark: whether the page begins dark.
    """

    def __init__(self, source: BenchSource, host: str, port: int, *, exposed: bool = False, token: str = "",
                 dark: bool = False):
        self.source, self._dark = source, dark
        self.server: ViewerServer = open_server(host, port, exposed=exposed, title="tissue_sim: bench",
                                                token=token)
        self.server.set_theme(dark_mode=dark, control_layout="fixed", control_width="large")
        gui, empty = self.server.gui, np.zeros(2)
        self._words = gui.add_html("")
        self._ranges: dict[str, tuple] = {}
        self._plots = {name: gui.add_uplot((empty, empty), **curve_options(label, (0.0, 1.0), (0.0, 1.0), dark=dark))
                       for name, label in (("depth", "depth [mm]"), ("time", "time [s]"))}

    def show(self, view: BenchView) -> None:
        """Draw what was seen."""
        self._words.content = words_html(view)
        known = np.isfinite(view.displacement)
        order = np.argsort(view.displacement[known], kind="stable")
        self._draw("depth", "depth [mm]", view.displacement[known][order], view.forces[known][order])
        self._plots["depth"].visible = bool(known.any())
        self._draw("time", "time [s]", view.time, view.forces)

    def _draw(self, name: str, label: str, x: np.ndarray, force: np.ndarray) -> None:
        if x.size < 2:
            return
        wanted = (settled_range((float(x.min()), float(x.max())), self._ranges.get(name, (None, None))[0]),
                  settled_range((float(force.min()), float(force.max())), self._ranges.get(name, (None, None))[1]))
        plot = self._plots[name]
        if wanted != self._ranges.get(name):
            self._ranges[name] = wanted
            for key, value in curve_options(label, *wanted, dark=self._dark).items():
                setattr(plot, key, value)
        plot.data = (x, force)

    def run(self, stop: threading.Event, seconds: float | None = None) -> None:
        """Look and draw until somebody stops it, or for so long, s."""
        waited = 0.0
        while not stop.is_set() and (seconds is None or waited < seconds):
            self.show(self.source.look())
            stop.wait(_EVERY)
            waited += _EVERY

    def close(self) -> None:
        self.server.stop()
        self.source.close()


def words_html(view: BenchView) -> str:
    """What goes on, force and depth large, and what to do where nothing does."""
    def number(key: str, label: str, value: float | None, decimals: int, unit: str) -> str:
        text = "–" if value is None else f"{round(value, decimals) + 0.0:.{decimals}f}"
        return (f'<div style="flex:1"><div style="font-size:0.75em;opacity:0.7">{label}</div>'
                f'<div style="font-size:1.7em;font-weight:600;font-variant-numeric:tabular-nums">'
                f'<span data-testid="{key}">{text}</span> <span style="font-size:0.6em">{unit}</span></div></div>')

    bar = "" if view.share is None else (
        '<div style="height:4px;background:#8884;margin-top:0.4em">'
        f'<div style="height:4px;width:{100 * view.share:.1f}%;background:#0072B2"></div></div>')
    said = "" if not view.message else (
        '<div data-testid="message" style="border-left:3px solid #D55E00;padding-left:0.6em;margin-top:0.4em;'
        f'font-size:0.85em">{escape(view.message)}</div>')
    return (f'<div style="padding:0.5em 0.75em"><div data-testid="doing" style="font-weight:600">{escape(view.title)}'
            f'</div>{bar}{said}<div style="display:flex;margin-top:0.4em">'
            f'{number("force", "force", view.force, 3, "N")}'
            f'{number("depth", "depth", view.depth, 3, "mm")}</div></div>')


def run_bench_page(source: BenchSource, page: dict[str, Any], *, seconds: float | None = None,
                   json: bool = False) -> int:
    """Serve the page until Ctrl-C, SIGTERM or the end of the time.

    Args:
        source: of the numbers; closed at the end.
        page: ``host``, ``port``, ``exposed``, ``token``, ``open``, ``dark``.
        seconds: None: until it is stopped. json: say the address as an object.

    Returns:
        Exit code.
    """
    shown = BenchPage(source, page["host"], page["port"], exposed=page["exposed"], token=page["token"],
                      dark=page["dark"])
    try:
        address = shown.server.address()
        print(json_format.dumps({"url": address}) if json else f"{address}   (Ctrl-C stops)", flush=True)
        if page["exposed"]:
            print(f"tissue-sim: warning: {exposure(page['host'], shown.server.get_port())}", file=sys.stderr)
        if page["open"]:
            webbrowser.open_new_tab(address)
        stop = threading.Event()
        with stopped_by_signals(stop.set):
            shown.run(stop, seconds)
    finally:
        shown.close()
    return 0
