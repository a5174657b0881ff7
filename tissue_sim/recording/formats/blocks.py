"""Find the header of a table and its blocks of numbers: replicates side by side or below each other.

A table starts with a row of names, with or without a row of units, or with the first row of numbers.
"""

from __future__ import annotations

import difflib
import io
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, parse_number_preferring_point_or_nan
from tissue_sim.recording.formats.table import Table, TableRow, move_cell_units_to_unit_row, split_text_into_rows
from tissue_sim.recording.formats.vocabulary import classify_size_name
from tissue_sim.units import find_known_unit_or_none, split_header_and_known_unit, split_header_with_brackets

#: A letter.
_LETTER = re.compile(r"[^\W\d_]")
#: Delimiters in the order of preference.
DELIMITERS = (",", ";", "\t")
#: Delimiters for columns without names: the comma is the last one, because it may be a decimal comma.
DELIMITERS_OF_NUMBERS = ("\t", ";", ",")


def iterate_table_for_each_delimiter(text: str, *, file: Path, skip_lines: int = 0,
                                     delimiters: Sequence[str] = DELIMITERS) -> Iterator[Table]:
    """Yield the table of a text for each delimiter; skipped lines count in the line numbers."""
    content = list(io.StringIO(text, newline=None))
    kept = "\n" * min(skip_lines, len(content)) + "".join(content[skip_lines:])
    for delimiter in delimiters:
        yield Table(move_cell_units_to_unit_row(split_text_into_rows(kept, delimiter, file=file), kept), delimiter)


def find_table_header_and_data_rows(tables: Iterable[Table], names: Sequence[str], *,
                                    file: Path) -> tuple[Table, TableRow, list[TableRow]]:
    """Return the first table with all named columns, its header row and its data rows.

    Raises:
        InputError: no such row; names the missing column and the nearest one in the file.
    """
    closest, delimiters = None, []
    lettered = any(_LETTER.search(name) for name in names)
    for table in tables:
        delimiters.append(table.delimiter)
        for i, row in enumerate(table.rows):
            # Most rows of a long table are numbers, which match no name.
            if lettered and closest is not None and not _LETTER.search("".join(row.cells)):
                continue
            # numpy.savetxt writes its header as a comment.
            row = TableRow(row.line, (row.cells[0].lstrip("# "), *row.cells[1:]))
            found = [find_positions_of_cells_with_name(row.cells, name) for name in names]
            if all(found):
                find_positions_of_each_column_name(row, names, file=file)
                return table, TableRow(row.line,
                                       strip_empty_trailing_cells(row.cells)), _remove_comment_rows(table.rows[i + 1:])
            # The error is about the most similar row: most matches, then a header directly above numbers.
            above_numbers = (i + 1 < len(table.rows) and _has_only_numbers_or_empty_cells(table.rows[i + 1])
                             and not _has_only_numbers_or_empty_cells(row))
            score = (sum(map(bool, found)), above_numbers, len(row.cells) if above_numbers else 0)
            if closest is None or score > closest[0]:
                closest = (score, row)
    raise _make_missing_column_error(closest, names, file, delimiters)


def find_table_first_row_and_rows_of_numbers(tables: Iterable[Table], places: Sequence[int], *,
                                             file: Path) -> tuple[Table, TableRow, list[TableRow]]:
    """Return the first table with numbers in all `places` (from 0), the first such row, and all rows from it.

    Raises:
        InputError: no such row; names the columns.
    """
    for table in tables:
        for i, row in enumerate(table.rows):
            if all(place < len(row.cells) and is_number_with_either_mark(row.cells[place]) for place in places):
                return table, TableRow(row.line,
                                       strip_empty_trailing_cells(row.cells)), _remove_comment_rows(table.rows[i:])
    wanted = ", ".join(str(place + 1) for place in places)
    raise InputError(f"no row has a number in each of the columns {wanted}; check the numbers of the columns",
                     file=file)


def find_positions_of_each_column_name(row: TableRow, names: Sequence[str], *, file: Path) -> list[list[int]]:
    """Return the positions of each name in a row with all names: one for each of the replicates side by side.

    Raises:
        InputError: a name occurs more often than another one.
    """
    found = [find_positions_of_cells_with_name(row.cells, name) for name in names]
    for name, places in zip(names, found, strict=True):
        if len(places) != min(map(len, found)):
            raise InputError(f"column {name!r} appears twice; remove or rename one, or give its number as column",
                             file=file, line=row.line)
    return found


def find_positions_of_cells_with_name(cells: Sequence[str], name: str) -> list[int]:
    """Return the positions of the cells that equal `name`, or else of those that are `name` followed by a unit."""
    def casefold_and_collapse_blanks(text: str) -> str:
        """Return a text in lower case with single blanks."""
        return " ".join(text.casefold().split())

    wanted = casefold_and_collapse_blanks(name)
    exact = [i for i, cell in enumerate(cells) if casefold_and_collapse_blanks(cell) == wanted]
    return exact or [i for i, cell in enumerate(cells)
                     if cell and wanted in (casefold_and_collapse_blanks(split_header_with_brackets(cell)[0]),
                                            casefold_and_collapse_blanks(split_header_and_known_unit(cell)[0]))]


def strip_empty_trailing_cells(cells: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cells of a row without the empty cells at its end."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _remove_comment_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    """Return the rows whose first cell does not begin with ``#``."""
    return [row for row in rows if not row.cells[0].startswith("#")]


def _has_only_numbers_or_empty_cells(row: TableRow) -> bool:
    """Return whether all cells with content are numbers; True for a row without content."""
    return all(is_number_with_either_mark(cell) for cell in row.cells if cell)


def _make_missing_column_error(closest, names, file, delimiters) -> InputError:
    """Return the error for a table without the named columns; it names the most similar row and header."""
    if closest is None:
        return InputError(f"no lines remain, expected a header with {names[0]!r}; skip fewer lines", file=file)
    (found, above_numbers, _), row = closest
    missing, *others = (name for name in names if not find_positions_of_cells_with_name(row.cells, name))
    also = f" (nor {', '.join(map(repr, others))})" if others else ""
    cells = [cell for cell in row.cells if cell and not is_number_with_either_mark(cell)]
    if found or (above_numbers and len(row.cells) > 1):
        bare = {split_header_with_brackets(cell)[0].casefold(): cell for cell in cells}
        close = difflib.get_close_matches(split_header_with_brackets(missing)[0].casefold(), bare, n=1)
        if close:
            hint = f"; did you mean {bare[close[0]]!r}?"
        else:
            hint = (make_hint_with_similar_or_known_words(missing, cells) if cells
                    else ": this row has numbers only; add a line with names above it")
        return InputError(f"no column {missing!r}{also}{hint}", file=file, line=row.line)
    if None in delimiters:
        return InputError(f"no row with the column {missing!r}, expected a header row above the numbers; without a "
                          'header, give columns by number: { column = "C", unit = "mm" }', file=file)
    cut = "commas, semicolons or tabs (or state the delimiter)" if len(delimiters) > 1 else repr(delimiters[0])
    return InputError(f"no row with the column {missing!r}, expected a header line and cells separated by {cut}; "
                      'without a header, give columns by number: { column = 3, unit = "mm" }', file=file)


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
