"""Find the start of a table: the row of names, or the first row of numbers."""

from __future__ import annotations

import difflib
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.recording.formats.cell_units import move_cell_units_to_unit_row
from tissue_sim.recording.formats.number_text import is_number_with_either_mark
from tissue_sim.recording.formats.table import Table, TableRow, split_text_into_rows
from tissue_sim.units import split_header_and_known_unit, split_header_with_brackets

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
