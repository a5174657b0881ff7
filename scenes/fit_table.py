"""The table of a calibration on the screen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

_NUMBERS = ("E0 [Pa]", "mu0 [Pa]", "R2", "RMSE [Pa]", "RMSE [N]", "BIC - best", "stable stretches")


def print_results(answer: dict[str, Any], output: Path, console: Console) -> None:
    """Print the object of ``calibrate --json``: a table for each campaign, its best law marked, and what was written.

    Args:
        answer: of `calibration.to_json`, for one campaign or for several.
        output: folder that the files are in.
        console: where to print.
    """
    several = answer.get("campaigns")
    for campaign in several or [answer]:
        console.print(fit_table(campaign))
        console.print(campaign["message"], markup=False, soft_wrap=True)
        for fit in campaign["fits"]:
            if fit["status"] != "converged":
                console.print(f"{fit['law']}: {fit['message']}", markup=False, soft_wrap=True)
        for prediction in campaign["predictions"]:
            console.print(f"held out {prediction['test']}, {prediction['law']}: {_prediction(prediction)}",
                          markup=False)
    for file in [*(Path(campaign["output"]) / "report.html" for campaign in several or [answer]),
                 *([output / "summary.csv"] if several else [])]:
        console.print(f"wrote {file}", markup=False, soft_wrap=True)


def fit_table(campaign: dict[str, Any]):
    """A rich table: one row a law, in the order of the ranking."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=campaign["campaign"], show_lines=True,
                  caption="* best of the stable, converged laws by BIC; errors are standard errors")
    table.add_column("law", no_wrap=True)
    table.add_column("parameters", no_wrap=True)
    for heading in _NUMBERS:
        table.add_column(Text(heading), justify="right")
    # The law that is marked, so that one with a lower BIC that is not sound stands below zero.
    reference = next(fit["BIC"] for fit in campaign["fits"] if fit["law"] == campaign["best"])
    for fit in campaign["fits"]:
        best = fit["law"] == campaign["best"]
        error_N = fit["RMSE_N"]
        table.add_row(f"{fit['law']}{' *' if best else ''}", "\n".join(_parameters(fit)), f"{fit['E0_Pa']:.1f}",
                      f"{fit['mu0_Pa']:.1f}", f"{fit['R2']:.5f}", f"{fit['RMSE_Pa']:.3g}",
                      "-" if error_N is None else f"{error_N:.3g}", f"{fit['BIC'] - reference:.4g}",
                      f"{fit['stable_from']:.3g} to {fit['stable_to']:.3g}", style="bold" if best else None)
    return table


def _parameters(fit: dict[str, Any]) -> list[str]:
    lines = []
    for name, value in fit["parameters"].items():
        error = fit["standard_errors"].get(name)
        if error is None:
            spread = "(on its bound)" if name in fit["on_bound"] else "(not determined)"
        else:
            spread = f"± {error:.2g}" if error else "(fixed)"
        lines.append(f"{name} {value:.5g} {spread}")
    return lines


def _prediction(prediction: dict[str, Any]) -> str:
    force = "" if prediction["RMSE_N"] is None else f"RMSE {prediction['RMSE_N']:.3g} N, "
    return f"{force}{prediction['percent']:.2g} % of the largest stress"
