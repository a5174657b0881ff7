"""Write the tables of a calibration report as HTML."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape

from calibration.campaign.campaign import Test
from calibration.fit.fit import Direction, Fit, Prediction, Suggestion
from calibration.report.curve_figures import describe_region, format_probability
from calibration.report.estimate_figures import UNDETERMINED
from calibration.report.figures import format_percent
from calibration.report.page import (
    format_moduli,
    format_number,
    format_stable_stretches,
    html_table,
    symbol_of,
    title_of,
    use_minus_signs,
)
from calibration.report.rounding import error_text
from calibration.report.symbols import plain_symbol
from calibration.report.units import Units


def make_ranking_table(fits: Sequence[Fit], units: Units) -> str:
    """Return the HTML table of the laws in the order of their rank; columns without values are omitted."""
    best, pressure, force = fits[0], units.pressure, units.force
    rows = []
    for fit in fits:
        # An unusable law gets no difference: a negative value would suggest to use this law.
        difference = f"{fit.BIC - best.BIC:.3g}" if fit.unusable is None else "-"
        rows.append([title_of(fit.law), "-" if fit.left_out is None else format_percent(fit.left_out),
                     *format_moduli(fit, units), f"{fit.R2:.5f}",
                     format_number(fit.RMSE_N and fit.RMSE_N / force.size, 3),
                     format_number(fit.RMSE_Pa and fit.RMSE_Pa / pressure.size, 3), f"{fit.noise_ratio:.3g}",
                     difference, format_stable_stretches(fit)])
    labels = ["Law", "Left-out error", f"E<sub>0</sub> [{pressure.name}]", f"μ<sub>0</sub> [{pressure.name}]", "R²",
              force.label("RMSE"), pressure.label("RMSE"), "Residual / noise", "ΔBIC", "Stable stretches"]
    kept = [j for j in range(len(labels)) if any(row[j] != "-" for row in rows)]
    return html_table([labels[j] for j in kept], [[use_minus_signs(row[j]) for j in kept] for row in rows], best=True)


def make_prediction_table(predictions: Iterable[Prediction], tests: Mapping[str, Test], units: Units) -> str:
    """Return the HTML table of the prediction errors of each law in tests that it was not fitted to."""
    rows: list[list[str | None]] = []
    last = None
    for p in predictions:
        test = tests[p.test]
        how = "held out of all fits" if test.hold_out else f"left out; fitted to {', '.join(p.fitted)}"
        how += f"; its specimen from the mean of {len(p.mean_of)} others" if p.mean_of else ""
        how += f"; no prediction: {p.note}" if p.percent is None and p.note else ""
        load = units.load_unit(test)
        error, chance = (None if value is None else load.text(value, 2) for value in (
            p.RMSE_Pa if test.specimen is None else p.RMSE_N, p.expected_N))
        rows.append([None if p.law == last else title_of(p.law), escape(p.test), escape(how), error or "-",
                     "-" if p.percent is None else format_percent(p.percent), chance or "-"])
        last = p.law
    return html_table(["Law", "Test", "Fitted to", "RMSE", "RMSE / largest load", "RMSE by chance"], rows, text=(1, 2))


def make_segment_test_table(fits: Sequence[Fit], tests: Mapping[str, Test], units: Units) -> str:
    """Return the HTML table of the residual tests of each region."""
    rows: list[list[str | None]] = []
    for fit in fits:
        last = None
        for r in fit.regions:
            test = tests[r.test]
            load, travel = units.load_unit(test), units.travel_unit(test)
            at = travel.text(r.at * (1.0 if test.specimen is None else 1e-3), 3)
            rows.append([None if last else title_of(fit.law), None if r.test == last else escape(r.test),
                         escape(describe_region(r, test, units)), load.text(r.misfit_N, 2),
                         use_minus_signs(f"{load.text(r.largest_N, 2)} at {at}"), f"{r.statistic:.3g} ({r.freedom})",
                         format_probability(r.p).replace("<", "&lt;"),
                         "as noise" if r.adequate else '<span class="bad">misfit</span>'])
            last = r.test
    return html_table(["Law", "Test", "Region", "Misfit (rms)", "Largest model − data", "χ² (freedom)",
                       "p, adjusted", "Residuals"], rows, text=(1, 2))


def make_identifiability_table(fits: Sequence[Fit], units: Units) -> str:
    """Return the HTML table of identifiability, one row per law.

    Columns: condition number, poorly determined combinations, parameters that are not identifiable, and remedies.
    """
    def format_suggestions(fit: Fit) -> str:
        return "; ".join(escape(describe_suggestion(each, fit, units, plain_symbol)) for each in fit.suggestions)

    rows = [[title_of(fit.law), format_number(fit.condition, 3),
             "; ".join(escape(describe_direction(d, fit, plain_symbol)) for d in fit.directions) or "none",
             f'<span class="bad">{", ".join(symbol_of(fit, name) for name in fit.not_identifiable)}</span>'
             if fit.not_identifiable else "none",
             format_suggestions(fit) or "-"] for fit in fits]
    return html_table(["Law", "Condition number", "Poorly determined", "Not identifiable", "Remedy"], rows,
                      text=(2, 3, 4))


def describe_direction(direction: Direction, fit: Fit, symbol: Callable[[str], str] = str) -> str:
    """Return a poorly determined combination as text, such as ``0.99 C20 − 0.08 C10, known to ± 35 %``.

    The numbers are relative parameter changes that together change the forces little.

    Args:
        direction: the combination.
        fit: the fit to which it belongs.
        symbol: formats the symbol of a parameter.
    """
    terms = sorted(direction.shares.items(), key=lambda item: -abs(item[1]))
    words = "".join(f"{' − ' if share < 0 else ' + '}{abs(share):.2f} {symbol(fit.symbols[name])}"
                    for name, share in terms if abs(share) >= 0.05)
    words = words.removeprefix(" + ").strip()
    error = direction.relative_error
    return f"{words}, known to ±\u00a0{error_text(100 * error)}\u00a0%" if error < UNDETERMINED \
        else f"{words}, undetermined"


def describe_suggestion(suggestion: Suggestion, fit: Fit, units: Units, symbol: Callable[[str], str] = str) -> str:
    """Return a suggested test as text, such as ``a test would give C20 ± 6.5 Pa``.

    Args:
        suggestion: the test and the standard errors that it would give.
        fit: the fit to which the suggestion belongs.
        units: display units.
        symbol: formats the symbol of a parameter.
    """
    worst = [name for name in suggestion.standard_errors if name in fit.not_identifiable] \
        or list(suggestion.standard_errors)
    errors = ", ".join(f"{symbol(fit.symbols[name])} ± {error_text(suggestion.standard_errors[name] / unit.size)} "
                       f"{unit.name}".rstrip() for name in worst
                       for unit in (units.of_parameter(fit.units[name]),))
    return f"{suggestion.test} would give {errors}"


def make_history_table(fit: Fit, units: Units) -> str:
    """Return the HTML table of all solves of all starts of a fit."""
    names = list(fit.history[0].parameters)
    scales = [units.of_parameter(fit.units[name]) for name in names]
    rows = [[f"{step.start}", f"{step.run}", *(use_minus_signs(f"{step.parameters[name] / unit.size:.5g}")
                                               for name, unit in zip(names, scales, strict=True)),
             f"{step.error:.5g}", f"{step.RMSE_N / units.force.size:.3g}", "yes" if step.corrected else "-"]
            for step in fit.history]
    return html_table(["Start", "Run", *(unit.label(symbol_of(fit, name))
                                         for name, unit in zip(names, scales, strict=True)),
                       "Error", units.force.label("RMSE"), "Accurate mesh"], rows)
