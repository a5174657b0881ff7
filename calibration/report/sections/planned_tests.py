"""Sections of a design: planned tests, and expected errors of the parameters."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.report.content import EMPTY, Block, Column, Figure, Paragraph, Span, Table, Text
from calibration.report.diagnosis_figures import draw_planned_test
from calibration.report.quantities import ReportUnits, format_value_and_error
from calibration.report.section import DesignReport, Section
from tissue_sim.laws import find_law


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
