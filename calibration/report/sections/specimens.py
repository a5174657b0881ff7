"""Section with the specimens: as a population, or the parameters that differ between them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.fit.population import describe_excluded_specimens
from calibration.report.content import Block, Figure, Paragraph
from calibration.report.estimate_figures import draw_population_figure, draw_unshared_parameters_or_none
from calibration.report.fit_tables import make_population_table
from calibration.report.fit_text import format_law_title
from calibration.report.section import CalibrationReport, Section


class Specimens(Section):
    """Mean and scatter of the parameters of several specimens; without a population the parameters of each."""

    name = "specimens"
    needs_figures = True

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title."""
        is_population = any(fit.population for fit in report.fits)
        return "Specimens as a population" if is_population else "Differences between specimens"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table, the excluded specimens and the figures; without a population one figure."""
        having = [(fit, fit.population) for fit in report.fits if fit.population is not None]
        if not having:
            yield Figure("specimens", partial(draw_unshared_parameters_or_none, report.fits, report.units),
                         "Parameters of each specimen", "Thick: ± one standard error; thin: 95 % interval.")
            return
        yield make_population_table(report.fits, report.units)
        for fit, _ in having:
            if fit.left_out_specimens:
                yield Paragraph(f"Not in the population of {format_law_title(fit.law)}: "
                                f"{describe_excluded_specimens(fit.left_out_specimens)}.")
        for fit, found in having:
            yield Figure(f"population {fit.law}", partial(draw_population_figure, fit, found, report.units),
                         f"Parameters of the specimens of {fit.law}",
                         f"{format_law_title(fit.law)}: separate fit of each specimen with its 95 % interval, and the "
                         "estimate that also uses the other specimens (shrinkage towards the mean).")
