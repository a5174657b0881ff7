"""Data and options of the three live plots (viser's uPlot): force and residual over depth, force over time.

Arrays are in mm, N and s with ascending x. Missing values are NaN, so that the number of series is constant. The axis
ranges are always given, because uPlot's automatic range fails at NaN. A change of the options makes the browser rebuild
the plot, so `keep_or_round_axis_range_with_zero` changes a range rarely.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from scenes.viewer.measurement import ForceResidualCurves, Measurement

Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class PlotSizesAndRanges:
    """Sizes and ranges of the plots.

    Attributes:
        time_span: time span of the plot of force over time, s.
        intervals: number of intervals of that span; each interval shows its smallest and its largest force.
        force_height: height of the plot of force over depth, pixels. The three plots with the texts between them fill a
            window of 720 pixels; the page stretches them in a larger window.
        other_height: height of the two other plots, pixels.
        min_fill: fraction of an axis that the data must fill, 1; an axis with less data shrinks. A larger value changes
            the axis more often.
        zero_force: force range below which a plot is empty, N.
    """

    time_span: float = 20.0
    intervals: int = 200
    force_height: int = 208
    other_height: int = 128
    min_fill: float = 0.4
    zero_force: float = 1e-9


#: Settings of every page.
PLOTS = PlotSizesAndRanges()
#: Colours of the curves on a light page (Okabe and Ito), by role.
LIGHT = {"measured": "#6b6b6b", "model": "#0072B2", "compared": "#CC79A7", "live": "#D55E00", "hand": "#009E73",
         "late": "#8a8a8a"}
#: Colours of the curves on a dark page, by role.
DARK = {"measured": "#b5b5b5", "model": "#56B4E9", "compared": "#CC79A7", "live": "#E69F00", "hand": "#2FD3A2",
        "late": "#a0a0a0"}
_BAND = "rgba(128, 128, 128, 0.28)"
_GRID = "rgba(128, 128, 128, 0.18)"
_DASH = (6, 4)
#: Mantissas of the ends of an axis, times powers of ten.
_NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def make_depth_grid(deepest: float, points: int = 201) -> np.ndarray:
    """Return equally spaced depths from 0 to `deepest`, m, shape (points,)."""
    return np.linspace(0.0, deepest, points)


def make_force_depth_columns_and_range(
        grid: np.ndarray, *, measured: Measurement | None = None, model: Pair | None = None,
        compared: Pair | None = None, live: Pair | None = None, late: np.ndarray | None = None,
        now: tuple[float, float] | None = None) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Return the data of the plot of force over depth.

    Args:
        grid: Ascending depths, m, shape (n,).
        measured: Measurement, drawn as the band of its replicates and their mean.
        model: Loading and unloading force of the model, N, each of shape (n,), NaN where missing.
        compared: The same of a second model curve, for example without the effects of a diagnosis.
        live: The same of the live simulation.
        late: Forces that late ticks extrapolated, N, shape (n,), NaN elsewhere.
        now: Present depth, m, and force, N; not drawn outside the grid.

    Returns:
        Columns in the order of `make_force_depth_options`, mm and N, each of shape (n,), or (n + 1,) if the depth of
        `now` is not on the grid; and the smallest and largest force of all columns, N.
    """
    columns = []
    for branch in (None, None) if measured is None else (measured.load, measured.unload):
        low, high, mean = (_interpolate_curve_to_grid(grid, measured, curve) for curve in (
            (None, None, None) if branch is None else (branch.low, branch.high, branch.mean)))
        columns += [*_replace_nan_in_band_edges(low, high, mean), mean]
    for pair in (model, compared, live):
        columns += [np.full(grid.size, np.nan)] * 2 if pair is None else [np.asarray(each, float) for each in pair]
    columns.append(np.full(grid.size, np.nan) if late is None else late)
    x, point = grid, np.full(grid.size, np.nan)
    if now is not None and grid[0] <= now[0] <= grid[-1]:
        i = int(np.searchsorted(grid, now[0]))
        if grid[i] != now[0]:
            columns = [np.insert(column, i, _interpolate_column_at_depth(grid, column, i, now[0]))
                       for column in columns]
            x, point = np.insert(grid, i, now[0]), np.insert(point, i, np.nan)
        point[i] = now[1]
    return (x * 1e3, *columns, point), _find_finite_range_or_zeros([*columns, point])


def make_force_depth_options(x_range: tuple[float, float], y_range: tuple[float, float], *,
                             dark: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of `add_uplot` for the data of `make_force_depth_columns_and_range`.

    Args:
        x_range: Range of the depth axis, mm.
        y_range: Range of the force axis, N.
        dark: Use the colours of a dark page.
    """
    colours = DARK if dark else LIGHT
    series: list[dict[str, Any]] = [{"label": "depth [mm]"}]
    for branch, dash in (("load", ()), ("unload", _DASH)):
        series += [_make_band_edge_series(f"measured {branch}, lowest"),
                   _make_band_edge_series(f"measured {branch}, highest"),
                   _make_line_series(f"measured {branch}", colours["measured"], 1.5, dash)]
    for role, width in (("model", 3.0), ("compared", 2.0), ("live", 1.5)):
        series += [_make_line_series(f"{role} {branch}", colours[role], width, dash)
                   for branch, dash in (("load", ()), ("unload", _DASH))]
    series.append({"label": "late", "stroke": colours["late"], "width": 0,
                   "points": {"show": True, "size": 4, "fill": colours["late"], "stroke": colours["late"]}})
    series.append({"label": "now", "stroke": colours["live"], "width": 0,
                   "points": {"show": True, "size": 9, "fill": colours["live"], "stroke": colours["live"]}})
    return _make_plot_options(series, x_range, y_range, "depth [mm]", "force [N]", height=PLOTS.force_height,
                              bands=({"series": (2, 1), "fill": _BAND}, {"series": (5, 4), "fill": _BAND}))


def make_residual_depth_columns_and_range(residual: ForceResidualCurves | None, measured: Measurement | None,
                                          grid: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Return the data of the plot of model minus measurement over depth.

    Args:
        residual: Model minus measurement; None: not drawn.
        measured: Measurement whose replicates minus their mean give the band around zero; None: no band.
        grid: Ascending depths, m, shape (n,).

    Returns:
        Columns in the order of `make_residual_depth_options`, mm and N, each of shape (n,); and the smallest and
        largest force of all columns, N.
    """
    low = high = np.full(grid.size, np.nan)
    if measured is not None and len(measured.recordings) > 1:
        branches = [each for each in (measured.load, measured.unload) if each is not None]
        low = np.fmin.reduce([_interpolate_curve_to_grid(grid, measured, each.low - each.mean) for each in branches])
        high = np.fmax.reduce([_interpolate_curve_to_grid(grid, measured, each.high - each.mean) for each in branches])
    pair = (None, None) if residual is None else (residual.load, residual.unload)
    zero = np.zeros(grid.size)
    columns = [*_replace_nan_in_band_edges(low, high, zero), zero,
               *(_interpolate_curve_to_grid(grid, residual, each) for each in pair)]
    return (grid * 1e3, *columns), _find_finite_range_or_zeros(columns)


def make_residual_depth_options(x_range: tuple[float, float], y_range: tuple[float, float], *,
                                dark: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of `add_uplot` for the data of `make_residual_depth_columns_and_range`.

    Args:
        x_range: Range of the depth axis, mm.
        y_range: Range of the residual axis, N.
        dark: Use the colours of a dark page.
    """
    colour = (DARK if dark else LIGHT)["model"]
    series = [{"label": "depth [mm]"}, _make_band_edge_series("lowest"), _make_band_edge_series("highest"),
              _make_line_series("zero", (DARK if dark else LIGHT)["measured"], 1.0),
              _make_line_series("load", colour, 2.0), _make_line_series("unload", colour, 2.0, _DASH)]
    return _make_plot_options(series, x_range, y_range, "depth [mm]", "residual [N]", height=PLOTS.other_height,
                              bands=({"series": (2, 1), "fill": _BAND},))


def make_force_time_columns_and_range(
        time: np.ndarray, force: np.ndarray, now: float, *, measured: Pair | None = None,
        hand: np.ndarray | None = None,
        seconds: float = PLOTS.time_span) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Return the data of the plot of force over time.

    Args:
        time: Times of a trace, s, shape (n,).
        force: Forces of the trace, N, shape (n,).
        now: Present time, s.
        measured: Time on the same clock, s, and force, N, of a repeated recording; None if none is repeated.
        hand: Force on the hand at the times of the trace, N, shape (n,); None without a haptic device.
        seconds: Time span, s.

    Returns:
        Columns in the order of `make_force_time_options`: time relative to now, s, and forces, N, each of shape
        (2 `PlotSizesAndRanges.intervals`,), with the smallest and the largest force of each interval; and the smallest
        and largest force of all columns, N.
    """
    x = np.linspace(-seconds, 0.0, 2 * PLOTS.intervals)
    live = _compute_interval_extremes(np.asarray(time) - now, np.asarray(force), seconds)
    on_hand = np.full(x.size, np.nan)
    if hand is not None:
        on_hand = _compute_interval_extremes(np.asarray(time) - now, np.asarray(hand), seconds)
    replayed = np.full(x.size, np.nan)
    if measured is not None and len(measured[0]):
        replayed = np.interp(x + now, *measured, left=np.nan, right=np.nan)
    return (x, replayed, live, on_hand), _find_finite_range_or_zeros([replayed, live, on_hand])


def make_force_time_options(y_range: tuple[float, float], *, seconds: float = PLOTS.time_span,
                            dark: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of `add_uplot` for the data of `make_force_time_columns_and_range`.

    Args:
        y_range: Range of the force axis, N.
        seconds: Time span, s.
        dark: Use the colours of a dark page.
    """
    colours = DARK if dark else LIGHT
    series = [{"label": "time [s]"}, _make_line_series("measured", colours["measured"], 1.5),
              _make_line_series("live", colours["live"], 2.0), _make_line_series("on the hand", colours["hand"], 1.5)]
    return _make_plot_options(series, (-seconds, 0.0), y_range, "time before now [s]", "force [N]",
                              height=PLOTS.other_height)


def make_uplot_scales_option(x_range: tuple[float, float], y_range: tuple[float, float]) -> dict[str, Any]:
    """Return the option ``scales`` of a plot, the only option that changes after its creation."""
    return {"x": {"time": False, "range": tuple(map(float, x_range))}, "y": {"range": tuple(map(float, y_range))}}


def make_unconnected_sample_plot_options(label: str, x_range: tuple[float, float], y_range: tuple[float, float], *,
                                         dark: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of `add_uplot` for force samples as points, without connecting lines.

    Args:
        label: Label of the x axis with its unit.
        x_range: Range of the x axis.
        y_range: Range of the force axis, N.
        dark: Use the colours of a dark page.
    """
    colour = (DARK if dark else LIGHT)["live"]
    series: list[dict[str, Any]] = [{"label": label}, {"label": "force", "stroke": colour, "width": 0, "points": {
        "show": True, "size": 3, "fill": colour, "stroke": colour}}]
    return _make_plot_options(series, x_range, y_range, label, "force [N]", height=PLOTS.force_height)


def keep_or_round_axis_range_with_zero(extent: tuple[float, float], previous: tuple[float, float] | None = None, *,
                                       about_zero: bool = False) -> tuple[float, float]:
    """Return a range of an axis with round ends that contains zero and the data.

    Args:
        extent: Smallest and largest value of the data.
        previous: Previous range, which is returned if it contains the data and the data fill enough of it.
        about_zero: Make the range symmetric about zero.
    """
    low, high = min(extent[0], 0.0), max(extent[1], 0.0)
    if about_zero:
        high = max(-low, high)
        low = -high
    if previous is not None and previous[0] <= low and high <= previous[1] \
            and high - low >= PLOTS.min_fill * (previous[1] - previous[0]):
        return previous
    if high - low < PLOTS.zero_force:
        return (-1.0 if about_zero else 0.0), 1.0
    # The smaller side gets at least 5 % of the larger one, so that small values near zero do not change the range.
    top = _round_up_axis_end(max(1.05 * high, -0.05 * low)) if high > 0 else 0.0
    bottom = -_round_up_axis_end(max(-1.05 * low, 0.05 * high)) if low < 0 else 0.0
    return bottom, top


def plot_legend_html(*, measured: int = 0, model: bool = True, compared: str | None = None, live: bool = True,
                     hand: bool = False, dark: bool = False) -> str:
    """Return the legend of the plots as HTML.

    Args:
        measured: Number of replicates; 0: no measurement.
        model: Whether the model curve is drawn.
        compared: Name of the second model curve; None: not drawn.
        live: Whether the live curve is drawn.
        hand: Whether the force on the hand is drawn.
        dark: Use the colours of a dark page.
    """
    colours = DARK if dark else LIGHT
    entries = []
    if measured:
        entries.append(("measured" if measured == 1 else f"measured ({measured})",
                        (_legend_area_svg(_BAND) if measured > 1 else "")
                        + _make_legend_stroke_svg(colours["measured"])))
    entries += [(name, _make_legend_stroke_svg(colours[role])) for role, name, drawn in (
        ("model", "model", model), ("compared", compared or "", compared is not None), ("live", "live", live),
        ("hand", "on the hand", hand)) if drawn]
    entries += [("loading", _make_legend_stroke_svg("currentColor")),
                ("unloading", _make_legend_stroke_svg("currentColor", "5 3"))]
    spans = "".join('<span style="display:inline-flex;align-items:center;gap:0.35em;white-space:nowrap">'
                    f'<svg width="22" height="10" viewBox="0 0 22 10" aria-hidden="true">{drawing}</svg>'
                    f"{escape(name)}</span>" for name, drawing in entries)
    return ('<div style="display:flex;flex-wrap:wrap;gap:0 0.7em;font-size:0.75em;line-height:1.3;'
            f'padding:0 0.6em">{spans}</div>')


def _interpolate_curve_to_grid(grid: np.ndarray, source: Measurement | ForceResidualCurves | None,
                               curve: np.ndarray | None) -> np.ndarray:
    """Interpolate a curve from the depths of its source to a grid; return NaN where the curve is missing."""
    if source is None or curve is None:
        return np.full(grid.size, np.nan)
    return np.interp(grid, source.depth, curve, left=np.nan, right=np.nan)


def _replace_nan_in_band_edges(low: np.ndarray, high: np.ndarray, middle: np.ndarray) -> Pair:
    """Replace NaN in the edges of a band by a band of zero width, because uPlot fills bands across NaN.

    Args:
        low: Lower edge, NaN where there is no band, shape (n,).
        high: Upper edge, NaN where there is no band, shape (n,).
        middle: Position of the band of zero width, shape (n,); NaN are replaced by the nearest value.

    Returns:
        Lower and upper edge without NaN; unchanged if there is no band at all.
    """
    inside = np.isfinite(low) & np.isfinite(high)
    if not inside.any():
        return low, high
    known = np.flatnonzero(np.isfinite(middle))
    flat = np.interp(np.arange(low.size), known, middle[known])
    return np.where(inside, low, flat), np.where(inside, high, flat)


def _interpolate_column_at_depth(grid: np.ndarray, column: np.ndarray, i: int, depth: float) -> float:
    """Interpolate a column to a depth between the grid points i - 1 and i."""
    return float(np.interp(depth, grid[i - 1:i + 1], column[i - 1:i + 1]))


def _find_finite_range_or_zeros(columns: list[np.ndarray]) -> tuple[float, float]:
    """Return the smallest and largest finite value of all columns; (0, 0) if there is none."""
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)


def _round_up_axis_end(value: float) -> float:
    """Round up to an element of `_NICE` times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(n * power for n in _NICE if n * power >= value * (1 - 1e-9))


def _compute_interval_extremes(age: np.ndarray, force: np.ndarray, seconds: float) -> np.ndarray:
    """Return the smallest and largest force of each interval of the time span in chronological order.

    An interval without a point gets the linear interpolation between the neighbouring points.

    Args:
        age: Times relative to now, ascending, s, shape (n,).
        force: Forces, N, shape (n,).
        seconds: Time span, s.

    Returns:
        Forces, N, shape (2 `PlotSizesAndRanges.intervals`,), NaN before the first and after the last point.
    """
    first = max(int(np.searchsorted(age, -seconds)) - 1, 0)
    age, force = age[first:], force[first:]
    if not age.size:
        return np.full(2 * PLOTS.intervals, np.nan)
    x = np.linspace(-seconds, 0.0, 2 * PLOTS.intervals)
    values = np.interp(x, age, force, left=np.nan).reshape(PLOTS.intervals, 2)
    part = np.clip(((age + seconds) * (PLOTS.intervals / seconds)).astype(int), 0, PLOTS.intervals - 1)
    recent = age >= -seconds
    part, force = part[recent], force[recent]
    if part.size:
        begins = np.flatnonzero(np.diff(part, prepend=-1))
        smallest, largest = np.minimum.reduceat(force, begins), np.maximum.reduceat(force, begins)
        ends = force[np.append(begins[1:], part.size) - 1]
        rises = ends - force[begins] >= 0
        values[part[begins]] = np.stack([np.where(rises, smallest, largest), np.where(rises, largest, smallest)], 1)
    return values.ravel()


def _make_line_series(label: str, colour: str, width: float, dash: tuple[int, ...] = ()) -> dict[str, Any]:
    return {"label": label, "stroke": colour, "width": width, "points": {"show": False}, "dash": dash}


def _make_band_edge_series(label: str) -> dict[str, Any]:
    """Return the uPlot options of an edge of a band, whose line is invisible."""
    return {"label": label, "stroke": "rgba(0, 0, 0, 0)", "width": 0, "points": {"show": False}}


def _make_plot_options(series: list[dict[str, Any]], x_range: tuple[float, float], y_range: tuple[float, float],
                       x_label: str, y_label: str, *, height: int,
                       bands: tuple[dict[str, Any], ...] | None = None) -> dict[str, Any]:
    """Return the options of a uPlot chart without legend and cursor."""
    axis = {"labelFont": "12px system-ui, sans-serif", "font": "11px system-ui, sans-serif",
            "grid": {"show": True, "stroke": _GRID, "width": 1}, "ticks": {"show": True, "size": 4, "width": 1},
            "gap": 4, "labelGap": 0}
    return {
        "series": tuple(series), "bands": bands, "height": height, "padding": (8, 16, 0, 0),
        "scales": make_uplot_scales_option(x_range, y_range),
        "axes": ({**axis, "label": x_label, "labelSize": 18, "size": 28, "space": 45},
                 {**axis, "label": y_label, "labelSize": 18, "size": 44, "space": 28}),
        "legend": {"show": False}, "cursor": {"show": False},
    }


def _make_legend_stroke_svg(colour: str, dash: str = "") -> str:
    return (f'<line x1="1" y1="5" x2="21" y2="5" stroke="{colour}" stroke-width="2"'
            + (f' stroke-dasharray="{dash}"' if dash else "") + "/>")


def _legend_area_svg(colour: str) -> str:
    return f'<rect x="0" y="0" width="22" height="10" fill="{colour}"/>'
