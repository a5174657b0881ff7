"""Split cells with a number and a unit, ``12.3 N``, into numbers and a row of units above them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from tissue_sim.recording.formats.long_text import TrailingNumberLines
from tissue_sim.recording.formats.number_text import ExactNumber, is_number, split_number_and_unit
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.recording import MIN_POINTS

#: A digit and a following letter, except the letter of an exponent.
_LETTER_AFTER_DIGIT = re.compile(r"\d[ \u00a0\u202f]?(?![eEdD][-+\d])[^\W\d_]|\d\s?[%\u00b0]")


class ExtractedUnitRow(TableRow):
    """Row of units that `extract_cell_units` removed from the cells of numbers below this row."""

    __slots__ = ()


def extract_cell_units(rows: list[TableRow], text: str | None = None) -> list[TableRow]:
    """Remove the units from the cells of columns with one common unit, and insert a row of units above the numbers.

    A column with different units, or with a number without a unit, is unchanged.

    Args:
        rows: rows of a table.
        text: text of all rows; a text without a letter after a digit has no units. None: the text of the cells.
    """
    parts = (text,) if text is not None else (cell for row in rows for cell in row.cells
                                              if not isinstance(cell, ExactNumber))
    if not any(map(_LETTER_AFTER_DIGIT.search, parts)):
        return rows
    found: list[TableRow] = []
    run: list[TableRow] = []
    for row in (*rows, TableRow(0, ())):
        if _are_mostly_quantities(row, begun=bool(run)):
            run.append(row)
            continue
        found += _remove_common_units(run)
        run = []
        found.append(row)
    return found[:-1]


def has_units_of_previous_rows(rows: Sequence[TableRow], end: TrailingNumberLines) -> bool:
    """Return whether trailing number lines have the same units in their cells as the rows above these lines.

    Args:
        rows: rows above the end; see `extract_cell_units`.
        end: lines below the rows.
    """
    last = next((row for row in reversed(rows) if isinstance(row, ExtractedUnitRow)), None)
    return (last.cells if last is not None else ("",) * end.cell_count) == end.units


def _are_mostly_quantities(row: TableRow, *, begun: bool) -> bool:
    """Return whether most cells are numbers and at least one has a unit; `begun`: a unit is not required."""
    filled = [cell for cell in row.cells if cell]
    united = sum(split_number_and_unit(cell) is not None for cell in filled)
    numbers = united + sum(map(is_number, filled))
    return numbers >= 2 and 2 * numbers >= len(filled) and (united > 0 or begun)


def _remove_common_units(run: Sequence[TableRow]) -> Iterable[TableRow]:
    """Return the rows of one table with plain numbers below a row of units; unchanged without a common unit."""
    width = max((len(row.cells) for row in run), default=0)
    units = [_find_common_unit(run, place) for place in range(width)]
    if len(run) < MIN_POINTS or not any(units):
        return run
    plain = []
    for row in run:
        pairs = ((cell, split_number_and_unit(cell) if unit else None) for cell,
                 unit in zip(row.cells, units, strict=False))
        plain.append(TableRow(row.line, tuple(cell if pair is None else pair[0] for cell, pair in pairs)))
    return [ExtractedUnitRow(run[0].line, tuple(units)), *plain]


def _find_common_unit(run: Sequence[TableRow], place: int) -> str:
    """Return the common unit of all numbers of a column; empty without a common unit."""
    units = set()
    for row in run:
        cell = row.cells[place] if place < len(row.cells) else ""
        pair = split_number_and_unit(cell)
        if pair is not None:
            units.add(pair[1])
        elif is_number(cell):
            return ""
    return units.pop() if len(units) == 1 else ""
