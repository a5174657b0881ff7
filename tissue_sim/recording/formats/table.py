"""Delimited text: rows with their line numbers, and columns of numbers in SI."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.long_text import NotPlainError, PlainEnd
from tissue_sim.recording.recording import CHANNELS, LABELS, MIN_POINTS, Recording
from tissue_sim.units import quantity_of, to_si

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
    """Where a channel or label stands and how its numbers become SI: value * factor + offset."""

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
            yield " ".join(content.split()) + "\n" if delimiter == " " else content

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
    """The cells at these places (from 0) alone, in rows that have something in them."""
    chosen = (Row(row.line, tuple(row.cells[i] if i < len(row.cells) else "" for i in places)) for row in rows)
    return [row for row in chosen if not row.blank]


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or a decimal comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def read_recording_table(header: Row, rows: Sequence[Row], columns: Sequence[Column], *, file: Path,
                         delimiter: str = ",", metadata: Mapping[str, Any] | None = None,
                         end: PlainEnd | None = None) -> Recording:
    """The recording in `columns` of the data rows, and of the plain end below them.

    Decimal commas are read where the delimiter is not a comma and no cell in use has a decimal point.

    Raises:
        InputError: a row of another length than the header, a cell that is not a finite number, time running
            backwards, fewer than `MIN_POINTS` rows; with file and line.
        NotPlainError: of an end: the rows and the end are not of one table of numbers that can be read so.
    """
    width = len(header.cells)
    for row in rows:
        # Loggers end their lines with the delimiter: empty cells behind the last column carry nothing.
        if len(row.cells) < width or any(row.cells[width:]):
            raise InputError(f"{_count(len(row.cells), 'cell')}, expected {width} as on line {header.line}",
                             file=file, line=row.line)
    if len(rows) < MIN_POINTS:
        raise InputError(f"{_count(len(rows), 'point')} in the table on line {header.line}, expected at least "
                         f"{MIN_POINTS}", file=file)
    numeric = [column for column in columns if column.channel not in LABELS]
    decimal_comma = (delimiter != "," or _quoted_commas(rows, numeric)) and _decimal_comma(rows, numeric, file)
    values = _numbers(rows, numeric, decimal_comma, file)
    if end is not None:
        values = np.concatenate([values, _below(end, columns, width, delimiter, decimal_comma)])
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


def _below(end: PlainEnd, columns: Sequence[Column], width: int, delimiter: str, decimal_comma: bool) -> np.ndarray:
    """The numbers of a plain end, as they stand in the file, shape (rows, columns)."""
    if any(column.channel in LABELS for column in columns) or (end.delimiter, end.cells, end.decimal_comma) != (
            delimiter, width, decimal_comma):
        raise NotPlainError
    values = end.numbers([column.index for column in columns])
    if values is None:
        raise NotPlainError
    return values


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _decimal_comma(rows, columns, file) -> bool:
    first: dict[str, tuple[int, str]] = {}
    for row in rows:
        for cell in (row.cells[column.index] for column in columns):
            marks = [mark for mark in ",." if mark in cell]
            if len(marks) == 2:
                raise InputError(f"{cell!r} has a decimal point and a comma, expected one of them and no thousands "
                                 "separators", file=file, line=row.line)
            for mark in marks:
                first.setdefault(mark, (row.line, cell))
        if len(first) == 2:
            (_, earlier), (line, later) = sorted(first.values())
            raise InputError(f"{later!r} after {earlier!r} mixes decimal points and decimal commas, expected one of "
                             "them", file=file, line=line)
    return "," in first


def _quoted_commas(rows, columns) -> bool:
    """Whether cells between commas hold decimal commas, in quotation marks: no cell in use has a point, and some comma
    cannot part thousands."""
    cells = [row.cells[column.index] for row in rows for column in columns]
    commas = [cell for cell in cells if "," in cell]
    return bool(commas) and not any("." in cell for cell in cells) and any(
        len(cell.lstrip("+-").partition(",")[2]) != 3 for cell in commas)


def _number(cell: str, decimal_comma: bool) -> float:
    # float() also takes 1_000 and non-Latin digits, which are typing errors in a table.
    if "_" in cell or not cell.isascii():
        return math.nan
    try:
        return float(cell.replace(",", ".", 1) if decimal_comma else cell)
    except ValueError:
        return math.nan


def _numbers(rows, columns, decimal_comma, file) -> np.ndarray:
    """Numbers as they stand in the file, shape (rows, columns)."""
    values = np.empty((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            cell = row.cells[column.index]
            values[i, j] = number = _number(cell, decimal_comma)
            if not math.isfinite(number):
                found = f"holds {cell[:40]!r}" if cell else "is empty"
                raise InputError(f"column {column.header!r} {found}, expected a finite number",
                                 file=file, line=row.line)
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
