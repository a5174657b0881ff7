"""Find the quantities that a file states in lines, small tables, sentences and constant columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from tissue_sim.recording.formats.blocks import has_only_units_in_columns
from tissue_sim.recording.formats.number_text import (
    DECIMAL_MARKS,
    find_thousands_separator_or_empty,
    is_number_with_either_mark,
    parse_number_or_nan,
)
from tissue_sim.recording.formats.sizes import parse_number_and_optional_unit_or_none
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.formats.vocabulary import SENTENCE_WORDS, classify_size_name
from tissue_sim.units import find_known_unit_or_none, split_header_and_known_unit

#: "key: value" or "key = value".
_KEY_VALUE = re.compile(r"^(?P<key>[^:=]{1,80}?)\s*[:=]\s*(?P<value>.*?)\s*[;,]*$")
#: A number, and optionally its uncertainty.
_NUMBER = r"(?P<number>\d+(?:[.,]\d+)?)(?:\s*(?:\u00b1|\+/?-)\s*\d+(?:[.,]\d+)?)?"
#: A unit of length, and optionally a square.
_UNIT = r"(?P<unit>mm|cm|µm|um|m|in|inch)(?P<square>\s*(?:\^2|²|2))?(?![\w/])"
#: Words and signs between the name of a size and its number.
_JOINING_WORDS = r"\s*(?:[:=\u2248~]|of|is|was|about|approx\.?|ca\.?|von|beträgt|de|est)?\s*"
#: "diameter 20 mm", "height of 12 mm". Up to two preceding words belong to the key, because they may name a tool.
_SIZE_BEFORE_NUMBER = re.compile(
    rf"(?P<key>(?:[^\W\d]+\s+){{0,2}}(?:{SENTENCE_WORDS})){_JOINING_WORDS}{_NUMBER}\s*{_UNIT}", re.IGNORECASE)
#: "20 mm in diameter", "12 mm high".
_NUMBER_BEFORE_SIZE = re.compile(
    rf"{_NUMBER}\s*{_UNIT}\s*(?:in\s+|de\s+)?(?P<key>(?:{SENTENCE_WORDS}|high|tall|thick|wide|"
    r"long|hoch|dick|breit|lang)(?:\s+[^\W\d]+)?)", re.IGNORECASE)
#: "Ø 20 x 12 mm": diameter and height.
_DIAMETER_BY_HEIGHT = re.compile(
    r"[Øø⌀]\s*(?P<diameter>\d+(?:[.,]\d+)?)\s*(?:mm|cm)?\s*[x\u00d7]\s*(?P<height>\d+(?:[.,]\d+)?)\s*"
    r"(?P<unit>mm|cm)\b")
#: "20 x 12 mm" and "10 x 10 x 12 mm", without words for the sizes.
_UNNAMED_PRODUCT = re.compile(
    r"\d+(?:[.,]\d+)?\s*(?:mm|cm)?(?:\s*[x\u00d7*]\s*\d+(?:[.,]\d+)?\s*(?:mm|cm)?){1,2}(?<=mm|cm)\b")
#: "diameter x height: 20 x 12 mm".
_NAMED_PRODUCT = re.compile(
    rf"(?P<first>{SENTENCE_WORDS})\s*[x\u00d7*]\s*(?P<second>{SENTENCE_WORDS})[^\d]{{1,20}}?(?P<a>\d+(?:[.,]\d+)?)\s*"
    r"(?:mm|cm)?\s*[x\u00d7*]\s*(?P<b>\d+(?:[.,]\d+)?)\s*(?P<unit>mm|cm)\b", re.IGNORECASE)
#: Key for sizes without names.
DIMENSIONS = "dimensions"
#: A cell that may hold a known or unknown unit.
_UNIT_CELL = re.compile(r"^[\[(]?[^\W\d]{1,10}(\s*(\^2|²|2)|/[^\W\d]{1,5})?[\])]?$")
#: First cell of a row that summarises other rows of a small table.
_SUMMARY_ROW = re.compile(r"^(mean|average|std|sd|stdev|min|max|median|cv|mittelwert|moyenne|standardabweichung)\b",
                          re.IGNORECASE)


@dataclass(frozen=True)
class StatementSettings:
    """Limits of the search for statements.

    Attributes:
        rows_of_numbers: number of rows of numbers whose other columns are searched for statements. A larger value
            finds statements further down and takes longer.
        longest_sentence: largest number of characters of a row that is searched for sentences. Longer rows are
            skipped, because the search time grows with the length.
    """

    rows_of_numbers: int = 60
    longest_sentence: int = 1000


#: Settings that the functions of this module use.
_SETTINGS = StatementSettings()


class FileStatementsByKey(dict[str, str]):
    """Statements of a file: key -> value with unit. Contradictory values of a key have the location in their keys."""

    def add_statement_with_location_if_repeated(self, key: str, value: str, location: str) -> None:
        """Add a statement; `location`, such as ``line 3``, distinguishes another value of an existing key."""
        key, value = " ".join(key.split()), " ".join(value.split())
        if key in self and self[key] != value:
            key = f"{key} ({location})"
        self.setdefault(key, value)


def collect_statements_about_table(numbers: NumberTable, used: Sequence[int], *, decimal: str | None, table: int = 0,
                                   tables: int = 1
                                   ) -> FileStatementsByKey:
    """Return the statements of a file about one table of numbers.

    Args:
        numbers: the table.
        used: positions (from 0) of the columns that are read.
        decimal: decimal mark of the numbers of the file; None: unknown.
        table: number (from 0) of the table; selects the row of a list with `tables` rows.
        tables: number of tables in the file.
    """
    found = FileStatementsByKey()
    add_statements_of_rows(numbers.above, found, decimal, table, tables)
    add_statements_of_rows(numbers.below, found, decimal, table, tables)
    for place, value in iterate_constant_size_columns(numbers):
        if place not in used:
            unit = numbers.get_unit_in_header_or_unit_row(place) or ""
            found.add_statement_with_location_if_repeated(numbers.get_header_without_unit(place),
                                                          f"{_remove_thousands_separator(value, decimal)} {unit}",
                                                          "column")
    for row in (*((numbers.header,) if numbers.header else ()), *numbers.rows[:_SETTINGS.rows_of_numbers]):
        others = TableRow(row.line, tuple(cell for i, cell in enumerate(row.cells) if i not in used))
        for key, value in _iterate_row_statements(others, decimal):
            if classify_size_name(key) is not None:
                found.add_statement_with_location_if_repeated(key, value, f"line {row.line}")
    return found


def add_rows_statements_except_known_sizes(rows: Sequence[TableRow], found: FileStatementsByKey, decimal: str | None,
                                           table: int = 0, tables: int = 1) -> None:
    """Add the statements in rows of other tables and sheets to `found`, except sizes that `found` already has."""
    more = FileStatementsByKey()
    add_statements_of_rows(rows, more, decimal, table, tables)
    stated = {classify_size_name(key) for key in found}
    for key, value in more.items():
        if classify_size_name(key) is None or classify_size_name(key) not in stated:
            found.add_statement_with_location_if_repeated(key, value, "elsewhere")


def do_rows_state_specimen_size(rows: Sequence[TableRow]) -> bool:
    """Return whether rows outside of the numbers state a size of the specimen."""
    found = FileStatementsByKey()
    add_statements_of_rows(rows, found)
    return any(classify_size_name(key) is not None for key in found)


def add_statements_of_rows(rows: Sequence[TableRow], found: FileStatementsByKey, decimal: str | None = None,
                           table: int = 0, tables: int = 1) -> None:
    """Add the statements in rows outside of the numbers to `found`; see `collect_statements_about_table`."""
    used: set[int] = set()
    for i, names in enumerate(rows):
        if _is_size_table_header(names):
            used |= _add_small_table_sizes_and_get_its_rows(rows, i, found, decimal, table, tables)
    for i, row in enumerate(rows):
        if i not in used:
            for key, value in _iterate_row_statements(row, decimal):
                found.add_statement_with_location_if_repeated(key, value, f"line {row.line}")
    for row in rows:
        for key, value in _iterate_sizes_in_sentences(row, decimal):
            # A line "Diameter: 20 mm" also matches the patterns of sentences.
            if not any(classify_size_name(other) == classify_size_name(key)
                       and _has_unit_and_same_number(found[other], value) for other in found):
                found.add_statement_with_location_if_repeated(key, value, f"line {row.line}")


def find_listed_sizes_of_one_recording(rows: Sequence[TableRow], decimal: str | None, table: int,
                                       tables: int) -> FileStatementsByKey:
    """Return the sizes of one recording from lists of sizes with one row for each recording of a file.

    Args:
        rows: rows outside of the numbers.
        decimal: decimal mark; None: unknown.
        table: number (from 0) of the recording.
        tables: number of recordings; a file with one recording has no such list.
    """
    found = FileStatementsByKey()
    for i, names in enumerate(rows):
        if tables > 1 and _is_size_table_header(names) and len(_find_unit_row_value_rows_and_last_row(rows, i)[1]) \
            == tables:
            _add_small_table_sizes_and_get_its_rows(rows, i, found, decimal, table, tables)
    return found


def iterate_constant_size_columns(numbers: NumberTable) -> Iterator[tuple[int, str]]:
    """Yield (position, value) of each column whose name is a size and whose value is the same in all rows."""
    for place in range(numbers.column_count):
        if classify_size_name(numbers.get_header_without_unit(place)) is None:
            continue
        values = {row.cells[place] for row in numbers.rows if place < len(row.cells) and row.cells[place]}
        if len(values) == 1 and is_number_with_either_mark(value := values.pop()):
            yield place, value


def _iterate_row_statements(row: TableRow, decimal: str | None) -> Iterator[tuple[str, str]]:
    """Yield the pairs (key, value) of a row: ``key: value``, ``key;value;unit`` or ``key (unit);value``."""
    cells = [cell for cell in row.cells if cell]
    if not cells:
        return
    numeric = [i for i in range(1, len(cells)) if is_number_with_either_mark(cells[i])
               and not is_number_with_either_mark(cells[i - 1])]
    if len(numeric) > 1 and not _KEY_VALUE.match(cells[0]):
        for i in numeric:
            unit = cells[i + 1] if i + 1 < len(cells) and find_known_unit_or_none(cells[i + 1]) else ""
            yield _move_unit_from_key_to_value(cells[i - 1], f"{_remove_thousands_separator(cells[i], decimal)} {unit}")
        return
    for cell in cells[1:]:
        if (match := _KEY_VALUE.match(cell)) and match["value"]:
            yield _move_unit_from_key_to_value(match["key"], match["value"])
    match = _KEY_VALUE.match(cells[0])
    if match and match["value"]:
        has_unit = (len(cells) > 1 and is_number_with_either_mark(match["value"])
                    and find_known_unit_or_none(cells[1]) is not None)
        unit = cells[1] if has_unit else ""
        yield _move_unit_from_key_to_value(match["key"],
                                           f"{_remove_thousands_separator(match['value'], decimal)} {unit}")
    elif len(cells) >= 2:
        unit = cells[2] if len(cells) > 2 and is_number_with_either_mark(cells[1]) and _UNIT_CELL.match(cells[2]) \
            else ""
        yield _move_unit_from_key_to_value(cells[0].rstrip(" :="),
                                           f"{_remove_thousands_separator(cells[1], decimal)} {unit}")


def _move_unit_from_key_to_value(key: str, value: str) -> tuple[str, str]:
    """Return key and value of a statement; a unit in the key is moved to the end of the value."""
    name, unit = split_header_and_known_unit(key.strip("# "))
    return name, f"{value} {unit}" if unit else value


def _remove_thousands_separator(cell: str, decimal: str | None) -> str:
    """Return a number without its thousands separators, or another cell without a change.

    If the decimal mark is unknown, only blanks and apostrophes are thousands separators.
    """
    for mark in DECIMAL_MARKS if decimal is None else (decimal,):
        separator = find_thousands_separator_or_empty(cell, mark)
        if separator and (decimal is not None or separator not in DECIMAL_MARKS):
            return f"{parse_number_or_nan(cell, mark):.12g}"
    return cell


def _is_size_table_header(row: TableRow) -> bool:
    """Return whether a row is the header of a small table of sizes."""
    cells = [cell for cell in row.cells if cell]
    return len(cells) >= 2 and not any(map(is_number_with_either_mark, cells)) and any(
        classify_size_name(split_header_and_known_unit(cell)[0]) is not None for cell in cells)


def _find_unit_row_value_rows_and_last_row(rows: Sequence[TableRow],
                                           header: int) -> tuple[TableRow | None, list[TableRow], int]:
    """Split the small table below row `header` of `rows`.

    Returns:
        Row of units (None: no such row), rows of values without summaries, and position of the last row of the table.
    """
    places = range(len(rows[header].cells))
    units: TableRow | None = None
    values: list[TableRow] = []
    last = header
    for i in range(header + 1, len(rows)):
        row = rows[i]
        if units is None and not values and has_only_units_in_columns(row, places):
            units = row
        elif any(map(is_number_with_either_mark, row.cells)) and sum(map(bool, row.cells)) >= 2:
            values.append(row)
        else:
            break
        last = i
    values = [row for row in values if not _SUMMARY_ROW.match(next(cell for cell in row.cells if cell))] or values
    return units, values, last


def _add_small_table_sizes_and_get_its_rows(rows: Sequence[TableRow], header: int, found: FileStatementsByKey,
                                            decimal: str | None, table: int, tables: int) -> set[int]:
    """Add the sizes of a small table to `found`, and return the positions of the rows of the small table."""
    units, values, last = _find_unit_row_value_rows_and_last_row(rows, header)
    if not values:
        return set()
    chosen = [values[table]] if len(values) == tables > 1 else values
    for place, cell in enumerate(rows[header].cells):
        name, unit = split_header_and_known_unit(cell)
        if classify_size_name(name) is None:
            continue
        if unit is None and units is not None and place < len(units.cells):
            unit = units.cells[place].strip("[]() ")
        for row in chosen:
            if place < len(row.cells) and is_number_with_either_mark(row.cells[place]):
                value = _remove_thousands_separator(row.cells[place], decimal)
                found.add_statement_with_location_if_repeated(name, f"{value} {unit or ''}", f"line {row.line}")
    return set(range(header, last + 1))


def _iterate_sizes_in_sentences(row: TableRow, decimal: str | None) -> Iterator[tuple[str, str]]:
    """Yield the pairs (name, quantity) of the sizes in running text."""
    cells: Iterable[str] = [cell for cell in row.cells if cell]
    if sum(map(len, cells)) > _SETTINGS.longest_sentence:
        return
    # A blank delimiter splits a sentence into its words; these are joined.
    if all(" " not in cell for cell in cells):
        cells = [" ".join(cells)]
    for cell in cells:
        for match in _DIAMETER_BY_HEIGHT.finditer(cell):
            yield "diameter", f"{match['diameter']} {match['unit']}"
            yield "height", f"{match['height']} {match['unit']}"
        for match in _NAMED_PRODUCT.finditer(cell):
            yield match["first"], f"{match['a']} {match['unit']}"
            yield match["second"], f"{match['b']} {match['unit']}"
        is_named = _DIAMETER_BY_HEIGHT.search(cell) or _NAMED_PRODUCT.search(cell)
        if (unnamed := _UNNAMED_PRODUCT.search(cell)) and not is_named:
            yield DIMENSIONS, cell if len(cell) < 80 else unnamed[0]
        taken: set[int] = set()
        for pattern in (_SIZE_BEFORE_NUMBER, _NUMBER_BEFORE_SIZE):
            for match in pattern.finditer(cell):
                # In "diameter 20 mm height 12 mm" the first number belongs to the first word.
                if match.start("number") not in taken:
                    taken.add(match.start("number"))
                    square = "^2" if match["square"] else ""
                    number = _remove_thousands_separator(match["number"], decimal)
                    yield match["key"].strip(), f"{number} {match['unit']}{square}"


def _has_unit_and_same_number(stated: str, quantity: str) -> bool:
    """Return whether a statement has a unit and the same number as a quantity."""
    first, second = parse_number_and_optional_unit_or_none(stated), parse_number_and_optional_unit_or_none(quantity)
    return first is not None and second is not None and first[1] is not None and first[0] == second[0]


def copy_second_with_missing_sizes(first: Mapping[str, str], second: Mapping[str, str]) -> dict[str, str]:
    """Return the statements of `second`, and the statements of `first` about sizes that `second` lacks."""
    own = {classify_size_name(key) for key in second} | {None}
    return {**{key: value for key, value in first.items() if classify_size_name(key) not in own}, **second}
