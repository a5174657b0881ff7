"""Printed results of `tissue-sim design`: planned tests, expected parameter errors and detectable effects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibration.report.diagnosis_tables import (
    format_detectable_sizes,
    format_effect_title_with_test,
    map_candidate_names_to_labels,
)
from calibration.report.rounding import format_value_and_error
from calibration.report.units import ReportUnits
from scenes.commands.shared.text_table import make_table_with_headings, print_sentence
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calibration.diagnosis.design import Design


def print_design_tables(design: Design, console: Console) -> None:
    """Print the predicted accuracy of planned experiments as tables."""
    law = find_law(design.law)
    modulus = law.mu0({name: design.parameters[name] for name in law.parameters if name in design.parameters}) \
        if all(name in design.parameters for name in law.parameters) else 1e3
    units = ReportUnits.choose_for_typical_sizes(1e-3 * max(test.depth_mm for test in design.tests),
                                                 max(test.force_N for test in design.tests), modulus)
    noise = ReportUnits.choose_for_typical_sizes(1e-3, design.noise_N, modulus).force
    print_sentence(console, f"{design.campaign}: {law.title}, sensor noise {noise.format_quantity(design.noise_N, 3)}")
    tables = [_make_planned_tests_table(design, units), _make_expected_errors_table(design, units)]
    effects = [_make_detectable_effects_table_or_none(design, units), _make_undetectable_effects_table_or_none(design)]
    for table in [*tables, *(each for each in effects if each is not None)]:
        console.print()
        console.print(table)


def _make_planned_tests_table(design: Design, units: ReportUnits) -> Table:
    """Return the table of the planned tests."""
    table = make_table_with_headings("planned test", "recordings", "samples", "depth", "largest force", "duration")
    for test in design.tests:
        table.add_row(test.name, str(test.recordings), str(test.samples),
                      units.length.format_quantity(1e-3 * test.depth_mm, 3),
                      units.force.format_quantity(test.force_N, 3),
                      "-" if test.duration_s is None else f"{test.duration_s:.3g} s")
    return table


def _make_expected_errors_table(design: Design, units: ReportUnits) -> Table:
    """Return the table of the parameters with their expected standard errors."""
    table = make_table_with_headings("parameter", "expected", "error")
    for name, value in design.parameters.items():
        unit, error = units.choose_display_unit_of_si_unit(design.units[name]), design.standard_errors[name]
        known = {None: "not determined", 0.0: "fixed"}.get(error, "")
        relative = f"{100 * error / abs(value):.2g} %" if error and value else "-"
        table.add_row(design.symbols[name],
                      format_value_and_error(value / unit.size, error and error / unit.size, unit.name,
                                             known=known), relative)
    return table


def _make_detectable_effects_table_or_none(design: Design, units: ReportUnits) -> Table | None:
    """Return the table of detectable effects, with their smallest detectable size and effects that look alike."""
    labels = map_candidate_names_to_labels(design.candidates)
    rows = [each for each in design.candidates if each.testable]
    if not rows:
        return None
    table = make_table_with_headings("effect", "detectable from", "similar to", text=3)
    table.columns[2].no_wrap = False
    for each in rows:
        table.add_row(format_effect_title_with_test(each), format_detectable_sizes(each, units),
                      ", ".join(labels.get(name, name)
                                for name in each.twins) or "-")
    return table


def _make_undetectable_effects_table_or_none(design: Design) -> Table | None:
    """Return the table of undetectable effects, with the reason and the experiment that would detect them."""
    rows = [each for each in design.candidates if not each.testable]
    if not rows:
        return None
    table = make_table_with_headings("not detectable", "reason", "detectable with", text=3)
    for column in table.columns[1:]:
        column.no_wrap = False
    for each in rows:
        table.add_row(format_effect_title_with_test(each), each.reason, each.separated_by)
    return table
