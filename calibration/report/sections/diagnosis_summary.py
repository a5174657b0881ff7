"""Section with the summary of a diagnosis: verdict, regions, influence, biased parameters, next experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from calibration.diagnosis.diagnosis import VERDICTS, Diagnosis, Verdict, join_as_enumeration
from calibration.effects.effect import Effect
from calibration.fit.fit import Fit
from calibration.report.content import Block, Paragraph, Span, Summary, Text
from calibration.report.diagnosis_tables import (
    capitalise_first_letter,
    compute_relative_bias_or_none,
    iterate_misfit_sentences,
    map_candidate_names_to_labels,
)
from calibration.report.drawing import format_count
from calibration.report.fit_text import format_law_title, format_parameter_estimate, make_parameter_symbol
from calibration.report.rounding import use_minus_signs
from calibration.report.section import DiagnosisReport, Section
from calibration.report.units import ReportUnits

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
