"""Section with the methods text for a paper."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Pasted, Span
from calibration.report.section import CalibrationReport, Section


class MethodsText(Section):
    """Methods text for a paper."""

    name = "methods_text"
    title = ("Methods ", Span("for a paper; also in methods.txt", "small"))

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the text."""
        yield Pasted(report.methods)
