"""Section with the files of the recordings."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Listing, Span
from calibration.report.section import CalibrationReport, DiagnosisReport, Section


class RecordingFiles(Section):
    """File name, SHA-256 and number of points of each recording."""

    name = "recording_files"
    title = "Recordings"
    reports = ("calibration", "diagnosis")

    def iterate_blocks(self, report: CalibrationReport | DiagnosisReport) -> Iterator[Block]:
        """Yield the list of the recordings."""
        yield Listing([(f"{curve.file.name} ", Span("SHA-256 ", "small"), Span(curve.sha256, "code"),
                        Span(f", {curve.force.size} points", "small"))
                       for curves in report.recordings.values() for curve in curves])
