"""Printed results of `tissue-sim diagnose`: the verdict first, then the evidence, in 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.report.diagnosis_tables import (
    format_effect_title_with_test,
    iterate_misfit_sentences,
    make_effect_table,
    make_held_out_error_table,
    make_parameter_change_table,
    map_candidate_names_to_labels,
)
from calibration.report.drawing import format_count
from calibration.report.units import ReportUnits
from scenes.commands.shared.report_table import make_printed_table
from scenes.commands.shared.text_table import TABLES, print_sentence

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.diagnosis.diagnosis import Diagnosis, DiagnosisResult


def print_diagnoses(results: Sequence[DiagnosisResult], console: Console) -> None:
    """Print the verdict of each diagnosis with its evidence, and the path of its report."""
    for result in results:
        diagnosis, units = result.diagnosis, ReportUnits.choose_for_fit(result.diagnosis.fit_before)
        console.print(f"{result.campaign.name}: {diagnosis.verdict}", style="bold", markup=False, emoji=False)
        print_sentence(console, diagnosis.message)
        console.print()
        for sentence in iterate_misfit_sentences(diagnosis):
            print_sentence(console, f"- {sentence}")
        likely = [each for each in diagnosis.candidates if each.testable][:TABLES.max_effects]
        tables = [make_parameter_change_table(diagnosis.fit_before, diagnosis.fit_after, units)]
        if likely:
            tables.insert(0, make_effect_table(likely, units))
        if diagnosis.held_out:
            tables.append(make_held_out_error_table(diagnosis.held_out, units))
        for table in tables:
            console.print()
            console.print(make_printed_table(table))
        console.print()
        for sentence in _iterate_diagnosis_remarks(diagnosis):
            print_sentence(console, sentence)
        read = " (this diagnosis was already finished)" if result.resumed else ""
        console.print(f"{'read' if result.resumed else 'wrote'} {result.output / 'report.html'}{read}", markup=False,
                      emoji=False, soft_wrap=True)


def _iterate_diagnosis_remarks(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield sentences on further effects, undetectable effects, the next experiments and the computing time."""
    detectable = sum(each.testable for each in diagnosis.candidates)
    if detectable > TABLES.max_effects:
        yield f"{format_count(detectable - TABLES.max_effects, 'more detectable effect')}: see the report"
    undetectable = [format_effect_title_with_test(each) for each in diagnosis.candidates if not each.testable]
    if undetectable:
        yield f"not detectable with these tests: {join_as_enumeration(undetectable)}"
    labels = map_candidate_names_to_labels(diagnosis.candidates)
    for each in diagnosis.next_experiment[:2]:
        names = join_as_enumeration([labels.get(name, name) for name in each.separates])
        yield f"next experiment: {each.sentence}{f' (distinguishes {names})' if names else ''}"
    yield (f"{sum(each.wall_s for each in diagnosis.stages):.0f} s: "
           + ", ".join(f"{each.name} {each.wall_s:.1f} s" for each in diagnosis.stages))
