"""Find blocks of numbers in a table: replicates side by side or below each other, with rows of names and units."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tissue_sim.recording.formats.header import (
    find_positions_of_cells_with_name,
    find_positions_of_each_column_name,
    find_table_first_row_and_rows_of_numbers,
    find_table_header_and_data_rows,
)
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, parse_number_preferring_point_or_nan
from tissue_sim.recording.formats.size_words import classify_size_name
from tissue_sim.recording.formats.table import Table, TableRow
from tissue_sim.units import find_known_unit_or_none, split_header_and_known_unit

#: A word: two letters or more.
_WORD = re.compile(r"[^\W\d_]{2}")
#: A cell that may be a unit by its length.
_SHORT = re.compile(r"^\S{1,8}$")


@dataclass(frozen=True)
class NumberBlockSearchSettings:
    """Settings of the search for blocks.

    Attributes:
        examined_rows: number of rows that determine whether a column has numbers.
        largest_gap: largest step of the first column across a row of text within one table, relative to the previous
            step. A larger value joins more rows to one table.
    """

    examined_rows: int = 50
    largest_gap: float = 5.0


#: Settings that the functions of this module use.
_SETTINGS = NumberBlockSearchSettings()


@dataclass(frozen=True)
class NumberBlock:
    """One table of numbers below a header row.

    Attributes:
        header: row of names; without names the first row of numbers.
        units: row of units below the names; None: no such row.
        rows: rows of numbers.
        places: positions of the requested columns, from 0, in the order of the request.
        below: whether another block with the same columns is above this block.
    """

    header: TableRow
    units: TableRow | None
    rows: tuple[TableRow, ...]
    places: tuple[int, ...]
    below: bool = False

    def find_known_unit_in_unit_row(self, place: int) -> str | None:
        """Return the unit of a column, numbered from 0, in the row of units; None without a known unit."""
        if self.units is None or place >= len(self.units.cells):
            return None
        return find_known_unit_or_none(self.units.cells[place])


def find_table_and_blocks_by_column_names(tables: Iterable[Table], names: Sequence[str], *, also: Sequence[int] = (),
                                          file: Path) -> tuple[Table, list[NumberBlock]]:
    """Return the first table with a row that has all names, and its blocks.

    Each such row starts one block for each repetition of the names. A block ends before the first row of text. A row of
    units below the names is not a row of numbers.

    Args:
        tables: tables that are searched.
        names: names of columns.
        also: positions of further columns, from 0.
        file: path for messages.

    Raises:
        InputError: no row has all names.
    """
    table, header, below = find_table_header_and_data_rows(tables, names, file=file)
    # A row of names has no number in the first column: this test excludes most rows fast.
    place = find_positions_of_cells_with_name(header.cells, names[0])[0]
    headers = [header, *(row for row in below if not _count_numeric_cells(row, (place,))
                         and all(find_positions_of_cells_with_name(row.cells, name) for name in names))]
    blocks: list[NumberBlock] = []
    for number, head in enumerate(headers):
        end = headers[number + 1].line if number + 1 < len(headers) else None
        rows = [row for row in below if row.line > head.line and (end is None or row.line < end)]
        for places in zip(*find_positions_of_each_column_name(head, names, file=file), strict=True):
            wanted = (*places, *also)
            units, data = _split_unit_row_and_numbers(rows, wanted)
            blocks.append(NumberBlock(head, units, tuple(data), wanted, below=number > 0))
    return table, blocks


def find_table_and_blocks_by_column_indices(tables: Iterable[Table], places: Sequence[int], *,
                                            file: Path) -> tuple[Table, list[NumberBlock]]:
    """Return the first table with a row of numbers in the given columns, and its blocks.

    A row without any number ends a block.

    Args:
        tables: tables that are searched.
        places: positions of the columns, from 0.
        file: path for messages.

    Raises:
        InputError: no row has numbers in all columns.
    """
    table, header, rows = find_table_first_row_and_rows_of_numbers(tables, places, file=file)
    runs = [run for run in _split_into_runs_of_numeric_rows(rows, places)
            if any(_count_numeric_cells(row, places) == len(places) for row in run)]
    return table, [NumberBlock(header if i == 0 else run[0], None, tuple(run), tuple(places), below=i > 0)
                   for i, run in enumerate(runs)]


def find_names_of_unread_columns(blocks: Sequence[NumberBlock], used: Collection[int]) -> tuple[str, ...]:
    """Return the names of the columns of numbers that no recording of a table reads.

    A column without a name has its number, from 1. A column that repeats one value and is named after a size states
    the size, and is omitted.

    Args:
        blocks: blocks of the table.
        used: positions of the columns that are read, from 0.
    """
    header, rows = blocks[0].header, blocks[0].rows
    found = []
    for place, name in enumerate(header.cells):
        cells = [row.cells[place] for row in rows[:_SETTINGS.examined_rows]
                 if place < len(row.cells) and row.cells[place]]
        is_size = classify_size_name(split_header_and_known_unit(name)[0]) is not None and len(set(cells)) == 1
        if place not in used and cells and 2 * sum(map(is_number_with_either_mark, cells)) > len(cells) and not is_size:
            found.append(str(place + 1) if not name or is_number_with_either_mark(name) else name)
    return tuple(found)


def _split_unit_row_and_numbers(rows: list[TableRow], places: Sequence[int]) -> tuple[TableRow | None, list[TableRow]]:
    """Return the row of units (None without one), and the rows of numbers."""
    first = next((i for i, row in enumerate(rows) if _count_numeric_cells(row, places)), len(rows))
    units = next((row for row in rows[:first] if has_only_units_in_columns(row, places)), None)
    # Words alone in the first row are a damaged cell, as in any other row; a second row of names is not.
    return units, _get_rows_before_terminating_text_row(rows[first:] if first < len(rows) else rows, places)


def _get_rows_before_terminating_text_row(rows: list[TableRow], places: Sequence[int]) -> list[TableRow]:
    """Return the rows above the first row of text that ends the table.

    A row of text with more rows of the same table below is kept; the reader of its cells reports an error.
    """
    labelled = bool(rows) and row_begins_with_word(rows[0])
    for i, row in enumerate(rows):
        if i and is_text_row_not_damaged_numbers(row, places, labelled=labelled) \
            and not _continues_after_text_row(rows, i, places):
            return rows[:i]
    return rows


def is_text_row_not_damaged_numbers(row: TableRow, places: Sequence[int], *, labelled: bool = False) -> bool:
    """Return whether a row is text, and not a row of numbers with a damaged cell.

    Args:
        row: row below the first row of numbers.
        places: positions of the columns of numbers, from 0.
        labelled: whether the rows of numbers of this table begin with a word.
    """
    numbers = _count_numeric_cells(row, places)
    if numbers == len(places):
        return False
    if numbers == 0 or (not labelled and row_begins_with_word(row)):
        return True
    filled = [cell for cell in row.cells if cell]
    return 2 * sum(map(is_number_with_either_mark, filled)) < len(filled)


def row_begins_with_word(row: TableRow) -> bool:
    """Return whether the first cell with content is a word."""
    first = next((cell for cell in row.cells if cell), "")
    return _WORD.search(first) is not None and not is_number_with_either_mark(first)


def _continues_after_text_row(rows: Sequence[TableRow], text: int, places: Sequence[int]) -> bool:
    """Return whether rows of the same table follow the row of text with index `text`.

    Rows of numbers below a second row of names belong to another table, unless their first column continues evenly.
    """
    named = False
    for row in rows[text:]:
        if _count_numeric_cells(row, places) == len(places):
            return not named or _continues_without_large_step(rows[max(text - 2, 0):text], row, places[0])
        words = sum(place < len(row.cells) and _WORD.search(row.cells[place]) is not None for place in places)
        named = named or (words >= min(2, len(places)) and not has_only_units_in_columns(row, places))
    return False


def _continues_without_large_step(before: Sequence[TableRow], row: TableRow, place: int) -> bool:
    """Return whether the step to `row` has the sign of the last step and at most `largest_gap` times its size."""
    values = [parse_number_preferring_point_or_nan(each.cells[place]) for each in (*before, row) if place
              < len(each.cells)]
    if len(values) < 3:
        return False
    step, gap = values[-2] - values[-3], values[-1] - values[-2]
    return step != 0 and 0 < gap / step <= _SETTINGS.largest_gap


def has_only_units_in_columns(row: TableRow, places: Sequence[int]) -> bool:
    """Return whether all cells with content in the given columns are units; a word in brackets is a unit."""
    cells = [row.cells[place] for place in places if place < len(row.cells) and row.cells[place]]
    return bool(cells) and all(find_known_unit_or_none(cell) or cell[0] in "[(" for cell in cells)


def has_mostly_units_in_columns(row: TableRow, places: Sequence[int]) -> bool:
    """Return whether at least two cells and half of the cells in the given columns are units, others short words."""
    cells = [row.cells[place] for place in places if place < len(row.cells) and row.cells[place]]
    known = sum(find_known_unit_or_none(cell) is not None for cell in cells)
    return known >= max(2, 0.5 * len(cells)) \
        and all(_SHORT.match(cell) and not is_number_with_either_mark(cell) for cell in cells)


def _split_into_runs_of_numeric_rows(rows: Iterable[TableRow], places: Sequence[int]) -> list[list[TableRow]]:
    """Return the runs of rows with numbers in the given columns, separated by rows of text."""
    runs: list[list[TableRow]] = [[]]
    for row in rows:
        if _count_numeric_cells(row, places) and not is_text_row_not_damaged_numbers(row, places):
            runs[-1].append(row)
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]


def _count_numeric_cells(row: TableRow, places: Sequence[int]) -> int:
    """Return in how many of the given columns (from 0) a row has a number."""
    return sum(place < len(row.cells) and is_number_with_either_mark(row.cells[place]) for place in places)
