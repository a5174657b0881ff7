"""Section with the effects of the catalogue: fitted, detectable and undetectable ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from calibration.diagnosis.diagnosis import CandidateResult, Diagnosis
from calibration.diagnosis.settings import DecisionLimits
from calibration.report.content import Block, Figure, Heading, Paragraph
from calibration.report.diagnosis_figures import draw_candidate_scores
from calibration.report.diagnosis_tables import (
    format_effect_title_with_test,
    make_detectable_effects_table,
    make_effect_table,
    make_undetectable_effects_table,
)
from calibration.report.drawing import LAYOUT
from calibration.report.section import DesignReport, DiagnosisReport, Section


class CatalogueEffects(Section):
    """Scores of the effects, fitted effects, and effects that these tests can and cannot detect."""

    name = "catalogue_effects"
    title = "Effects of the catalogue in these tests"
    reports = ("diagnosis", "design")

    def iterate_blocks(self, report: DiagnosisReport | DesignReport) -> Iterator[Block]:
        """Yield the figure of the scores and the tables; a design has no scores and no fitted effects."""
        if isinstance(report, DiagnosisReport):
            yield from _iterate_scores_and_fitted_effects(report)
        testable = sum(each.testable for each in report.candidates)
        if testable:
            yield Heading("Effects that these tests can detect")
            yield make_detectable_effects_table(report.candidates, report.units)
            scores = "Score: standard deviations along the force change that the effect makes and that the fitted " \
                "parameters cannot compensate. p: probability that chance gives any effect of the catalogue such a " \
                "score. Explains: fraction of the misfit beyond chance that the effect removes. " \
                if isinstance(report, DiagnosisReport) else ""
            yield Paragraph(
                "Smallest detectable size: nine of ten data sets like this would show an effect of this size. "
                f"{scores}Similar effects: change these tests in the same way except for a few per cent.", quiet=True)
        if testable < len(report.candidates):
            yield Heading("Effects that these tests cannot detect")
            yield make_undetectable_effects_table(report.candidates)


def _iterate_scores_and_fitted_effects(report: DiagnosisReport) -> Iterator[Block]:
    """Yield the figure of the scores and the table of the fitted effects."""
    diagnosis = report.diagnosis
    limits = DecisionLimits(**diagnosis.decision_limits)
    drawn = [each for each in diagnosis.candidates if each.testable
             and (each.refitted or (each.p is not None and each.p <= limits.effect_level))][:LAYOUT.drawn_effects]
    if drawn:
        yield Figure("candidates", partial(draw_candidate_scores, drawn,
                                           [format_effect_title_with_test(each) for each in drawn],
                                           _get_names_of_added_candidates(diagnosis, drawn)),
                     "Score and gain of each effect")
    refitted = [each for each in diagnosis.candidates if each.refitted]
    if refitted:
        yield make_effect_table(refitted, report.units)


def _get_names_of_added_candidates(diagnosis: Diagnosis, seen: Sequence[CandidateResult]) -> list[str]:
    """Return those names of the candidates `seen` whose effect was added to the model.

    An effect that acts in one test matches only the candidate of this test.
    """
    added = {(each.name, tuple(each.tests)) for each in diagnosis.effects}
    return [each.name for each in seen for test in (each.name.partition("@")[2],)
            if (each.effect, (test,) if test else ()) in added]
