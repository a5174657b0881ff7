"""Diagnoses on the screen: the verdict first, then what it rests on, in 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from calibration.diagnosis.words import joined
from calibration.report.diagnosis_page import places
from calibration.report.diagnosis_tables import absorbed, label_of, labels_of, odds, sizes_in_words
from calibration.report.drawing import counted
from calibration.report.page import estimate_of
from calibration.report.rounding import gain_text
from calibration.report.units import Units
from scenes.commands.shared.text_table import print_sentence, text_table

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calibration.diagnosis.diagnosis import Diagnosis
    from calibration.diagnosis.result import DiagnosisResult

#: Rows of the table of candidates; the page has all.
_MOST = 8


def print_diagnoses(results: Sequence[DiagnosisResult], console: Console) -> None:
    """Print each verdict with what it rests on, and where its page is."""
    for result in results:
        diagnosis, units = result.diagnosis, Units.of_fit(result.diagnosis.fit_before)
        console.print(f"{result.campaign.name}: {diagnosis.verdict}", style="bold", markup=False, emoji=False)
        print_sentence(console, diagnosis.message)
        console.print()
        for sentence in places(diagnosis):
            print_sentence(console, f"- {sentence}")
        for table in (_candidates(diagnosis, units), _parameters(diagnosis, units), _held_out(diagnosis, units)):
            if table is not None:
                console.print()
                console.print(table)
        console.print()
        for sentence in _rest(diagnosis):
            print_sentence(console, sentence)
        read = " (read back, nothing was computed)" if result.resumed else ""
        console.print(f"{'kept' if result.resumed else 'wrote'} {result.output / 'report.html'}{read}", markup=False,
                      emoji=False, soft_wrap=True)


def _candidates(diagnosis: Diagnosis, units: Units) -> Table | None:
    """The likeliest effects that these tests can show."""
    seen = [each for each in diagnosis.candidates if each.testable]
    if not seen:
        return None
    table = text_table("effect", "score", "dBIC", "explains", "odds against", "smallest size seen", text=1)
    for each in seen[:_MOST]:
        table.add_row(label_of(each), "-" if each.score is None else f"{each.score:.1f}",
                      "-" if each.delta_BIC is None else gain_text(each.delta_BIC),
                      "-" if each.explained_percent is None else f"{each.explained_percent:.3g} %",
                      odds(each.evidence_ratio),
                      sizes_in_words(each, units))
    return table


def _parameters(diagnosis: Diagnosis, units: Units) -> Table:
    before, after = diagnosis.fit_before, diagnosis.fit_after
    headings = ["parameter", "nothing added", *([] if after is None else ["with what was added", "was off by"])]
    table = text_table(*headings)
    names = dict.fromkeys((*before.parameters, *(() if after is None else after.parameters)))
    for name in names:
        row = [(before if name in before.parameters else after or before).symbols[name]]
        row += ["-" if fit is None or name not in fit.parameters else estimate_of(fit, name, units)
                for fit in (before, after)][:len(headings) - 1]
        moved = absorbed(before, after, name)
        table.add_row(*[*row, "-" if moved is None else f"{100 * moved:+.2g} %"][:len(headings)])
    return table


def _held_out(diagnosis: Diagnosis, units: Units) -> Table | None:
    if not diagnosis.held_out:
        return None
    table = text_table("unseen data", "error before", "after", "noise", "only chance left")
    for each in diagnosis.held_out:
        sizes = ["-" if size is None else units.force.text(size, 2)
                 for size in (each.before_N, each.after_N, each.noise_N)]
        judged = each.adequate_before if each.after_N is None else each.adequate_after
        table.add_row(each.name, *sizes, "not tested" if judged is None else "yes" if judged else "no")
    return table


def _rest(diagnosis: Diagnosis) -> Iterator[str]:
    """What these tests cannot show, what to measure next, and what it took."""
    seen = [each for each in diagnosis.candidates if each.testable]
    if len(seen) > _MOST:
        yield f"{counted(len(seen) - _MOST, 'more effect')} that these tests could show: in the report"
    silent = [label_of(each) for each in diagnosis.candidates if not each.testable]
    if silent:
        yield f"not seen in these tests: {joined(silent)}"
    labels = labels_of(diagnosis.candidates)
    for each in diagnosis.next_experiment[:2]:
        names = joined([labels.get(name, name) for name in each.separates])
        yield f"next: {each.sentence}{f' (separates {names})' if names else ''}"
    yield (f"{sum(each.wall_s for each in diagnosis.stages):.0f} s: "
           + ", ".join(f"{each.name} {each.wall_s:.1f} s" for each in diagnosis.stages))
