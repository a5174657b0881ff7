"""Tables and sentences of fits, diagnoses and designs, which the report and the terminal show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calibration.campaign.campaign import Test
from calibration.diagnosis.diagnosis import (
    CandidateResult,
    Diagnosis,
    EffectParameter,
    HeldOutPrediction,
    join_as_enumeration,
)
from calibration.effects.effect import CATEGORIES
from calibration.fit.fit import Fit, PopulationRecord, Prediction, SuggestedTest, WeakDirection
from calibration.report.content import (
    EMPTY,
    LINE_BREAK,
    Column,
    Part,
    Span,
    Table,
    Text,
    join_texts,
    make_text_of_page_or_terminal,
)
from calibration.report.drawing import LAYOUT, format_count
from calibration.report.figures import UNDETERMINED, format_percentage_value
from calibration.report.fit_text import (
    format_law_title,
    format_parameter_estimate,
    format_parameter_interval_without_unit,
    format_stable_stretches,
    format_young_and_shear_modulus_values,
    make_parameter_symbol,
)
from calibration.report.quantities import (
    DisplayUnit,
    ReportUnits,
    format_criterion_difference,
    format_error,
    format_interval,
    format_odds_number,
    format_plain_symbol,
    format_significant_digits_or_dash,
    format_value_and_error,
    use_minus_signs,
)


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
        load, error = units.get_load_unit(test), p.RMSE_Pa if test.states_stress else p.RMSE_N
        if test.modulus and p.percent is not None:
            error = 1e-2 * p.percent
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


#: Relative change above which both values are written instead of a percentage.
_LARGE_CHANGE = 0.5
#: Smallest probability that is written; the number of random draws limits the resolution.
_MIN_PROBABILITY = 1e-4
#: Absolute score above which an effect of the wrong sign is marked, standard deviations.
_MIN_WRONG_SIGN_SCORE = 3.0


def format_effect_title_with_test(candidate: CandidateResult) -> str:
    """Return the display name of a candidate, such as ``plate friction`` or ``tilt in needle``."""
    test = candidate.name.partition("@")[2]
    return f"{candidate.title} in {test}" if test else candidate.title


def map_candidate_names_to_labels(candidates: Iterable[CandidateResult]) -> dict[str, str]:
    """Return a dictionary: name of each candidate -> display name."""
    return {each.name: format_effect_title_with_test(each) for each in candidates}


def capitalise_first_letter(words: str) -> str:
    """Return the text with its first letter as a capital letter; other letters are unchanged."""
    return words[:1].upper() + words[1:]


def iterate_misfit_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield a sentence for each of the worst regions, and one for the regions that agree with the model."""
    # Holds first: a reader understands a change of force at constant displacement without a model.
    bad = sorted((each for each in diagnosis.regions if not each.adequate_before),
                 key=lambda one: (not one.segment.startswith("hold"), -one.before_sigma))
    for each in bad[:LAYOUT.summary_regions]:
        yield f"{each.sentence}."
    if len(bad) > LAYOUT.summary_regions:
        yield f"And {format_count(len(bad) - LAYOUT.summary_regions, 'more region')}."
    good = [f"{each.test} {each.segment}" for each in diagnosis.regions if each.adequate_before]
    if good and len(good) == len(diagnosis.regions):
        yield "Every region agrees."
    elif good:
        yield f"{join_as_enumeration(good)} {'agrees' if len(good) == 1 else 'agree'}."


def choose_effect_parameter_unit(path: str, unit: str, units: ReportUnits) -> DisplayUnit:
    """Return the unit in which a parameter of an effect is written; gain errors are written in %."""
    return DisplayUnit("%", 0.01) if unit == "1" and path.endswith("gain") \
        else units.choose_display_unit_of_si_unit(unit)


def format_detectable_sizes(candidate: CandidateResult, units: ReportUnits) -> str:
    """Return the smallest detectable size of an effect as text, such as ``c 0.01 mm/N``.

    A size is the difference from the parameter value at which the effect is absent.
    """
    words = []
    for path, value in candidate.seen_from.items():
        absent = candidate.absent.get(path, 0.0)
        unit = choose_effect_parameter_unit(path, candidate.units.get(path, "1"), units)
        text = unit.format_quantity(abs(value - absent), 2)
        if absent:
            change = abs(value / absent - 1.0)
            in_percent = DisplayUnit("%", 0.01).format_quantity(change, 2)
            both = f"{unit.format_quantity(value, 2)} instead of {unit.format_quantity(absent, 2)}"
            text = both if change > _LARGE_CHANGE else in_percent if absent == 1.0 else f"{text} ({in_percent})"
        words.append(f"{format_plain_symbol(candidate.symbols.get(path, path.rpartition('.')[2]))} {text}")
    return ", ".join(words)


def make_fitted_parameter_text(number: EffectParameter, units: ReportUnits) -> Text:
    """Return a fitted parameter of an effect, such as ``g1 = 3.02 ± 0.05 %``, as one word for line breaks."""
    unit, error = choose_effect_parameter_unit(number.path, number.unit, units), number.standard_error
    text = format_value_and_error(number.value / unit.size, error and error / unit.size, unit.name)
    return Span(number.symbol, "symbol"), f" = {use_minus_signs(text)}".replace(" ", "\u00a0")


def make_effect_table(candidates: Sequence[CandidateResult], units: ReportUnits) -> Table:
    """Return the table of effects in the given order: score, gain, explained misfit and odds.

    A page also shows the fitted parameters, a terminal the smallest detectable size.
    """
    rows: list[list[Text | None]] = []
    for each in candidates:
        notes = [f"{', '.join(map(format_plain_symbol, each.on_bound))} on a bound"] if each.on_bound else []
        notes += [each.note] if each.note else []
        fitted = [make_fitted_parameter_text(number, units) for number in each.parameters] or [EMPTY]
        rows.append([format_effect_title_with_test(each),
                     join_texts([*fitted, *([Span("; ".join(notes), "bad")] if notes else [])], LINE_BREAK),
                     EMPTY if each.score is None else f"{each.score:.1f}",
                     EMPTY if each.delta_BIC is None else format_criterion_difference(each.delta_BIC),
                     EMPTY if each.explained_percent is None else f"{each.explained_percent:.3g}\u00a0%",
                     format_odds_against_candidate(each.evidence_ratio), format_detectable_sizes(each, units)])
    return Table([Column("Fitted effect", "effect"), Column("Parameters", text=True), Column("Score", "score"),
                  Column("ΔBIC", "dBIC"), Column("Explains", "explains"), Column("Odds against", "odds against"),
                  Column(terminal="detectable from")], rows, narrow=True)


def format_odds_against_candidate(ratio: float | None) -> str:
    """Return the odds against a candidate, such as ``45 : 1``; ``best`` for the best and ``-`` for None."""
    if ratio is None:
        return "-"
    return "best" if ratio <= 1.0 else f"{format_odds_number(ratio)} : 1"


def make_parameter_change_table(before: Fit, after: Fit | None, units: ReportUnits) -> Table:
    """Return the table of the parameters: estimates without and with the added effects, and the resulting bias."""
    columns = [Column("Parameter", "parameter"), Column("Nothing added", "without effects"), Column("95 % interval"),
               Column("With the added effects", "with effects"), Column("95 % interval"),
               Column("Bias", "error without")]
    rows: list[list[Text | None]] = []
    for name in dict.fromkeys((*before.parameters, *(() if after is None else after.parameters))):
        row: list[Text | None] = [make_parameter_symbol(before if after is None or name in before.parameters else after,
                                                        name)]
        for fit in (before, after):
            row += [EMPTY, EMPTY] if fit is None or name not in fit.parameters else [
                format_parameter_estimate(fit, name, units),
                format_parameter_interval_without_unit(fit, name, units) or EMPTY]
        change = compute_relative_bias_or_none(before, after, name)
        row.append(EMPTY if change is None else f"{100 * change:+.2g}\u00a0%")
        rows.append(row)
    kept = slice(None, 3 if after is None else None)
    return Table(columns[kept], [row[kept] for row in rows], narrow=True)


def compute_relative_bias_or_none(before: Fit, after: Fit | None, name: str) -> float | None:
    """Return the relative error (a number) of a parameter in the fit without the effect: value before / after - 1.

    Returns:
        The relative error, such as 0.1 for 10 % too large; None if there is no fit with an effect, if either fit lacks
        the parameter, or if the parameter was fixed.
    """
    if after is None or name not in before.parameters or not after.parameters.get(name) \
            or before.standard_errors[name] == 0:
        return None
    return before.parameters[name] / after.parameters[name] - 1.0


def make_held_out_error_table(held_out: Sequence[HeldOutPrediction], units: ReportUnits) -> Table:
    """Return the table of the prediction errors in data that were not fitted."""
    def make_error_with_noise_ratio(value: float | None, noise: float | None, adequate: bool | None) -> Text:
        """Return an error, on the page with its ratio to the noise, such as ``0.1 N (2 × noise)``; ``-`` for None."""
        if value is None:
            return EMPTY
        ratio, mark = f" ({value / noise:.2g} × noise)" if noise else "", "bad" if adequate is False else ""
        return [Span(units.force.format_quantity(value, 2), mark), Span(ratio, mark, only="page")]

    kinds = {"replicate": "recording, left out of the fits to the other recordings",
             "test": "test, held out of all fits"}
    judgements: dict[bool | None, Part] = {None: "not tested", True: "yes", False: Span("no", "bad")}
    rows: list[list[Text | None]] = [
        [each.name, kinds.get(each.kind, each.kind),
         make_error_with_noise_ratio(each.before_N, each.noise_N, each.adequate_before),
         make_error_with_noise_ratio(each.after_N, each.noise_N, each.adequate_after),
         EMPTY if each.noise_N is None else units.force.format_quantity(each.noise_N, 2),
         judgements[each.adequate_before if each.after_N is None else each.adequate_after], each.note]
        for each in held_out]
    return Table([Column("Not fitted", "held-out data"), Column("Kind", text=True),
                  Column("Error, nothing added", "error before"),
                  Column("with the added effects", "error after", optional=True), Column(terminal="noise"),
                  Column("Within chance", "adequate"), Column("Note", text=True, optional=True)], rows, narrow=True)


def make_detectable_effects_table(candidates: Sequence[CandidateResult], units: ReportUnits) -> Table:
    """Return the table of the effects that these tests can detect, by category.

    Columns: smallest detectable size, score, probability and effects that these tests cannot distinguish. A design has
    no scores.
    """
    labels = map_candidate_names_to_labels(candidates)
    seen = sorted((each for each in candidates if each.testable),
                  key=lambda each: (CATEGORIES.index(each.category), each.title))
    rows: list[list[Text | None]] = []
    last = CandidateResult(name="", effect="", category="", title="", testable=True)
    for each in seen:
        rows.append([format_effect_title_with_test(each), None if each.category == last.category else each.category,
                     None if each.effect == last.effect else each.title, each.name.partition("@")[2],
                     format_detectable_sizes(each, units), EMPTY if each.score is None else f"{each.score:.1f}",
                     _make_p_value_or_wrong_sign(each),
                     ", ".join(labels.get(name, name) for name in each.twins) or EMPTY])
        last = each
    return Table([Column(terminal="effect"), Column("Category"), Column("Effect", text=True),
                  Column("Test", text=True, optional=True),
                  Column("Smallest detectable size", "detectable from", text=True),
                  Column("Score", optional=True), Column("p", optional=True),
                  Column("Similar effects", "similar to", text=True, optional=True)], rows)


def _make_p_value_or_wrong_sign(each: CandidateResult) -> str | Span:
    """Return the p value of the score, or ``wrong sign`` if no size of the effect gives a score of this sign."""
    if each.p is None:
        return EMPTY
    if each.score is not None and each.score < -_MIN_WRONG_SIGN_SCORE and each.p > 0.5:
        return Span("wrong sign", "bad")
    return "< 10⁻⁴" if each.p < _MIN_PROBABILITY else f"{each.p:.2g}".replace("e-0", "e-")


def make_undetectable_effects_table(candidates: Sequence[CandidateResult]) -> Table:
    """Return the table of the effects that these tests cannot detect, grouped by the reason, with a remedy."""
    groups: dict[tuple[str, str], list[str]] = {}
    for each in candidates:
        if not each.testable:
            groups.setdefault((each.reason, each.separated_by), []).append(format_effect_title_with_test(each))
    return Table([Column("Effect", "not detectable", text=True), Column("Not detectable because", "reason", text=True),
                  Column("Detectable with", "detectable with", text=True)],
                 [[", ".join(several), *(make_text_of_page_or_terminal(capitalise_first_letter(words), words)
                                         for words in (reason, remedy))]
                  for (reason, remedy), several in groups.items()], narrow=True)
