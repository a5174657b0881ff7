"""The results of an analytical calibration on the screen; the tables fit on 80 columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from calibration.report.page import parameter_unit, stable_stretches
from calibration.report.pressure import format_pressure, pressure_unit
from calibration.report.self_weight import statement
from scenes.commands.shared.text_table import print_sentence, text_table
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calibration.fit.fit import Fit, Prediction
    from calibration.fit.result import CalibrationResult


def print_analytical(result: CalibrationResult, console: Console) -> None:
    """Print what an analytical calibration found: ranking, parameters, remarks and predictions."""
    console.print(_ranking_table(result.fits))
    print_sentence(console, "* best usable law; dBIC: BIC above it; stable: stretches, in any loading")
    console.print(_parameter_table(result.fits))
    print_sentence(console, result.message)
    print_sentence(console, statement(result.campaign, result.best))
    for fit in result.fits:
        print_remarks(fit, console)
    for prediction in result.predictions:
        print_sentence(console, f"held out {prediction.test}, {prediction.law}: {_prediction(prediction)}")


def print_remarks(fit: Fit, console: Console) -> None:
    """What to mind about a fit, in a sentence; nothing where there is nothing."""
    remarks = [fit.message] if fit.unusable else fit.warnings
    if remarks:
        print_sentence(console, f"{fit.law}: {'; '.join(remarks)}")


def _ranking_table(fits: Sequence[Fit]) -> Table:
    """One row a law, pressures in the unit that suits the first."""
    best = fits[0]
    E0, mu0 = pressure_unit(best.E0), pressure_unit(best.mu0)
    unit, size = error_unit(best)
    table = text_table("law", f"E0 {E0[0]}", f"mu0 {mu0[0]}", "R2", f"RMSE {unit}", "dBIC", "stable")
    for fit in fits:
        error = fit.RMSE_N if unit == "N" else fit.RMSE_Pa
        table.add_row(ranked_name(fit, best), f"{fit.E0 / E0[1]:.4g}", f"{fit.mu0 / mu0[1]:.4g}",
                      share_of_variance(fit), f"{error / size:.4g}",
                      "-" if fit.unusable else f"{fit.BIC - best.BIC:.4g}", stable_stretches(fit),
                      style=ranked_style(fit, best))
    return table


def error_unit(best: Fit) -> tuple[str, float]:
    """Unit of the root mean square errors of a ranking, and its size in SI; a force where all tests have one."""
    return ("N", 1.0) if best.RMSE_N is not None or best.RMSE_Pa is None else pressure_unit(best.RMSE_Pa)


def ranked_name(fit: Fit, best: Fit) -> str:
    """The law, with a star where it is the best usable one: without a usable law there is a first one, and no best."""
    return f"{fit.law} *" if fit is best and fit.unusable is None else fit.law


def ranked_style(fit: Fit, best: Fit) -> str | None:
    """Style of a row of the ranking."""
    return "bold" if fit is best and fit.unusable is None else None


def share_of_variance(fit: Fit) -> str:
    """R2."""
    return f"{fit.R2:.5f}" if fit.R2 > -1 else f"{fit.R2:.3g}"


def _parameter_table(fits: Sequence[Fit]) -> Table:
    """The parameters and their standard errors, in the order of the ranking."""
    table = text_table("law", "parameter", "value ± standard error", text=3)
    for fit in fits:
        law = find_law(fit.law)
        for i, (name, value) in enumerate(fit.parameters.items()):
            table.add_row(fit.law if i == 0 else "", name, _value(fit, name, value, parameter_unit(law, name)))
    return table


def _value(fit: Fit, name: str, value: float, unit: str) -> str:
    """A parameter with its standard error, or why it has none."""
    error = fit.standard_errors.get(name)
    spread = error or None
    if unit == "Pa":
        text = format_pressure(value, error=spread)
    else:
        text = f"{value:.5g}" if spread is None else f"{value:.5g} ± {spread:.2g}"
        text = f"{text} {unit}".rstrip()
    return f"{text}{remark_on_error(fit, name)}"


def remark_on_error(fit: Fit, name: str) -> str:
    """Why a parameter has no standard error, in brackets; empty where it has one."""
    error = fit.standard_errors.get(name)
    if error is None:
        return f" ({'on its bound' if name in fit.on_bound else 'not determined'})"
    return "" if error else " (fixed)"


def _prediction(prediction: Prediction) -> str:
    if prediction.percent is None:
        return "the law does not carry the specimen so far"
    force = "" if prediction.RMSE_N is None else f"RMSE {prediction.RMSE_N:.3g} N, "
    return f"{force}{prediction.percent:.2g} % of the largest stress"
