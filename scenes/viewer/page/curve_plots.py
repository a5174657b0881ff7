"""The plots of the page: force over depth, what the model misses, force over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from scenes.viewer.frame import Commands, Frame
from scenes.viewer.live_gap import late_forces, live_gap
from scenes.viewer.measurement import branches_on_grid
from scenes.viewer.page.notices import answer_to
from scenes.viewer.page.readouts import agreement_html, live_gap_html
from scenes.viewer.plots import (
    Pair,
    depth_grid,
    force_depth,
    force_depth_options,
    force_time,
    force_time_options,
    legend_html,
    residual_depth,
    residual_depth_options,
    settled_range,
)
from tissue_sim.recording.recording import Recording


class CurvePlots:
    """The panel with the curves. Arrays are written where they have changed, options where a range has."""

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame):
        gui = server.gui
        self._dark = False
        self._ranges: dict[str, Any] = {}
        self._drawn: tuple = ()
        self._written: dict[Any, tuple] = {}
        self._known: dict[str, tuple] = {}
        empty = np.zeros(2)
        x = (0.0, frame.scene.deepest * 1e3)
        unit = (0.0, 1.0)
        self._legend = gui.add_html("")

        def add(options: dict[str, Any]) -> viser.GuiUplotHandle:
            return gui.add_uplot(tuple(empty for _ in options["series"]), **options)

        self._force = add(force_depth_options(x, unit))
        self._live_gap = gui.add_html("")
        self._agreement = gui.add_html("")
        self._residual = add(residual_depth_options(x, unit))
        self._time = add(force_time_options(unit))
        keep = gui.add_button("Keep this model curve", icon=viser.Icon.PIN,
                              hint="to compare the curves of other materials with it; pressed again, it goes")
        self._kept = False

        @keep.on_click
        def _(event: viser.GuiEvent) -> None:
            session.post("keep_curve", reply=answer_to(event), name="" if self._kept else "kept")

    def set_dark(self, dark: bool) -> None:
        """Colours for a dark or a light page."""
        self._dark, self._ranges, self._drawn = dark, {}, ()

    def show(self, frame: Frame) -> None:
        """Draw the curves, where they are other ones than the last time."""
        curves, readouts = frame.curves, frame.readouts
        moment = None if readouts is None else (readouts.depth, readouts.force)
        drawn = (curves, moment, frame.scene.experiment)
        if self._drawn and all(a is b or a == b for a, b in zip(drawn, self._drawn, strict=True)):
            return
        self._drawn, self._kept = drawn, curves.before is not None
        grid = depth_grid(frame.scene.deepest)
        x = (0.0, frame.scene.deepest * 1e3)
        measured, trace = curves.measurement, curves.trace
        model = self._branches("model", curves.model, grid)
        before = self._branches("before", None if curves.before is None else curves.before[1], grid)
        live = trace.newest_passes(grid) if trace is not None and len(trace) else None
        late = None if trace is None else late_forces(trace, grid)
        columns, extent = force_depth(grid, measured=measured, model=model, before=before, live=live, late=late,
                                      now=moment)
        self._write(self._force, columns, ("force", x, settled_range(extent, self._ranges.get("force"))),
                    lambda y: force_depth_options(x, y, dark=self._dark))
        columns, extent = residual_depth(curves.residual, measured, grid)
        self._residual.visible = measured is not None
        self._write(self._residual, columns,
                    ("residual", x, settled_range(extent, self._ranges.get("residual"), about_zero=True)),
                    lambda y: residual_depth_options(x, y, dark=self._dark))
        time, force = (np.empty(0), np.empty(0)) if trace is None else (trace.time, trace.force)
        now = readouts.time if readouts else 0.0
        hand = trace.rendered_force if trace is not None and curves.felt else None
        columns, extent = force_time(time, force, now, measured=curves.replayed, hand=hand)
        self._write(self._time, columns, ("time", x, settled_range(extent, self._ranges.get("time"))),
                    lambda y: force_time_options(y, dark=self._dark))
        _set(self._legend, "content", legend_html(
            measured=0 if measured is None else len(measured.recordings), model=model is not None,
            before=None if curves.before is None else curves.before[0], live=live is not None, hand=curves.felt,
            dark=self._dark))
        _set(self._agreement, "content", agreement_html(frame))
        gap = None
        if trace is not None and live is not None and model is not None:
            gap = live_gap(trace, grid, live, model)
        _set(self._live_gap, "content", live_gap_html(gap))

    def _branches(self, name: str, recording: Recording | None, grid: np.ndarray) -> Pair | None:
        """`branches_on_grid` of a curve, worked out when it or the grid is another one."""
        if recording is None:
            return None
        known = self._known.get(name)
        if known is None or known[0] is not recording or not np.array_equal(known[1], grid):
            self._known[name] = known = (recording, grid, branches_on_grid(recording, grid))
        return known[2]

    def _write(self, handle: viser.GuiUplotHandle, columns: tuple[np.ndarray, ...], wanted: tuple, options) -> None:
        name, x, y = wanted
        if self._ranges.get(name) != y or self._written.get(name) != (x, self._dark):
            self._ranges[name], self._written[name] = y, (x, self._dark)
            for key, value in options(y).items():
                _set(handle, key, value)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns, handle.data, strict=True)):
            handle.data = columns


def _set(handle: Any, key: str, value: Any) -> None:
    """Write a property where it changes."""
    if getattr(handle, key) != value:
        setattr(handle, key, value)
