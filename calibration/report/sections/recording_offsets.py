"""Section with the contact offset and the force zero of each recording."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Column, Span, Table
from calibration.report.fit_text import format_law_title
from calibration.report.rounding import format_value_and_error
from calibration.report.section import CalibrationReport, Section
from calibration.report.units import ReportUnits


class RecordingOffsets(Section):
    """Contact offset and force zero of each recording, for the best law."""

    name = "recording_offsets"

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title with the best law."""
        return f"Contact offsets and zeros of {format_law_title(report.result.best.law)}"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table; nothing if offsets and zeros were not fitted."""
        test = ReportUnits.choose_first_specimen_test_or_first(report.campaign.tests)
        travel, load = report.units.get_displacement_unit(test), report.units.get_load_unit(test)

        def format_nuisance_in_column_unit(value: float, error: float | None, size: float) -> str:
            """Return a value with its standard error as text without unit, in the unit with this size."""
            return format_value_and_error(value / size, error and error / size)

        if report.result.best.nuisances:
            yield Table([Column("Recording"), Column(travel.format_axis_label("Contact offset")),
                         Column(load.format_axis_label("Zero")), Column("On its bound", text=True, optional=True)], [
                [n.replicate,
                 format_nuisance_in_column_unit(n.contact_offset_mm, n.contact_offset_error_mm, travel.size * 1e3),
                 format_nuisance_in_column_unit(n.zero_offset_N, n.zero_offset_error_N, load.size),
                 Span(", ".join(n.on_bound), "bad") if n.on_bound else ""]
                for n in report.result.best.nuisances], narrow=True)
