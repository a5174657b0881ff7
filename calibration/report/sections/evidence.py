"""Sections with the evidence of a diagnosis: misfit, effects, predictions, proposed experiments, duration, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from calibration.diagnosis.diagnosis import CandidateResult, Diagnosis, SegmentMisfit, join_as_enumeration
from calibration.diagnosis.settings import DecisionLimits
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.content import (
    EMPTY,
    Block,
    Column,
    Details,
    Figure,
    Heading,
    Listing,
    Paragraph,
    Part,
    Span,
    Table,
    Text,
)
from calibration.report.diagnosis_figures import (
    build_fitted_curves_of_test,
    draw_candidate_scores,
    draw_region_significance_in_deviations,
    draw_test_misfit,
)
from calibration.report.drawing import LAYOUT, format_count
from calibration.report.quantities import ReportUnits
from calibration.report.section import DesignReport, DiagnosisReport, Section
from calibration.report.tables import (
    capitalise_first_letter,
    format_effect_title_with_test,
    make_detectable_effects_table,
    make_effect_table,
    make_held_out_error_table,
    make_parameter_change_table,
    make_undetectable_effects_table,
    map_candidate_names_to_labels,
)


class RegionEvidence(Section):
    """Misfit and its significance in each region, without and with the added effects."""

    name = "region_evidence"
    title = "Evidence by region"
    reports = ("diagnosis",)
    needs_figures = True

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the figure and the table."""
        regions = report.diagnosis.regions
        yield Figure("regions", partial(draw_region_significance_in_deviations, regions, report.units),
                     "Significance of the residuals in each region, before and after",
                     "Significance of the smooth part of the residuals, adjusted for the number of regions (Holm). "
                     "Right: root mean square of the smooth part.")
        yield Details("In numbers", [_make_misfit_table_before_and_after(regions, report.units)])


def _make_misfit_table_before_and_after(regions: Sequence[SegmentMisfit], units: ReportUnits) -> Table:
    """Return the table of the regions: misfit and significance, before and after."""
    rows: list[list[Text | None]] = []
    last = None
    for each in regions:
        after = EMPTY if each.after_N is None else units.force.format_quantity(each.after_N, 2)
        sigma = EMPTY if each.after_sigma is None else f"{each.after_sigma:.1f}"
        rows.append([None if each.test == last else each.test, each.segment,
                     EMPTY if each.speed_mm_s is None else f"{each.speed_mm_s:g}",
                     units.force.format_quantity(each.before_N, 2), after,
                     Span(f"{each.before_sigma:.1f}", "" if each.adequate_before else "bad"),
                     Span(sigma, "bad" if each.adequate_after is False else "")])
        last = each.test
    return Table([Column("Test"), Column("Segment", text=True), *map(Column, (
        "Speed [mm/s]", "Misfit before", "after", "Deviations before", "after"))], rows, narrow=True)


class ParameterChanges(Section):
    """Estimates without and with the added effects, and the resulting bias."""

    name = "parameter_changes"
    title = "Parameters"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table."""
        yield make_parameter_change_table(report.diagnosis.fit_before, report.diagnosis.fit_after, report.units)


class HeldOutErrors(Section):
    """Prediction errors in data that were not fitted."""

    name = "held_out_errors"
    title = "Data that were not fitted"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table; nothing without such data."""
        if report.diagnosis.held_out:
            yield make_held_out_error_table(report.diagnosis.held_out, report.units)


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


class NextExperiments(Section):
    """Proposed experiments, with the effects that each would distinguish."""

    name = "next_experiments"
    title = "What to measure next"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the numbered list; nothing without proposals."""
        labels = map_candidate_names_to_labels(report.diagnosis.candidates)
        sentences: list[Text] = []
        for each in report.diagnosis.next_experiment:
            by = "" if each.deviations is None else f" by {each.deviations:.2g} standard deviations"
            names = join_as_enumeration([labels.get(name, name) for name in each.separates], "and")
            separation: list[Part] = [" ", Span(f"Distinguishes {names}{by}.", "quiet")] if names else []
            sentences.append([f"{capitalise_first_letter(each.sentence)}.", *separation])
        if sentences:
            yield Listing(sentences, ordered=True)


class Durations(Section):
    """Duration, s, and number of simulations of each stage, and their sums."""

    name = "durations"
    title = "Time"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the table."""
        stages = report.diagnosis.stages
        every = [*((each.name, each.wall_s, each.simulations) for each in stages),
                 ("all", sum(each.wall_s for each in stages), sum(each.simulations for each in stages))]
        yield Table([*map(Column, ("Stage", "Time [s]", "Simulations"))],
                    [[name, f"{seconds:.1f}", str(simulations)] for name, seconds, simulations in every], narrow=True)


class WrittenFiles(Section):
    """Files that include the effects found."""

    name = "written_files"
    title = "Files"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the list of the files; nothing if no file was written."""
        if report.diagnosis.files:
            yield Listing([(f"{content}: ", Span(name, "code")) for content, name in report.diagnosis.files.items()])


#: Explanation above the figures of the tests.
_NOTE = ("The models include the offset and the zero of each recording. Shaded: regions whose residuals exceed the "
         "noise before an effect is added. The numbers are root mean squares of the misfit there, before → after. "
         "Offsets, zeros and parameters can compensate part of the misfit; the numbers do not include this "
         "compensation. Thin lines: each recording; thick lines: mean of the recordings.")


class MisfitByTest(Section):
    """Recordings, model and residuals of each fitted test, before and after the found effects are added."""

    name = "misfit_by_test"
    title = "Where model and measurement differ"
    reports = ("diagnosis",)
    needs_figures = True

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield a note, then a heading and a figure for each test."""
        diagnosis, before, after = report.diagnosis, report.before, report.after
        yield Paragraph(_NOTE, quiet=True)
        label = join_as_enumeration([each.title for each in diagnosis.effects])
        for number, test in enumerate(before.campaign.tests):
            gaps = [each for each in diagnosis.regions if each.test == test.name]
            if not gaps:
                continue
            count = format_count(len(before.measured[test.name]), "recording")
            yield Heading((f"{test.name} ", Span(f"{test.kind.name.replace('_', ' ')}; {count}", "small")))
            regions = [region for region in before.region_misfit_tests if region.test == test.name]
            later = None if after is None else build_fitted_curves_of_test(after, test.name)
            yield Figure(make_numbered_test_figure_name(before.campaign, number), partial(
                draw_test_misfit, build_fitted_curves_of_test(before, test.name), later, regions, gaps, label,
                report.units), f"Recordings, model before and after, and residuals of {test.name}")
