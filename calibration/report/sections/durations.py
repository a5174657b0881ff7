"""Section with the duration of each stage of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Column, Table
from calibration.report.section import DiagnosisReport, Section


class Durations(Section):
    """Duration, s, and number of simulations of each stage, and their sums."""

    name = "durations"
    title = "Time"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table."""
        stages = report.diagnosis.stages
        every = [*((each.name, each.wall_s, each.simulations) for each in stages),
                 ("all", sum(each.wall_s for each in stages), sum(each.simulations for each in stages))]
        yield Table([*map(Column, ("Stage", "Time [s]", "Simulations"))],
                    [[name, f"{seconds:.1f}", str(simulations)] for name, seconds, simulations in every], narrow=True)
