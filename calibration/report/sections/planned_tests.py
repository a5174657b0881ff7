"""Section with the planned tests of a design: motion, expected force and noise."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.report.content import EMPTY, Block, Column, Figure, Paragraph, Table
from calibration.report.diagnosis_figures import draw_planned_test
from calibration.report.section import DesignReport, Section
from calibration.report.units import ReportUnits
from tissue_sim.laws import find_law


class PlannedTests(Section):
    """Law and noise, a table of the planned tests, and a figure of each."""

    name = "planned_tests"
    title = "Planned tests"
    reports = ("design",)

    def iterate_blocks(self, report: DesignReport) -> Iterator[Block]:
        """Yield the law with the noise, the table and the figures."""
        design, units = report.design, report.units
        noise = ReportUnits.choose_for_typical_sizes(1e-3, design.noise_N, units.pressure.size).force
        yield Paragraph(f"{find_law(design.law).title}, sensor noise {noise.format_quantity(design.noise_N, 3)}")
        yield Table([Column("Test", "planned test"), Column("Recordings", "recordings"),
                     Column("Samples", "samples"), Column("Depth", "depth"), Column("Largest force", "largest force"),
                     Column("Duration", "duration")],
                    [[test.name, str(test.recordings), str(test.samples),
                      units.length.format_quantity(1e-3 * test.depth_mm, 3),
                      units.force.format_quantity(test.force_N, 3),
                      EMPTY if test.duration_s is None else f"{test.duration_s:.3g} s"] for test in design.tests],
                    narrow=True)
        for name, curves in report.curves.items():
            yield Figure(name, partial(draw_planned_test, curves, units),
                         f"Planned motion and expected force of {curves.test.name}",
                         f"{curves.test.name}: planned motion and expected force of one recording.")
