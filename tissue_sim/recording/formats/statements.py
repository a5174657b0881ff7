"""Quantities that a file states outside of its numbers: in lines, small tables, sentences and constant columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from tissue_sim.recording.formats.blocks import is_unit_row
from tissue_sim.recording.formats.number_text import DECIMAL_MARKS, is_number, parse_number, thousands_separator
from tissue_sim.recording.formats.size_words import SENTENCE_WORDS, size_class
from tissue_sim.recording.formats.sizes import quantity_in
from tissue_sim.recording.formats.sources import Numbers
from tissue_sim.recording.formats.table import Row
from tissue_sim.units import known_unit, loose_header

_PAIR = re.compile(r"^(?P<key>[^:=]{1,80}?)\s*[:=]\s*(?P<value>.*?)\s*[;,]*$")
_NUMBER = r"(?P<number>\d+(?:[.,]\d+)?)(?:\s*(?:\u00b1|\+/?-)\s*\d+(?:[.,]\d+)?)?"
_UNIT = r"(?P<unit>mm|cm|µm|um|m|in|inch)(?P<square>\s*(?:\^2|²|2))?(?![\w/])"
_JOINED = r"\s*(?:[:=\u2248~]|of|is|was|about|approx\.?|ca\.?|von|beträgt|de|est)?\s*"
#: "diameter 20 mm", "height of 12 mm", with up to two words before that may name a tool.
_WORD_FIRST = re.compile(rf"(?P<key>(?:[^\W\d]+\s+){{0,2}}(?:{SENTENCE_WORDS})){_JOINED}{_NUMBER}\s*{_UNIT}",
                         re.IGNORECASE)
#: "20 mm in diameter", "12 mm high".
_NUMBER_FIRST = re.compile(rf"{_NUMBER}\s*{_UNIT}\s*(?:in\s+|de\s+)?(?P<key>(?:{SENTENCE_WORDS}|high|tall|thick|wide|"
                           r"long|hoch|dick|breit|lang)(?:\s+[^\W\d]+)?)", re.IGNORECASE)
#: "Ø 20 x 12 mm": diameter and height.
_ROUND = re.compile(r"[Øø⌀]\s*(?P<diameter>\d+(?:[.,]\d+)?)\s*(?:mm|cm)?\s*[x\u00d7]\s*(?P<height>\d+(?:[.,]\d+)?)\s*"
                    r"(?P<unit>mm|cm)\b")
#: "20 x 12 mm" and "10 x 10 x 12 mm", without words for the sizes.
_UNNAMED = re.compile(r"\d+(?:[.,]\d+)?\s*(?:mm|cm)?(?:\s*[x\u00d7*]\s*\d+(?:[.,]\d+)?\s*(?:mm|cm)?){1,2}(?<=mm|cm)\b")
#: "diameter x height: 20 x 12 mm".
_NAMED_PRODUCT = re.compile(
    rf"(?P<first>{SENTENCE_WORDS})\s*[x\u00d7*]\s*(?P<second>{SENTENCE_WORDS})[^\d]{{1,20}}?(?P<a>\d+(?:[.,]\d+)?)\s*"
    r"(?:mm|cm)?\s*[x\u00d7*]\s*(?P<b>\d+(?:[.,]\d+)?)\s*(?P<unit>mm|cm)\b", re.IGNORECASE)
#: Key of sizes that no word names.
DIMENSIONS = "dimensions"
#: A cell that may hold a unit, known or not.
_UNIT_CELL = re.compile(r"^[\[(]?[^\W\d]{1,10}(\s*(\^2|²|2)|/[^\W\d]{1,5})?[\])]?$")
#: Rows of a small table that summarise others.
_SUMMARY = re.compile(r"^(mean|average|std|sd|stdev|min|max|median|cv|mittelwert|moyenne|standardabweichung)\b",
                      re.IGNORECASE)


@dataclass(frozen=True)
class StatementSettings:
    """Limits of the search for statements.

    Attributes:
        rows_of_numbers: rows of numbers that are searched for statements outside of the columns of a table.
        longest_sentence: largest number of characters of a row that is searched for sentences.
    """

    rows_of_numbers: int = 60
    longest_sentence: int = 1000


#: Settings that the functions of this module use.
_SETTINGS = StatementSettings()


class Statements(dict[str, str]):
    """Key -> value with unit. A key that comes again with another value is kept under its line."""

    def add(self, key: str, value: str, place: str) -> None:
        """Keep a statement; `place` tells it from another one with the same key."""
        key, value = " ".join(key.split()), " ".join(value.split())
        if key in self and self[key] != value:
            key = f"{key} ({place})"
        self.setdefault(key, value)


def table_statements(numbers: Numbers, used: Sequence[int], *, decimal: str | None, table: int = 0, tables: int = 1
                     ) -> Statements:
    """Return the statements of a file about one table of numbers.

    Args:
        numbers: the table. used: places from 0 of the columns that are read.
        decimal: decimal mark of the numbers of the file; None: the numbers do not show it.
        table: number from 0 of it among `tables` of the file, which chooses the row of a summary with as many rows.
    """
    found = Statements()
    row_statements(numbers.above, found, decimal, table, tables)
    row_statements(numbers.below, found, decimal, table, tables)
    for place, value in constant_columns(numbers):
        if place not in used:
            found.add(numbers.bare_name(place), f"{_canonical(value, decimal)} {numbers.unit(place) or ''}", "column")
    for row in (*((numbers.header,) if numbers.header else ()), *numbers.rows[:_SETTINGS.rows_of_numbers]):
        others = Row(row.line, tuple(cell for i, cell in enumerate(row.cells) if i not in used))
        for key, value in _pairs(others, decimal):
            if size_class(key) is not None:
                found.add(key, value, f"line {row.line}")
    return found


def add_unstated(rows: Sequence[Row], found: Statements, decimal: str | None, table: int = 0, tables: int = 1) -> None:
    """Add what rows of other tables and sheets state, but no size that is stated already."""
    more = Statements()
    row_statements(rows, more, decimal, table, tables)
    stated = {size_class(key) for key in found}
    for key, value in more.items():
        if size_class(key) is None or size_class(key) not in stated:
            found.add(key, value, "elsewhere")


def states_sizes(rows: Sequence[Row]) -> bool:
    """Return whether rows outside of the numbers state a size of the specimen."""
    found = Statements()
    row_statements(rows, found)
    return any(size_class(key) is not None for key in found)


def row_statements(rows: Sequence[Row], found: Statements, decimal: str | None = None, table: int = 0,
                   tables: int = 1) -> None:
    """Add what rows outside of the numbers state."""
    used: set[int] = set()
    for i, names in enumerate(rows):
        if _names_sizes(names):
            used |= _add_sizes(rows, i, found, decimal, table, tables)
    for i, row in enumerate(rows):
        if i not in used:
            for key, value in _pairs(row, decimal):
                found.add(key, value, f"line {row.line}")
    for row in rows:
        for key, value in _sentences(row, decimal):
            # A line "Diameter: 20 mm" is a sentence too.
            if not any(size_class(other) == size_class(key) and _same(found[other], value) for other in found):
                found.add(key, value, f"line {row.line}")


def listed_sizes(rows: Sequence[Row], decimal: str | None, table: int, tables: int) -> Statements:
    """The sizes of recording `table` (from 0) in small tables that have one row for each of the recordings of a file.

    Args:
        rows: outside of the numbers. tables: number of recordings; one has no such list.
    """
    found = Statements()
    for i, names in enumerate(rows):
        if tables > 1 and _names_sizes(names) and len(_small_table(rows, i)[1]) == tables:
            _add_sizes(rows, i, found, decimal, table, tables)
    return found


def constant_columns(numbers: Numbers) -> Iterator[tuple[int, str]]:
    """(place, value) of each column that is named after a size and holds the same value in all its rows."""
    for place in range(numbers.width):
        if size_class(numbers.bare_name(place)) is None:
            continue
        values = {row.cells[place] for row in numbers.rows if place < len(row.cells) and row.cells[place]}
        if len(values) == 1 and is_number(value := values.pop()):
            yield place, value


def _pairs(row: Row, decimal: str | None) -> Iterator[tuple[str, str]]:
    """``key: value``, ``key;value;unit`` or ``key (unit);value``, several in a row."""
    cells = [cell for cell in row.cells if cell]
    if not cells:
        return
    numeric = [i for i in range(1, len(cells)) if is_number(cells[i]) and not is_number(cells[i - 1])]
    if len(numeric) > 1 and not _PAIR.match(cells[0]):
        for i in numeric:
            unit = cells[i + 1] if i + 1 < len(cells) and known_unit(cells[i + 1]) else ""
            yield _pair(cells[i - 1], f"{_canonical(cells[i], decimal)} {unit}")
        return
    for cell in cells[1:]:
        if (match := _PAIR.match(cell)) and match["value"]:
            yield _pair(match["key"], match["value"])
    match = _PAIR.match(cells[0])
    if match and match["value"]:
        unit = cells[1] if len(cells) > 1 and is_number(match["value"]) and known_unit(cells[1]) else ""
        yield _pair(match["key"], f"{_canonical(match['value'], decimal)} {unit}")
    elif len(cells) >= 2:
        unit = cells[2] if len(cells) > 2 and is_number(cells[1]) and _UNIT_CELL.match(cells[2]) else ""
        yield _pair(cells[0].rstrip(" :="), f"{_canonical(cells[1], decimal)} {unit}")


def _pair(key: str, value: str) -> tuple[str, str]:
    name, unit = loose_header(key.strip("# "))
    return name, f"{value} {unit}" if unit else value


def _canonical(cell: str, decimal: str | None) -> str:
    """A number with thousands separators without them; any other cell as it is.

    Where the decimal mark of the file is not known, only blanks and apostrophes separate thousands.
    """
    for mark in DECIMAL_MARKS if decimal is None else (decimal,):
        separator = thousands_separator(cell, mark)
        if separator and (decimal is not None or separator not in DECIMAL_MARKS):
            return f"{parse_number(cell, mark):.12g}"
    return cell


def _names_sizes(row: Row) -> bool:
    cells = [cell for cell in row.cells if cell]
    return len(cells) >= 2 and not any(map(is_number, cells)) and any(
        size_class(loose_header(cell)[0]) is not None for cell in cells)


def _small_table(rows: Sequence[Row], header: int) -> tuple[Row | None, list[Row], int]:
    """The row of units, the rows of values and the last row of the small table below a row of names."""
    places = range(len(rows[header].cells))
    units: Row | None = None
    values: list[Row] = []
    last = header
    for i in range(header + 1, len(rows)):
        row = rows[i]
        if units is None and not values and is_unit_row(row, places):
            units = row
        elif any(map(is_number, row.cells)) and sum(map(bool, row.cells)) >= 2:
            values.append(row)
        else:
            break
        last = i
    values = [row for row in values if not _SUMMARY.match(next(cell for cell in row.cells if cell))] or values
    return units, values, last


def _add_sizes(rows: Sequence[Row], header: int, found: Statements, decimal: str | None, table: int, tables: int
               ) -> set[int]:
    """Add the sizes in the rows below a row of names; returns the rows that belong to the small table."""
    units, values, last = _small_table(rows, header)
    if not values:
        return set()
    chosen = [values[table]] if len(values) == tables > 1 else values
    for place, cell in enumerate(rows[header].cells):
        name, unit = loose_header(cell)
        if size_class(name) is None:
            continue
        if unit is None and units is not None and place < len(units.cells):
            unit = units.cells[place].strip("[]() ")
        for row in chosen:
            if place < len(row.cells) and is_number(row.cells[place]):
                found.add(name, f"{_canonical(row.cells[place], decimal)} {unit or ''}", f"line {row.line}")
    return set(range(header, last + 1))


def _sentences(row: Row, decimal: str | None) -> Iterator[tuple[str, str]]:
    """Sizes with units in running text."""
    cells: Iterable[str] = [cell for cell in row.cells if cell]
    if sum(map(len, cells)) > _SETTINGS.longest_sentence:
        return
    # Text that is cut at its blanks is put together again.
    if all(" " not in cell for cell in cells):
        cells = [" ".join(cells)]
    for cell in cells:
        for match in _ROUND.finditer(cell):
            yield "diameter", f"{match['diameter']} {match['unit']}"
            yield "height", f"{match['height']} {match['unit']}"
        for match in _NAMED_PRODUCT.finditer(cell):
            yield match["first"], f"{match['a']} {match['unit']}"
            yield match["second"], f"{match['b']} {match['unit']}"
        if (unnamed := _UNNAMED.search(cell)) and not _ROUND.search(cell) and not _NAMED_PRODUCT.search(cell):
            yield DIMENSIONS, cell if len(cell) < 80 else unnamed[0]
        taken: set[int] = set()
        for pattern in (_WORD_FIRST, _NUMBER_FIRST):
            for match in pattern.finditer(cell):
                # In "diameter 20 mm height 12 mm" the first number belongs to the first word.
                if match.start("number") not in taken:
                    taken.add(match.start("number"))
                    square = "^2" if match["square"] else ""
                    yield match["key"].strip(), f"{_canonical(match['number'], decimal)} {match['unit']}{square}"


def _same(stated: str, quantity: str) -> bool:
    """Return whether a statement is the same quantity, with a unit."""
    first, second = quantity_in(stated), quantity_in(quantity)
    return first is not None and second is not None and first[1] is not None and first[0] == second[0]


def merged(first: Mapping[str, str], second: Mapping[str, str]) -> dict[str, str]:
    """The statements of `second`, and those of `first` about sizes that `second` does not state."""
    own = {size_class(key) for key in second} | {None}
    return {**{key: value for key, value in first.items() if size_class(key) not in own}, **second}
