"""What all pictures of the reports share: colours, style, and the way from a figure to a page."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import cycle
from pathlib import Path
from typing import Any

from calibration.output_folder import picture_file
from calibration.report.png import as_png
from tissue_sim.atomic_write import write_bytes
from tissue_sim.laws import find_law

#: Okabe and Ito's palette without yellow and black: apart for every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#555555")
DASHES = ("-", (0, (6, 2)), (0, (2, 1.2)), (0, (6, 2, 1.5, 2)), (0, (9, 3)), (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)), "-")
STYLE: Any = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
              "grid.alpha": 0.25, "legend.frameon": False, "figure.constrained_layout.use": True,
              "font.family": "DejaVu Sans", "mathtext.fontset": "dejavusans", "axes.titlesize": 10,
              "axes.titleweight": "bold", "axes.titlelocation": "left", "figure.constrained_layout.w_pad": 0.09,
              "figure.constrained_layout.h_pad": 0.08,
              # Letters stay letters, and the same picture is the same file.
              "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "tissue_sim"}
#: Of all pictures, inches.
WIDTH = 12.0
#: Points of a recording that are drawn, at most about that many.
DATA_POINTS = 250
#: Of PNG files beside a page.
_PRINT_DPI = 300
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


def panels(counts: Sequence[int], height: float, width: float = WIDTH):
    """A figure with rows of so many panels each, as wide as the page, and all of its axes.

    Args:
        counts: panels of each row. height: of a row, inches. width: of the figure, inches.
    """
    cells = math.lcm(*counts)
    mosaic = [[f"{row} {column * count // cells}" for column in range(cells)] for row, count in enumerate(counts)]
    figure = new_figure(width, height * len(counts))
    return figure, [*figure.subplot_mosaic(mosaic).values()]


def in_rows(count: int, most: int = 3) -> list[int]:
    """How many of `count` panels stand in each row, as even as it goes."""
    rows = -(-count // most)
    return [count // rows + (row < count % rows) for row in range(rows)]


def legend_above(figure, columns: int = 4) -> None:
    """One legend for all panels above them, where no data are; what has the same label is said once."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=min(columns, len(handles)),
                      fontsize=9.5, handlelength=2.2, columnspacing=1.6)


def to_bytes(figure, kind: str, **options) -> bytes:
    """The figure as ``png``, ``svg`` or ``pdf``, the same bytes each time."""
    stream = io.BytesIO()
    dated = {"svg": "Date", "pdf": "CreationDate"}.get(kind)
    figure.savefig(stream, format=kind, metadata={dated: None} if dated else None, **options)
    return stream.getvalue()


@dataclass(frozen=True)
class Pictures:
    """The pictures of a page: inside it as PNG and, where asked, each as a file beside it.

    Attributes:
        folder: of the page. kind: ``svg``, ``pdf`` or ``png``; None: no files.
    """

    folder: Path
    kind: str | None = None

    def show(self, name: str, draw: Callable[[], Any], alt: str, caption: str = "") -> str:
        """A picture inside the page, empty where there is nothing to draw.

        Args:
            name: of its file, as `calibration.output_folder.picture_file` makes one of it.
            draw: makes the figure, or None; called in the style of the reports.
            alt: words (plain) instead of it. caption: HTML below it.
        """
        import matplotlib

        with matplotlib.rc_context(STYLE):
            figure = draw()
            if figure is None:
                return ""
            png = as_png(figure)
            if self.kind is not None:
                write_bytes(self.folder / picture_file(name, self.kind), to_bytes(figure, self.kind, dpi=_PRINT_DPI))
        below = f"<figcaption>{caption}</figcaption>" if caption else ""
        share = 100 * figure.get_figwidth() / WIDTH
        return f'<figure><img src="{as_data_uri(png)}" style="width:{share:.0f}%" alt="{escape(alt)}">{below}</figure>'


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
            return to_bytes(figure, "png", dpi=_FORMULA_DPI, bbox_inches="tight", pad_inches=0.03, transparent=True)
        except ValueError:
            return None


def natural_width(png: bytes) -> int:
    """Width in CSS pixels at which the text of `draw_formula` has the size that it was set in."""
    # Width of the image header: https://www.w3.org/TR/png/#11IHDR
    return round(int.from_bytes(png[16:20], "big") * 96 / _FORMULA_DPI)
