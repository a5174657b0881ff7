"""What all pictures of the reports share: colours, style, and the way from a figure to a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from itertools import cycle
from typing import Any

from tissue_sim.laws import find_law

#: Okabe and Ito's palette without yellow and black: apart for every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#555555")
DASHES = ("-", (0, (6, 2)), (0, (2, 1.2)), (0, (6, 2, 1.5, 2)), (0, (9, 3)), (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)), "-")
STYLE: Any = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
              "grid.alpha": 0.25, "legend.frameon": False, "figure.constrained_layout.use": True,
              "font.family": "DejaVu Sans"}
#: Points of a recording that are drawn, at most about that many.
DATA_POINTS = 250
#: Twice the 96 of a CSS inch, for sharp screens.
_FORMULA_DPI = 192


def line_styles() -> Iterator[dict]:
    """Colour and dashes of one law after the other, without end."""
    return ({"color": colour, "ls": dashes} for colour, dashes in zip(cycle(COLOURS), cycle(DASHES), strict=False))


def cloud(points: int) -> dict:
    """Style of measured points: few are rings above the curves, many are a cloud below them."""
    few = points <= DATA_POINTS
    return {"mfc": "none", "mec": "0.2", "zorder": 4} if few else {"color": "0.35", "mew": 0, "alpha": 0.35}


def thinned(size: int) -> slice:
    """Every so-manieth of `size` samples, so that a picture stays light."""
    return slice(None, None, max(1, size // DATA_POINTS))


def counted(count: int, noun: str) -> str:
    """``1 test``, ``2 tests``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def new_figure(width: float, height: float):
    """An empty figure, inches, without pyplot: no global state, no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def to_png(figure, dpi: int = 150, **options) -> bytes:
    """The figure as a PNG; `options` are those of ``savefig``."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, **options)
    return stream.getvalue()


def as_data_uri(png: bytes) -> str:
    """A PNG that stands inside an HTML page."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def draw_formula(law_name: str) -> bytes | None:
    """The energy as a PNG, None where mathtext cannot set it."""
    import matplotlib

    law = find_law(law_name)
    with matplotlib.rc_context({"mathtext.fontset": "cm"}):
        figure = new_figure(0.01, 0.01)
        figure.text(0, 0, f"${law.latex()}$", fontsize=13)
        try:
            return to_png(figure, _FORMULA_DPI, bbox_inches="tight", pad_inches=0.03, transparent=True)
        except ValueError:
            return None


def natural_width(png: bytes) -> int:
    """Width in CSS pixels at which the text of `draw_formula` has the size that it was set in."""
    # Width of the image header: https://www.w3.org/TR/png/#11IHDR
    return round(int.from_bytes(png[16:20], "big") * 96 / _FORMULA_DPI)
