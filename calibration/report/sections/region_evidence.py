"""Section with the significance of the misfit in each region, before and after."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from calibration.diagnosis.diagnosis import SegmentMisfit
from calibration.report.content import EMPTY, Block, Column, Details, Figure, Span, Table, Text
from calibration.report.diagnosis_figures import draw_region_significance_in_deviations
from calibration.report.section import DiagnosisReport, Section
from calibration.report.units import ReportUnits


class RegionEvidence(Section):
    """Misfit and its significance in each region, without and with the added effects."""

    name = "region_evidence"
    title = "Evidence by region"
    reports = ("diagnosis",)
    needs_figures = True

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the figure and the table."""
        regions = report.diagnosis.regions
        yield Figure("regions", partial(draw_region_significance_in_deviations, regions, report.units),
                     "Significance of the residuals in each region, before and after",
                     "Significance of the smooth part of the residuals, adjusted for the number of regions (Holm). "
                     "Right: root mean square of the smooth part.")
        yield Details("In numbers", [_make_misfit_table_before_and_after(regions, report.units)])


def _make_misfit_table_before_and_after(regions: Sequence[SegmentMisfit], units: ReportUnits) -> Table:
    """Return the table of the regions: misfit and significance, before and after."""
    rows: list[list[Text | None]] = []
    last = None
    for each in regions:
        after = EMPTY if each.after_N is None else units.force.format_quantity(each.after_N, 2)
        sigma = EMPTY if each.after_sigma is None else f"{each.after_sigma:.1f}"
        rows.append([None if each.test == last else each.test, each.segment,
                     EMPTY if each.speed_mm_s is None else f"{each.speed_mm_s:g}",
                     units.force.format_quantity(each.before_N, 2), after,
                     Span(f"{each.before_sigma:.1f}", "" if each.adequate_before else "bad"),
                     Span(sigma, "bad" if each.adequate_after is False else "")])
        last = each.test
    return Table([Column("Test"), Column("Segment", text=True), *map(Column, (
        "Speed [mm/s]", "Misfit before", "after", "Deviations before", "after"))], rows, narrow=True)
