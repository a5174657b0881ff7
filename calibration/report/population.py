"""Report the population of specimens: a table and a figure of each parameter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from html import escape
from typing import NamedTuple

import numpy as np

from calibration.fit.fit import Fit
from calibration.fit.population import describe_excluded_specimens
from calibration.fit.population_records import PopulationRecord
from calibration.report.drawing import (
    COLOURS,
    FigureEmbedder,
    add_figure_legend_above_panels,
    create_figure_with_panel_rows,
    distribute_panels_over_rows,
)
from calibration.report.page import format_law_title, make_html_table, use_minus_signs
from calibration.report.rounding import NORMAL_95, format_error, format_interval, format_value_and_error
from calibration.report.symbols import format_html_symbol, format_mathtext_symbol
from calibration.report.units import DisplayUnit, ReportUnits


class PopulationRow(NamedTuple):
    """Formatted statistics of one parameter in a population of specimens.

    Attributes:
        symbol: symbol of the parameter.
        unit: unit of the parameter.
        mean: mean over the specimens with its standard error.
        mean_interval: 95 % interval of the mean.
        spread: standard deviation between specimens.
        spread_interval: 95 % interval of the standard deviation.
        next_specimen: 95 % prediction interval of a further specimen.
    """

    symbol: str
    unit: DisplayUnit
    mean: str
    mean_interval: str
    spread: str
    spread_interval: str
    next_specimen: str


def iterate_population_rows(fit: Fit, population: PopulationRecord, units: ReportUnits) -> Iterator[PopulationRow]:
    """Yield the formatted statistics of each parameter of a population."""
    for k, path in enumerate(population.order):
        name = f"{path}@{population.specimens[0]}"
        unit = units.choose_display_unit_of_si_unit(fit.units[name])
        mean, error, spread = (getattr(population, key)[k] / unit.size for key in ("mean", "mean_errors", "spread"))
        # Standard error of a standard deviation from n specimens: spread / sqrt(2 (n - 1)).
        spread_error = max(spread / np.sqrt(2 * (len(population.specimens) - 1)), 1e-3 * abs(mean))
        intervals = [format_interval(low / unit.size, high / unit.size, precision, mean) for (low, high), precision in (
            (population.mean_intervals[k], error), (population.spread_intervals[k], spread_error),
            (population.next_specimen[k], error))]
        yield PopulationRow(fit.symbols[name].partition("@")[0], unit, format_value_and_error(mean, error, unit.name),
                            intervals[0], f"{format_error(spread)} {unit.name}".rstrip(), intervals[1], intervals[2])


def iterate_population_section_html(fits: Sequence[Fit], units: ReportUnits, pictures: FigureEmbedder) -> Iterator[str]:
    """Yield the HTML parts of the section on the population of specimens; no part if no fit has a population."""
    having = [(fit, fit.population) for fit in fits if fit.population is not None]
    if not having:
        return
    yield "<h2>Specimens as a population</h2>"
    yield make_html_table(["Law", "Parameter", "Mean", "95 %", "Spread", "95 %", "Next specimen, 95\u00a0%",
                           "Specimens"], [
        [format_law_title(fit.law), format_html_symbol(each.symbol), *map(use_minus_signs, (
            each.mean, each.mean_interval, each.spread, each.spread_interval, each.next_specimen)),
         str(len(found.specimens))]
        for fit, found in having for each in iterate_population_rows(fit, found, units)])
    for fit, _ in having:
        if fit.left_out_specimens:
            others = escape(describe_excluded_specimens(fit.left_out_specimens))
            yield f"<p>Not in the population of {format_law_title(fit.law)}: {others}.</p>"
    for fit, found in having:
        yield pictures.embed_figure(f"population {fit.law}", partial(draw_population_figure, fit, found, units),
                                    f"Parameters of the specimens of {fit.law}",
                                    f"{format_law_title(fit.law)}: separate fit of each specimen with its 95 % "
                                    "interval, and the estimate that also uses the other specimens (shrinkage towards "
                                    "the mean).")


def draw_population_figure(fit: Fit, population: PopulationRecord, units: ReportUnits):
    """Draw each parameter of each specimen: separate estimate, shrinkage estimate and mean of the population."""
    specimens = len(population.specimens)
    rows = distribute_panels_over_rows(len(population.order))
    figure, grid = create_figure_with_panel_rows(rows, 1.5 + 0.3 * specimens)
    firsts = {sum(rows[:row]) for row in range(len(rows))}
    for k, axes in enumerate(grid):
        _draw_population_parameter(axes, fit, population, k, units)
        axes.set_yticks(range(specimens), population.specimens if k in firsts else [])
        axes.set_ylim(specimens - 0.5, -0.5)
    add_figure_legend_above_panels(figure)
    return figure


def _draw_population_parameter(axes, fit: Fit, population: PopulationRecord, k: int, units: ReportUnits) -> None:
    """Draw the parameter with index `k` of all specimens: estimates, population mean, range of further specimens."""
    name = f"{population.order[k]}@{population.specimens[0]}"
    unit = units.choose_display_unit_of_si_unit(fit.units[name])
    rows = np.arange(len(population.specimens))
    axes.axvspan(*(end / unit.size for end in population.next_specimen[k]), color="0.93", lw=0,
                 label="95 % of further specimens")
    axes.axvspan(*(end / unit.size for end in population.mean_intervals[k]), color=COLOURS[0], alpha=0.2, lw=0,
                 label="mean, 95 %")
    axes.axvline(population.mean[k] / unit.size, color=COLOURS[0], lw=1.4)
    values, errors = (np.array(getattr(population, key))[:, k] / unit.size for key in ("estimates", "errors"))
    axes.errorbar(values, rows, xerr=NORMAL_95 * errors, fmt="o", color=COLOURS[1], capsize=2.5, lw=1.2, ms=5,
                  label="specimen alone, 95 %")
    axes.plot(np.array(population.shrunken)[:, k] / unit.size, rows, "D", mfc="white", mec="0.2", ms=4, zorder=5,
              label="using the other specimens")
    axes.set_xlabel(unit.format_axis_label(format_mathtext_symbol(fit.symbols[name].partition("@")[0])))
