"""Shared drawing functions of the reports: colours, style, panels, and embedding of figures in HTML pages."""

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

from calibration.output_folder import make_figure_file_name
from calibration.report.layout import LAYOUT
from calibration.report.png import render_png
from tissue_sim.atomic_write import write_bytes
from tissue_sim.laws import find_law

#: Palette of Okabe and Ito without yellow and black, distinguishable with every type of colour vision, and two more.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#555555")
#: Dash patterns of matplotlib, combined with `COLOURS` in the same order.
DASHES = ("-", (0, (6, 2)), (0, (2, 1.2)), (0, (6, 2, 1.5, 2)), (0, (9, 3)), (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)), "-")
#: Settings of matplotlib for all figures of the reports.
STYLE: Any = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
              "grid.alpha": 0.25, "legend.frameon": False, "figure.constrained_layout.use": True,
              "font.family": "DejaVu Sans", "mathtext.fontset": "dejavusans", "axes.titlesize": 10,
              "axes.titleweight": "bold", "axes.titlelocation": "left", "figure.constrained_layout.w_pad": 0.09,
              "figure.constrained_layout.h_pad": 0.08,
              # Text is stored as text, and files are reproducible byte for byte.
              "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "tissue_sim"}


def iterate_line_styles() -> Iterator[dict]:
    """Yield line styles (colour and dashes), one for each law, without end."""
    return ({"color": colour, "ls": dashes} for colour, dashes in zip(cycle(COLOURS), cycle(DASHES), strict=False))


def choose_marker_style(points: int) -> dict:
    """Return the marker style for measured points: open circles in front for few points, dots behind for many."""
    few = points <= LAYOUT.data_points
    return {"mfc": "none", "mec": "0.2", "zorder": 4} if few else {"color": "0.35", "mew": 0, "alpha": 0.35}


def make_thinning_slice(size: int) -> slice:
    """Return a slice with a constant step that reduces `size` samples to about `ReportLayoutSettings.data_points`."""
    return slice(None, None, max(1, size // LAYOUT.data_points))


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 test`` or ``2 tests``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def create_figure(width: float, height: float):
    """Return an empty matplotlib figure of this size in inches, without pyplot and thus without global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def create_figure_with_panel_rows(counts: Sequence[int], height: float, width: float = LAYOUT.width):
    """Create a figure with rows of panels; rows may have different numbers of panels.

    Args:
        counts: number of panels in each row.
        height: height of a row, inches.
        width: width of the figure, inches.

    Returns:
        The figure and the list of its axes, row by row.
    """
    cells = math.lcm(*counts)
    mosaic = [[f"{row} {column * count // cells}" for column in range(cells)] for row, count in enumerate(counts)]
    figure = create_figure(width, height * len(counts))
    return figure, [*figure.subplot_mosaic(mosaic).values()]


def distribute_panels_over_rows(count: int, most: int = LAYOUT.panels_per_row) -> list[int]:
    """Return a list with the number of panels in each row, for `count` panels and at most `most` panels in a row."""
    rows = -(-count // most)
    return [count // rows + (row < count % rows) for row in range(rows)]


def add_figure_legend_above_panels(figure, columns: int = LAYOUT.legend_columns) -> None:
    """Add one legend of the whole figure above all panels; entries with the same label appear once."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=min(columns, len(handles)),
                      fontsize=9.5, handlelength=2.2, columnspacing=1.6)


def render_figure(figure, kind: str, **options) -> bytes:
    """Return the bytes of a figure file of format `kind` (``png``, ``svg`` or ``pdf``), which are reproducible."""
    stream = io.BytesIO()
    dated = {"svg": "Date", "pdf": "CreationDate"}.get(kind)
    figure.savefig(stream, format=kind, metadata={dated: None} if dated else None, **options)
    return stream.getvalue()


@dataclass(frozen=True)
class FigureEmbedder:
    """Embed figures in an HTML page as PNG and optionally write each figure as a file.

    Attributes:
        folder: folder of the page.
        kind: format of the files, ``svg``, ``pdf`` or ``png``; None: no files.
    """

    folder: Path
    kind: str | None = None

    def embed_figure(self, name: str, draw: Callable[[], Any], alt: str, caption: str = "") -> str:
        """Draw a figure and return its HTML; write the figure file if `kind` is set.

        Args:
            name: name of the figure, from which `calibration.output_folder.make_figure_file_name` makes the file name.
            draw: returns the figure, or None if there is nothing to draw; called with the style of the reports.
            alt: plain text for readers without images.
            caption: HTML below the figure.

        Returns:
            The HTML; empty if there is nothing to draw.
        """
        import matplotlib

        with matplotlib.rc_context(STYLE):
            figure = draw()
            if figure is None:
                return ""
            png = render_png(figure)
            if self.kind is not None:
                write_bytes(self.folder / make_figure_file_name(name, self.kind),
                            render_figure(figure, self.kind, dpi=LAYOUT.print_dpi))
        below = f"<figcaption>{caption}</figcaption>" if caption else ""
        width = 100 * figure.get_figwidth() / LAYOUT.width
        return (f'<figure><img src="{make_png_data_uri(png)}" style="width:{width:.0f}%" alt="{escape(alt)}">{below}'
                "</figure>")


def make_png_data_uri(png: bytes) -> str:
    """Return a PNG image as a data URI for an HTML page."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def render_law_formula_png_or_none(law_name: str) -> bytes | None:
    """Draw the strain energy of a law as a PNG image; return None if mathtext cannot typeset the formula."""
    import matplotlib

    law = find_law(law_name)
    with matplotlib.rc_context({"mathtext.fontset": "cm"}):
        figure = create_figure(0.01, 0.01)
        figure.text(0, 0, f"${law.latex()}$", fontsize=13)
        try:
            return render_figure(figure, "png", dpi=LAYOUT.formula_dpi, bbox_inches="tight", pad_inches=0.03,
                                 transparent=True)
        except ValueError:
            return None


def get_formula_width_in_css_pixels(png: bytes) -> int:
    """Return the width, CSS pixels, at which an image of `render_law_formula_png_or_none` has its font size."""
    # Bytes 16 to 20 of a PNG are its width: https://www.w3.org/TR/png/#11IHDR
    return round(int.from_bytes(png[16:20], "big") * 96 / LAYOUT.formula_dpi)
