"""Write the tables of a calibration report as HTML."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape

from calibration.campaign.campaign import Test
from calibration.fit.fit import Fit, Prediction, SuggestedTest, WeakDirection
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.estimate_figures import UNDETERMINED
from calibration.report.figures import format_percentage_value
from calibration.report.page import (
    format_law_title,
    format_parameter_symbol,
    format_significant_digits_or_dash,
    format_stable_stretches,
    format_young_and_shear_modulus_values,
    make_html_table,
    use_minus_signs,
)
from calibration.report.rounding import format_error
from calibration.report.symbols import format_plain_symbol
from calibration.report.units import ReportUnits


def make_ranking_table(fits: Sequence[Fit], units: ReportUnits) -> str:
    """Return the HTML table of the laws in the order of their rank; columns without values are omitted."""
    best, pressure, force = fits[0], units.pressure, units.force
    rows = []
    for fit in fits:
        # An unusable law gets no difference: a negative value would suggest to use this law.
        difference = f"{fit.BIC - best.BIC:.3g}" if fit.unusable is None else "-"
        rows.append([format_law_title(fit.law), "-" if fit.left_out is None else format_percentage_value(fit.left_out),
                     *format_young_and_shear_modulus_values(fit, units), f"{fit.R2:.5f}",
                     format_significant_digits_or_dash(fit.RMSE_N and fit.RMSE_N / force.size, 3),
                     format_significant_digits_or_dash(fit.RMSE_Pa and fit.RMSE_Pa / pressure.size, 3),
                     f"{fit.noise_ratio:.3g}", difference, format_stable_stretches(fit)])
    labels = ["Law", "Left-out error", f"E<sub>0</sub> [{pressure.name}]", f"μ<sub>0</sub> [{pressure.name}]", "R²",
              force.format_axis_label("RMSE"), pressure.format_axis_label("RMSE"), "Residual / noise", "ΔBIC",
              "Stable stretches"]
    kept = [j for j in range(len(labels)) if any(row[j] != "-" for row in rows)]
    return make_html_table([labels[j] for j in kept], [[use_minus_signs(row[j]) for j in kept] for row in rows],
                           best=True)


def make_prediction_table(predictions: Iterable[Prediction], tests: Mapping[str, Test], units: ReportUnits) -> str:
    """Return the HTML table of the prediction errors of each law in tests that it was not fitted to."""
    rows: list[list[str | None]] = []
    last = None
    for p in predictions:
        test = tests[p.test]
        how = "held out of all fits" if test.hold_out else f"left out; fitted to {', '.join(p.fitted)}"
        how += f"; its specimen from the mean of {len(p.mean_of)} others" if p.mean_of else ""
        how += f"; no prediction: {p.note}" if p.percent is None and p.note else ""
        load = units.get_load_unit(test)
        error, chance = (None if value is None else load.format_quantity(value, 2) for value in (
            p.RMSE_Pa if test.specimen is None else p.RMSE_N, p.expected_N))
        rows.append([None if p.law == last else format_law_title(p.law), escape(p.test), escape(how), error or "-",
                     "-" if p.percent is None else format_percentage_value(p.percent), chance or "-"])
        last = p.law
    return make_html_table(["Law", "Test", "Fitted to", "RMSE", "RMSE / largest load", "RMSE by chance"], rows,
                           text=(1, 2))


def make_region_residual_test_table(fits: Sequence[Fit], tests: Mapping[str, Test], units: ReportUnits) -> str:
    """Return the HTML table of the statistical tests of the residuals, one row per law and region of a test."""
    rows: list[list[str | None]] = []
    for fit in fits:
        last = None
        for r in fit.regions:
            test = tests[r.test]
            load, travel = units.get_load_unit(test), units.get_displacement_unit(test)
            at = travel.format_quantity(r.at * (1.0 if test.specimen is None else 1e-3), 3)
            rows.append([None if last else format_law_title(fit.law), None if r.test == last else escape(r.test),
                         escape(describe_region(r, test, units)), load.format_quantity(r.misfit_N, 2),
                         use_minus_signs(f"{load.format_quantity(r.largest_N, 2)} at {at}"),
                         f"{r.statistic:.3g} ({r.freedom})", format_p_value_text(r.p).replace("<", "&lt;"),
                         "as noise" if r.adequate else '<span class="bad">misfit</span>'])
            last = r.test
    return make_html_table(["Law", "Test", "Region", "Misfit (rms)", "Largest model − data", "χ² (freedom)",
                            "p, adjusted", "Residuals"], rows, text=(1, 2))


def make_identifiability_table(fits: Sequence[Fit], units: ReportUnits) -> str:
    """Return the HTML table of identifiability, one row per law.

    Columns: condition number, poorly determined combinations, parameters that are not identifiable, and remedies.
    """
    def join_suggestions_with_semicolons(fit: Fit) -> str:
        """Return the suggested tests of a fit as HTML, separated by semicolons; empty if there is none."""
        return "; ".join(escape(describe_suggested_test_and_errors(each, fit, units, format_plain_symbol))
                         for each in fit.suggestions)

    rows = [[format_law_title(fit.law), format_significant_digits_or_dash(fit.condition, 3),
             "; ".join(escape(describe_poorly_determined_combination(d, fit, format_plain_symbol))
                       for d in fit.directions) or "none",
             '<span class="bad">'
             f'{", ".join(format_parameter_symbol(fit, name) for name in fit.not_identifiable)}</span>'
             if fit.not_identifiable else "none",
             join_suggestions_with_semicolons(fit) or "-"] for fit in fits]
    return make_html_table(["Law", "Condition number", "Poorly determined", "Not identifiable", "Remedy"], rows,
                           text=(2, 3, 4))


def describe_poorly_determined_combination(direction: WeakDirection, fit: Fit,
                                           symbol: Callable[[str], str] = str) -> str:
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
    return f"{words}, known to ±\u00a0{format_error(100 * error)}\u00a0%" if error < UNDETERMINED \
        else f"{words}, undetermined"


def describe_suggested_test_and_errors(suggestion: SuggestedTest, fit: Fit, units: ReportUnits,
                                       symbol: Callable[[str], str] = str) -> str:
    """Return a suggested test as text, such as ``a test would give C20 ± 6.5 Pa``.

    Args:
        suggestion: the test and the standard errors that it would give.
        fit: the fit to which the suggestion belongs.
        units: display units.
        symbol: formats the symbol of a parameter.
    """
    worst = [name for name in suggestion.standard_errors if name in fit.not_identifiable] \
        or list(suggestion.standard_errors)
    errors = ", ".join(f"{symbol(fit.symbols[name])} ± {format_error(suggestion.standard_errors[name] / unit.size)} "
                       f"{unit.name}".rstrip() for name in worst
                       for unit in (units.choose_display_unit_of_si_unit(fit.units[name]),))
    return f"{suggestion.test} would give {errors}"


def make_table_of_all_solves(fit: Fit, units: ReportUnits) -> str:
    """Return the HTML table of all solves of all starts of a fit: parameters, error and RMSE, one row per solve."""
    names = list(fit.history[0].parameters)
    scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in names]
    rows = [[f"{step.start}", f"{step.run}", *(use_minus_signs(f"{step.parameters[name] / unit.size:.5g}")
                                               for name, unit in zip(names, scales, strict=True)),
             f"{step.error:.5g}", f"{step.RMSE_N / units.force.size:.3g}", "yes" if step.corrected else "-"]
            for step in fit.history]
    return make_html_table(["Start", "Run", *(unit.format_axis_label(format_parameter_symbol(fit, name))
                                              for name, unit in zip(names, scales, strict=True)),
                            "Error", units.force.format_axis_label("RMSE"), "Accurate mesh"], rows)
