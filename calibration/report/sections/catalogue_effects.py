"""Section with the effects of the catalogue: fitted, detectable and undetectable ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from calibration.diagnosis.diagnosis import CandidateResult, Diagnosis
from calibration.diagnosis.settings import DecisionLimits
from calibration.effects.effect import CATEGORIES
from calibration.report.content import EMPTY, Block, Column, Figure, Heading, Paragraph, Span, Table, Text
from calibration.report.diagnosis_figures import draw_candidate_scores
from calibration.report.diagnosis_tables import (
    capitalise_first_letter,
    format_detectable_sizes,
    format_effect_title_with_test,
    make_effect_table,
    map_candidate_names_to_labels,
)
from calibration.report.drawing import LAYOUT
from calibration.report.section import DiagnosisReport, Section
from calibration.report.units import ReportUnits

#: Smallest probability that is written; the number of random draws limits the resolution.
_MIN_PROBABILITY = 1e-4
#: Absolute score above which an effect of the wrong sign is marked, standard deviations.
_MIN_WRONG_SIGN_SCORE = 3.0


class CatalogueEffects(Section):
    """Scores of the effects, fitted effects, and effects that these tests can and cannot detect."""

    name = "catalogue_effects"
    title = "Effects of the catalogue in these tests"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the figure of the scores and the tables."""
        diagnosis, units = report.diagnosis, report.units
        seen = [each for each in diagnosis.candidates if each.testable]
        limits = DecisionLimits(**diagnosis.decision_limits)
        drawn = [each for each in seen
                 if each.refitted or (each.p is not None and each.p <= limits.effect_level)][:LAYOUT.drawn_effects]
        if drawn:
            yield Figure("candidates", partial(draw_candidate_scores, drawn,
                                               [format_effect_title_with_test(each) for each in drawn],
                                               _get_names_of_added_candidates(diagnosis, drawn)),
                         "Score and gain of each effect")
        refitted = [each for each in diagnosis.candidates if each.refitted]
        if refitted:
            yield make_effect_table(refitted, units)
        if seen:
            yield Heading("Effects that these tests can detect")
            yield _make_detectable_effects_table(diagnosis.candidates, units)
            yield Paragraph(
                "Smallest detectable size: nine of ten data sets like this would show an effect of this size. Score: "
                "standard deviations along the force change that the effect makes and that the fitted parameters "
                "cannot compensate. p: probability that chance gives any effect of the catalogue such a score. "
                "Explains: fraction of the misfit beyond chance that the effect removes. Similar effects: change these "
                "tests in the same way except for a few per cent.", quiet=True)
        if len(seen) < len(diagnosis.candidates):
            yield Heading("Effects that these tests cannot detect")
            yield _make_undetectable_effects_table(diagnosis.candidates)


def _get_names_of_added_candidates(diagnosis: Diagnosis, seen: Sequence[CandidateResult]) -> list[str]:
    """Return those names of the candidates `seen` whose effect was added to the model.

    An effect that acts in one test matches only the candidate of this test.
    """
    added = {(each.name, tuple(each.tests)) for each in diagnosis.effects}
    return [each.name for each in seen for test in (each.name.partition("@")[2],)
            if (each.effect, (test,) if test else ()) in added]


def _make_detectable_effects_table(candidates: Sequence[CandidateResult], units: ReportUnits) -> Table:
    """Return the table of the effects that these tests can detect, by category.

    Columns: smallest detectable size, score, probability and effects that these tests cannot distinguish.
    """
    labels = map_candidate_names_to_labels(candidates)
    seen = sorted((each for each in candidates if each.testable),
                  key=lambda each: (CATEGORIES.index(each.category), each.title))
    rows: list[list[Text | None]] = []
    last = CandidateResult(name="", effect="", category="", title="", testable=True)
    for each in seen:
        rows.append([None if each.category == last.category else each.category,
                     None if each.effect == last.effect else each.title, each.name.partition("@")[2],
                     format_detectable_sizes(each, units), EMPTY if each.score is None else f"{each.score:.1f}",
                     _make_p_value_or_wrong_sign(each),
                     ", ".join(labels.get(name, name) for name in each.twins) or EMPTY])
        last = each
    return Table([Column("Category"), Column("Effect", text=True), Column("Test", text=True, optional=True),
                  Column("Smallest detectable size", text=True), Column("Score"), Column("p"),
                  Column("Similar effects", text=True, optional=True)], rows)


def _make_p_value_or_wrong_sign(each: CandidateResult) -> str | Span:
    """Return the p value of the score, or ``wrong sign`` if no size of the effect gives a score of this sign."""
    if each.p is None:
        return EMPTY
    if each.score is not None and each.score < -_MIN_WRONG_SIGN_SCORE and each.p > 0.5:
        return Span("wrong sign", "bad")
    return "< 10⁻⁴" if each.p < _MIN_PROBABILITY else f"{each.p:.2g}".replace("e-0", "e-")


def _make_undetectable_effects_table(candidates: Sequence[CandidateResult]) -> Table:
    """Return the table of the effects that these tests cannot detect, grouped by the reason."""
    reasons: dict[str, list[str]] = {}
    for each in candidates:
        if not each.testable:
            reasons.setdefault(each.reason, []).append(format_effect_title_with_test(each))
    return Table([Column("Effect", text=True), Column("Not detectable because", text=True)],
                 [[", ".join(several), capitalise_first_letter(reason)] for reason, several in reasons.items()],
                 narrow=True)
