"""Specimens as a population, on the screen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from calibration.report.population import scaled
from scenes.commands.shared.text_table import text_table

if TYPE_CHECKING:
    from rich.table import Table

    from calibration.fit.fit import Fit


def population_table(fits: Sequence[Fit]) -> Table | None:
    """Mean and scatter between specimens of each law, with their 95 % intervals; None without a population."""
    if not any(fit.population for fit in fits):
        return None
    table = text_table("between specimens", "mean ± standard error", "95 %", "spread", "95 %", text=5)
    for fit in fits:
        if (found := fit.population) is None:
            continue
        if len(fits) > 1:
            table.add_row(fit.law, "", "", "", "")
        for k in range(len(found.order)):
            symbol, unit, size = scaled(fit, found, k)
            mean, spread = (" to ".join(f"{end / size:.4g}" for end in pair)
                            for pair in (found.mean_intervals[k], found.spread_intervals[k]))
            table.add_row(f"{'  ' if len(fits) > 1 else ''}{symbol}",
                          f"{found.mean[k] / size:.4g} ± {found.mean_errors[k] / size:.2g} {unit}".rstrip(), mean,
                          f"{found.spread[k] / size:.3g} {unit}".rstrip(), spread)
    return table
