"""Printed statistics of a population of specimens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from calibration.report.population import iterate_population_rows
from scenes.commands.shared.text_table import make_table_with_headings

if TYPE_CHECKING:
    from rich.table import Table

    from calibration.fit.fit import Fit
    from calibration.report.units import ReportUnits


def make_population_table_or_none(fits: Sequence[Fit], units: ReportUnits) -> Table | None:
    """Return the table of mean and between-specimen scatter of each parameter, with 95 % intervals.

    Args:
        fits: fits of a campaign, one for each law.
        units: display units.

    Returns:
        The table; None if no fit has a population.
    """
    if not any(fit.population for fit in fits):
        return None
    table = make_table_with_headings("between specimens", "mean ± standard error", "95 %", "SD", "95 %", text=5)
    for fit in fits:
        if fit.population is None:
            continue
        if len(fits) > 1:
            table.add_row(fit.law, "", "", "", "")
        for each in iterate_population_rows(fit, fit.population, units):
            table.add_row(f"{'  ' if len(fits) > 1 else ''}{each.symbol}", each.mean, each.mean_interval, each.spread,
                          each.spread_interval)
    return table
