"""Section with the prediction errors in data that were not fitted."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block
from calibration.report.diagnosis_tables import make_held_out_error_table
from calibration.report.section import DiagnosisReport, Section


class HeldOutErrors(Section):
    """Prediction errors in data that were not fitted."""

    name = "held_out_errors"
    title = "Data that were not fitted"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table; nothing without such data."""
        if report.diagnosis.held_out:
            yield make_held_out_error_table(report.diagnosis.held_out, report.units)
