"""Sections with the summary of a calibration or a diagnosis."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from calibration.campaign.campaign import Test
from calibration.diagnosis.diagnosis import VERDICTS, Diagnosis, Verdict, join_as_enumeration
from calibration.effects.effect import Effect
from calibration.fit.fit import Fit, Prediction
from calibration.fit.population import describe_excluded_specimens
from calibration.report.content import Block, Paragraph, Part, Span, Summary, Text, join_texts
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.drawing import LAYOUT, format_count
from calibration.report.figures import format_percentage_value
from calibration.report.fit_text import (
    format_law_title,
    format_parameter_estimate,
    format_stable_stretches,
    format_young_modulus,
    make_parameter_symbol,
)
from calibration.report.quantities import ReportUnits, format_plain_symbol, use_minus_signs
from calibration.report.section import CalibrationReport, DiagnosisReport, Section
from calibration.report.tables import (
    capitalise_first_letter,
    compute_relative_bias_or_none,
    describe_suggested_test_and_errors,
    iterate_misfit_sentences,
    map_candidate_names_to_labels,
)
from tissue_sim.laws import find_law

#: Short heading of each verdict.
HEADINGS: dict[Verdict, str] = {"NAMED": "One effect", "SET": "Several possible effects",
                                "LOOKS_LIKE": "Probable effect", "UNKNOWN": "Unknown effect",
                                "NONE": "No effect missing"}
#: Relative change below which a parameter is not mentioned as biased.
_MIN_CHANGE = 0.005


class DiagnosisSummary(Section):
    """Numbers of recordings, tests and effects; then the verdict and its evidence."""

    name = "diagnosis_summary"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the line with the numbers and the summary."""
        diagnosis, effects = report.diagnosis, report.effects
        yield Paragraph(f"{format_count(sum(map(len, report.recordings.values())), 'recording')} of "
                        f"{format_count(len(report.recordings), 'test')}, {format_law_title(diagnosis.law)}, "
                        f"{format_count(len(effects), 'effect')} in the catalogue", quiet=True)
        verdict = diagnosis.verdict
        # The message may already contain the meaning of the verdict.
        is_stated = VERDICTS[verdict] in diagnosis.message.lower()
        meaning = [] if is_stated else [Span(f"{verdict}: {VERDICTS[verdict]}.", "quiet")]
        influence = [f"{capitalise_first_letter(effects[each.name].title)}: {effects[each.name].signature}"
                     + (f"; largest here in {join_as_enumeration(each.acts_in)}." if each.acts_in else ".")
                     for each in diagnosis.effects if each.name in effects]
        yield Summary([
            (HEADINGS[verdict], [Span(diagnosis.message, "strong"), *meaning]),
            ("Where", [*iterate_misfit_sentences(diagnosis)]),
            ("Influence", influence),
            ("Distinguished by", [*_iterate_how_to_separate_sentences(diagnosis, effects)]),
            ("Biased parameters",
             [*_iterate_parameter_bias_sentences(diagnosis.fit_before, diagnosis.fit_after, report.units)]),
            ("Data not fitted", [*_iterate_held_out_prediction_sentences(diagnosis, report.units)]),
            ("Next", [f"{capitalise_first_letter(each.sentence)}." for each in diagnosis.next_experiment[:1]])])


def _iterate_how_to_separate_sentences(diagnosis: Diagnosis, effects: Mapping[str, Effect]) -> Iterator[str]:
    """Yield a sentence for each effect that these data cannot distinguish: the test that would distinguish it."""
    if diagnosis.verdict != "SET":
        return
    labels = map_candidate_names_to_labels(diagnosis.candidates)
    ratios = {each.name: each.evidence_ratio for each in diagnosis.candidates}
    for name in diagnosis.indistinguishable:
        effect = effects.get(name.partition("@")[0])
        if effect is None:
            continue
        ratio = ratios.get(name)
        against = "" if ratio is None or ratio < 1.05 else f" (1 : {ratio:.2g} against the most likely effect)"
        label = capitalise_first_letter(labels.get(name, effect.title))
        yield f"{label}{against}: {effect.separated_by}."


def _iterate_parameter_bias_sentences(before: Fit, after: Fit | None, units: ReportUnits) -> Iterator[Text]:
    """Yield a sentence for each parameter that was biased because the effect was missing in the model."""
    for name in before.parameters:
        change = compute_relative_bias_or_none(before, after, name)
        if after is not None and change is not None and abs(change) > _MIN_CHANGE:
            side = "too large" if change > 0 else "too small"
            yield make_parameter_symbol(before, name), (
                f" was {abs(100 * change):.2g}\u00a0% {side}: "
                f"{use_minus_signs(format_parameter_estimate(before, name, units))} without the effect, "
                f"{use_minus_signs(format_parameter_estimate(after, name, units))} with the effect.")


def _iterate_held_out_prediction_sentences(diagnosis: Diagnosis, units: ReportUnits) -> Iterator[str]:
    """Yield a sentence on the prediction errors in recordings left out of the fit, and one on tests held out."""
    for kind, noun, how in (("replicate", "recording", "left out"), ("test", "test", "held out")):
        predicted = [each for each in diagnosis.held_out if each.kind == kind and each.before_N is not None]
        if not predicted:
            continue
        later = [each.after_N for each in predicted if each.after_N is not None]
        before, after = (" to ".join(units.force.format_quantity(size, 2)
                                     for size in _get_distinct_minimum_and_maximum(sizes))
                         for sizes in ([each.before_N for each in predicted], later))
        judged = [each.adequate_before if each.after_N is None else each.adequate_after for each in predicted]
        held = sum(each is True for each in judged)
        added = f", with the added effects {after}" if after else ""
        yield (f"Error in {format_count(len(predicted), noun)} {how}: {before}{added}. In {held} of {len(predicted)} "
               "the error is within noise, jitter and parameter uncertainty.")


def _get_distinct_minimum_and_maximum(sizes: Sequence[float | None]) -> list[float]:
    """Return the smallest and the largest value that is not None, once if they are equal; empty without values."""
    known = [size for size in sizes if size is not None]
    return sorted({min(known), max(known)}) if known else []


class CalibrationSummary(Section):
    """Numbers of recordings, tests and laws; then best law, its predictions, misfits and undetermined parameters."""

    name = "calibration_summary"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the line with the numbers and the summary."""
        recordings = sum(map(len, report.recordings.values()))
        method = "least squares on nominal stress" if report.campaign.fit.method == "analytical" else \
            "inverse finite elements, all tests at once"
        yield Paragraph(f"{format_count(recordings, 'recording')} of "
                        f"{format_count(len(report.campaign.tests), 'test')}, "
                        f"{format_count(len(report.fits), 'law')}; {method}", quiet=True)
        best = report.result.best
        predictions: list[Text] = [_make_prediction_line(each, report.tests[each.test], report.units)
                                   for each in report.result.predictions if each.law == best.law]
        rows: list[tuple[str, list[Text]]] = [
            ("Law", [_make_best_law_line(report), _get_message_with_law_titles(report)]),
            ("Predictions", predictions or ["No prediction: all tests were fitted. Add a second test, left out or held "
                                            "out, to check the law on data that it was not fitted to."])]
        if best.regions:
            rows.append(("Misfits", [*_iterate_worst_misfit_lines(report)]
                         or ["All regions of all tests agree with the law within chance."]))
        yield Summary([*rows, ("Undetermined", [*_iterate_undetermined_lines(report)])])


def _make_best_law_line(report: CalibrationReport) -> Text:
    """Return the best law, its parameters, Young's modulus and stable stretches; with a warning if not usable."""
    fit, units = report.result.best, report.units
    estimates = join_texts((make_parameter_symbol(fit, name),
                            f" = {use_minus_signs(format_parameter_estimate(fit, name, units))}")
                           for name in fit.parameters)
    warning: list[Part] = [] if fit.status == "converged" else [" ", Span(fit.unusable or fit.message, "bad")]
    return [Span(format_law_title(fit.law), "strong"), ": ", *estimates, "; ", Span("E0", "symbol"),
            f" = {use_minus_signs(format_young_modulus(fit, units))}, stable stretches {format_stable_stretches(fit)}.",
            *warning]


def _get_message_with_law_titles(report: CalibrationReport) -> str:
    """Return the message of a calibration, in which the names of laws are replaced by their titles."""
    message = report.result.message
    for law in sorted(report.campaign.fit.laws, key=len, reverse=True):
        message = re.sub(rf"\b{re.escape(law)}\b", find_law(law).title, message)
    return message


def _make_prediction_line(prediction: Prediction, test: Test, units: ReportUnits) -> Text:
    """Return the error of the prediction of a test, compared with the error by chance; or why there is none."""
    how = "held out of every fit" if test.hold_out else f"fitted to {', '.join(prediction.fitted)} only"
    how += f", its specimen from the mean of {len(prediction.mean_of)} others" if prediction.mean_of else ""
    name = Span(prediction.test, "strong")
    if prediction.percent is None:
        return name, f", {how}: ", Span(f"no prediction: {prediction.note}", "bad")
    load, error = units.get_load_unit(test), prediction.RMSE_Pa if test.states_stress else prediction.RMSE_N
    size = "" if error is None else f"{load.format_quantity(error, 2)}, "
    expected = prediction.expected_N
    chance = "" if expected is None else f" (expected by chance: {load.format_quantity(expected, 2)})"
    largest = "stress" if test.states_stress else "force"
    return name, f", {how}: {size}{format_percentage_value(prediction.percent)} of the largest {largest}{chance}"


def _iterate_worst_misfit_lines(report: CalibrationReport) -> Iterator[Text]:
    """Yield the most significant misfits of the best fit, and the number of further ones."""
    bad = sorted((r for r in report.result.best.regions if not r.adequate), key=lambda r: r.p)
    for r in bad[:LAYOUT.summary_misfits]:
        test = report.tests[r.test]
        size = report.units.get_load_unit(test).format_quantity(r.misfit_N, 2)
        yield Span(r.test, "strong"), (f", {describe_region(r, test, report.units)}: {size} that the law does not "
                                       f"explain ({format_p_value_text(r.p)})")
    if len(bad) > LAYOUT.summary_misfits:
        yield f"and {len(bad) - LAYOUT.summary_misfits} more regions, in the table below."


def _iterate_undetermined_lines(report: CalibrationReport) -> Iterator[Text]:
    """Yield a line for each law with parameters that the tests do not determine, and one for the best law."""
    for i, fit in enumerate(report.fits):
        law = format_law_title(fit.law)
        if fit.not_identifiable:
            names = join_texts(make_parameter_symbol(fit, name, "bad_symbol") for name in fit.not_identifiable)
            remedy = "".join(f"; {describe_suggested_test_and_errors(each, fit, report.units, format_plain_symbol)}"
                             for each in fit.suggestions[:1])
            yield [*names, f" of {law} from these tests{remedy}."]
        elif i == 0 and fit.left_out_specimens:
            left_out = describe_excluded_specimens(fit.left_out_specimens)
            yield Span(f"The parameters of {left_out}", "bad"), f" for {law}."
        elif i == 0:
            yield f"These tests determine every parameter of {law}."
