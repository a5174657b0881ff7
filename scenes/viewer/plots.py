"""The three live plots as arrays and options of viser's uPlot: force and residual over depth, force over time.

Arrays are in mm, N and s. What is missing is NaN, so the series never change. x ascends. Ranges are always given, as an
automatic one goes blank at a NaN. A change of options makes the browser draw the plot anew, so `settled_range` lets a
range change rarely.
"""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np

from scenes.viewer.measurement import Measurement, Residual

Pair = tuple[np.ndarray, np.ndarray]
#: Of the force over time, s, and how finely: each part shows its smallest and its largest force.
SECONDS, PARTS = 20.0, 200
#: Okabe and Ito's, by role, on a light and on a dark page.
LIGHT = {"measured": "#6b6b6b", "model": "#0072B2", "before": "#CC79A7", "live": "#D55E00", "hand": "#009E73",
         "late": "#8a8a8a"}
DARK = {"measured": "#b5b5b5", "model": "#56B4E9", "before": "#CC79A7", "live": "#E69F00", "hand": "#2FD3A2",
        "late": "#a0a0a0"}
_BAND = "rgba(128, 128, 128, 0.28)"
_GRID = "rgba(128, 128, 128, 0.18)"
_DASH = (6, 4)
#: Pixels; with what stands between them three plots fill a window of 720. In a larger one the page stretches them.
FORCE_HEIGHT, OTHER_HEIGHT = 208, 128
_NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: A range shrinks when what it shows fills less of it than this.
_TOO_EMPTY = 0.4
#: A smaller force than this is none, N.
_NOTHING = 1e-9


def depth_grid(deepest: float, points: int = 201) -> np.ndarray:
    """Depths of a plot, m: from the touch to `deepest`."""
    return np.linspace(0.0, deepest, points)


def force_depth(grid: np.ndarray, *, measured: Measurement | None = None, model: Pair | None = None,
                before: Pair | None = None, live: Pair | None = None, late: np.ndarray | None = None,
                now: tuple[float, float] | None = None) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Data of the plot of force over depth.

    Args:
        grid: depths, m, ascending, shape (n,).
        measured: drawn as the band of its replicates and their mean.
        model, before, live: load and unload, N, each of shape (n,), NaN where they do not reach; `before` is a second
            model, such as that before a diagnosis.
        late: forces that late ticks carried on, N, shape (n,), NaN where none did.
        now: depth (m) and force (N) of this moment; outside the grid it is left out.

    Returns:
        The columns of `force_depth_options`, mm and N, each of shape (n,), or (n + 1,) where `now` lies between two
        depths; and the smallest and largest force among them.
    """
    columns = []
    for branch in (None, None) if measured is None else (measured.load, measured.unload):
        low, high, mean = (_at(grid, measured, curve) for curve in (
            (None, None, None) if branch is None else (branch.low, branch.high, branch.mean)))
        columns += [*_closed(low, high, mean), mean]
    for pair in (model, before, live):
        columns += [np.full(grid.size, np.nan)] * 2 if pair is None else [np.asarray(each, float) for each in pair]
    columns.append(np.full(grid.size, np.nan) if late is None else late)
    x, point = grid, np.full(grid.size, np.nan)
    if now is not None and grid[0] <= now[0] <= grid[-1]:
        i = int(np.searchsorted(grid, now[0]))
        if grid[i] != now[0]:
            columns = [np.insert(column, i, _between(grid, column, i, now[0])) for column in columns]
            x, point = np.insert(grid, i, now[0]), np.insert(point, i, np.nan)
        point[i] = now[1]
    return (x * 1e3, *columns, point), _extent([*columns, point])


def force_depth_options(x_range: tuple[float, float], y_range: tuple[float, float], *,
                        dark: bool = False) -> dict[str, Any]:
    """Keyword arguments of `add_uplot` beside the data of `force_depth`; ranges in mm and N."""
    colours = DARK if dark else LIGHT
    series: list[dict[str, Any]] = [{"label": "depth [mm]"}]
    for way, dash in (("load", ()), ("unload", _DASH)):
        series += [_hidden(f"measured {way}, lowest"), _hidden(f"measured {way}, highest"),
                   _line(f"measured {way}", colours["measured"], 1.5, dash)]
    for role, width in (("model", 3.0), ("before", 2.0), ("live", 1.5)):
        series += [_line(f"{role} {way}", colours[role], width, dash) for way, dash in (("load", ()),
                                                                                        ("unload", _DASH))]
    series.append({"label": "late", "stroke": colours["late"], "width": 0,
                   "points": {"show": True, "size": 4, "fill": colours["late"], "stroke": colours["late"]}})
    series.append({"label": "now", "stroke": colours["live"], "width": 0,
                   "points": {"show": True, "size": 9, "fill": colours["live"], "stroke": colours["live"]}})
    return _options(series, x_range, y_range, "depth [mm]", "force [N]", height=FORCE_HEIGHT,
                    bands=({"series": (2, 1), "fill": _BAND}, {"series": (5, 4), "fill": _BAND}))


def residual_depth(residual: Residual | None, measured: Measurement | None,
                   grid: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Data of the plot of model minus measurement over depth.

    Args:
        residual: None: nothing to compare.
        measured: for the band about zero, from the lowest to the highest replicate minus their mean.
        grid: depths, m, ascending, shape (n,).

    Returns:
        The columns of `residual_depth_options`, mm and N, each of shape (n,), and the smallest and largest residual.
    """
    low = high = np.full(grid.size, np.nan)
    if measured is not None and len(measured.recordings) > 1:
        branches = [each for each in (measured.load, measured.unload) if each is not None]
        low = np.fmin.reduce([_at(grid, measured, each.low - each.mean) for each in branches])
        high = np.fmax.reduce([_at(grid, measured, each.high - each.mean) for each in branches])
    pair = (None, None) if residual is None else (residual.load, residual.unload)
    zero = np.zeros(grid.size)
    columns = [*_closed(low, high, zero), zero, *(_at(grid, residual, each) for each in pair)]
    return (grid * 1e3, *columns), _extent(columns)


def residual_depth_options(x_range: tuple[float, float], y_range: tuple[float, float], *,
                           dark: bool = False) -> dict[str, Any]:
    """Keyword arguments of `add_uplot` beside the data of `residual_depth`; ranges in mm and N."""
    colour = (DARK if dark else LIGHT)["model"]
    series = [{"label": "depth [mm]"}, _hidden("lowest"), _hidden("highest"),
              _line("zero", (DARK if dark else LIGHT)["measured"], 1.0), _line("load", colour, 2.0),
              _line("unload", colour, 2.0, _DASH)]
    return _options(series, x_range, y_range, "depth [mm]", "residual [N]", height=OTHER_HEIGHT,
                    bands=({"series": (2, 1), "fill": _BAND},))


def force_time(time: np.ndarray, force: np.ndarray, now: float, *, measured: Pair | None = None,
               hand: np.ndarray | None = None,
               seconds: float = SECONDS) -> tuple[tuple[np.ndarray, ...], tuple[float, float]]:
    """Data of the plot of the last seconds.

    Args:
        time, force: of a trace, s and N, shape (n,).
        now: time of this moment, s.
        measured: time (s, of the same clock) and force (N) of a recording that is replayed.
        hand: force on the hand at these times, N, shape (n,); None: no hand is there.
        seconds: how far back.

    Returns:
        The columns of `force_time_options`: s before now and N, of the smallest and the largest force in each
        `seconds`/`PARTS`; and the smallest and largest force among them.
    """
    x = np.linspace(-seconds, 0.0, 2 * PARTS)
    live = _smallest_and_largest(np.asarray(time) - now, np.asarray(force), seconds)
    felt = np.full(x.size, np.nan)
    if hand is not None:
        felt = _smallest_and_largest(np.asarray(time) - now, np.asarray(hand), seconds)
    replayed = np.full(x.size, np.nan)
    if measured is not None and len(measured[0]):
        replayed = np.interp(x + now, *measured, left=np.nan, right=np.nan)
    return (x, replayed, live, felt), _extent([replayed, live, felt])


def force_time_options(y_range: tuple[float, float], *, seconds: float = SECONDS, dark: bool = False) -> dict[str, Any]:
    """Keyword arguments of `add_uplot` beside the data of `force_time`."""
    colours = DARK if dark else LIGHT
    series = [{"label": "time [s]"}, _line("measured", colours["measured"], 1.5), _line("live", colours["live"], 2.0),
              _line("on the hand", colours["hand"], 1.5)]
    return _options(series, (-seconds, 0.0), y_range, "time before now [s]", "force [N]", height=OTHER_HEIGHT)


def plot_scales(x_range: tuple[float, float], y_range: tuple[float, float]) -> dict[str, Any]:
    """The `scales` of a plot, the only option that changes while it lives."""
    return {"x": {"time": False, "range": tuple(map(float, x_range))}, "y": {"range": tuple(map(float, y_range))}}


def curve_options(label: str, x_range: tuple[float, float], y_range: tuple[float, float], *,
                  dark: bool = False) -> dict[str, Any]:
    """Keyword arguments of `add_uplot` for points of force, N, over what `label` says: samples go up and down."""
    colour = (DARK if dark else LIGHT)["live"]
    series: list[dict[str, Any]] = [{"label": label}, {"label": "force", "stroke": colour, "width": 0, "points": {
        "show": True, "size": 3, "fill": colour, "stroke": colour}}]
    return _options(series, x_range, y_range, label, "force [N]", height=FORCE_HEIGHT)


def settled_range(extent: tuple[float, float], previous: tuple[float, float] | None = None, *,
                  about_zero: bool = False) -> tuple[float, float]:
    """Range of an axis that holds zero and `extent`, in round numbers, and stays where it was while that still fits.

    Args:
        extent: smallest and largest value.
        previous: the range before.
        about_zero: as far below zero as above.
    """
    low, high = min(extent[0], 0.0), max(extent[1], 0.0)
    if about_zero:
        high = max(-low, high)
        low = -high
    if previous is not None and previous[0] <= low and high <= previous[1] \
            and high - low >= _TOO_EMPTY * (previous[1] - previous[0]):
        return previous
    if high - low < _NOTHING:
        return (-1.0 if about_zero else 0.0), 1.0
    # A force that is a little below zero, or above, needs no axis of its own.
    top = _round_up(max(1.05 * high, -0.05 * low)) if high > 0 else 0.0
    bottom = -_round_up(max(-1.05 * low, 0.05 * high)) if low < 0 else 0.0
    return bottom, top


def legend_html(*, measured: int = 0, model: bool = True, before: str | None = None, live: bool = True,
                hand: bool = False, dark: bool = False) -> str:
    """The legend of `force_depth` as HTML for the page.

    Args:
        measured: number of replicates; 0: no measurement.
        model, live: whether they are drawn.
        hand: whether the force on a hand is drawn over time.
        before: name of the second model curve, such as that of an effect; None: it is not drawn.
        dark: as in the options.
    """
    colours = DARK if dark else LIGHT
    entries = []
    if measured:
        entries.append(("measured" if measured == 1 else f"measured ({measured})",
                        (_swatch(_BAND) if measured > 1 else "") + _stroke(colours["measured"])))
    entries += [(name, _stroke(colours[role])) for role, name, drawn in (
        ("model", "model", model), ("before", before or "", before is not None), ("live", "live", live),
        ("hand", "on the hand", hand)) if drawn]
    entries += [("in", _stroke("currentColor")), ("out", _stroke("currentColor", "5 3"))]
    spans = "".join('<span style="display:inline-flex;align-items:center;gap:0.35em;white-space:nowrap">'
                    f'<svg width="22" height="10" viewBox="0 0 22 10" aria-hidden="true">{drawing}</svg>'
                    f"{escape(name)}</span>" for name, drawing in entries)
    return ('<div style="display:flex;flex-wrap:wrap;gap:0 0.7em;font-size:0.75em;line-height:1.3;'
            f'padding:0 0.6em">{spans}</div>')


def _at(grid: np.ndarray, source: Measurement | Residual | None, curve: np.ndarray | None) -> np.ndarray:
    """A curve over the depths of its source, on another grid; NaN where it is missing."""
    if source is None or curve is None:
        return np.full(grid.size, np.nan)
    return np.interp(grid, source.depth, curve, left=np.nan, right=np.nan)


def _closed(low: np.ndarray, high: np.ndarray, middle: np.ndarray) -> Pair:
    """The edges of a band without their NaN, for uPlot fills on beyond these: where there is no band it has no width.

    Args:
        low, high: edges, NaN where there is no band, shape (n,).
        middle: where it has no width; where that is missing too, its nearest value.
    """
    there = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    if not there.size:
        return low, high
    known = np.flatnonzero(np.isfinite(middle))
    flat = np.interp(np.arange(low.size), known, middle[known])
    inside = np.zeros(low.size, dtype=bool)
    inside[there] = True
    return np.where(inside, low, flat), np.where(inside, high, flat)


def _between(grid: np.ndarray, column: np.ndarray, i: int, depth: float) -> float:
    """Value of a column at a depth between grid points i - 1 and i."""
    return float(np.interp(depth, grid[i - 1:i + 1], column[i - 1:i + 1]))


def _extent(columns: list[np.ndarray]) -> tuple[float, float]:
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)


def _round_up(value: float) -> float:
    """The next of 1, 1.2, 1.5, 2, ... times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(n * power for n in _NICE if n * power >= value * (1 - 1e-9))


def _smallest_and_largest(age: np.ndarray, force: np.ndarray, seconds: float) -> np.ndarray:
    """Smallest and largest force in each part of the last seconds, in the order in which they came.

    A part without a point lies between two kept ones and takes the straight line between them.
    """
    first = max(int(np.searchsorted(age, -seconds)) - 1, 0)
    age, force = age[first:], force[first:]
    if not age.size:
        return np.full(2 * PARTS, np.nan)
    x = np.linspace(-seconds, 0.0, 2 * PARTS)
    values = np.interp(x, age, force, left=np.nan).reshape(PARTS, 2)
    part = np.clip(((age + seconds) * (PARTS / seconds)).astype(int), 0, PARTS - 1)
    recent = age >= -seconds
    part, force = part[recent], force[recent]
    if part.size:
        begins = np.flatnonzero(np.diff(part, prepend=-1))
        smallest, largest = np.minimum.reduceat(force, begins), np.maximum.reduceat(force, begins)
        ends = force[np.append(begins[1:], part.size) - 1]
        rises = ends - force[begins] >= 0
        values[part[begins]] = np.stack([np.where(rises, smallest, largest), np.where(rises, largest, smallest)], 1)
    return values.ravel()


def _line(label: str, colour: str, width: float, dash: tuple[int, ...] = ()) -> dict[str, Any]:
    return {"label": label, "stroke": colour, "width": width, "points": {"show": False}, "dash": dash}


def _hidden(label: str) -> dict[str, Any]:
    """An edge of a band: its area is drawn, its line is not."""
    return {"label": label, "stroke": "rgba(0, 0, 0, 0)", "width": 0, "points": {"show": False}}


def _options(series: list[dict[str, Any]], x_range: tuple[float, float], y_range: tuple[float, float], x_label: str,
             y_label: str, *, height: int, bands: tuple[dict[str, Any], ...] | None = None) -> dict[str, Any]:
    axis = {"labelFont": "12px system-ui, sans-serif", "font": "11px system-ui, sans-serif",
            "grid": {"show": True, "stroke": _GRID, "width": 1}, "ticks": {"show": True, "size": 4, "width": 1},
            "gap": 4, "labelGap": 0}
    return {
        "series": tuple(series), "bands": bands, "height": height, "padding": (8, 16, 0, 0),
        "scales": plot_scales(x_range, y_range),
        "axes": ({**axis, "label": x_label, "labelSize": 18, "size": 28, "space": 45},
                 {**axis, "label": y_label, "labelSize": 18, "size": 44, "space": 28}),
        "legend": {"show": False}, "cursor": {"show": False},
    }


def _stroke(colour: str, dash: str = "") -> str:
    return (f'<line x1="1" y1="5" x2="21" y2="5" stroke="{colour}" stroke-width="2"'
            + (f' stroke-dasharray="{dash}"' if dash else "") + "/>")


def _swatch(colour: str) -> str:
    return f'<rect x="0" y="0" width="22" height="10" fill="{colour}"/>'
