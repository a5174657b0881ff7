"""Foreign CSV by a map of column names: the header row and the delimiter are found."""

from __future__ import annotations

import difflib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, nearest
from tissue_sim.formats.native import conversion
from tissue_sim.formats.table import Column, Row, is_number, read_recording_table, split_rows
from tissue_sim.formats.text import read_text
from tissue_sim.recording import CHANNELS, LABELS, Recording
from tissue_sim.units import split_header

DELIMITERS = (",", ";", "\t")
_KEYS = ("name", "unit", "sign")


def read_columns(path: str | Path, columns: Mapping[str, Any], *, skip_lines: int = 0, delimiter: str | None = None,
                 metadata: Mapping[str, Any] | None = None) -> Recording:
    """A recording from named columns of any delimited text file.

    The header is the first row that contains every named column. Delimiter: comma, semicolon or tab, whichever has
    such a row, unless it is stated; with any but the comma, decimal commas are read too. A column matches by its whole
    header (``"Load (N)"``) or by the part before the unit (``"Load"``), whatever the case.

    Args:
        path: the file.
        columns: channel -> header, or a mapping with ``name`` and, where wanted, ``unit`` (in place of the one in the
            header's brackets) and ``sign`` (1 or -1).
        skip_lines: lines at the top of the file that are not looked at.
        delimiter: one character; a blank stands for any number of blanks. None: found.
        metadata: goes into the recording.

    Raises:
        InputError: a bad map (by field), a column that the file lacks, or a bad cell (by file and line).
    """
    path = Path(path)
    wanted = check_columns(columns)
    if isinstance(skip_lines, bool) or not isinstance(skip_lines, int) or skip_lines < 0:
        raise InputError(f"{skip_lines!r} is not a number of lines; give 0 or more", field="skip_lines")
    delimiters = DELIMITERS if delimiter is None else (check_delimiter(delimiter),)
    text = read_text(path, "a table with the columns " + ", ".join(repr(entry["name"]) for entry in wanted.values()))
    delimiter, header, data = find_header(text, [entry["name"] for entry in wanted.values()], file=path,
                                          skip_lines=skip_lines, delimiters=delimiters)
    found: list[Column] = []
    for channel, entry in wanted.items():
        index = _matches(header.cells, entry["name"])[0]
        cell = header.cells[index]
        if index in [column.index for column in found]:
            raise InputError(f"column {cell!r} is named for two channels; give each its own", file=path,
                             line=header.line, field=f"columns.{channel}")
        if channel in LABELS:
            found.append(Column(channel, index, cell))
            continue
        try:
            factor, offset = conversion(channel, entry.get("unit", split_header(cell)[1]))
        except InputError as error:
            raise InputError(f"column {cell!r}: {error.problem}; or give it as "
                             f'{{ name = "{entry["name"]}", unit = "..." }}', file=path, line=header.line,
                             field=f"columns.{channel}") from None
        sign = entry.get("sign", 1)
        found.append(Column(channel, index, cell, sign * factor, sign * offset))
    return read_recording_table(header, data, found, file=path, delimiter=delimiter, metadata=metadata)


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
    """The map with every entry as ``{"name": ..., "unit": ..., "sign": ...}``; unit and sign only where given.

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
            raise InputError(f"{entry!r} is not a column name or a map with name, unit and sign", field=field)
        for key, value in entry.items():
            if key not in _KEYS:
                raise InputError(f"unknown key{nearest(str(key), _KEYS)}", field=f"{field}.{key}")
            if key == "sign" and (isinstance(value, bool) or value not in (1, -1)):
                raise InputError(f"{value!r} is not a sign; give 1 or -1", field=f"{field}.sign")
            if key != "sign" and not isinstance(value, str):
                raise InputError(f"{value!r} is not text in quotation marks", field=f"{field}.{key}")
        if not entry.get("name", "").strip():
            raise InputError("the name of the column is missing", field=f"{field}.name")
        if channel in LABELS and len(entry) > 1:
            raise InputError("a label has neither unit nor sign; give its name only", field=field)
        checked[channel] = dict(entry)
    return checked


def find_header(text: str, names: Sequence[str], *, file: Path, skip_lines: int = 0,
                delimiters: Sequence[str] = DELIMITERS) -> tuple[str, Row, list[Row]]:
    """Delimiter, header row and data rows of the first table that has all the named columns.

    Raises:
        InputError: no such row; names the missing column and the nearest one in the file.
    """
    closest = None
    kept = _skip(text, skip_lines)
    for delimiter in delimiters:
        rows = split_rows(kept, delimiter, file=file)
        for i, row in enumerate(rows):
            # numpy.savetxt writes its header as a comment.
            row = Row(row.line, (row.cells[0].lstrip("# "), *row.cells[1:]))
            found = [_matches(row.cells, name) for name in names]
            if all(found):
                for name, places in zip(names, found, strict=True):
                    if len(places) > 1:
                        raise InputError(f"column {name!r} appears twice; remove or rename one",
                                         file=file, line=row.line)
                header = Row(row.line, _without_empty_end(row.cells))
                return delimiter, header, [other for other in rows[i + 1:] if not other.cells[0].startswith("#")]
            # The row that comes closest is the one to talk about: most matches, then a header right above numbers.
            above_numbers = i + 1 < len(rows) and _looks_like_data(rows[i + 1]) and not _looks_like_data(row)
            score = (sum(map(bool, found)), above_numbers, len(row.cells) if above_numbers else 0)
            if closest is None or score > closest[0]:
                closest = (score, row)
    raise _missing(closest, names, file, delimiters)


def _skip(text: str, lines: int) -> str:
    """The text with its first lines blanked, so that line numbers stay those of the file."""
    content = list(io.StringIO(text, newline=None))
    return "\n" * min(lines, len(content)) + "".join(content[lines:])


def _missing(closest, names, file, delimiters) -> InputError:
    if closest is None:
        return InputError(f"no lines are left, expected a header with {names[0]!r}; skip fewer lines", file=file)
    (matches, above_numbers, _), row = closest
    missing = next(name for name in names if not _matches(row.cells, name))
    cells = [cell for cell in row.cells if cell and not is_number(cell)]
    if matches or (above_numbers and len(row.cells) > 1):
        bare = {split_header(cell)[0].casefold(): cell for cell in cells}
        close = difflib.get_close_matches(split_header(missing)[0].casefold(), bare, n=1)
        if close:
            hint = f"; did you mean {bare[close[0]]!r}?"
        else:
            hint = nearest(missing, cells) if cells else ": this row has numbers only; add a line with names above it"
        return InputError(f"no column {missing!r}{hint}", file=file, line=row.line)
    found = "commas, semicolons or tabs (or state the delimiter)" if len(delimiters) > 1 else repr(delimiters[0])
    return InputError(f"no row with the column {missing!r}, expected a header line and cells separated by {found}",
                      file=file)


def _matches(cells: Sequence[str], name: str) -> list[int]:
    """Places of the cells that are `name`, or else of those that are `name` without their unit."""
    def plain(text):
        return " ".join(text.casefold().split())

    exact = [i for i, cell in enumerate(cells) if plain(cell) == plain(name)]
    return exact or [i for i, cell in enumerate(cells) if cell and plain(split_header(cell)[0]) == plain(name)]


def _looks_like_data(row: Row) -> bool:
    return all(is_number(cell) for cell in row.cells if cell)


def _without_empty_end(cells: tuple[str, ...]) -> tuple[str, ...]:
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells
