"""Section with the misfit of each law in each region of each test."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.report.content import Block, Column, Details, Figure, Span, Table, Text
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.figures import draw_region_misfit_map
from calibration.report.fit_text import format_law_title
from calibration.report.section import CalibrationReport, Section


class RegionMisfits(Section):
    """Misfit of each law in each region of each test, and the statistical tests of the residuals."""

    name = "region_misfits"
    title = "Misfit by region"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the figure and the table; nothing if the residuals were not tested."""
        if not any(fit.regions for fit in report.fits):
            return
        yield Figure("regions", partial(draw_region_misfit_map, report.fits, report.campaign.tests, report.units),
                     "Misfit of each law in each region of each test",
                     "Root mean square of the misfit in each region and its probability by chance, adjusted for the "
                     "number of regions (Holm); orange for p ≤ 0.05. Offsets, zeros and mesh error can compensate part "
                     "of the misfit; the numbers do not include this compensation.")
        table = _make_residual_test_table(report)
        yield Details("In numbers", [table]) if report.has_figures else table


def _make_residual_test_table(report: CalibrationReport) -> Table:
    """Return the table of the statistical tests of the residuals: one row per law and region of a test."""
    units = report.units
    rows: list[list[Text | None]] = []
    for fit in report.fits:
        last = None
        for r in fit.regions:
            test = report.tests[r.test]
            load, travel = units.get_load_unit(test), units.get_displacement_unit(test)
            at = travel.format_quantity(r.at * (1.0 if test.specimen is None else 1e-3), 3)
            rows.append([None if last else format_law_title(fit.law), None if r.test == last else r.test,
                         describe_region(r, test, units), load.format_quantity(r.misfit_N, 2),
                         f"{load.format_quantity(r.largest_N, 2)} at {at}", f"{r.statistic:.3g} ({r.freedom})",
                         format_p_value_text(r.p), "as noise" if r.adequate else Span("misfit", "bad")])
            last = r.test
    return Table([Column("Law"), Column("Test", text=True), Column("Region", text=True), Column("Misfit (rms)"),
                  Column("Largest model − data"), Column("χ² (freedom)"), Column("p, adjusted"), Column("Residuals")],
                 rows)
