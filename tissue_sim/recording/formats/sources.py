"""Read the content of a file of any kind: tables of cells, and runs of rows of numbers in them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.files import decode_text_and_find_encoding, read_bytes
from tissue_sim.recording.formats.blocks import (
    has_mostly_units_in_columns,
    has_only_units_in_columns,
    row_begins_with_word,
)
from tissue_sim.recording.formats.columns import Sheets, validate_delimiter
from tissue_sim.recording.formats.long_text import try_splitting_off_trailing_numbers
from tissue_sim.recording.formats.number_text import is_number_with_either_mark
from tissue_sim.recording.formats.sheets import (
    is_mat_tdms_or_hdf5_file,
    is_workbook,
    read_container_tables_as_sheets,
    read_sheets,
)
from tissue_sim.recording.formats.table import (
    Table,
    TableRow,
    has_same_units_in_trailing_lines,
    move_cell_units_to_unit_row,
    split_text_into_rows,
)
from tissue_sim.recording.formats.vocabulary import classify_size_name
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.units import find_known_unit_or_none, split_header_and_known_unit, split_header_with_brackets

#: Expected content of the file, for messages.
_EXPECTED = "a recording (text, spreadsheet, MATLAB, LabVIEW, HDF5 or AFM)"
#: Delimiters in the order of preference; a comma is late, because it may be a decimal comma.
_DELIMITERS = ("\t", ";", ",", "|", " ")
#: Number of lines that determine the delimiter.
_SAMPLE_LINES = 2000


@dataclass(frozen=True)
class FileContent:
    """Tables of one file, as text, before their interpretation.

    Attributes:
        kind: ``text``, ``workbook`` or ``container``.
        file: path.
        tables: one table of a text (of a long text only the beginning, if numbers alone follow), or one for each sheet.
        encoding: encoding of a text; else None.
    """

    file: Path
    kind: str
    tables: tuple[Table, ...]
    encoding: str | None = None


@dataclass(frozen=True)
class NumberTable:
    """Consecutive rows of numbers with their header and the rows around them.

    Attributes:
        table: table of the rows.
        rows: rows of numbers.
        columns: positions of the columns with numbers, from 0.
        header: row of names; None: no such row.
        units: row of units above or below the names; None: no such row.
        above: rows between the previous numbers, or the start of the table, and the header.
        below: rows below the last numbers of the table; empty for other numbers.
    """

    table: Table
    rows: tuple[TableRow, ...]
    columns: tuple[int, ...]
    header: TableRow | None
    units: TableRow | None
    above: tuple[TableRow, ...] = field(repr=False)
    below: tuple[TableRow, ...] = field(default=(), repr=False)

    @property
    def all_rows_above_in_and_below(self) -> tuple[TableRow, ...]:
        """All rows around and in the table, in the order of the file: above, header, units, numbers, below."""
        names = [row for row in (self.header, self.units) if row is not None]
        return (*self.above, *sorted(names, key=lambda row: row.line), *self.rows, *self.below)

    @property
    def column_count(self) -> int:
        """Number of columns, including columns without numbers."""
        return max(len(row.cells) for row in (self.rows[0], *([self.header] if self.header else [])))

    def get_column_header(self, place: int) -> str:
        """Return the complete header of a column; empty without a header."""
        return self.header.cells[place].lstrip("# ") if self.header and place < len(self.header.cells) else ""

    def get_header_without_unit(self, place: int) -> str:
        """Return the header of a column without the unit."""
        return split_header_and_known_unit(self.get_column_header(place))[0]

    def get_unit_in_header_or_unit_row(self, place: int) -> str | None:
        """Return the unit in the header or in the row of units; an unknown unit is returned without a change."""
        header = self.get_column_header(place)
        loose = split_header_and_known_unit(header)[1]
        below = self.units.cells[place].strip("[]() ") if self.units and place < len(self.units.cells) else None
        return (find_known_unit_or_none(loose or "") or find_known_unit_or_none(below or "")
                or split_header_with_brackets(header)[1]
                or below or None)


def read_file_content(path: Path, *, delimiter: str | None = None, sheet: Sheets | None = None,
                      skip_lines: int = 0) -> FileContent:
    """Read the tables of a file.

    Args:
        path: the file.
        delimiter: delimiter of a text; None: found.
        sheet: name or number (from 1) of a sheet, or a list of names and numbers; None: all.
        skip_lines: number of lines at the top that are ignored.

    Raises:
        InputError: the file does not exist or cannot be read, or a text has no numbers in columns.
    """
    if is_mat_tdms_or_hdf5_file(path) or is_workbook(path):
        kind = "container" if is_mat_tdms_or_hdf5_file(path) else "workbook"
        sheets = read_container_tables_as_sheets(path, sheet) if kind == "container" else read_sheets(path, sheet)
        return FileContent(path, kind, tuple(each.build_table_below_skipped_rows(skip_lines) for each in sheets))
    text, encoding = decode_text_and_find_encoding(read_bytes(path, _EXPECTED), path, _EXPECTED)
    if delimiter is not None:
        validate_delimiter(delimiter)
    beginning, end = try_splitting_off_trailing_numbers(text, skip_lines)
    if end is not None:
        with suppress(InputError):
            table = _split_text_to_table_or_raise(beginning, delimiter, skip_lines, path)
            runs = [*_iterate_runs_of_rows_and_columns(table)]
            # A single run of numbers in all columns, up to the end of the file, needs no further search.
            if table.delimiter == end.delimiter and [columns for _,
                                                     columns in runs] == [(*range(end.cell_count_per_line),)] and (
                    runs[0][0][-1] is table.rows[-1] and has_same_units_in_trailing_lines(table.rows, end)):
                return FileContent(path, "text", (table,), encoding)
    return FileContent(path, "text", (_split_text_to_table_or_raise(text, delimiter, skip_lines, path),), encoding)


def _split_text_to_table_or_raise(text: str, delimiter: str | None, skip_lines: int, path: Path) -> Table:
    """Return the table of a text; the skipped lines become empty, so that line numbers are preserved."""
    lines = text.splitlines()
    lines[:skip_lines] = [""] * min(skip_lines, len(lines))
    found = _find_delimiter_with_most_numbers(lines, path) if delimiter is None else delimiter
    return _split_lines_and_move_units_to_row(lines, found, path)


def _split_lines_and_move_units_to_row(lines: list[str], delimiter: str, path: Path) -> Table:
    """Return the table of lines split at the delimiter; units after the numbers are moved to a row of units."""
    text = "\n".join(lines)
    return Table(move_cell_units_to_unit_row(split_text_into_rows(text, delimiter, file=path), text), delimiter)


def _find_delimiter_with_most_numbers(lines: list[str], path: Path) -> str:
    """Return the delimiter with the largest number of numeric cells minus other cells, in runs of numeric rows.

    Raises:
        InputError: no delimiter gives numbers in columns.
    """
    for sample in (lines[:_SAMPLE_LINES], lines) if len(lines) > _SAMPLE_LINES else (lines,):
        scores = {}
        for delimiter in _DELIMITERS:
            try:
                table = _split_lines_and_move_units_to_row(sample, delimiter, path)
            except InputError:
                continue
            scores[delimiter] = sum(max(score, 1) for _, _, score in _iterate_runs_with_numeric_cell_surplus(table))
            # A blank between digits is a thousands separator if another delimiter gives a table of the same lines.
            if delimiter == " " and scores[delimiter] > max([0, *scores.values()][:-1]) and any(
                    scores.get(other) and _does_delimiter_explain_blanks_in_numbers(
                        sample, other, table, path) for other in _DELIMITERS[:-1]):
                del scores[delimiter]
        # Cells contain blanks, but no tabs: a tab in every line separates, also if a damaged number contains a blank.
        if scores.get("\t") and len({line.count("\t") for line in sample if line.strip()}) == 1:
            scores.pop(" ", None)
        best = max(scores, key=lambda each: scores[each], default=None)
        if best is not None and scores[best]:
            return best
    raise InputError(f"holds no table of numbers: no {MIN_POINTS} lines in a row have two numbers or more, separated "
                     "by tabs, semicolons, commas, bars or blanks", file=path)


def _does_delimiter_explain_blanks_in_numbers(lines: list[str], delimiter: str, blank: Table, path: Path) -> bool:
    """Return whether a delimiter gives at least as many rows of numbers as blanks, with numbers that contain blanks."""
    table = _split_lines_and_move_units_to_row(lines, delimiter, path)
    runs, of_blanks = [*_iterate_runs_of_rows_and_columns(table)], [*_iterate_runs_of_rows_and_columns(blank)]
    grouped = any(" " in cell and is_number_with_either_mark(cell) for run,
                  _ in runs for row in run for cell in row.cells)
    return grouped and sum(len(run) for run, _ in runs) >= sum(len(run) for run, _ in of_blanks)


def list_all_number_tables(source: FileContent) -> list[NumberTable]:
    """Return all tables of numbers in a file: runs of consecutive rows of numbers."""
    return [numbers for table in source.tables for numbers in _iterate_number_tables_of_table(table)]


def _iterate_number_tables_of_table(table: Table) -> Iterator[NumberTable]:
    """Yield each run of consecutive rows of numbers in a table, with its header and the rows around the run."""
    begin = 0
    place = {id(row): i for i, row in enumerate(table.rows)}
    runs = [*_iterate_runs_of_rows_and_columns(table)]
    for number, (run, columns) in enumerate(runs, start=1):
        first = place[id(run[0])]
        above = [row for row in table.rows[begin:first] if re.search(r"\w", "".join(row.cells))]
        begin = place[id(run[-1])] + 1
        header, units, rest = _find_name_row_unit_row_and_count_above(above, columns)
        below = table.rows[begin:] if number == len(runs) else ()
        yield NumberTable(table, tuple(run), columns, header, units, tuple(above[:rest]), tuple(below))


def _find_name_row_unit_row_and_count_above(above: list[TableRow],
                                            columns: Sequence[int]) -> tuple[TableRow | None, TableRow | None, int]:
    """Return the rows of names and of units directly above the numbers, and the number of rows above both."""
    header, units, rest = None, None, len(above)
    for number, row in enumerate(reversed(above[-3:]), start=1):
        named = [i for i in columns if i < len(row.cells) and row.cells[i]
                 and not is_number_with_either_mark(row.cells[i])]
        if units is None and named and (has_only_units_in_columns(row, columns) or (
                header is None and has_mostly_units_in_columns(row, columns) and _does_last_row_name_all_columns(
                    above[:-number], columns))):
            units = row
        elif header is None and not _is_size_statement(row) and 2 * len(named) >= len(columns) and len(named) >= 2:
            header = row
        else:
            break
        rest -= 1
        if header is not None and units is not None:
            break
    return header, units, rest


def _does_last_row_name_all_columns(above: Sequence[TableRow], columns: Sequence[int]) -> bool:
    """Return whether the last of the rows above the numbers has a name for each of the columns."""
    return bool(above) \
        and all(i < len(above[-1].cells) and above[-1].cells[i] and not is_number_with_either_mark(above[-1].cells[i])
                for i in columns)


def _is_size_statement(row: TableRow) -> bool:
    """Return whether a row states a size, such as ``Height 12 mm``, and not names."""
    cells = [cell for cell in row.cells if cell]
    return len(cells) > 1 and is_number_with_either_mark(cells[1]) and classify_size_name(cells[0]) is not None


def _iterate_runs_of_rows_and_columns(table: Table) -> Iterator[tuple[list[TableRow], tuple[int, ...]]]:
    """Yield runs of at least `MIN_POINTS` rows with two or more numbers and little else, and their columns."""
    for run, columns, _ in _iterate_runs_with_numeric_cell_surplus(table):
        yield run, columns


def _iterate_runs_with_numeric_cell_surplus(table: Table) -> Iterator[tuple[list[TableRow], tuple[int, ...], int]]:
    """Yield the runs of `_iterate_runs_of_rows_and_columns` with a score: cells that are numbers minus other cells."""
    run: list[TableRow] = []
    counts: dict[int, int] = {}
    score = 0
    for row in (*table.rows, TableRow(0, ())):
        numeric = [i for i, cell in enumerate(row.cells) if cell and is_number_with_either_mark(cell)]
        filled = sum(map(bool, row.cells))
        if len(numeric) >= 2 and 2 * len(numeric) >= filled:
            run.append(row)
            score += 2 * len(numeric) - filled
            for i in numeric:
                counts[i] = counts.get(i, 0) + 1
            continue
        # Rows such as "Mean, 1.2, 3.4" below the numbers are a summary.
        while len(run) > 1 and row_begins_with_word(run[-1]) and not row_begins_with_word(run[0]):
            run.pop()
        # A column may start late or end early, because replicates side by side differ in length.
        columns = tuple(sorted(i for i, count in counts.items() if count >= MIN_POINTS))
        if len(run) >= MIN_POINTS and len(columns) >= 2:
            yield run, columns, score
        run, counts, score = [], {}, 0
