"""Section with the expected standard errors of the parameters in a design."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import EMPTY, Block, Column, Paragraph, Span, Table, Text
from calibration.report.rounding import format_value_and_error
from calibration.report.section import DesignReport, Section


class ExpectedErrors(Section):
    """Assumed parameters with the standard errors that the planned tests will give."""

    name = "expected_errors"
    title = "Expected errors of the parameters"
    reports = ("design",)

    def iterate_blocks(self, report: DesignReport) -> Iterator[Block]:
        """Yield the table and its explanation."""
        design, rows = report.design, list[list[Text | None]]()
        for name, value in design.parameters.items():
            unit, error = report.units.choose_display_unit_of_si_unit(design.units[name]), design.standard_errors[name]
            known = {None: "not determined", 0.0: "fixed"}.get(error, "")
            rows.append([Span(design.symbols[name], "symbol"),
                         format_value_and_error(value / unit.size, error and error / unit.size, unit.name, known=known),
                         f"{100 * error / abs(value):.2g}\u00a0%" if error and value else EMPTY])
        yield Table([Column("Parameter", "parameter"), Column("Expected", "expected"), Column("Error", "error")], rows,
                    narrow=True)
        yield Paragraph("Standard errors from the noise of the sensor, the scatter of contact and zero between "
                        "recordings, and the error of the mesh.", quiet=True)
