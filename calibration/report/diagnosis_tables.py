"""Write the tables of a diagnosis as HTML and format its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from calibration.diagnosis.diagnosis import (
    CandidateResult,
    Diagnosis,
    EffectParameter,
    HeldOutPrediction,
    SegmentMisfit,
)
from calibration.effects.effect import CATEGORIES
from calibration.fit.fit import Fit
from calibration.report.page import (
    format_parameter_estimate,
    format_parameter_interval_without_unit,
    format_parameter_symbol,
    make_html_table,
    use_minus_signs,
)
from calibration.report.rounding import format_criterion_difference, format_odds_number, format_value_and_error
from calibration.report.symbols import format_html_symbol, format_plain_symbol
from calibration.report.units import DisplayUnit, ReportUnits

#: Smallest probability that is written; the number of random draws limits the resolution.
_MIN_PROBABILITY = 1e-4
#: Absolute score above which an effect of the wrong sign is marked, standard deviations.
_MIN_WRONG_SIGN_SCORE = 3.0
#: Relative change above which both values are written instead of a percentage.
_LARGE_CHANGE = 0.5


def format_effect_title_with_test(candidate: CandidateResult) -> str:
    """Return the display name of a candidate, such as ``plate friction`` or ``tilt in needle``."""
    test = candidate.name.partition("@")[2]
    return f"{candidate.title} in {test}" if test else candidate.title


def map_candidate_names_to_labels(candidates: Iterable[CandidateResult]) -> dict[str, str]:
    """Return a dictionary: name of each candidate -> display name."""
    return {each.name: format_effect_title_with_test(each) for each in candidates}


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


def format_fitted_parameter_as_html(number: EffectParameter, units: ReportUnits) -> str:
    """Return a fitted parameter as HTML, such as ``g₁ = 3.02 ± 0.05 %``."""
    unit, error = choose_effect_parameter_unit(number.path, number.unit, units), number.standard_error
    text = format_value_and_error(number.value / unit.size, error and error / unit.size, unit.name)
    return f"{format_html_symbol(number.symbol)} = {use_minus_signs(text)}".replace(" ", "\u00a0")


def make_fitted_effects_table(candidates: Sequence[CandidateResult], units: ReportUnits) -> str:
    """Return the HTML table of the effects that were fitted, best first."""
    rows = []
    for each in (each for each in candidates if each.refitted):
        fitted = "<br>".join(format_fitted_parameter_as_html(number, units) for number in each.parameters)
        notes = [f"{', '.join(map(format_plain_symbol, each.on_bound))} on a bound"] if each.on_bound else []
        notes += [each.note] if each.note else []
        fitted += f'<br><span class="bad">{escape("; ".join(notes))}</span>' if notes else ""
        rows.append([escape(format_effect_title_with_test(each)), fitted or "-",
                     "-" if each.score is None else use_minus_signs(
            f"{each.score:.1f}"), "-" if each.delta_BIC is None else format_criterion_difference(each.delta_BIC),
            "-" if each.explained_percent is None else f"{each.explained_percent:.3g}\u00a0%",
            escape(format_odds_against_candidate(each.evidence_ratio))])
    return make_html_table(["Fitted effect", "Parameters", "Score", "ΔBIC", "Explains", "Odds against"], rows,
                           text=(1,), narrow=True) if rows else ""


def make_detectable_effects_table(candidates: Sequence[CandidateResult], units: ReportUnits) -> str:
    """Return the HTML table of the effects that these tests can detect, by category.

    Columns: smallest detectable size, score, probability and effects that these tests cannot distinguish.
    """
    labels = map_candidate_names_to_labels(candidates)
    seen = sorted((each for each in candidates if each.testable),
                  key=lambda each: (CATEGORIES.index(each.category), each.title))
    rows: list[list[str | None]] = []
    last = CandidateResult(name="", effect="", category="", title="", testable=True)
    for each in seen:
        test = each.name.partition("@")[2]
        rows.append([None if each.category == last.category else escape(each.category),
                     None if each.effect == last.effect else escape(each.title), escape(test),
                     escape(format_detectable_sizes(each, units)),
                     "-" if each.score is None else use_minus_signs(f"{each.score:.1f}"),
                     _format_p_value_or_wrong_sign(each),
                     escape(", ".join(labels.get(name, name) for name in each.twins)) or "-"])
        last = each
    labelled = ["Category", "Effect", "Test", "Smallest detectable size", "Score", "p", "Similar effects"]
    kept = [j for j in range(len(labelled)) if j not in (2, 6) or any(row[j] not in ("", "-") for row in rows)]
    return make_html_table([labelled[j] for j in kept], [[row[j] for j in kept] for row in rows],
                           text=[kept.index(j) for j in (1, 2, 3, 6) if j in kept])


def _format_p_value_or_wrong_sign(each: CandidateResult) -> str:
    """Return the p value of the score, or ``wrong sign`` if no size of the effect gives a score of this sign."""
    if each.score is not None and each.p is not None and each.score < -_MIN_WRONG_SIGN_SCORE and each.p > 0.5:
        return '<span class="bad">wrong sign</span>'
    return format_p_value_html_or_dash(each.p)


def make_undetectable_effects_table(candidates: Sequence[CandidateResult]) -> str:
    """Return the HTML table of the effects that these tests cannot detect, grouped by the reason."""
    reasons: dict[str, list[CandidateResult]] = {}
    for each in candidates:
        if not each.testable:
            reasons.setdefault(each.reason, []).append(each)
    rows = [[escape(", ".join(map(format_effect_title_with_test, several))), escape(capitalise_first_letter(reason))]
            for reason, several in reasons.items()]
    return make_html_table(["Effect", "Not detectable because"], rows, text=(0, 1), narrow=True) if rows else ""


def capitalise_first_letter(words: str) -> str:
    """Return the text with its first letter as a capital letter; other letters are unchanged."""
    return words[:1].upper() + words[1:]


def format_p_value_html_or_dash(p: float | None) -> str:
    """Return a probability as HTML, such as ``0.031`` or ``< 10⁻⁴``; ``-`` for None."""
    return "-" if p is None else "&lt; 10⁻⁴" if p < _MIN_PROBABILITY else f"{p:.2g}".replace("e-0", "e-")


def format_odds_against_candidate(ratio: float | None) -> str:
    """Return the odds against a candidate, such as ``45 : 1``; ``best`` for the best and ``-`` for None."""
    if ratio is None:
        return "-"
    return "best" if ratio <= 1.0 else f"{format_odds_number(ratio)} : 1"


def make_misfit_table_before_and_after(regions: Sequence[SegmentMisfit], units: ReportUnits) -> str:
    """Return the HTML table of the regions: misfit and significance, before and after."""
    rows: list[list[str | None]] = []
    last = None
    for each in regions:
        speed = "-" if each.speed_mm_s is None else f"{each.speed_mm_s:g}"
        after = "-" if each.after_N is None else units.force.format_quantity(each.after_N, 2)
        sigma = "-" if each.after_sigma is None else f"{each.after_sigma:.1f}"
        rows.append([None if each.test == last else escape(each.test), escape(each.segment), speed,
                     units.force.format_quantity(each.before_N, 2), after,
                     _mark_text_if_inadequate(f"{each.before_sigma:.1f}",
                                              each.adequate_before),
                     sigma if each.adequate_after is None else _mark_text_if_inadequate(sigma, each.adequate_after)])
        last = each.test
    return make_html_table(["Test", "Segment", "Speed [mm/s]", "Misfit before", "after", "Deviations before", "after"],
                           rows, text=(1,), narrow=True)


def _mark_text_if_inadequate(text: str, adequate: bool) -> str:
    """Return a number as HTML: in the colour of a warning if it is not adequate, otherwise unchanged."""
    return text if adequate else f'<span class="bad">{text}</span>'


def make_parameter_table_before_and_after(before: Fit, after: Fit | None, units: ReportUnits) -> str:
    """Return the HTML table of the parameters: estimates without and with the added effects, and the resulting bias."""
    rows = []
    for name in dict.fromkeys((*before.parameters, *(() if after is None else after.parameters))):
        cells = [format_parameter_symbol(before if after is None or name in before.parameters else after, name)]
        for fit in (before, after):
            cells += ["-", "-"] if fit is None or name not in fit.parameters else [
                use_minus_signs(format_parameter_estimate(fit, name, units)),
                use_minus_signs(format_parameter_interval_without_unit(fit, name, units)) or "-"]
        change = compute_relative_bias_or_none(before, after, name)
        cells.append("-" if change is None else use_minus_signs(f"{100 * change:+.2g}\u00a0%"))
        rows.append(cells)
    labels = ["Parameter", "Nothing added", "95 % interval", "With the added effects", "95 % interval", "Bias"]
    kept = slice(None, 3 if after is None else None)
    return make_html_table(labels[kept], [row[kept] for row in rows], narrow=True)


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


def make_prediction_error_table(held_out: Sequence[HeldOutPrediction], units: ReportUnits) -> str:
    """Return the HTML table of the prediction errors in data that were not fitted."""
    def format_error_force_and_noise_ratio(value: float | None, noise: float | None, adequate: bool | None) -> str:
        """Return an error as HTML with its ratio to the noise, such as ``0.1 N (2 × noise)``; ``-`` for None."""
        if value is None:
            return "-"
        ratio = f" ({value / noise:.2g} × noise)" if noise else ""
        return _mark_text_if_inadequate(f"{units.force.format_quantity(value, 2)}{ratio}", adequate is not False)

    kinds = {"replicate": "recording, left out of the fits to the other recordings",
             "test": "test, held out of all fits"}
    rows = [[escape(each.name), escape(kinds.get(each.kind, each.kind)),
             format_error_force_and_noise_ratio(each.before_N, each.noise_N,
                                                each.adequate_before),
             format_error_force_and_noise_ratio(each.after_N, each.noise_N, each.adequate_after),
             {None: "not tested", True: "yes", False: '<span class="bad">no</span>'}[
                 each.adequate_before if each.after_N is None else each.adequate_after],
             escape(each.note)] for each in held_out]
    kept = [j for j in range(6) if (j != 3 or any(each.after_N is not None for each in held_out))
            and (j != 5 or any(each.note for each in held_out))]
    labels = ["Not fitted", "Kind", "Error, nothing added", "with the added effects", "Within chance", "Note"]
    return make_html_table([labels[j] for j in kept], [[row[j] for j in kept] for row in rows],
                           text=[kept.index(j) for j in (1, 5) if j in kept], narrow=True)


def make_stage_duration_table(diagnosis: Diagnosis) -> str:
    """Return the HTML table of the duration, s, and the number of simulations of each stage, and their sums."""
    rows = [[escape(each.name), f"{each.wall_s:.1f}", str(each.simulations)] for each in diagnosis.stages]
    rows.append(["all", f"{sum(each.wall_s for each in diagnosis.stages):.1f}",
                 str(sum(each.simulations for each in diagnosis.stages))])
    return make_html_table(["Stage", "Time [s]", "Simulations"], rows, narrow=True)
