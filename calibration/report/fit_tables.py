"""Tables of the fits of a campaign, which the report and the terminal show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calibration.campaign.campaign import Test
from calibration.fit.fit import Fit, PopulationRecord, Prediction, SuggestedTest, WeakDirection
from calibration.report.content import EMPTY, Column, Part, Span, Table, Text, make_text_of_page_or_terminal
from calibration.report.estimate_figures import UNDETERMINED
from calibration.report.figures import format_percentage_value
from calibration.report.fit_text import (
    format_law_title,
    format_parameter_estimate,
    format_parameter_interval_without_unit,
    format_stable_stretches,
    format_young_and_shear_modulus_values,
    make_parameter_symbol,
)
from calibration.report.rounding import (
    format_error,
    format_interval,
    format_significant_digits_or_dash,
    format_value_and_error,
)
from calibration.report.units import DisplayUnit, ReportUnits


def make_ranking_table(fits: Sequence[Fit], units: ReportUnits, terminal_criterion: str = "dBIC") -> Table:
    """Return the table of the laws in the order of their rank: criteria, errors, moduli and stable stretches.

    Args:
        fits: fits of all laws, best first.
        units: display units.
        terminal_criterion: heading of the only criterion on the terminal: ``"dBIC"``, or the heading of the error in
            tests left out or held out.
    """
    best, pressure, force = fits[0], units.pressure, units.force
    by_BIC, has_forces = terminal_criterion == "dBIC", best.RMSE_N is not None or best.RMSE_Pa is None
    columns = [
        Column("Law", "law"),
        Column("Left-out error", None if by_BIC else terminal_criterion, optional=True),
        Column("ΔBIC", terminal_criterion if by_BIC else None, optional=True), Column("R²", "R2"),
        Column(force.format_axis_label("RMSE"), f"RMSE {force.name}" if has_forces else None, optional=True),
        Column(pressure.format_axis_label("RMSE"), None if has_forces else f"RMSE {pressure.name}", optional=True),
        Column("Residual / noise"),
        Column((Span("E0", "symbol"), f" [{pressure.name}]"), f"E0 {pressure.name}"),
        Column((Span("mu0", "symbol"), f" [{pressure.name}]"), f"mu0 {pressure.name}"),
        Column("Stable stretches", "stable")]
    rows: list[list[Text | None]] = []
    for fit in fits:
        star = " *" if fit is best and fit.unusable is None else ""
        left_out = EMPTY if fit.left_out is None else format_percentage_value(fit.left_out)
        rows.append([
            make_text_of_page_or_terminal(format_law_title(fit.law), f"{fit.law}{star}"),
            make_text_of_page_or_terminal(left_out, format_significant_digits_or_dash(fit.left_out, 3)),
            # An unusable law gets no difference: a negative value would suggest to use this law.
            EMPTY if fit.unusable else f"{fit.BIC - best.BIC:.3g}",
            f"{fit.R2:.5f}" if fit.R2 > -1 else f"{fit.R2:.3g}",
            format_significant_digits_or_dash(fit.RMSE_N and fit.RMSE_N / force.size, 4),
            format_significant_digits_or_dash(fit.RMSE_Pa and fit.RMSE_Pa / pressure.size, 4),
            f"{fit.noise_ratio:.3g}", *format_young_and_shear_modulus_values(fit, units), format_stable_stretches(fit)])
    return Table(columns, rows, best_row=0 if best.unusable is None else None)


def make_parameter_table(fit: Fit, units: ReportUnits) -> Table:
    """Return the table of the parameters of a law: estimate, standard error, interval and limit of the interval."""
    rows: list[list[Text | None]] = []
    for name in fit.parameters:
        symbol: list[Part] = [make_parameter_symbol(fit, name)]
        if name in fit.not_identifiable:
            symbol += [Span(" ", only="page"), Span("not determined", "bad", only="page")]
        estimate: list[Part] = [format_parameter_estimate(fit, name, units)]
        if fit.standard_errors.get(name) is None and name not in fit.on_bound and not fit.alternatives:
            estimate.append(Span(" (not determined)", only="terminal"))
        interval: list[Part] = [format_parameter_interval_without_unit(fit, name, units) or Span(EMPTY, only="page")]
        if name in fit.interval_notes:
            interval.append(Span(" (cut)", only="terminal"))
        rows.append([symbol, estimate, interval, fit.interval_notes.get(name, "").replace(f"{name} ", "")])
    return Table([Column("Parameter", "parameter"), Column("Value ± standard error", "value ± standard error"),
                  Column("95 % interval", "95 % interval"),
                  Column("Limit of the interval", text=True, optional=True)], rows, narrow=True)


def make_prediction_table(predictions: Iterable[Prediction], tests: Mapping[str, Test], units: ReportUnits) -> Table:
    """Return the table of the errors of each law in tests that it was not fitted to."""
    rows: list[list[Text | None]] = []
    last = None
    for p in predictions:
        test = tests[p.test]
        how = "held out of all fits" if test.hold_out else f"left out; fitted to {', '.join(p.fitted)}"
        how += f"; its specimen from the mean of {len(p.mean_of)} others" if p.mean_of else ""
        how += f"; no prediction: {p.note}" if p.percent is None and p.note else ""
        short = f"{'left out' if p.fitted else 'held out'}{f', by the mean of {len(p.mean_of)}' if p.mean_of else ''}"
        load, error = units.get_load_unit(test), p.RMSE_Pa if test.specimen is None else p.RMSE_N
        rows.append([
            None if p.law == last else make_text_of_page_or_terminal(format_law_title(p.law), p.law), p.test,
            make_text_of_page_or_terminal(how, short),
            make_text_of_page_or_terminal(EMPTY, "none") if error is None else load.format_quantity(error, 3),
            make_text_of_page_or_terminal(EMPTY if p.percent is None else format_percentage_value(p.percent),
                                          format_significant_digits_or_dash(p.percent, 2)),
            EMPTY if p.expected_N is None else load.format_quantity(p.expected_N, 2)])
        last = p.law
    return Table([Column("Law", "law"), Column("Test", "predicts", text=True), Column("Fitted to", "", text=True),
                  Column("RMSE", "RMSE"), Column("RMSE / largest load", "%"),
                  Column("RMSE by chance", "by chance")], rows)


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


def make_population_table(fits: Sequence[Fit], units: ReportUnits) -> Table:
    """Return the table of mean and between-specimen scatter of each parameter, with 95 % intervals.

    Args:
        fits: fits, one for each law; those without a population have no row.
        units: display units.
    """
    rows: list[list[Text]] = [
        [format_law_title(fit.law), Span(each.symbol, "symbol"), each.mean, each.mean_interval, each.spread,
         each.spread_interval, each.next_specimen, str(len(fit.population.specimens))]
        for fit in fits if fit.population is not None
        for each in iterate_population_rows(fit, fit.population, units)]
    return Table([Column("Law"), Column("Parameter", "between specimens"), Column("Mean", "mean ± standard error"),
                  Column("95 %", "95 %"), Column("Spread", "SD"), Column("95 %", "95 %"),
                  Column("Next specimen, 95\u00a0%"), Column("Specimens")], rows)


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
