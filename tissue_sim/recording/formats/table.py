"""Delimited text: rows with their line numbers, and columns of numbers in SI."""

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
from tissue_sim.recording.formats.decimal_mark import DECIMAL_WORDS, NumberMarks, find_marks
from tissue_sim.recording.formats.long_text import NotPlainError, PlainEnd
from tissue_sim.recording.formats.number_text import DECIMAL_MARKS, parse_number
from tissue_sim.recording.recording import CHANNELS, LABELS, MIN_POINTS, Recording
from tissue_sim.units import quantity_of, to_si

_BLANKS = re.compile(r"[ \t]+")
#: A group of thousands with decimals, and the digits before it.
_GROUP = re.compile(r"\d{3}(\.\d*)?")
_LEADING = re.compile(r"[+-]?[1-9]\d{0,2}")
#: SI units in words of the messages.
_SI = {"time": "s", "length": "m", "force": "N", "torque": "Nm", "stress": "Pa", "ratio": "units",
       "temperature": "K"}


@dataclass(frozen=True, slots=True)
class Row:
    """Cells of one line, stripped of blanks; `line` is 1-based."""

    line: int
    cells: tuple[str, ...]

    @property
    def blank(self) -> bool:
        return not any(self.cells)


@dataclass(frozen=True)
class Table:
    """Rows that are not blank: of a text split at `delimiter`, or of the sheet or group `name`."""

    rows: Sequence[Row]
    delimiter: str | None = None
    name: str = ""


@dataclass(frozen=True)
class Column:
    """Column of a channel or label, and the conversion of its numbers to SI: value * factor + offset."""

    channel: str
    index: int
    header: str
    factor: float = 1.0
    offset: float = 0.0


def split_rows(text: str, delimiter: str, *, file: Path) -> list[Row]:
    """Every line that is not blank, split at `delimiter` with the quoting of RFC 4180; a blank means any number."""
    line = 0

    def lines():
        nonlocal line
        for content in io.StringIO(text, newline=None):
            line += 1
            # A no-break blank separates thousands.
            yield _BLANKS.sub(" ", content.strip(" \t\r\n")) + "\n" if delimiter == " " else content

    rows: list[Row] = []
    reader = csv.reader(lines(), delimiter=delimiter, skipinitialspace=delimiter != " ")
    while True:
        start = line + 1
        try:
            cells = next(reader)
        except StopIteration:
            return rows
        except csv.Error as error:
            raise InputError(f"cannot be split into cells ({error}); expected a table with one row a line",
                             file=file, line=start) from None
        if line > start:
            raise InputError("a quoted cell runs over the end of the line; close its quotation mark",
                             file=file, line=start)
        row = Row(start, tuple(cell.strip() for cell in cells))
        if not row.blank:
            rows.append(row)


def narrow(rows: Iterable[Row], places: Sequence[int]) -> list[Row]:
    """Select the cells in the given columns (from 0) of rows with content."""
    chosen = (Row(row.line, tuple(row.cells[i] if i < len(row.cells) else "" for i in places)) for row in rows)
    return [row for row in chosen if not row.blank]


def read_recording_table(header: Row, rows: Sequence[Row], columns: Sequence[Column], *, file: Path,
                         delimiter: str = ",", metadata: Mapping[str, Any] | None = None,
                         end: PlainEnd | None = None, marks: NumberMarks | None = None) -> Recording:
    """The recording in `columns` of the data rows, and of the plain end below them.

    Args:
        header: row of names. rows: data rows. columns: that are read. file: for messages.
        delimiter: between the cells. metadata: of the recording. end: lines below the rows.
        marks: decimal mark and thousands separator. None: found from the cells of the columns.

    Raises:
        InputError: a row of another length than the header, a cell that is not a finite number, a decimal mark that
            the values do not show, time running backwards, fewer than `MIN_POINTS` rows; with file and line.
        NotPlainError: of an end: the rows and the end are not of one table of numbers that can be read so.
    """
    width = len(header.cells)
    for row in rows:
        # Loggers end their lines with the delimiter: empty cells behind the last column carry nothing.
        if len(row.cells) < width or any(row.cells[width:]):
            raise InputError(f"{_count(len(row.cells), 'cell')}, expected {width} as on line {header.line}"
                             f"{_split_thousands(row, width, delimiter)}", file=file, line=row.line)
    if len(rows) < MIN_POINTS:
        raise InputError(f"{_count(len(rows), 'point')} in the table on line {header.line}, expected at least "
                         f"{MIN_POINTS}", file=file)
    numeric = [column for column in columns if column.channel not in LABELS]
    if marks is None:
        marks = find_marks(cells_of(rows, numeric), delimiter=delimiter)
        if marks.is_open:
            raise InputError(f"{marks.question}; expected numbers with one reading", file=file, line=header.line)
    values = _numbers(rows, numeric, marks, file)
    if end is not None:
        values = np.concatenate([values, _below(end, columns, width, delimiter, marks)])
    channels = {column.channel: values[:, i] * column.factor + column.offset for i, column in enumerate(numeric)}
    if "time" in channels:
        back = np.flatnonzero(np.diff(channels["time"]) < 0)
        if back.size and end is not None:
            raise NotPlainError
        if back.size:
            column = next(column for column in numeric if column.channel == "time")
            before, after = (rows[i].cells[column.index] for i in (back[0], back[0] + 1))
            raise InputError(f"time runs backwards from {before} to {after} in column {column.header!r}, expected "
                             "times that never fall", file=file, line=rows[back[0] + 1].line)
    labels = {column.channel: _labels(rows, column, file) for column in columns if column.channel in LABELS}
    return Recording(channels, labels, metadata or {})


def _split_thousands(row: Row, width: int, delimiter: str) -> str:
    """Return a hint if thousands separators may have split numbers into cells; else an empty text."""
    groups = [cell for before, cell in pairwise(row.cells) if _GROUP.fullmatch(cell) and _LEADING.fullmatch(before)]
    if delimiter not in (",", " ") or not 0 < len(row.cells) - width <= len(groups):
        return ""
    return ("; a thousands separator that is also the delimiter may have split a number: quote the numbers "
            "or export without thousands separators")


def cells_of(rows: Sequence[Row], columns: Iterable[Column]) -> list[list[str]]:
    """Cells of each column that has numbers, without labels."""
    return [[row.cells[column.index] if column.index < len(row.cells) else "" for row in rows] for column in columns
            if column.channel not in LABELS]


def _below(end: PlainEnd, columns: Sequence[Column], width: int, delimiter: str, marks: NumberMarks) -> np.ndarray:
    """The numbers of a plain end, as they stand in the file, shape (rows, columns)."""
    if any(column.channel in LABELS for column in columns) or (end.delimiter, end.cells) != (delimiter, width):
        raise NotPlainError
    # Marks that the rows above do not explain may separate thousands: then all rows decide together.
    others, is_sure = set(end.marks) - {marks.decimal}, marks.is_certain or marks.is_stated
    if others - set(marks.thousands) or (not is_sure and not set(end.marks).isdisjoint(DECIMAL_MARKS)):
        raise NotPlainError
    values = end.numbers([column.index for column in columns], marks.decimal)
    if values is None:
        raise NotPlainError
    return values


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _numbers(rows: Sequence[Row], columns: Sequence[Column], marks: NumberMarks, file: Path) -> np.ndarray:
    """Numbers as they stand in the file, shape (rows, columns)."""
    values = np.empty((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            cell = row.cells[column.index]
            values[i, j] = number = parse_number(cell, marks.decimal)
            if not math.isfinite(number):
                found = f"holds {cell[:40]!r}" if cell else "is empty"
                mixed = (f" with {DECIMAL_WORDS[marks.decimal]}; the table mixes decimal points and decimal commas"
                         if math.isfinite(parse_number(cell, marks.other)) else "")
                raise InputError(f"column {column.header!r} {found}, expected a finite number{mixed}", file=file,
                                 line=row.line)
    return values


def _labels(rows, column, file) -> np.ndarray:
    cells = [row.cells[column.index] for row in rows]
    if column.channel == "segment":
        return np.array(cells, dtype=str)
    for row, cell in zip(rows, cells, strict=True):
        if not (cell.isascii() and cell.removeprefix("-").isdigit() and len(cell) <= 18):
            raise InputError(f"column {column.header!r} holds {cell[:40]!r}, expected a whole number",
                             file=file, line=row.line)
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def conversion(channel: str, unit: str | None, scale: float | None = None) -> tuple[float, float]:
    """Factor and offset to SI for a channel; a ratio may stand without a unit.

    Args:
        channel: a name in `CHANNELS`.
        unit: of the values. scale: that many units in one of the file; SI units where the unit is that of a signal
            (V, counts) or none is stated.

    Raises:
        InputError: no unit, an unknown one, or one of another quantity; a signal without a scale.
    """
    quantity = CHANNELS[channel]
    if unit is None and quantity == "ratio":
        unit = "-"
    if scale is not None and (unit is None or quantity_of(unit) == "signal"):
        return scale, 0.0
    if scale is not None:
        factor, offset = to_si(unit or "-", quantity)
        return scale * factor, offset
    if unit is not None and quantity_of(unit) == "signal":
        raise InputError(f"{unit} is the signal of a sensor; give scale, the {_SI[quantity]} in 1 {unit}")
    if unit is None:
        example = {"time": "s", "length": "mm", "force": "N", "torque": "Nm", "stress": "kPa", "temperature": "degC"}
        raise InputError(f"the unit is missing, expected a {quantity} such as [{example[quantity]}]")
    return to_si(unit, quantity)
