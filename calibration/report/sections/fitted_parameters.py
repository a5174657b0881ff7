"""Section with the formula and the parameters of each law."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.fit.fit import Fit
from calibration.report.content import Block, Heading, Picture, Span
from calibration.report.drawing import (
    get_formula_width_in_css_pixels,
    make_png_data_uri,
    render_law_formula_png_or_none,
)
from calibration.report.fit_tables import make_parameter_table
from calibration.report.fit_text import format_law_title
from calibration.report.section import CalibrationReport, Section


class FittedParameters(Section):
    """Formula, estimates and intervals of each law."""

    name = "fitted_parameters"
    title = "Parameters"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield a heading with the formula and a table for each law."""
        for fit in report.fits:
            yield Heading((f"{format_law_title(fit.law)} ", _make_formula(fit, report.has_figures)))
            yield make_parameter_table(fit, report.units)


def _make_formula(fit: Fit, is_typeset: bool) -> Picture | Span:
    """Return the formula of a law as an image, or as text if `is_typeset` is false or there is no image."""
    png = render_law_formula_png_or_none(fit.law) if is_typeset else None
    if png is None:
        return Span(fit.formula, "small")
    return Picture(make_png_data_uri(png), get_formula_width_in_css_pixels(png), fit.formula)
