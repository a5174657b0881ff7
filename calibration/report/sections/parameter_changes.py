"""Section with the parameters before and after the found effects are added."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block
from calibration.report.diagnosis_tables import make_parameter_change_table
from calibration.report.section import DiagnosisReport, Section


class ParameterChanges(Section):
    """Estimates without and with the added effects, and the resulting bias."""

    name = "parameter_changes"
    title = "Parameters"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table."""
        yield make_parameter_change_table(report.diagnosis.fit_before, report.diagnosis.fit_after, report.units)
