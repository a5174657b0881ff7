"""Picture file of the page: the view of a browser with colour bar, caption and force curves as one PNG."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.report.png import render_png
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
