"""A view that was rendered in the browser, with its colour bar, a caption and the force curve, as one image file."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.report.png import as_png
from tissue_sim.errors import InputError

#: Dots per inch of the file, and of the view in it: one pixel of the render is one of the file.
DPI = 150
#: Width of the force curve and of the colour bar with its numbers, and heights of a caption line and of the margin, in.
_CURVE, _BAR, _LINE, _MARGIN = 4.0, 1.1, 0.24, 0.18
#: Narrower or lower views are drawn no smaller than this, in.
_SMALLEST = 2.0
#: Letters of a caption to the inch, at most.
_LETTERS = 10


@dataclass(frozen=True, eq=False)
class Curve:
    """A line of the force curve beside the view.

    Attributes:
        depth: m, shape (n,). force: N, shape (n,); NaN is left out.
        label: for the legend; empty: none.
        colour: of matplotlib.
        dashed: as unloading is drawn.
    """

    depth: np.ndarray
    force: np.ndarray
    label: str
    colour: str
    dashed: bool = False


def compose_png(render: np.ndarray, levels: Sequence[float] | np.ndarray | None, colours: Sequence | np.ndarray,
                label: str,
                caption: Sequence[str], *, curves: Sequence[Curve] = (),
                band: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
                now: tuple[float, float] | None = None) -> bytes:
    """The picture as the bytes of a PNG.

    Args:
        render: of the view, shape (h, w, 3) or (h, w, 4), uint8; what is transparent becomes white.
        levels: edges of the colour bar's bands in the unit of `label`, ascending, shape (n + 1,); None: no
            colour bar.
        colours: of the bands, n of matplotlib's colours or rows of 3 or 4 numbers; uint8 or from 0 to 1.
        label: field and unit, for the colour bar.
        caption: lines above the view, such as scene, material, depth and force; the first is the title.
        curves: lines of the force curve; none: it is left out.
        band: depth (m), smallest and largest force (N) of the replicates.
        now: depth (m) and force (N) that the view shows.

    Raises:
        InputError: a render that is no picture, or levels and colours that do not fit.
    """
    from matplotlib.figure import Figure

    view = _on_white(render)
    bands = None if levels is None else _checked_bands(levels, colours)
    height, width = (max(side / DPI, _SMALLEST) for side in view.shape[:2])
    wide = width + (_BAR if bands else 0.0) + (_CURVE if curves else 0.0) + 3 * _MARGIN
    caption = [part for line in caption for part in textwrap.wrap(line, int(_LETTERS * (wide - 2 * _MARGIN)))]
    size = (wide, height + _LINE * len(caption) + 2 * _MARGIN)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")

    def axes(left: float, bottom: float, wide: float, high: float):
        return figure.add_axes((left / size[0], bottom / size[1], wide / size[0], high / size[1]))

    picture = axes(_MARGIN, _MARGIN, width, height)
    picture.imshow(view, interpolation="nearest")
    picture.set_axis_off()
    for number, line in enumerate(caption):
        figure.text(_MARGIN / size[0], 1.0 - (0.5 * _MARGIN + _LINE * number) / size[1], line, va="top",
                    fontsize=11 if number == 0 else 9, fontweight="bold" if number == 0 else "normal",
                    color="0.1" if number == 0 else "0.3", parse_math=False)
    if bands is not None:
        _draw_bar(axes(width + 2 * _MARGIN, _MARGIN + 0.1 * height, 0.2, 0.8 * height), *bands, label)
    if curves:
        left = width + (_BAR if bands else 0.0) + 2 * _MARGIN + 0.6
        high = min(height - 0.5, 3.2)
        curve = axes(left, _MARGIN + 0.5 * (height - high + 0.4), _CURVE - 0.6, high)
        _draw_curves(curve, curves, band, now)
    return as_png(figure, DPI)


def _on_white(render: np.ndarray) -> np.ndarray:
    """Shape (h, w, 3), uint8."""
    render = np.asarray(render)
    if render.dtype != np.uint8 or render.ndim != 3 or render.shape[2] not in (3, 4) or not render.size:
        raise InputError(f"has shape {render.shape} and type {render.dtype}, expected (height, width, 3 or 4) of uint8",
                         field="render")
    if render.shape[2] == 3:
        return render
    share = render[:, :, 3:] / 255.0
    return np.round(render[:, :, :3] * share + 255.0 * (1.0 - share)).astype(np.uint8)


def _checked_bands(levels: Sequence[float] | np.ndarray,
                   colours: Sequence | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges, and colours of shape (n, 4) from 0 to 1."""
    from matplotlib.colors import to_rgba_array

    edges = np.asarray(levels, dtype=float)
    if edges.ndim != 1 or edges.size < 2 or not np.isfinite(edges).all() or not (np.diff(edges) > 0).all():
        raise InputError("expected two or more numbers that ascend", field="levels")
    array = np.asarray(colours)
    if array.dtype == np.uint8:
        array = array / 255.0
    palette = to_rgba_array(array if array.dtype.kind == "f" else list(colours))
    if len(palette) != edges.size - 1:
        raise InputError(f"{len(palette)} colours for {edges.size - 1} bands; give one for each", field="colours")
    return edges, palette


def _draw_bar(axes, levels: np.ndarray, palette: np.ndarray, label: str) -> None:
    """Bands of equal height, whatever the levels are."""
    n = len(palette)
    axes.imshow(palette[:, None, :], origin="lower", aspect="auto", extent=(0, 1, 0, n), interpolation="nearest")
    every = max(1, -(-n // 10))
    places = list(range(0, n + 1, every))
    axes.set_yticks(places, [_number(levels[i]) for i in places], fontsize=8)
    axes.yaxis.tick_right()
    axes.yaxis.set_label_position("right")
    axes.set_ylabel(label, fontsize=9, parse_math=False)
    axes.set_xticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "−") if value else "0"


def _draw_curves(axes, curves: Sequence[Curve], band, now) -> None:
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
