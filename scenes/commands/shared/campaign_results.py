"""Printed results of `tissue-sim calibrate` and `tissue-sim diagnose`, and tables of reports on the console."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.fit.ranking import does_any_law_predict_a_held_out_test
from calibration.fit.result import describe_aggregate_modulus, describe_self_weight, list_method_agreement_sentences
from calibration.report.content import Table, get_terminal_text
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.drawing import format_count
from calibration.report.fit_text import iterate_fit_groups_with_remarks
from calibration.report.quantities import ReportUnits
from calibration.report.tables import (
    describe_poorly_determined_combination,
    describe_suggested_test_and_errors,
    format_effect_title_with_test,
    iterate_misfit_sentences,
    make_effect_table,
    make_held_out_error_table,
    make_parameter_change_table,
    make_parameter_table,
    make_population_table,
    make_prediction_table,
    make_ranking_table,
    map_candidate_names_to_labels,
)
from scenes.commands.shared.console import TABLES, make_table_with_headings, print_sentence

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as PrintedTable

    from calibration.campaign.campaign import Test
    from calibration.diagnosis.diagnosis import Diagnosis, DiagnosisResult
    from calibration.fit.fit import Fit, Prediction, RegionMisfitTest
    from calibration.fit.result import CalibrationResult

def make_printed_table(table: Table, *, text: int = 1) -> PrintedTable:
    """Return a table of a report as a table of the library rich; the best row is bold.

    Args:
        table: table; columns without a heading for the terminal are omitted.
        text: number of left-aligned columns at the left; columns of text are left-aligned too.
    """
    return make_printed_table_of_groups([("", table)], text=text)


def make_printed_table_of_groups(groups: Sequence[tuple[str, Table]], *, text: int = 1) -> PrintedTable:
    """Return tables with equal columns as one printed table.

    Args:
        groups: name and table of each group, at least one. A group with a name begins with a row that contains the
            name, and its other rows are indented.
        text: see `make_printed_table`.
    """
    from rich.text import Text

    shown = [(name, table.select_terminal_columns()) for name, table in groups]
    columns = shown[0][1].columns
    printed = make_table_with_headings(*(str(column.terminal) for column in columns), text=text)
    for column, style in zip(columns, printed.columns, strict=True):
        if column.text:
            style.justify, style.no_wrap = "left", False
    for name, table in shown:
        if name:
            printed.add_row(name)
        for i, row in enumerate(table.rows):
            first, *others = map(get_terminal_text, row)
            printed.add_row(Text(f"{'  ' if name else ''}{first}"), *map(Text, others),
                            style="bold" if i == table.best_row else None)
    return printed


@dataclass(frozen=True)
class FitTableLayout:
    """Sizes of the tables of fits.

    Attributes:
        name_width: width of the parameter names, characters; longer names are wrapped.
        note_width: length of a note on an interval, characters; the report has the whole note.
        max_regions: number of regions with a misfit that are printed for a law; the report lists all.
    """

    name_width: int = 29
    note_width: int = 60
    max_regions: int = 3


_LAYOUT = FitTableLayout()


def print_fit_tables(result: CalibrationResult, console: Console) -> None:
    """Print ranking, parameters and predictions of the laws, and remarks on them."""
    fits, tests, units = result.fits, {test.name: test
                                       for test in result.campaign.tests}, ReportUnits.choose_for_best_fit(result)
    heading, meaning = _get_ranking_heading_and_explanation(result)
    console.print(make_printed_table(make_ranking_table(fits, units, heading)))
    star = "" if fits[0].unusable else "* best usable law; "
    print_sentence(console, f"{star}{meaning}; stable: range of stable stretches")
    console.print()
    console.print(_make_parameter_table(fits, units))
    console.print()
    if legend := _join_symbol_and_derivative_notes(fits):
        print_sentence(console, legend)
        console.print()
    if any(fit.population for fit in fits):
        console.print(_make_printed_table_of_laws([(fit.law, make_population_table([fit], units)) for fit in fits
                                                   if fit.population], text=5))
        console.print()
    if result.predictions:
        table = make_printed_table(make_prediction_table(result.predictions, tests, units), text=3)
        table.columns[1].no_wrap, table.columns[1].overflow = False, "fold"
        console.print(table)
        chance = "; by chance: error expected from noise, jitter and the errors of the parameters"
        several = any(prediction.mean_of for prediction in result.predictions)
        chance += "; by the mean: predicted with the mean of other specimens, whose scatter is part of the chance" \
            if several else ""
        known = any(prediction.expected_N is not None for prediction in result.predictions)
        print_sentence(console, f"%: relative to the largest force or stress{chance if known else ''}")
        console.print()
    print_sentence(console, result.message)
    for sentence in (*_iterate_missing_prediction_reasons(result.predictions),
                     *_iterate_identifiability_remarks(fits, units),
                     *_iterate_misfit_remarks(fits, tests, units),
                     *_iterate_noise_mesh_and_weight_remarks(result, tests, units)):
        print_sentence(console, sentence)
    # The message of the result contains that of the first law if the law is unusable.
    for having, remarks in iterate_fit_groups_with_remarks(fits, lambda fit: fit.warnings if fit.unusable is None else
                                                           [] if fit is fits[0] else [fit.message]):
        names = "all laws" if 1 < len(having) == len(fits) else ", ".join(fit.law for fit in having)
        print_sentence(console, f"{names}: {remarks}")
    for fit in fits:
        if fit.fem_solves:
            print_sentence(console, f"{fit.law}: {_describe_computing_effort(fit)}")


def _get_ranking_heading_and_explanation(result: CalibrationResult) -> tuple[str, str]:
    """Return column heading and explanation of the criterion that ranks the laws."""
    if all(fit.left_out is None for fit in result.fits):
        return "dBIC", "dBIC: BIC minus the best"
    if does_any_law_predict_a_held_out_test(result.predictions):
        return "held out %", "held out: error in tests that no fit used"
    return "left out %", "left out: error in each test, predicted by a fit to the other tests"


def _make_parameter_table(fits: Sequence[Fit], units: ReportUnits) -> PrintedTable:
    """Return the table of the parameters of all laws with standard errors and profile-likelihood intervals."""
    table = _make_printed_table_of_laws([(fit.law, make_parameter_table(fit, units)) for fit in fits], text=3)
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    table.columns[0].max_width = _LAYOUT.name_width
    return table


def _make_printed_table_of_laws(tables: Sequence[tuple[str, Table]], *, text: int) -> PrintedTable:
    """Return the tables of some laws as one printed table; the laws are named if there are several.

    Args:
        tables: name of each law and its table.
        text: number of left-aligned columns at the left.
    """
    return make_printed_table_of_groups(tables if len(tables) > 1 else [("", table) for _, table in tables], text=text)


def _join_symbol_and_derivative_notes(fits: Sequence[Fit]) -> str:
    """Return the legend: full names of abbreviated parameters, and parameters with finite-difference derivatives."""
    full_names = {symbol: name for fit in fits for name, symbol in fit.symbols.items() if symbol != name}
    parts = [f"{symbol}: {name}" for symbol, name in full_names.items()]
    inexact = dict.fromkeys(fit.symbols[name] for fit in fits for name, how in fit.derivatives.items()
                            if how == "difference")
    if inexact:
        parts.append(f"derivatives by finite differences: {', '.join(inexact)}")
    return "; ".join(parts)


def _iterate_missing_prediction_reasons(predictions: Sequence[Prediction]) -> Iterator[str]:
    """Yield the reason for each missing prediction."""
    for p in predictions:
        if p.percent is None:
            yield f"{p.law} does not predict {p.test}: {p.note or 'the simulation did not reach its depth'}"


def _iterate_identifiability_remarks(fits: Sequence[Fit], units: ReportUnits) -> Iterator[str]:
    """Yield sentences on truncated intervals, unidentifiable parameters and poorly determined directions."""
    for fit in fits:
        cuts = [f"{fit.symbols[name]} {shorten(note, _LAYOUT.note_width, placeholder=' ...')}"
                for name, profile in fit.profiles.items() for note in profile.notes]
        if cuts:
            yield f"{fit.law}: cut intervals: {'; '.join(cuts)}"
        if fit.not_identifiable:
            advice = "; ".join(describe_suggested_test_and_errors(each, fit, units) for each in fit.suggestions)
            if fit.fem_solves and not advice:
                advice = "no further test is known to help"
            yield (f"{fit.law}: not identifiable from these tests: {fit.format_symbols(fit.not_identifiable)}"
                   f"{f'; {advice}' if advice else ''}")
        elif fit.directions:
            advice = f"; {describe_suggested_test_and_errors(fit.suggestions[0], fit, units)}" if fit.suggestions \
                else ""
            directions = "; ".join(describe_poorly_determined_combination(each, fit) for each in fit.directions)
            yield f"{fit.law}: poorly determined: {directions}{advice}"


def _iterate_misfit_remarks(fits: Sequence[Fit], tests: Mapping[str, Test], units: ReportUnits) -> Iterator[str]:
    """Yield sentences on regions whose residuals exceed noise, the most significant first."""
    for fit in fits:
        bad = sorted((region for region in fit.regions if not region.adequate),
                     key=lambda region: (region.p, -region.statistic))
        if bad:
            most = _LAYOUT.max_regions
            worst = "; ".join(_describe_misfit(region, tests[region.test], units) for region in bad[:most])
            more = f"; and {len(bad) - most} more" if len(bad) > most else ""
            yield f"{fit.law}: smooth misfit in {worst}{more}"
        elif fit.regions:
            yield f"{fit.law}: no smooth misfit in any of {format_count(len(fit.regions), 'region')}"


def _describe_misfit(region: RegionMisfitTest, test: Test, units: ReportUnits) -> str:
    """Return test, range, size and significance of a misfit."""
    size = units.get_load_unit(test).format_quantity(region.misfit_N, 2)
    return f"{region.test} ({describe_region(region, test, units)}): {size}, {format_p_value_text(region.p)}"


def _iterate_noise_mesh_and_weight_remarks(result: CalibrationResult, tests: Mapping[str, Test],
                                           units: ReportUnits) -> Iterator[str]:
    """Yield sentences on the noise, the scatter between recordings, the mesh error and the self-weight of the fit."""
    tests_by_noise: dict[str, list[str]] = {}
    for noise in result.noise:
        colour = "white" if noise.correlation_time_s == 0 else f"correlated over {noise.correlation_time_s:.2g} s"
        deviation = units.get_load_unit(tests[noise.test]).format_quantity(noise.deviation_N, 2)
        words = f"{deviation} {noise.source}, {colour}"
        tests_by_noise.setdefault(words, []).append(noise.test)
    parts = [words if len(tests_by_noise) == 1 else f"{words} ({', '.join(names)})"
             for words, names in tests_by_noise.items()]
    jitter = result.best.jitter
    scatter = ""
    if jitter is not None:
        freedom = "stated" if jitter.freedom is None else "assumed" if not jitter.freedom else \
            f"from {format_count(jitter.freedom, 'degree')} of freedom"
        contact, zero = units.format_contact_and_zero_scatter(jitter, result.campaign.tests)
        scatter = f"; scatter between recordings {contact} of contact, {zero} of zero, {freedom}"
    if parts:
        yield f"noise: {', '.join(parts)}{scatter}"
    meshes = [f"{mesh.test} {mesh.largest_percent:.2g} %" for mesh in result.best.mesh if mesh.largest_percent]
    if meshes:
        yield f"difference between accurate and fast mesh, included in the fit: {', '.join(meshes)}"
    yield from describe_aggregate_modulus(result.campaign, result.best)
    yield describe_self_weight(result.campaign, result.best)


def _describe_computing_effort(fit: Fit) -> str:
    """Return the computational effort of a fit in words."""
    return (f"{format_count(fit.iterations, 'solve')} from {format_count(fit.starts, 'start')}, "
            f"{format_count(fit.fem_solves, 'simulated test')} with profiles and predictions, {fit.cpu_s:.3g} s of "
            "processor time")


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


def print_calibration_results(results: Sequence[CalibrationResult], output: Path, console: Console) -> None:
    """Print tables and remarks of each campaign, and the written files.

    Args:
        results: results of one call of `calibration.calibrate`.
        output: result folder of this call.
        console: console of the results.
    """
    for result in results:
        print_sentence(console, result.campaign.name)
        print_fit_tables(result, console)
    for sentence in list_method_agreement_sentences(results):
        print_sentence(console, sentence)
    for result in results:
        if result.resumed:
            _print_sentence_with_path(console,
                                      f"read from {result.output}, where this calibration was already finished")
        else:
            _print_sentence_with_path(console, f"wrote {result.output / 'report.html'}")
    if len(results) > 1:
        _print_sentence_with_path(console, f"wrote {output / 'summary.csv'}")


def _print_sentence_with_path(console: Console, text: str) -> None:
    """Print a sentence with a path on one line of any length, so that the path can be copied."""
    console.print(text, markup=False, emoji=False, soft_wrap=True)
