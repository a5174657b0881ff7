"""The tables of a calibration on the screen; they fit on 80 columns."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.pressure import format_pressure, pressure_unit
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def print_results(answer: dict[str, Any], output: Path, console: Console, *, read_back: Collection[Path] = ()) -> None:
    """Print the object of ``calibrate --json``: tables for each campaign, remarks, and what was written.

    Args:
        answer: of `calibration.to_json`, for one campaign or for several.
        output: folder that the files are in.
        console: where to print.
        read_back: folders of campaigns that were finished before, so that nothing was fitted.
    """
    several = answer.get("campaigns")
    campaigns = several or [answer]

    def line(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    for campaign in campaigns:
        line(campaign["campaign"])
        console.print(fit_table(campaign))
        line("* best usable law; dBIC: BIC above it; stable: stretches, in any loading")
        console.print(parameter_table(campaign))
        line(campaign["message"])
        line(campaign["self_weight"])
        for fit in campaign["fits"]:
            remarks = [fit["message"]] if fit["unusable"] else fit["warnings"]
            if remarks:
                line(f"{fit['law']}: {'; '.join(remarks)}")
        for prediction in campaign["predictions"]:
            line(f"held out {prediction['test']}, {prediction['law']}: {_prediction(prediction)}")
    for folder in [Path(campaign["output"]) for campaign in campaigns]:
        if folder in read_back:
            line(f"read back from {folder}, nothing was fitted")
        else:
            line(f"wrote {folder / 'report.html'}")
    if several:
        line(f"wrote {output / 'summary.csv'}")


def fit_table(campaign: dict[str, Any]) -> Table:
    """A rich table of the ranking: one row a law, pressures in the unit that suits the first."""
    best = campaign["fits"][0]
    E0, mu0 = pressure_unit(best["E0_Pa"]), pressure_unit(best["mu0_Pa"])
    error_key, error = ("RMSE_N", ("N", 1.0)) if best["RMSE_N"] is not None else \
        ("RMSE_Pa", pressure_unit(best["RMSE_Pa"]))
    table = _table("law", f"E0 {E0[0]}", f"mu0 {mu0[0]}", "R2", f"RMSE {error[0]}", "dBIC", "stable")
    for fit in campaign["fits"]:
        # Without a usable law there is a first one, and no best.
        first = fit is best and fit["unusable"] is None
        table.add_row(f"{fit['law']}{' *' if first else ''}", f"{fit['E0_Pa'] / E0[1]:.4g}",
                      f"{fit['mu0_Pa'] / mu0[1]:.4g}", _share(fit["R2"]), f"{fit[error_key] / error[1]:.4g}",
                      "-" if fit["unusable"] else f"{fit['BIC'] - best['BIC']:.4g}", _stretches(fit),
                      style="bold" if first else None)
    return table


def parameter_table(campaign: dict[str, Any]) -> Table:
    """A rich table of the parameters and their standard errors, in the order of the ranking."""
    table = _table("law", "parameter", "value ± standard error")
    table.columns[1].justify = table.columns[2].justify = "left"
    for fit in campaign["fits"]:
        units = find_law(fit["law"]).units
        for i, (name, value) in enumerate(fit["parameters"].items()):
            table.add_row(fit["law"] if i == 0 else "", name, _value(fit, name, value, units[name] != "1"))
    return table


def _table(*headings: str) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(headings):
        table.add_column(heading, no_wrap=True, justify="left" if i == 0 else "right")
    return table


def _share(R2: float) -> str:
    return f"{R2:.5f}" if R2 > -1 else f"{R2:.3g}"


def _stretches(fit: dict[str, Any]) -> str:
    if fit["mu0_Pa"] <= 0 or fit["stable_from"] >= fit["stable_to"]:
        return "nowhere"
    return f"{fit['stable_from']:.3g} to {fit['stable_to']:.3g}"


def _value(fit: dict[str, Any], name: str, value: float, pressure: bool) -> str:
    """A parameter with its standard error, or why it has none."""
    error = fit["standard_errors"].get(name)
    spread = error or None
    if pressure:
        text = format_pressure(value, error=spread)
    else:
        text = f"{value:.5g}" if spread is None else f"{value:.5g} ± {spread:.2g}"
    if error is None:
        return f"{text} ({'on its bound' if name in fit['on_bound'] else 'not determined'})"
    return text if error else f"{text} (fixed)"


def _prediction(prediction: dict[str, Any]) -> str:
    if prediction["percent"] is None:
        return "the law does not carry the specimen so far"
    force = "" if prediction["RMSE_N"] is None else f"RMSE {prediction['RMSE_N']:.3g} N, "
    return f"{force}{prediction['percent']:.2g} % of the largest stress"
