"""Numbers with a unit in their cell, ``12.3 N``: the numbers, and a row of units above them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from tissue_sim.recording.formats.number_text import ExactNumber, is_number
from tissue_sim.recording.formats.table import Row
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.units import known_unit

#: A digit, and a letter that is not that of an exponent.
_LETTER_AFTER_DIGIT = re.compile(r"\d[ \u00a0\u202f]?(?![eEdD][-+\d])[^\W\d_]|\d\s?[%\u00b0]")
_QUANTITY = re.compile(r"(?P<number>[-+\u2212]?[\d.,](?:[\d.,'\u2019\u00a0\u202f\u2009 ]*[\d.,])?(?:[eEdD][-+]?\d+)?)"
                       r"\s*(?P<unit>[\[(]?(?:[^\W\d_]\S*|%|\u00b0C)[\])]?)")


class CellUnits(Row):
    """Row of units that were removed from the cells below."""

    __slots__ = ()


def split_quantity(cell: str) -> tuple[str, str] | None:
    """The number and the name of the unit in a cell, ``("12.3", "N")``; None: not a number with a known unit."""
    match = _QUANTITY.fullmatch(cell)
    unit = None if match is None else known_unit(match["unit"])
    if match is None or unit is None or not is_number(match["number"]):
        return None
    return match["number"], unit


def without_cell_units(rows: list[Row], text: str | None = None) -> list[Row]:
    """The rows with plain numbers in columns whose cells have one unit, and a row of these units above the numbers.

    Columns with different units in their cells, or with a number without a unit, stay as they are.

    Args:
        rows: of a table.
        text: of all rows; one without a letter behind a digit is not searched. None: that of the cells.
    """
    parts = (text,) if text is not None else (cell for row in rows for cell in row.cells
                                              if not isinstance(cell, ExactNumber))
    if not any(map(_LETTER_AFTER_DIGIT.search, parts)):
        return rows
    found: list[Row] = []
    run: list[Row] = []
    for row in (*rows, Row(0, ())):
        if _is_of_quantities(row, begun=bool(run)):
            run.append(row)
            continue
        found += _plain(run)
        run = []
        found.append(row)
    return found[:-1]


def _is_of_quantities(row: Row, *, begun: bool) -> bool:
    """Return whether most cells are numbers, and at least one has a unit; `begun` rows may have lost their units."""
    filled = [cell for cell in row.cells if cell]
    united = sum(split_quantity(cell) is not None for cell in filled)
    numbers = united + sum(map(is_number, filled))
    return numbers >= 2 and 2 * numbers >= len(filled) and (united > 0 or begun)


def _plain(run: Sequence[Row]) -> Iterable[Row]:
    """Return the rows of one table with plain numbers below a row of units; unchanged without a common unit."""
    width = max((len(row.cells) for row in run), default=0)
    units = [_unit_of(run, place) for place in range(width)]
    if len(run) < MIN_POINTS or not any(units):
        return run
    plain = []
    for row in run:
        pairs = ((cell, split_quantity(cell) if unit else None) for cell, unit in zip(row.cells, units, strict=False))
        plain.append(Row(row.line, tuple(cell if pair is None else pair[0] for cell, pair in pairs)))
    return [CellUnits(run[0].line, tuple(units)), *plain]


def _unit_of(run: Sequence[Row], place: int) -> str:
    """Return the common unit of all numbers of a column; empty without a common unit."""
    units = set()
    for row in run:
        cell = row.cells[place] if place < len(row.cells) else ""
        pair = split_quantity(cell)
        if pair is not None:
            units.add(pair[1])
        elif is_number(cell):
            return ""
    return units.pop() if len(units) == 1 else ""
