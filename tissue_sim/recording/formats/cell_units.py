"""Split cells with a number and a unit, ``12.3 N``, into numbers and a row of units above them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from tissue_sim.recording.formats.long_text import TrailingNumberLines
from tissue_sim.recording.formats.number_text import (
    TextOfNumericCell,
    is_number_with_either_mark,
    split_number_and_unit,
)
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.recording import MIN_POINTS

#: A digit and a following letter, except the letter of an exponent.
_LETTER_AFTER_DIGIT = re.compile(r"\d[ \u00a0\u202f]?(?![eEdD][-+\d])[^\W\d_]|\d\s?[%\u00b0]")


class UnitRowExtractedFromCells(TableRow):
    """Row of units that `move_cell_units_to_unit_row` removed from the cells of numbers below this row."""

    __slots__ = ()


def move_cell_units_to_unit_row(rows: list[TableRow], text: str | None = None) -> list[TableRow]:
    """Remove the units from the cells of columns with one common unit, and insert a row of units above the numbers.

    A column with different units, or with a number without a unit, is unchanged.

    Args:
        rows: rows of a table.
        text: text of all rows; a text without a letter after a digit has no units. None: the text of the cells.
    """
    parts = (text,) if text is not None else (cell for row in rows for cell in row.cells
                                              if not isinstance(cell, TextOfNumericCell))
    if not any(map(_LETTER_AFTER_DIGIT.search, parts)):
        return rows
    found: list[TableRow] = []
    run: list[TableRow] = []
    for row in (*rows, TableRow(0, ())):
        if _has_mostly_numbers_some_with_units(row, begun=bool(run)):
            run.append(row)
            continue
        if run:
            found += _move_common_units_to_unit_row(run)
            run = []
        found.append(row)
    return found[:-1]


def has_same_units_in_trailing_lines(rows: Sequence[TableRow], end: TrailingNumberLines) -> bool:
    """Return whether trailing number lines have the same units in their cells as the rows above these lines.

    Args:
        rows: rows above the end; see `move_cell_units_to_unit_row`.
        end: lines below the rows.
    """
    last = next((row for row in reversed(rows) if isinstance(row, UnitRowExtractedFromCells)), None)
    return (last.cells if last is not None else ("",) * end.cell_count_per_line) == end.units


def _has_mostly_numbers_some_with_units(row: TableRow, *, begun: bool) -> bool:
    """Return whether most cells are numbers and at least one has a unit; `begun`: a unit is not required."""
    filled = [cell for cell in row.cells if cell]
    united = sum(split_number_and_unit(cell) is not None for cell in filled)
    if not united and not begun:
        return False
    numbers = united + sum(map(is_number_with_either_mark, filled))
    return numbers >= 2 and 2 * numbers >= len(filled)


def _move_common_units_to_unit_row(run: Sequence[TableRow]) -> Iterable[TableRow]:
    """Return the rows of one table with plain numbers below a row of units; unchanged without a common unit."""
    width = max((len(row.cells) for row in run), default=0)
    units = [_find_common_unit_or_empty_text(run, place) for place in range(width)]
    if len(run) < MIN_POINTS or not any(units):
        return run
    plain = []
    for row in run:
        pairs = ((cell, split_number_and_unit(cell) if unit else None) for cell,
                 unit in zip(row.cells, units, strict=False))
        plain.append(TableRow(row.line, tuple(cell if pair is None else pair[0] for cell, pair in pairs)))
    return [UnitRowExtractedFromCells(run[0].line, tuple(units)), *plain]


def _find_common_unit_or_empty_text(run: Sequence[TableRow], place: int) -> str:
    """Return the common unit of all numbers of a column; empty without a common unit."""
    units = set()
    for row in run:
        cell = row.cells[place] if place < len(row.cells) else ""
        pair = split_number_and_unit(cell)
        if pair is not None:
            units.add(pair[1])
        elif is_number_with_either_mark(cell):
            return ""
    return units.pop() if len(units) == 1 else ""
