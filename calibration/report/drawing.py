"""Shared drawing functions of the reports: layout, colours, style, panels, and figures as images."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

from calibration.output_folder import make_figure_file_name
from calibration.report.content import DrawnFigure, Figure
from calibration.report.png import render_png
from tissue_sim.files import write_bytes
from tissue_sim.laws import find_law


@dataclass(frozen=True)
class ReportLayoutSettings:
    """Settings of the layout of all reports: sizes of figures, numbers of drawn points, and limits of lists.

    Attributes:
        width: width of a figure that fills the page, inches. A larger width makes text smaller on the page.
        panels_per_row: largest number of panels in a row.
        legend_columns: largest number of columns of the legend above the panels.
        profile_legend_columns: the same above the profile likelihoods, whose entries are short.
        print_dpi: resolution of separate PNG files, dots per inch.
        formula_dpi: resolution of formulas, dots per inch: twice the 96 of CSS, for high-resolution screens.
        data_points: approximate maximum number of drawn points per recording; more points make larger files.
        dense_points: number of points of all recordings above which the markers are smaller.
        test_row_height: height of a row of panels in the figure of a test, inches.
        residual_row_height: height of the panels in the figure of a test of a diagnosis, inches.
        history_row_height: height of a row of panels with the convergence of the starts, inches.
        profile_row_height: height of a row of panels with profile likelihoods or specimens, inches.
        window_row_height: height of a row of panels with fits to a part of the strain, inches.
        correlation_height: height of the figure of up to four correlated parameters, inches.
        segment_height: height of the figure of the segments of a recording, inches.
        bar_height: height of a row of bars in a diagnosis, inches.
        frame_height: height of title, axis labels and legend around the bars, inches.
        specimen_width: width of one specimen in a panel, inches.
        residual_bins: bins over the duration (or displacement range) of a test in which residuals are averaged.
            More bins resolve shorter misfits and scatter more.
        margin: margin between the data and the frame, as a fraction of the range of the data.
        ignored_rates: fraction of rates at either end that is ignored for the scale of the axis.
        few_rates: number of rates up to which all of them count for the scale of the axis.
        min_labelled_width: minimum width of a region with a label in the residuals of a test, as a fraction of the
            panel width.
        min_two_line_width: the same for the labels of a diagnosis, which state the misfit before and after.
        max_label_characters: total number of characters of the tick labels above which the labels are rotated.
        note_characters: maximum length of a note in a figure, characters.
        two_line_regions: number of regions of a test from which misfit and probability are written in two lines.
        darkest_misfit: misfit that is drawn with the darkest colour, standard errors.
        max_linear_ratio: quotient of the largest and the smallest parameter ratio up to which the scale is linear.
        linear_deviations: standard deviations up to which the scale of a score is linear; logarithmic above.
        samples_before_contact: samples before contact in the detail view of the contact.
        fraction_after_contact: displacement after contact in the detail view, as a fraction of the largest displacement
            after contact.
        summary_misfits: maximum number of misfits in the summary of a calibration; the table lists all.
        summary_regions: maximum number of regions in the summary of a diagnosis; the figure shows all.
        drawn_effects: maximum number of effects in the figure of a diagnosis; the table lists all.
    """

    width: float = 12.0
    panels_per_row: int = 3
    legend_columns: int = 4
    profile_legend_columns: int = 6
    print_dpi: int = 300
    formula_dpi: int = 192
    data_points: int = 250
    dense_points: int = 400
    test_row_height: float = 3.15
    residual_row_height: float = 3.4
    history_row_height: float = 2.7
    profile_row_height: float = 3.1
    window_row_height: float = 2.6
    correlation_height: float = 4.2
    segment_height: float = 4.2
    bar_height: float = 0.3
    frame_height: float = 1.25
    specimen_width: float = 0.9
    residual_bins: int = 60
    margin: float = 0.06
    ignored_rates: float = 0.02
    few_rates: int = 200
    min_labelled_width: float = 0.11
    min_two_line_width: float = 0.16
    max_label_characters: int = 40
    note_characters: int = 90
    two_line_regions: int = 7
    darkest_misfit: float = 6.0
    max_linear_ratio: float = 5.0
    linear_deviations: float = 4.0
    samples_before_contact: int = 80
    fraction_after_contact: float = 0.12
    summary_misfits: int = 3
    summary_regions: int = 4
    drawn_effects: int = 14


#: Layout of all reports.
LAYOUT = ReportLayoutSettings()
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
    """Draw figures as PNG images for an HTML page and optionally write each figure as a file.

    Attributes:
        folder: folder of the page.
        kind: format of the files, ``svg``, ``pdf`` or ``png``; None: no files.
    """

    folder: Path
    kind: str | None = None

    def draw_figure_or_none(self, figure: Figure) -> DrawnFigure | None:
        """Return a figure as an image, drawn with the style of the reports; write the figure file if `kind` is set.

        Returns:
            The image; None if there is nothing to draw.
        """
        import matplotlib

        with matplotlib.rc_context(STYLE):
            drawn = figure.draw()
            if drawn is None:
                return None
            png = render_png(drawn)
            if self.kind is not None:
                write_bytes(self.folder / make_figure_file_name(figure.name, self.kind),
                            render_figure(drawn, self.kind, dpi=LAYOUT.print_dpi))
        return DrawnFigure(make_png_data_uri(png), 100 * drawn.get_figwidth() / LAYOUT.width, figure.alt,
                           figure.caption)


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
