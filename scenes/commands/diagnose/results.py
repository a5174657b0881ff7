"""Printed results of `tissue-sim diagnose`: the verdict first, then the evidence, in 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from calibration.diagnosis.words import join_as_enumeration
from calibration.report.diagnosis_page import iterate_misfit_sentences
from calibration.report.diagnosis_tables import (
    compute_relative_bias_or_none,
    format_detectable_sizes,
    format_effect_title_with_test,
    format_odds_against_candidate,
    map_candidate_names_to_labels,
)
from calibration.report.drawing import format_count
from calibration.report.page import format_parameter_estimate
from calibration.report.rounding import format_criterion_difference
from calibration.report.units import ReportUnits
from scenes.commands.shared.text_table import TABLES, make_table_with_headings, print_sentence

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calibration.diagnosis.diagnosis import Diagnosis
    from calibration.diagnosis.result import DiagnosisResult



def print_diagnoses(results: Sequence[DiagnosisResult], console: Console) -> None:
    """Print the verdict of each diagnosis with its evidence, and the path of its report."""
    for result in results:
        diagnosis, units = result.diagnosis, ReportUnits.choose_for_fit(result.diagnosis.fit_before)
        console.print(f"{result.campaign.name}: {diagnosis.verdict}", style="bold", markup=False, emoji=False)
        print_sentence(console, diagnosis.message)
        console.print()
        for sentence in iterate_misfit_sentences(diagnosis):
            print_sentence(console, f"- {sentence}")
        tables = (_make_likely_effects_table_or_none(diagnosis, units), _make_parameter_changes_table(diagnosis, units),
                  _make_held_out_errors_table_or_none(diagnosis, units))
        for table in tables:
            if table is not None:
                console.print()
                console.print(table)
        console.print()
        for sentence in _iterate_diagnosis_remarks(diagnosis):
            print_sentence(console, sentence)
        read = " (this diagnosis was already finished)" if result.resumed else ""
        console.print(f"{'read' if result.resumed else 'wrote'} {result.output / 'report.html'}{read}", markup=False,
                      emoji=False, soft_wrap=True)


def _make_likely_effects_table_or_none(diagnosis: Diagnosis, units: ReportUnits) -> Table | None:
    """Return the table of the most likely effects that the tests can detect; None without such an effect."""
    detectable = [each for each in diagnosis.candidates if each.testable]
    if not detectable:
        return None
    table = make_table_with_headings("effect", "score", "dBIC", "explains", "odds against", "detectable from", text=1)
    for each in detectable[:TABLES.max_effects]:
        table.add_row(format_effect_title_with_test(each), "-" if each.score is None else f"{each.score:.1f}",
                      "-" if each.delta_BIC is None else format_criterion_difference(each.delta_BIC),
                      "-" if each.explained_percent is None else f"{each.explained_percent:.3g} %",
                      format_odds_against_candidate(each.evidence_ratio),
                      format_detectable_sizes(each, units))
    return table


def _make_parameter_changes_table(diagnosis: Diagnosis, units: ReportUnits) -> Table:
    """Return the table of the parameters before and after the found effects were added to the model."""
    before, after = diagnosis.fit_before, diagnosis.fit_after
    headings = ["parameter", "without effects", *([] if after is None else ["with effects", "error without"])]
    table = make_table_with_headings(*headings)
    names = dict.fromkeys((*before.parameters, *(() if after is None else after.parameters)))
    for name in names:
        row = [(before if name in before.parameters else after or before).symbols[name]]
        row += ["-" if fit is None or name not in fit.parameters else format_parameter_estimate(fit, name, units)
                for fit in (before, after)][:len(headings) - 1]
        moved = compute_relative_bias_or_none(before, after, name)
        table.add_row(*[*row, "-" if moved is None else f"{100 * moved:+.2g} %"][:len(headings)])
    return table


def _make_held_out_errors_table_or_none(diagnosis: Diagnosis, units: ReportUnits) -> Table | None:
    """Return the table of the prediction errors in data that the fits did not use; None without such data."""
    if not diagnosis.held_out:
        return None
    table = make_table_with_headings("held-out data", "error before", "error after", "noise", "adequate")
    for each in diagnosis.held_out:
        sizes = ["-" if size is None else units.force.format_quantity(size, 2)
                 for size in (each.before_N, each.after_N, each.noise_N)]
        judged = each.adequate_before if each.after_N is None else each.adequate_after
        table.add_row(each.name, *sizes, "not tested" if judged is None else "yes" if judged else "no")
    return table


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
