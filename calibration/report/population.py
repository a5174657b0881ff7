"""Specimens as a population on the page: a table, and a picture of every parameter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calibration.fit.fit import Fit, PopulationStatement
from calibration.report.drawing import COLOURS, STYLE, new_figure, to_png
from calibration.report.estimate_figures import unit_of
from calibration.report.figures import WIDTH
from calibration.report.page import html_figure, html_table, title_of

_PANELS = 3
#: Half width of a 95 % interval in standard errors.
_REACH = 1.96


def scaled(fit: Fit, population: PopulationStatement, k: int) -> tuple[str, str, float]:
    """Symbol of a parameter of the population, its unit as people read it, and the size of that in SI."""
    path = population.order[k]
    name = f"{path}@{population.specimens[0]}"
    return fit.symbols[name].partition("@")[0], *unit_of(fit, name)


def population_table(fits: Sequence[Fit]) -> str:
    """Mean, spread between specimens and the next specimen, with their 95 % intervals; empty without a population."""
    rows = []
    for fit in fits:
        if (found := fit.population) is None:
            continue
        for k in range(len(found.order)):
            symbol, unit, size = scaled(fit, found, k)
            ends = [" to ".join(f"{end / size:.4g}" for end in pair) for pair in (
                found.mean_intervals[k], found.spread_intervals[k], found.next_specimen[k])]
            rows.append([title_of(fit.law), f"{symbol} [{unit}]" if unit else symbol, f"{found.mean[k] / size:.4g}",
                         ends[0], f"{found.spread[k] / size:.3g}", ends[1],
                         f"{found.spread[k] / abs(found.mean[k]):.1%}" if found.mean[k] else "-", ends[2],
                         str(len(found.specimens))])
    return html_table(["Law", "Parameter", "Mean", "95 %", "Spread", "95 %", "of the mean", "Next specimen, 95 %",
                       "Specimens"], rows) if rows else ""


def populations(fits: Sequence[Fit]) -> Iterator[str]:
    """The part of the page that is about specimens; nothing without a population."""
    if not any(fit.population for fit in fits):
        return
    yield "<h2>Specimens as a population</h2>"
    yield population_table(fits)
    for fit in fits:
        if fit.population is not None:
            yield html_figure(draw_population(fit, fit.population), f"Parameters of the specimens of {fit.law}",
                              f"{title_of(fit.law)}: each specimen's own fit with its 95 % interval, and what is left "
                              "of its distance from the mean where its own error is allowed for.")


def draw_population(fit: Fit, population: PopulationStatement) -> bytes:
    """Each parameter of each specimen alone and with what the others tell, about the mean of the population."""
    import matplotlib

    count, specimens = len(population.order), len(population.specimens)
    columns = min(_PANELS, max(2, count))
    rows = -(-count // columns)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(WIDTH, rows * (1.6 + 0.32 * specimens))
        grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for k, axes in enumerate(grid.flat[:count]):
            _draw_parameter(axes, fit, population, k)
        for axes in grid.flat[count:]:
            axes.set_visible(False)
        for axes in grid[:, 0]:
            axes.set_yticks(range(specimens), population.specimens)
            axes.set_ylim(specimens - 0.5, -0.5)
        figure.legend(*grid.flat[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
        return to_png(figure)


def _draw_parameter(axes, fit: Fit, population: PopulationStatement, k: int) -> None:
    symbol, unit, size = scaled(fit, population, k)
    place = np.arange(len(population.specimens))
    low, high = np.array(population.next_specimen[k]) / size
    axes.axvspan(low, high, color="0.93", lw=0, label="95 % of further specimens")
    axes.axvspan(*(end / size for end in population.mean_intervals[k]), color=COLOURS[0], alpha=0.2, lw=0)
    axes.axvline(population.mean[k] / size, color=COLOURS[0], lw=1.4, label="mean, 95 %")
    values, errors = (np.array(getattr(population, name))[:, k] / size for name in ("estimates", "errors"))
    axes.errorbar(values, place, xerr=_REACH * errors, fmt="o", color=COLOURS[1], capsize=2.5, lw=1.2, ms=5,
                  label="specimen alone, 95 %")
    axes.plot(np.array(population.shrunken)[:, k] / size, place, "D", mfc="white", mec="0.2", ms=4, zorder=5,
              label="with what the others tell")
    axes.set_xlabel(f"{symbol} [{unit}]" if unit else symbol)
