"""What stands in a file of whatever kind, before anybody knows what it means: tables of cells, and numbers in them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.files import decode_text, read_bytes
from tissue_sim.recording.formats.blocks import begins_with_word, is_mostly_units, is_unit_row
from tissue_sim.recording.formats.cell_units import without_cell_units
from tissue_sim.recording.formats.columns import Sheets, check_delimiter
from tissue_sim.recording.formats.containers import is_container, read_container
from tissue_sim.recording.formats.long_text import split_long
from tissue_sim.recording.formats.number_text import is_number
from tissue_sim.recording.formats.size_words import size_class
from tissue_sim.recording.formats.table import Row, Table, split_rows
from tissue_sim.recording.formats.workbook import is_workbook, read_sheets
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.units import known_unit, loose_header, split_header

EXPECTED = "a recording (text, spreadsheet, MATLAB, LabVIEW, HDF5 or AFM)"
#: The first of those that give equally many numbers is taken: a comma may be a decimal comma.
_DELIMITERS = ("\t", ";", ",", "|", " ")
#: Lines by which the delimiter is found.
_SAMPLE = 2000


@dataclass(frozen=True)
class Source:
    """The content of a file.

    Attributes:
        kind: ``text``, ``workbook`` or ``container``.
        tables: of a text one, of a long one its beginning where numbers alone follow; of the others one for each sheet.
        encoding: of a text.
    """

    file: Path
    kind: str
    tables: tuple[Table, ...]
    encoding: str | None = None


@dataclass(frozen=True)
class Numbers:
    """Rows of numbers below each other, and what stands above them.

    Attributes:
        table: in which they stand.
        rows: consecutive ones.
        columns: places from 0 with numbers in them.
        header: the row of names, None: there is none. units: the row of units, above or below the names.
        above: rows from the numbers before, or the beginning, to the names.
        below: rows below the last numbers of the table; of the others none.
    """

    table: Table
    rows: tuple[Row, ...]
    columns: tuple[int, ...]
    header: Row | None
    units: Row | None
    above: tuple[Row, ...] = field(repr=False)
    below: tuple[Row, ...] = field(default=(), repr=False)

    @property
    def lines(self) -> tuple[Row, ...]:
        """All rows: above the names, the names and units, the numbers, and below."""
        names = [row for row in (self.header, self.units) if row is not None]
        return (*self.above, *sorted(names, key=lambda row: row.line), *self.rows, *self.below)

    @property
    def width(self) -> int:
        """Number of columns, those without numbers included."""
        return max(len(row.cells) for row in (self.rows[0], *([self.header] if self.header else [])))

    def name(self, place: int) -> str:
        """The whole header of a column; empty: it has none."""
        return self.header.cells[place].lstrip("# ") if self.header and place < len(self.header.cells) else ""

    def bare_name(self, place: int) -> str:
        """The header without its unit."""
        return loose_header(self.name(place))[0]

    def unit(self, place: int) -> str | None:
        """In the header, or in the row of units; one that nobody knows as it stands."""
        header = self.name(place)
        loose = loose_header(header)[1]
        below = self.units.cells[place].strip("[]() ") if self.units and place < len(self.units.cells) else None
        return known_unit(loose or "") or known_unit(below or "") or split_header(header)[1] or below or None


def open_source(path: Path, *, delimiter: str | None = None, sheet: Sheets | None = None,
                skip_lines: int = 0) -> Source:
    """The tables of a file.

    Args:
        path: the file. delimiter: of a text; None: found. sheet: name, number, or a list of them; None: all.
        skip_lines: lines at the top that are not looked at.

    Raises:
        InputError: no such file, not one that can be read, a text without numbers in columns.
    """
    if is_container(path) or is_workbook(path):
        kind = "container" if is_container(path) else "workbook"
        sheets = read_container(path, sheet) if kind == "container" else read_sheets(path, sheet)
        return Source(path, kind, tuple(each.table(skip_lines) for each in sheets))
    text, encoding = decode_text(read_bytes(path, EXPECTED), path, EXPECTED)
    if delimiter is not None:
        check_delimiter(delimiter)
    beginning, end = split_long(text, skip_lines)
    if end is not None:
        with suppress(InputError):
            table = _text_table(beginning, delimiter, skip_lines, path)
            runs = [*_runs(table)]
            # One run of numbers in all columns that goes on to the end of the file says nothing new below.
            if table.delimiter == end.delimiter and [columns for _, columns in runs] == [(*range(end.cells),)] and (
                    runs[0][0][-1] is table.rows[-1]):
                return Source(path, "text", (table,), encoding)
    return Source(path, "text", (_text_table(text, delimiter, skip_lines, path),), encoding)


def _text_table(text: str, delimiter: str | None, skip_lines: int, path: Path) -> Table:
    lines = text.splitlines()
    lines[:skip_lines] = [""] * min(skip_lines, len(lines))
    found = _find_delimiter(lines, path) if delimiter is None else delimiter
    return _table(lines, found, path)


def _table(lines: list[str], delimiter: str, path: Path) -> Table:
    """The lines split at the delimiter, without units behind the numbers."""
    text = "\n".join(lines)
    return Table(without_cell_units(split_rows(text, delimiter, file=path), text), delimiter)


def _find_delimiter(lines: list[str], path: Path) -> str:
    """The delimiter that makes most numbers in columns of the text, and fewest other cells in their rows.

    Raises:
        InputError: none makes any.
    """
    for sample in (lines[:_SAMPLE], lines) if len(lines) > _SAMPLE else (lines,):
        scores = {}
        for delimiter in _DELIMITERS:
            try:
                table = _table(sample, delimiter, path)
            except InputError:
                continue
            scores[delimiter] = sum(max(score, 1) for _, _, score in _scored_runs(table))
            # A blank between digits separates thousands where another delimiter makes a table of the same lines.
            if delimiter == " " and scores[delimiter] > max([0, *scores.values()][:-1]) and any(
                    scores.get(other) and _has_same_rows(sample, other, table, path) for other in _DELIMITERS[:-1]):
                del scores[delimiter]
        best = max(scores, key=lambda each: scores[each], default=None)
        if best is not None and scores[best]:
            return best
    raise InputError(f"holds no table of numbers: no {MIN_POINTS} lines in a row have two numbers or more, separated "
                     "by tabs, semicolons, commas, bars or blanks", file=path)


def _has_same_rows(lines: list[str], delimiter: str, blank: Table, path: Path) -> bool:
    """Whether a delimiter makes as many rows of numbers as blanks do, and cells with blanks are numbers in them."""
    table = _table(lines, delimiter, path)
    runs, of_blanks = [*_runs(table)], [*_runs(blank)]
    grouped = any(" " in cell and is_number(cell) for run, _ in runs for row in run for cell in row.cells)
    return grouped and sum(len(run) for run, _ in runs) >= sum(len(run) for run, _ in of_blanks)


def find_numbers(source: Source) -> list[Numbers]:
    """All runs of rows of numbers in a file."""
    return [numbers for table in source.tables for numbers in _of_table(table)]


def _of_table(table: Table) -> Iterator[Numbers]:
    begin = 0
    place = {id(row): i for i, row in enumerate(table.rows)}
    runs = [*_runs(table)]
    for number, (run, columns) in enumerate(runs, start=1):
        first = place[id(run[0])]
        above = [row for row in table.rows[begin:first] if re.search(r"\w", "".join(row.cells))]
        begin = place[id(run[-1])] + 1
        header, units, rest = _names(above, columns)
        below = table.rows[begin:] if number == len(runs) else ()
        yield Numbers(table, tuple(run), columns, header, units, tuple(above[:rest]), tuple(below))


def _names(above: list[Row], columns: Sequence[int]) -> tuple[Row | None, Row | None, int]:
    """Rows of names and units right above the numbers, and how many rows stand above both."""
    header, units, rest = None, None, len(above)
    for number, row in enumerate(reversed(above[-3:]), start=1):
        named = [i for i in columns if i < len(row.cells) and row.cells[i] and not is_number(row.cells[i])]
        if units is None and named and (is_unit_row(row, columns) or (
                header is None and is_mostly_units(row, columns) and _names_columns(above[:-number], columns))):
            units = row
        elif header is None and not _states_size(row) and 2 * len(named) >= len(columns) and len(named) >= 2:
            header = row
        else:
            break
        rest -= 1
        if header is not None and units is not None:
            break
    return header, units, rest


def _names_columns(above: Sequence[Row], columns: Sequence[int]) -> bool:
    """Whether the last row has a name for each of the columns."""
    return bool(above) and all(i < len(above[-1].cells) and above[-1].cells[i] and not is_number(above[-1].cells[i])
                               for i in columns)


def _states_size(row: Row) -> bool:
    """Whether a row states a size, as ``Height 12 mm`` does, rather than names."""
    cells = [cell for cell in row.cells if cell]
    return len(cells) > 1 and is_number(cells[1]) and size_class(cells[0]) is not None


def _runs(table: Table) -> Iterator[tuple[list[Row], tuple[int, ...]]]:
    """Rows that hold two numbers or more and little else, at least `MIN_POINTS` in a row, and their columns."""
    for run, columns, _ in _scored_runs(table):
        yield run, columns


def _scored_runs(table: Table) -> Iterator[tuple[list[Row], tuple[int, ...], int]]:
    """As `_runs`, with the number of cells that are numbers less those that are not."""
    run: list[Row] = []
    counts: dict[int, int] = {}
    score = 0
    for row in (*table.rows, Row(0, ())):
        numeric = [i for i, cell in enumerate(row.cells) if cell and is_number(cell)]
        filled = sum(map(bool, row.cells))
        if len(numeric) >= 2 and 2 * len(numeric) >= filled:
            run.append(row)
            score += 2 * len(numeric) - filled
            for i in numeric:
                counts[i] = counts.get(i, 0) + 1
            continue
        # Rows such as "Mean, 1.2, 3.4" below the numbers are of a summary.
        while len(run) > 1 and begins_with_word(run[-1]) and not begins_with_word(run[0]):
            run.pop()
        # A column that begins late, or ends early, is one too: replicates beside each other differ in length.
        columns = tuple(sorted(i for i, count in counts.items() if count >= MIN_POINTS))
        if len(run) >= MIN_POINTS and len(columns) >= 2:
            yield run, columns, score
        run, counts, score = [], {}, 0
