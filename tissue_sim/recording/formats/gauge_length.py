"""Convert columns by the gauge length: strain to displacement, or displacement to stretch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from tissue_sim.recording.formats.guesses import ColumnGuess, ColumnHints
from tissue_sim.recording.formats.kind_hints import title_hints
from tissue_sim.recording.formats.kind_words import named_tests
from tissue_sim.recording.formats.sizes import find_sizes
from tissue_sim.recording.formats.sources import Numbers
from tissue_sim.units import to_si


def gauge_length(numbers: Numbers, statements: Mapping[str, str], stated: ColumnHints) -> tuple[float, str] | None:
    """Length to which strains refer, m, and its source: stated by the user, or in the file; None: not known.

    Args:
        statements: key -> value with unit, as the file states them about these numbers.
    """
    if stated.height is not None:
        return stated.height, "stated"
    kinds = {each.kind for each in named_tests(title_hints(numbers)) if each.kind}
    kind = stated.kind or (kinds.pop() if len(kinds) == 1 else None)
    size = find_sizes(statements, kind).get("height_mm")
    return None if size is None or kind is None else (1e-3 * size.value, size.reason)


def displacement_of_strain(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """The displacement, in mm, of a column of engineering (or shear) strain."""
    length, source = gauge
    factor = (column.scale or 1.0) * to_si(column.unit or "-", "ratio")[0]
    return replace(column, channel="displacement", unit="mm", scale=round(1e3 * length * factor, 9), offset=None,
                   strain_unit=column.unit or "-",
                   reason=f"{_first(column)}; displacement = strain x {1e3 * length:g} mm ({source})")


def stretch_of_displacement(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """The stretch of a column of displacement with a unit of length."""
    length, source = gauge
    factor = (column.scale or 1.0) * to_si(column.unit or "m", "length")[0]
    return replace(column, channel="stretch", unit="-", scale=factor / length, offset=1.0,
                   reason=f"{_first(column)}; stretch = 1 + displacement / {1e3 * length:g} mm ({source})")


def _first(column: ColumnGuess) -> str:
    """Return the reason of a column without the replaced conversion."""
    return column.reason.split("; a strain, ")[0]


def is_derived(column: ColumnGuess) -> bool:
    """Return whether the gauge length makes the channel of a column from another quantity."""
    return (column.channel, column.role) in (("displacement", "strain"), ("displacement", "shear strain"),
                                             ("stretch", "displacement"))


def uses_gauge_length(columns: Sequence[ColumnGuess]) -> bool:
    """Return whether one of the columns is derived."""
    return any(is_derived(column) for column in columns)
