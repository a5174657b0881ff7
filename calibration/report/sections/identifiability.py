"""Section with the identifiability of the parameters."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import EMPTY, Block, Column, Table, join_texts
from calibration.report.fit_tables import describe_poorly_determined_combination, describe_suggested_test_and_errors
from calibration.report.fit_text import format_law_title, make_parameter_symbol
from calibration.report.rounding import format_significant_digits_or_dash
from calibration.report.section import CalibrationReport, Section
from calibration.report.symbols import format_plain_symbol


class Identifiability(Section):
    """Condition number, poorly determined combinations, parameters that are not identifiable, and remedies."""

    name = "identifiability"
    title = "Identifiability of the parameters"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table with one row per law; nothing for fits of closed forms."""
        if report.campaign.fit.method == "analytical":
            return
        yield Table([Column("Law"), Column("Condition number"), Column("Poorly determined", text=True),
                     Column("Not identifiable", text=True), Column("Remedy", text=True)], [
            [format_law_title(fit.law), format_significant_digits_or_dash(fit.condition, 3),
             "; ".join(describe_poorly_determined_combination(each, fit, format_plain_symbol)
                       for each in fit.directions) or "none",
             join_texts(make_parameter_symbol(fit, name, "bad_symbol") for name in fit.not_identifiable) or "none",
             "; ".join(describe_suggested_test_and_errors(each, fit, report.units, format_plain_symbol)
                       for each in fit.suggestions) or EMPTY] for fit in report.fits])
