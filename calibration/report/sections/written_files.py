"""Section with the files that a diagnosis has written."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Listing, Span
from calibration.report.section import DiagnosisReport, Section


class WrittenFiles(Section):
    """Files that include the effects found."""

    name = "written_files"
    title = "Files"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the list of the files; nothing if no file was written."""
        if report.diagnosis.files:
            yield Listing([(f"{content}: ", Span(name, "code")) for content, name in report.diagnosis.files.items()])
