"""Foreign tables, text or spreadsheet, by a map of channels to columns: by name under a header, or by place."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, located, nearest
from tissue_sim.files import read_text
from tissue_sim.recording.formats.header import (
    DELIMITERS,
    DELIMITERS_OF_NUMBERS,
    Table,
    find_header,
    find_numbers,
    matches,
    text_tables,
)
from tissue_sim.recording.formats.table import Column, Row, conversion, narrow, read_recording_table
from tissue_sim.recording.formats.workbook import is_workbook, read_sheet
from tissue_sim.recording.recording import CHANNELS, LABELS, Recording
from tissue_sim.units import split_header

_KEYS = ("name", "column", "unit", "sign")
#: The last column of a spreadsheet is XFD.
_LETTERS = re.compile(r"[A-Za-z]{1,3}")


def read_columns(path: str | Path, columns: Mapping[str, Any], *, skip_lines: int = 0, delimiter: str | None = None,
                 sheet: str | int | None = None, metadata: Mapping[str, Any] | None = None) -> Recording:
    """A recording from chosen columns of any delimited text file or xlsx spreadsheet.

    Columns by name: the header is the first row that contains every named column. A column matches by its whole header
    (``"Load (N)"``) or by the part before the unit (``"Load"``), whatever the case. Columns by place only: the table
    begins with the first row that has a number in each of them.

    Delimiter of a text: comma, semicolon or tab, whichever has such a row, unless it is stated; with any but the comma,
    decimal commas are read too. In a spreadsheet the rows end with the last one that has a cell in these columns.

    Args:
        path: the file.
        columns: channel -> header, or a mapping with ``name`` or ``column`` (a number from 1, or a letter) and, where
            wanted, ``unit`` (in place of the one in the header's brackets) and ``sign`` (1 or -1).
        skip_lines: lines (rows) at the top of the file that are not looked at.
        delimiter: one character; a blank stands for any number of blanks. None: found. Text only.
        sheet: name or number (from 1) of a spreadsheet's sheet. None: the only one that holds anything.
        metadata: goes into the recording.

    Raises:
        InputError: a bad map (by field), a column that the file lacks, or a bad cell (by file and line), or a
            spreadsheet without the extra ``formats``.
    """
    path = Path(path)
    wanted = check_columns(columns)
    if isinstance(skip_lines, bool) or not isinstance(skip_lines, int) or skip_lines < 0:
        raise InputError(f"{skip_lines!r} is not a number of lines; give 0 or more", field="skip_lines")
    names = [entry["name"] for entry in wanted.values() if "name" in entry]
    places = [entry["column"] - 1 for entry in wanted.values() if "column" in entry]
    if is_workbook(path):
        if delimiter is not None:
            raise InputError("a spreadsheet has no delimiter; leave it out", file=path, field="delimiter")
        found = read_sheet(path, sheet)
        with located(file=path, part=f"sheet {found.name!r}"):
            below = Table([row for row in found.rows if row.line > skip_lines])
            _, header, rows = _begin([below], names, places, path)
            chosen = _choose(wanted, header, bool(names), path)
            rows, chosen = _alone(rows, chosen)
            header = Row(header.line, tuple(column.header for column in chosen))
            return read_recording_table(header, rows, chosen, file=path, delimiter=";", metadata=metadata)
    if sheet is not None:
        raise InputError("this file is no spreadsheet (xlsx), so it has no sheets; leave it out", file=path,
                         field="sheet")
    text = read_text(path, "a table with the columns " + ", ".join(map(repr, names)) if names else "a table of numbers")
    delimiters = ((DELIMITERS if names else DELIMITERS_OF_NUMBERS) if delimiter is None
                  else (check_delimiter(delimiter),))
    tables = text_tables(text, file=path, skip_lines=skip_lines, delimiters=delimiters)
    table, header, rows = _begin(tables, names, places, path)
    chosen = _choose(wanted, header, bool(names), path)
    return read_recording_table(header, rows, chosen, file=path, delimiter=table.delimiter, metadata=metadata)


def _begin(tables, names, places, path):
    return find_header(tables, names, file=path) if names else find_numbers(tables, places, file=path)


def _choose(wanted: Mapping[str, Mapping[str, Any]], header: Row, named: bool, path: Path) -> list[Column]:
    """Where each channel stands under the header (the first row of numbers where nothing is named)."""
    chosen: list[Column] = []
    for channel, entry in wanted.items():
        field = f"columns.{channel}"
        index = matches(header.cells, entry["name"])[0] if "name" in entry else entry["column"] - 1
        if index >= len(header.cells):
            raise InputError(f"there is no column {entry['column']}; the table has {len(header.cells)}", file=path,
                             line=header.line, field=field)
        cell = header.cells[index] if named and header.cells[index] else str(index + 1)
        if index in [column.index for column in chosen]:
            raise InputError(f"column {cell!r} is named for two channels; give each its own", file=path,
                             line=header.line, field=field)
        if channel in LABELS:
            chosen.append(Column(channel, index, cell))
            continue
        try:
            factor, offset = conversion(channel, entry.get("unit", split_header(cell)[1]))
        except InputError as error:
            key, value = ("name", f'"{entry["name"]}"') if "name" in entry else ("column", entry["column"])
            raise InputError(f'column {cell!r}: {error.problem}; or give it as {{ {key} = {value}, unit = "..." }}',
                             file=path, line=header.line, field=field) from None
        sign = entry.get("sign", 1)
        chosen.append(Column(channel, index, cell, sign * factor, sign * offset))
    return chosen


def _alone(rows: Sequence[Row], chosen: Sequence[Column]) -> tuple[list[Row], list[Column]]:
    """The chosen columns alone, and the rows that have something in them: a sheet holds other things beside a table."""
    return (narrow(rows, [column.index for column in chosen]),
            [Column(column.channel, i, column.header, column.factor, column.offset)
             for i, column in enumerate(chosen)])


def check_delimiter(delimiter: Any, field: str = "delimiter") -> str:
    """The delimiter, if it is one.

    Raises:
        InputError: not one character, or one that numbers and quoted cells are made of; with the field.
    """
    if not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter.isalnum() or delimiter in "\"'.+-\r\n":
        raise InputError(f'{delimiter!r} is not a delimiter; give one character such as " ", "|" or ";"',
                         field=field)
    return delimiter


def check_columns(columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The map with every entry as a mapping with ``name`` or ``column`` (from 1); unit and sign only where given.

    Raises:
        InputError: unknown channel or key, wrong type; with the field, such as ``columns.force.sign``.
    """
    if not isinstance(columns, Mapping) or not columns:
        raise InputError('expected a map of channels to column names such as { force = "Load (N)" }', field="columns")
    checked = {}
    for channel, entry in columns.items():
        field = f"columns.{channel}"
        if channel not in CHANNELS and channel not in LABELS:
            raise InputError(f"unknown channel{nearest(str(channel), (*CHANNELS, *LABELS))}", field=field)
        entry = {"name": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, Mapping):
            raise InputError(f"{entry!r} is not a column name or a map with name or column, unit and sign", field=field)
        for key, value in entry.items():
            if key not in _KEYS:
                raise InputError(f"unknown key{nearest(str(key), _KEYS)}", field=f"{field}.{key}")
            if key == "sign" and (isinstance(value, bool) or value not in (1, -1)):
                raise InputError(f"{value!r} is not a sign; give 1 or -1", field=f"{field}.sign")
            if key in ("name", "unit") and not isinstance(value, str):
                raise InputError(f"{value!r} is not text in quotation marks", field=f"{field}.{key}")
        if "column" in entry:
            if "name" in entry:
                raise InputError("give either the name of the column or its place, not both", field=f"{field}.column")
            entry = {**entry, "column": column_number(entry["column"], f"{field}.column")}
        elif not entry.get("name", "").strip():
            raise InputError("the name of the column is missing", field=f"{field}.name")
        if channel in LABELS and set(entry) & {"unit", "sign"}:
            raise InputError("a label has neither unit nor sign; give its name only", field=field)
        checked[channel] = dict(entry)
    return checked


def column_number(column: Any, field: str = "column") -> int:
    """The number of a column, from 1, of a number or of a spreadsheet's letters: ``"AB"`` is 28.

    Raises:
        InputError: neither; with the field.
    """
    if isinstance(column, str) and _LETTERS.fullmatch(column):
        number = 0
        for letter in column.upper():
            number = 26 * number + ord(letter) - ord("A") + 1
        return number
    if isinstance(column, bool) or not isinstance(column, int) or column < 1:
        raise InputError(f'{column!r} is not the place of a column; give a number from 1 or a letter such as "C"',
                         field=field)
    return column
