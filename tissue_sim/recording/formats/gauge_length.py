"""Convert columns by the gauge length: strain to displacement, or displacement to stretch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from tissue_sim.recording.formats.guesses import ColumnGuess, InterpretationOverrides
from tissue_sim.recording.formats.kind_hints import make_hints_from_text_above_and_sheet_name
from tissue_sim.recording.formats.kind_words import find_named_tests
from tissue_sim.recording.formats.sizes import find_sizes_and_speed_in_mm
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.units import get_si_factor_and_offset


def find_gauge_length_and_source_or_none(numbers: NumberTable, statements: Mapping[str, str],
                                         hints: InterpretationOverrides) -> tuple[float, str] | None:
    """Return the gauge length, m, and its source: the user or the file; None: unknown.

    Args:
        numbers: table of numbers.
        statements: statements of the file about these numbers, key -> value with unit.
        hints: hints of the user; `InterpretationOverrides.height` is the gauge length.
    """
    if hints.height is not None:
        return hints.height, "stated"
    kinds = {each.kind for each in find_named_tests(make_hints_from_text_above_and_sheet_name(numbers)) if each.kind}
    kind = hints.kind or (kinds.pop() if len(kinds) == 1 else None)
    size = find_sizes_and_speed_in_mm(statements, kind).get("height_mm")
    return None if size is None or kind is None else (1e-3 * size.value, size.reason)


def make_displacement_column_from_strain(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """Return a column of engineering or shear strain as a displacement in mm, by the gauge length (m, source)."""
    length, source = gauge
    factor = (column.scale or 1.0) * get_si_factor_and_offset(column.unit or "-", "ratio")[0]
    return replace(column, channel="displacement", unit="mm", scale=round(1e3 * length * factor, 9), offset=None,
                   strain_unit=column.unit or "-",
                   reason=f"{_strip_conversion_from_reason(column)}; displacement = strain x {1e3 * length:g} mm "
                   f"({source})")


def make_stretch_column_from_displacement(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """Return a column of displacement as a stretch, by the gauge length (m, source)."""
    length, source = gauge
    factor = (column.scale or 1.0) * get_si_factor_and_offset(column.unit or "m", "length")[0]
    return replace(column, channel="stretch", unit="-", scale=factor / length, offset=1.0,
                   reason=f"{_strip_conversion_from_reason(column)}; stretch = 1 + displacement / {1e3 * length:g} mm "
                   f"({source})")


def _strip_conversion_from_reason(column: ColumnGuess) -> str:
    """Return the reason of a column guess without the sentence about its earlier conversion by the gauge length."""
    return column.reason.split("; a strain, ")[0]


def is_converted_by_gauge_length(column: ColumnGuess) -> bool:
    """Return whether the channel of a column was computed with the gauge length (strain <-> displacement)."""
    return (column.channel, column.role) in (("displacement", "strain"), ("displacement", "shear strain"),
                                             ("stretch", "displacement"))


def uses_gauge_length(columns: Sequence[ColumnGuess]) -> bool:
    """Return whether one of the columns was converted by the gauge length."""
    return any(is_converted_by_gauge_length(column) for column in columns)
