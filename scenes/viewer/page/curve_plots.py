"""Panel with the plots of the page: force over depth, residual over depth, force over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from scenes.viewer.frame import CommandReceiver, SessionFrame
from scenes.viewer.measurement import interpolate_loading_and_unloading
from scenes.viewer.page.readouts import (
    find_largest_live_model_difference,
    largest_live_model_difference_html,
    make_browser_reply_function,
    model_rmse_html,
    select_forces_of_late_ticks_on_grid,
)
from scenes.viewer.plots import (
    Pair,
    keep_or_round_axis_range_with_zero,
    make_depth_grid,
    make_force_depth_columns_and_range,
    make_force_depth_options,
    make_force_time_columns_and_range,
    make_force_time_options,
    make_residual_depth_columns_and_range,
    make_residual_depth_options,
    plot_legend_html,
)
from tissue_sim.recording.recording import Recording


class CurvePlots:
    """Panel that draws the curves of a frame; it sends data and axis ranges only when they change.

    Args:
        server: Server of the page.
        session: Receives the command that keeps a curve.
        frame: First frame.
    """

    def __init__(self, server: viser.ViserServer, session: CommandReceiver, frame: SessionFrame):
        gui = server.gui
        self._dark = False
        self._ranges: dict[str, Any] = {}
        self._drawn: tuple = ()
        self._written: dict[Any, tuple] = {}
        self._branch_cache: dict[str, tuple] = {}
        empty = np.zeros(2)
        x = (0.0, frame.scene.max_tool_displacement * 1e3)
        unit = (0.0, 1.0)
        self._legend = gui.add_html("")

        def add_empty_plot(options: dict[str, Any]) -> viser.GuiUplotHandle:
            """Add a plot without data to the panel, and return its handle."""
            return gui.add_uplot(tuple(empty for _ in options["series"]), **options)

        self._force = add_empty_plot(make_force_depth_options(x, unit))
        self._live_gap = gui.add_html("")
        self._agreement = gui.add_html("")
        self._residual = add_empty_plot(make_residual_depth_options(x, unit))
        self._time = add_empty_plot(make_force_time_options(unit))
        keep = gui.add_button("Keep this model curve", icon=viser.Icon.PIN,
                              hint="compare later model curves with the present one; press again to remove it")
        self._kept = False

        @keep.on_click
        def keep_or_remove_curve_on_click(event: viser.GuiEvent) -> None:
            """Keep the present model curve for comparison, or remove the kept curve."""
            session.post("keep_curve", reply=make_browser_reply_function(event), name="" if self._kept else "kept")

    def set_colour_scheme_of_next_update(self, dark: bool) -> None:
        """Select the colours of a dark or a light page; the next `update_plots` redraws all plots."""
        self._dark, self._ranges, self._drawn = dark, {}, ()

    def update_plots(self, frame: SessionFrame) -> None:
        """Draw the curves of a frame if they have changed."""
        curves, readouts = frame.curves, frame.readouts
        current = None if readouts is None else (readouts.depth, readouts.force)
        drawn = (curves, current, frame.scene.experiment)
        if self._drawn and all(a is b or a == b for a, b in zip(drawn, self._drawn, strict=True)):
            return
        self._drawn, self._kept = drawn, curves.compared is not None
        grid = make_depth_grid(frame.scene.max_tool_displacement)
        x = (0.0, frame.scene.max_tool_displacement * 1e3)
        measured, trace = curves.measurement, curves.trace
        model = self._interpolate_branches_with_cache("model", curves.model, grid)
        compared = self._interpolate_branches_with_cache("compared",
                                                         None if curves.compared is None else curves.compared[1], grid)
        live = trace.interpolate_newest_force_at_each_depth(grid) if trace is not None and len(trace) else None
        late = None if trace is None else select_forces_of_late_ticks_on_grid(trace, grid)
        columns, extent = make_force_depth_columns_and_range(grid, measured=measured, model=model, compared=compared,
                                                             live=live, late=late, now=current)
        self._send_plot_if_changed(self._force, columns,
                                   ("force", x, keep_or_round_axis_range_with_zero(extent, self._ranges.get("force"))),
                                   lambda y: make_force_depth_options(x, y, dark=self._dark))
        columns, extent = make_residual_depth_columns_and_range(curves.residual, measured, grid)
        self._residual.visible = measured is not None
        self._send_plot_if_changed(self._residual, columns,
                                   ("residual", x,
                                    keep_or_round_axis_range_with_zero(extent, self._ranges.get("residual"),
                                                                       about_zero=True)),
                                   lambda y: make_residual_depth_options(x, y, dark=self._dark))
        time, force = (np.empty(0), np.empty(0)) if trace is None else (trace.time, trace.force)
        now = readouts.time if readouts else 0.0
        hand = trace.rendered_force if trace is not None and curves.has_hand_force else None
        columns, extent = make_force_time_columns_and_range(time, force, now, measured=curves.replayed, hand=hand)
        self._send_plot_if_changed(self._time, columns,
                                   ("time", x, keep_or_round_axis_range_with_zero(extent, self._ranges.get("time"))),
                                   lambda y: make_force_time_options(y, dark=self._dark))
        _assign_if_changed(self._legend, "content", plot_legend_html(
            measured=0 if measured is None else len(measured.recordings), model=model is not None,
            compared=None if curves.compared is None else curves.compared[0], live=live is not None,
            hand=curves.has_hand_force, dark=self._dark))
        _assign_if_changed(self._agreement, "content", model_rmse_html(frame))
        gap = None
        if trace is not None and live is not None and model is not None:
            gap = find_largest_live_model_difference(trace, grid, live, model)
        _assign_if_changed(self._live_gap, "content", largest_live_model_difference_html(gap))

    def _interpolate_branches_with_cache(self, name: str, recording: Recording | None, grid: np.ndarray) -> Pair | None:
        """Return the loading and unloading force of a curve on the grid, N; None without a curve.

        The result is cached until the curve or the grid changes.
        """
        if recording is None:
            return None
        cached = self._branch_cache.get(name)
        if cached is None or cached[0] is not recording or not np.array_equal(cached[1], grid):
            self._branch_cache[name] = cached = (recording, grid, interpolate_loading_and_unloading(recording, grid))
        return cached[2]

    def _send_plot_if_changed(self, handle: viser.GuiUplotHandle, columns: tuple[np.ndarray, ...], ranges: tuple,
                              options) -> None:
        """Send the options if a range, (name, x range, y range), has changed, and the data if they have changed."""
        name, x, y = ranges
        if self._ranges.get(name) != y or self._written.get(name) != (x, self._dark):
            self._ranges[name], self._written[name] = y, (x, self._dark)
            for key, value in options(y).items():
                _assign_if_changed(handle, key, value)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns, handle.data, strict=True)):
            handle.data = columns


def _assign_if_changed(handle: Any, key: str, value: Any) -> None:
    """Assign a property only if its value differs, because each assignment sends a message."""
    if getattr(handle, key) != value:
        setattr(handle, key, value)
