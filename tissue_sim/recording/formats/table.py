"""Split delimited text into rows with line numbers, and read columns of numbers in SI units.

Cells with a number and a unit, ``12.3 N``, are split into numbers and a row of units above them.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.decimal_mark import (
    DECIMAL_WORDS,
    DecimalAndThousandsMarks,
    detect_decimal_and_thousands_marks,
)
from tissue_sim.recording.formats.long_text import NotPlainNumbersError, TrailingNumberLines
from tissue_sim.recording.formats.number_text import (
    DECIMAL_MARKS,
    TextOfNumericCell,
    is_number_with_either_mark,
    parse_number_or_nan,
    split_number_and_unit,
)
from tissue_sim.recording.recording import CHANNELS, LABELS, MIN_POINTS, Recording
from tissue_sim.units import find_quantity_of_unit_or_none, get_si_factor_and_offset

#: Consecutive blanks and tabs.
_BLANK_RUN = re.compile(r"[ \t]+")
#: Three digits and optional decimals: the second part of a number that was split at its thousands separator.
_THREE_DIGIT_GROUP = re.compile(r"\d{3}(\.\d*)?")
#: One to three digits: the first part of such a number.
_LEADING_DIGITS = re.compile(r"[+-]?[1-9]\d{0,2}")
#: Quantity -> name of its SI unit in messages.
_SI_UNIT_WORDS = {"time": "s", "length": "m", "force": "N", "torque": "Nm", "stress": "Pa", "ratio": "units",
                  "angle": "rad",
                  "temperature": "K", "frequency": "Hz"}


@dataclass(frozen=True, slots=True)
class TableRow:
    """One line of a file: line number (from 1), and cells without blanks at their ends."""

    line: int
    cells: tuple[str, ...]

    @property
    def is_blank(self) -> bool:
        """Return whether all cells are empty."""
        return not any(self.cells)


@dataclass(frozen=True)
class Table:
    """Rows with content of a text or of a sheet.

    Attributes:
        rows: rows that are not blank.
        delimiter: delimiter of a text; None: not a text.
        name: name of the sheet or group; empty for a text.
    """

    rows: Sequence[TableRow]
    delimiter: str | None = None
    name: str = ""


@dataclass(frozen=True)
class ChannelColumn:
    """Column of a channel or label; converts its numbers to SI units by value * factor + offset.

    Attributes:
        channel: name in `CHANNELS` or `LABELS`.
        index: position of the column, from 0.
        header: header of the column.
        factor: SI units in one unit of the column.
        offset: value of zero, SI units.
    """

    channel: str
    index: int
    header: str
    factor: float = 1.0
    offset: float = 0.0


def split_text_into_rows(text: str, delimiter: str, *, file: Path) -> list[TableRow]:
    """Split the lines with content at a delimiter; cells may be quoted (RFC 4180).

    Args:
        text: complete text.
        delimiter: one character; consecutive blanks count as one delimiter.
        file: file name for messages.

    Raises:
        InputError: a quoted cell that continues on the next line, or a cell that is too long.
    """
    line = 0

    def iterate_and_count_normalized_lines():
        """Yield the lines with their ends, and count them in `line`; a blank delimiter may be several blanks."""
        nonlocal line
        for content in io.StringIO(text, newline=None):
            line += 1
            # Only blanks and tabs are stripped: a no-break blank is a thousands separator.
            yield _BLANK_RUN.sub(" ", content.strip(" \t\r\n")) + "\n" if delimiter == " " else content

    rows: list[TableRow] = []
    reader = csv.reader(iterate_and_count_normalized_lines(), delimiter=delimiter, skipinitialspace=delimiter != " ")
    while True:
        start = line + 1
        try:
            cells = next(reader)
        except StopIteration:
            return rows
        except csv.Error as error:
            raise InputError(f"cannot be split into cells ({error}); expected a table with one row per line",
                             file=file, line=start) from None
        if line > start:
            raise InputError("a quoted cell continues on the next line; close its quotation mark",
                             file=file, line=start)
        row = TableRow(start, tuple(cell.strip() for cell in cells))
        if not row.is_blank:
            rows.append(row)


def select_cells_and_drop_blank_rows(rows: Iterable[TableRow], places: Sequence[int]) -> list[TableRow]:
    """Return rows with only the cells at the given positions (from 0), without rows that are then blank."""
    chosen = (TableRow(row.line, tuple(row.cells[i] if i < len(row.cells) else "" for i in places)) for row in rows)
    return [row for row in chosen if not row.is_blank]


def build_recording_from_rows(header: TableRow, rows: Sequence[TableRow], columns: Sequence[ChannelColumn], *,
                              file: Path,
                              delimiter: str = ",", metadata: Mapping[str, Any] | None = None,
                              end: TrailingNumberLines | None = None,
                              marks: DecimalAndThousandsMarks | None = None) -> Recording:
    """Return the recording in the columns of a table.

    Args:
        header: row of names.
        rows: data rows.
        columns: columns to read.
        file: file name for messages.
        delimiter: delimiter of the cells.
        metadata: metadata of the recording.
        end: further lines below the rows, which contain only numbers; None: no such lines.
        marks: decimal mark and thousands separator; None: found from the cells of the columns.

    Raises:
        InputError: the length of a row differs from the header, a cell is not a finite number, the decimal mark is
            ambiguous, the time decreases, or the table has fewer than `MIN_POINTS` rows; with file and line.
        NotPlainNumbersError: `end` cannot be read with the marks of the rows; all lines must be read as rows.
    """
    width = len(header.cells)
    for row in rows:
        # Some loggers write a delimiter at the end of each line: additional empty cells are ignored.
        if len(row.cells) < width or any(row.cells[width:]):
            raise InputError(f"{_format_count_with_noun(len(row.cells), 'cell')}, expected {width} as on "
                             f"line {header.line}{_hint_at_split_thousands(row, width, delimiter)}", file=file,
                             line=row.line)
    if len(rows) < MIN_POINTS:
        raise InputError(f"{_format_count_with_noun(len(rows), 'point')} in the table on line {header.line}, expected "
                         f"at least {MIN_POINTS}", file=file)
    numeric = [column for column in columns if column.channel not in LABELS]
    if marks is None:
        marks = detect_decimal_and_thousands_marks(list_cells_of_each_number_column(rows, numeric), delimiter=delimiter)
        if marks.is_open:
            raise InputError(f"{marks.question_text}; expected numbers with one reading", file=file, line=header.line)
    values = _parse_number_matrix_in_file_units(rows, numeric, marks, file)
    if end is not None:
        values = np.concatenate([values, _parse_trailing_numbers_in_file_units(end, columns, width, delimiter, marks)])
    channels = {column.channel: values[:, i] * column.factor + column.offset for i, column in enumerate(numeric)}
    if "time" in channels:
        back = np.flatnonzero(np.diff(channels["time"]) < 0)
        if back.size and end is not None:
            raise NotPlainNumbersError
        if back.size:
            column = next(column for column in numeric if column.channel == "time")
            before, after = (rows[i].cells[column.index] for i in (back[0], back[0] + 1))
            raise InputError(f"time runs backwards from {before} to {after} in column {column.header!r}; expected "
                             "times that do not decrease", file=file, line=rows[back[0] + 1].line)
    labels = {column.channel: _parse_segment_names_or_whole_numbers(rows, column, file) for column in columns
              if column.channel in LABELS}
    return Recording(channels, labels, metadata or {})


def _hint_at_split_thousands(row: TableRow, width: int, delimiter: str) -> str:
    """Return the remedy if thousands separators may have split numbers into cells; else an empty text."""
    groups = [cell for before, cell in pairwise(row.cells)
              if _THREE_DIGIT_GROUP.fullmatch(cell) and _LEADING_DIGITS.fullmatch(before)]
    if delimiter not in (",", " ") or not 0 < len(row.cells) - width <= len(groups):
        return ""
    return ("; a thousands separator that is also the delimiter may have split a number: quote the numbers "
            "or export without thousands separators")


def list_cells_of_each_number_column(rows: Sequence[TableRow], columns: Iterable[ChannelColumn]) -> list[list[str]]:
    """Return the cells of each column of numbers; columns of labels are omitted."""
    return [[row.cells[column.index] if column.index < len(row.cells) else "" for row in rows] for column in columns
            if column.channel not in LABELS]


def _parse_trailing_numbers_in_file_units(end: TrailingNumberLines, columns: Sequence[ChannelColumn], width: int,
                                          delimiter: str, marks: DecimalAndThousandsMarks) -> np.ndarray:
    """Return the numbers of the trailing lines in the units of the file, shape (rows, columns).

    Raises:
        NotPlainNumbersError: labels, another delimiter or width, or marks that differ from those of the rows.
    """
    if any(column.channel in LABELS for column in columns) or (end.delimiter, end.cell_count_per_line) \
        != (delimiter, width):
        raise NotPlainNumbersError
    # An additional mark may be a thousands separator: all rows are then needed to find the marks.
    others, is_sure = set(end.marks) - {marks.decimal}, marks.is_certain or marks.is_stated
    if others - set(marks.thousands) or (not is_sure and not set(end.marks).isdisjoint(DECIMAL_MARKS)):
        raise NotPlainNumbersError
    values = end.parse_columns_or_none([column.index for column in columns], marks.decimal)
    if values is None:
        raise NotPlainNumbersError
    return values


def _format_count_with_noun(number: int, noun: str) -> str:
    """Return the number and the noun, such as ``1 cell`` or ``3 cells``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _parse_number_matrix_in_file_units(rows: Sequence[TableRow], columns: Sequence[ChannelColumn],
                                       marks: DecimalAndThousandsMarks,
                                       file: Path) -> np.ndarray:
    """Return the numbers of the columns in the units of the file, shape (rows, columns).

    Raises:
        InputError: a cell that is not a finite number; with file and line.
    """
    values = np.empty((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            cell = row.cells[column.index]
            values[i, j] = number = parse_number_or_nan(cell, marks.decimal)
            if not math.isfinite(number):
                found = f"holds {cell[:40]!r}" if cell else "is empty"
                mixed = (f" with {DECIMAL_WORDS[marks.decimal]}; the table mixes decimal points and decimal commas"
                         if math.isfinite(parse_number_or_nan(cell, marks.other_decimal_mark)) else "")
                raise InputError(f"column {column.header!r} {found}, expected a finite number{mixed}", file=file,
                                 line=row.line)
    return values


def _parse_segment_names_or_whole_numbers(rows: Sequence[TableRow], column: ChannelColumn, file: Path) -> np.ndarray:
    """Return the labels of a column, shape (rows,): text for the segment, else whole numbers.

    Raises:
        InputError: a cell that is not a whole number; with file and line.
    """
    cells = [row.cells[column.index] for row in rows]
    if column.channel == "segment":
        return np.array(cells, dtype=str)
    for row, cell in zip(rows, cells, strict=True):
        if not (cell.isascii() and cell.removeprefix("-").isdigit() and len(cell) <= 18):
            raise InputError(f"column {column.header!r} holds {cell[:40]!r}, expected a whole number",
                             file=file, line=row.line)
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def get_si_conversion(channel: str, unit: str | None, scale: float | None = None) -> tuple[float, float]:
    """Return factor and offset that convert the numbers of a channel to SI units: number * factor + offset.

    Args:
        channel: name in `CHANNELS`.
        unit: unit of the numbers; None: not stated, which is valid for a ratio and for a number with a scale.
        scale: units in a number of 1 of the file; SI units if the unit is a signal (V, counts) or not stated. None: 1.

    Raises:
        InputError: a missing or unknown unit, a unit of another quantity, or a signal without a scale.
    """
    quantity = CHANNELS[channel]
    if unit is None and quantity == "ratio":
        unit = "-"
    if scale is not None and (unit is None or find_quantity_of_unit_or_none(unit) == "signal"):
        return scale, 0.0
    if scale is not None:
        factor, offset = get_si_factor_and_offset(unit or "-", quantity)
        return scale * factor, offset
    if unit is not None and find_quantity_of_unit_or_none(unit) == "signal":
        raise InputError(f"{unit} is the signal of a sensor; give scale, the {_SI_UNIT_WORDS[quantity]} in 1 {unit}")
    if unit is None:
        example = {"time": "s", "length": "mm", "force": "N", "torque": "Nm", "stress": "kPa", "angle": "deg",
                   "temperature": "degC", "frequency": "Hz"}
        raise InputError(f"the unit is missing, expected a {quantity} such as [{example[quantity]}]")
    return get_si_factor_and_offset(unit, quantity)


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
