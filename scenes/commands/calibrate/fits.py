"""Printed fits of a campaign: tables of at most 80 columns, and remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten
from typing import TYPE_CHECKING

from calibration.fit.ranking import does_any_law_predict_a_held_out_test
from calibration.fit.result import describe_self_weight
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.drawing import format_count
from calibration.report.fit_tables import (
    describe_poorly_determined_combination,
    describe_suggested_test_and_errors,
    make_parameter_table,
    make_population_table,
    make_prediction_table,
    make_ranking_table,
)
from calibration.report.fit_text import iterate_fit_groups_with_remarks
from calibration.report.units import ReportUnits
from scenes.commands.shared.report_table import make_printed_table, make_printed_table_of_groups
from scenes.commands.shared.text_table import print_sentence

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as PrintedTable

    from calibration.campaign.campaign import Test
    from calibration.fit.fit import Fit, Prediction, RegionMisfitTest
    from calibration.fit.result import CalibrationResult
    from calibration.report.content import Table


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
    yield describe_self_weight(result.campaign, result.best)


def _describe_computing_effort(fit: Fit) -> str:
    """Return the computational effort of a fit in words."""
    return (f"{format_count(fit.iterations, 'solve')} from {format_count(fit.starts, 'start')}, "
            f"{format_count(fit.fem_solves, 'simulated test')} with profiles and predictions, {fit.cpu_s:.3g} s of "
            "processor time")
