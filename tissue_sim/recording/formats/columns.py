"""Read tables of texts, spreadsheets and containers by a map from channels to columns: names or positions.

Options that select columns: delimiter, decimal mark, column numbers and the map ``columns``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.files import decode_text_and_find_encoding, read_bytes
from tissue_sim.recording.formats.blocks import (
    DELIMITERS,
    DELIMITERS_OF_NUMBERS,
    NumberBlock,
    find_names_of_unread_columns,
    find_table_and_blocks_by_column_indices,
    find_table_and_blocks_by_column_names,
    iterate_table_for_each_delimiter,
)
from tissue_sim.recording.formats.decimal_mark import DecimalAndThousandsMarks, detect_decimal_and_thousands_marks
from tissue_sim.recording.formats.long_text import (
    NotPlainNumbersError,
    TrailingNumberLines,
    try_splitting_off_trailing_numbers,
)
from tissue_sim.recording.formats.number_text import DECIMAL_MARKS, is_number_with_either_mark
from tissue_sim.recording.formats.sheets import (
    Sheet,
    is_mat_tdms_or_hdf5_file,
    is_workbook,
    read_container_tables_as_sheets,
    read_sheet,
    read_sheets,
)
from tissue_sim.recording.formats.table import (
    ChannelColumn,
    Table,
    TableRow,
    build_recording_from_rows,
    get_si_conversion,
    has_same_units_in_trailing_lines,
    list_cells_of_each_number_column,
    select_cells_and_drop_blank_rows,
)
from tissue_sim.recording.measures import convert_recording_to_stretch_and_nominal, require_valid_measure
from tissue_sim.recording.recording import CHANNELS, LABELS, MIN_POINTS, Recording
from tissue_sim.units import split_header_and_known_unit, split_header_with_brackets

#: Keys of an entry of ``columns``.
_KEYS = ("name", "column", "unit", "sign", "scale", "offset", "measure")
#: Largest valid column number.
_MAX_COLUMN_NUMBER = 1_000_000
#: Letters of a column of a spreadsheet, up to XFD.
_LETTERS = re.compile(r"[A-Za-z]{1,3}")


def validate_decimal_mark(decimal: Any, field: str = "decimal") -> str:
    """Require that a decimal mark is valid, and return the mark.

    Raises:
        InputError: neither point nor comma; with the field.
    """
    if decimal not in DECIMAL_MARKS:
        raise InputError(f'must be "." or ","; got {decimal!r}. The other mark separates thousands.', field=field)
    return decimal


def validate_delimiter(delimiter: Any, field: str = "delimiter") -> str:
    """Require that a delimiter is valid, and return the delimiter.

    Raises:
        InputError: not one character, or a character of numbers or quoted cells; with the field.
    """
    if not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter.isalnum() or delimiter in "\"'.+-\r\n":
        raise InputError(f'must be one character such as " ", "|" or ";"; got {delimiter!r}', field=field)
    return delimiter


def normalize_column_mapping(columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Check the option ``columns``; return channel -> mapping with ``name`` or ``column`` (from 1) and other keys.

    Raises:
        InputError: unknown channel or key, wrong type; with the field, such as ``columns.force.sign``.
    """
    if not isinstance(columns, Mapping) or not columns:
        raise InputError('expected a map of channels to column names such as { force = "Load (N)" }', field="columns")
    checked = {}
    for channel, entry in columns.items():
        field = f"columns.{channel}"
        if channel not in CHANNELS and channel not in LABELS:
            raise InputError(
                f"unknown channel{make_hint_with_similar_or_known_words(str(channel), (*CHANNELS, *LABELS))}",
                field=field)
        entry = {"name": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, Mapping):
            raise InputError(f"must be a column name or a map with name or column, unit and sign; got {entry!r}",
                             field=field)
        for key, value in entry.items():
            if key not in _KEYS:
                raise InputError(f"unknown key{make_hint_with_similar_or_known_words(str(key), _KEYS)}",
                                 field=f"{field}.{key}")
            if key == "sign" and (isinstance(value, bool) or value not in (1, -1)):
                raise InputError(f"must be 1 or -1; got {value!r}", field=f"{field}.sign")
            if key in ("name", "unit") and not isinstance(value, str):
                raise InputError(f"must be text in quotation marks; got {value!r}", field=f"{field}.{key}")
            number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
            if key == "scale" and not (number and value > 0):
                raise InputError(f"must be a positive number; got {value!r}. State the direction with sign.",
                                 field=f"{field}.scale")
            if key == "offset" and not number and value != "start":
                raise InputError(f'must be a finite number or "start"; got {value!r}. "start" subtracts the first '
                                 "value.", field=f"{field}.offset")
        if "column" in entry:
            if "name" in entry:
                raise InputError("give either the name or the number of the column", field=f"{field}.column")
            entry = {**entry, "column": parse_column_number_or_letters(entry["column"], f"{field}.column")}
        elif not entry.get("name", "").strip():
            raise InputError("the name of the column is missing", field=f"{field}.name")
        if "measure" in entry:
            require_valid_measure(entry["measure"], channel, columns, field)
        if channel in LABELS and set(entry) & {"unit", "sign", "scale", "offset"}:
            raise InputError("a label has no unit, sign, scale or offset; give only the name of the column",
                             field=field)
        checked[channel] = dict(entry)
    return checked


def parse_column_number_or_letters(column: Any, field: str = "column") -> int:
    """Return the number of a column, from 1, for a number or for letters of a spreadsheet: ``"AB"`` gives 28.

    Raises:
        InputError: neither; with the field.
    """
    if isinstance(column, str) and _LETTERS.fullmatch(column):
        number = 0
        for letter in column.upper():
            number = 26 * number + ord(letter) - ord("A") + 1
        column = number
    if isinstance(column, bool) or not isinstance(column, int) or not 1 <= column <= _MAX_COLUMN_NUMBER:
        raise InputError(f'must be a number from 1 or a letter such as "C"; got {column!r}', field=field)
    return column


Sheets = str | int | Sequence[str | int]
Curves = int | Sequence[int]


@dataclass(frozen=True)
class RecordingWithDecimalMark:
    """Recording of a table, with the decimal mark and the thousands separators that its numbers have in the file.

    Attributes:
        recording: recording in SI.
        marks: decimal mark and thousands separator of the numbers.
        line: line of the header.
        sheet: name of the sheet; empty in a text.
    """

    recording: Recording
    marks: DecimalAndThousandsMarks
    line: int
    sheet: str = ""


def read_single_recording(path: str | Path, columns: Mapping[str, Any], *, skip_lines: int = 0,
                          delimiter: str | None = None,
                          sheet: Sheets | None = None, metadata: Mapping[str, Any] | None = None) -> Recording:
    """Read a file with exactly one recording; see `read_recordings_from_columns` for the arguments.

    Raises:
        InputError: several recordings, or an error of `read_recordings_from_columns`.
    """
    found = read_recordings_from_columns(path, columns, skip_lines=skip_lines, delimiter=delimiter, sheet=sheet,
                                         metadata=metadata)
    if len(found) > 1:
        raise InputError(f"holds {len(found)} tables with these columns, expected one", file=path, field="columns")
    return found[0]


def read_recordings_from_columns(path: str | Path, columns: Mapping[str, Any], *, skip_lines: int = 0,
                                 delimiter: str | None = None,
                                 sheet: Sheets | None = None, curve: Curves | None = None, decimal: str | None = None,
                                 metadata: Mapping[str, Any] | None = None) -> tuple[Recording, ...]:
    """Read recordings from chosen columns of a delimited text, a spreadsheet or a container of arrays.

    Columns by name: the header is the first row with all names. A name is the complete header (``"Load (N)"``) or the
    part before the unit (``"Load"``), in any case. A repeated header, in the same or a later row, begins another
    recording. Exception: if the time continues below a later header, the recording continues. Columns by number: the
    table begins at the first row with a number in each of the columns.

    The delimiter of a text is the first of comma, semicolon and tab that gives such a row. Rows of text below the
    numbers end a table. Decimal mark and thousands separator are found from all values, see
    `tissue_sim.recording.formats.decimal_mark.detect_decimal_and_thousands_marks`.

    Args:
        path: the file: text in any usual encoding, xlsx, xls, ods, mat, tdms, h5.
        columns: channel -> header, or a mapping with ``name`` or ``column`` (a number from 1, or a letter) and
            optional keys. The value is (sign * scale * cell + offset) units with ``sign`` (1 or -1), ``scale`` (units
            in a number of 1 of the file; SI units for a signal), ``offset`` (units) and ``unit``, which replaces the
            unit in the header or below the header. The offset ``"start"`` subtracts the first value. ``measure`` is a
            name in `tissue_sim.recording.measures.MEASURES`, from which a stretch or nominal stress is converted for
            an incompressible specimen.
        skip_lines: number of lines (rows) at the top of the file that are ignored.
        delimiter: one character, for a text only; a blank matches any number of blanks. None: found.
        sheet: name or number (from 1) of a sheet of a spreadsheet or a table of a container, or a list of replicates.
            None: the only sheet with content.
        curve: number (from 1) of the recording to read, or a list of numbers. None: all.
        decimal: decimal mark of the numbers, ``"."`` or ``","``; the other mark separates thousands. None: found.
        metadata: metadata of the recordings. The names of columns of numbers that are not read are added under
            ``unread_columns``.

    Raises:
        InputError: an invalid map (with field), a missing column, an invalid cell (with file and line), an ambiguous
            decimal mark, or a spreadsheet without the extra ``formats``.
    """
    found = read_recordings_and_decimal_marks(path, columns, skip_lines=skip_lines, delimiter=delimiter, sheet=sheet,
                                              curve=curve, decimal=decimal, metadata=metadata)
    for each in found:
        if each.marks.is_open:
            raise InputError(f'{each.marks.question_text}; give decimal = "." or decimal = ","', file=path,
                             line=each.line,
                             field="decimal")
    return tuple(each.recording for each in found)


def read_recordings_and_decimal_marks(path: str | Path, columns: Mapping[str, Any], *, skip_lines: int = 0,
                                      delimiter: str | None = None, sheet: Sheets | None = None,
                                      curve: Curves | None = None,
                                      decimal: str | None = None, metadata: Mapping[str, Any] | None = None
                                      ) -> tuple[RecordingWithDecimalMark, ...]:
    """Read recordings like `read_recordings_from_columns`, each with the decimal mark and separator of its numbers.

    Ambiguous decimal marks are not an error.
    """
    path = Path(path)
    if decimal is not None:
        validate_decimal_mark(decimal)
    wanted = normalize_column_mapping(columns)
    if isinstance(skip_lines, bool) or not isinstance(skip_lines, int) or skip_lines < 0:
        raise InputError(f"must be a whole number from 0; got {skip_lines!r}. Give a number of lines.",
                         field="skip_lines")
    chosen = _make_list_of_valid_curve_numbers(curve, path)
    found: list[RecordingWithDecimalMark] = []
    if is_mat_tdms_or_hdf5_file(path) or is_workbook(path):
        if delimiter is not None:
            raise InputError("must be omitted, because only a text has a delimiter", file=path, field="delimiter")
        for each in _read_chosen_or_default_tables(path, sheet):
            with each.located_errors():
                found += _read_recordings_of_first_matching_table([each.build_table_below_skipped_rows(skip_lines)],
                                                                  wanted, path, metadata, decimal, alone=True)
    else:
        if sheet is not None:
            raise InputError("must be omitted, because only a spreadsheet (xlsx, xls, ods) or container has sheets",
                             file=path, field="sheet")
        names = [entry["name"] for entry in wanted.values() if "name" in entry]
        expected = "a table with the columns " + ", ".join(map(repr, names)) if names else "a table of numbers"
        text, _ = decode_text_and_find_encoding(read_bytes(path, expected), path, expected)
        delimiters = ((DELIMITERS if names else DELIMITERS_OF_NUMBERS) if delimiter is None
                      else (validate_delimiter(delimiter),))
        found += _read_recordings_of_text(text, skip_lines, delimiters, wanted, path, metadata, decimal)
    for number in chosen:
        if number > len(found):
            raise InputError(f"must be from 1 to {len(found)}, the number of curves in the file; got {number}.",
                             file=path, field="curve")
    return tuple(found[number - 1] for number in chosen) if chosen else tuple(found)


def _make_list_of_valid_curve_numbers(curve: Any, path: Path) -> list[int]:
    """Return the numbers of the curves to read; an empty list means all curves.

    Raises:
        InputError: not a whole number from 1.
    """
    numbers = list(curve) if isinstance(curve, list | tuple) else [] if curve is None else [curve]
    for each in numbers:
        if isinstance(each, bool) or not isinstance(each, int) or each < 1:
            raise InputError(f"must be a whole number from 1; got {each!r}. Give the number of a curve.", file=path,
                             field="curve")
    return numbers


def _read_recordings_of_text(text: str, skip_lines: int, delimiters: Sequence[str],
                             wanted: Mapping[str, Mapping[str, Any]],
                             path: Path, metadata: Mapping[str, Any] | None,
                             decimal: str | None) -> list[RecordingWithDecimalMark]:
    """Read the recordings of a text; see `read_recordings_from_columns` for the arguments."""
    beginning, end = try_splitting_off_trailing_numbers(text, skip_lines)
    if end is not None:
        with suppress(InputError, NotPlainNumbersError):
            tables = iterate_table_for_each_delimiter(beginning, file=path, skip_lines=skip_lines,
                                                      delimiters=delimiters)
            return _read_recordings_of_first_matching_table(tables, wanted, path, metadata, decimal, end=end)
    tables = iterate_table_for_each_delimiter(text, file=path, skip_lines=skip_lines, delimiters=delimiters)
    return _read_recordings_of_first_matching_table(tables, wanted, path, metadata, decimal)


def _read_chosen_or_default_tables(path: Path, sheet: Sheets | None) -> Sequence[Sheet]:
    """Read the requested sheets of a spreadsheet or tables of a container."""
    if is_mat_tdms_or_hdf5_file(path):
        return read_container_tables_as_sheets(path, sheet)
    return read_sheets(path, sheet) if isinstance(sheet, Sequence) and not isinstance(sheet, str) else [
        read_sheet(path, sheet)]


def _read_recordings_of_first_matching_table(tables, wanted: Mapping[str, Mapping[str, Any]], path: Path,
                                             metadata: Mapping[str, Any] | None,
                                             decimal: str | None, *, alone: bool = False,
                                             end: TrailingNumberLines | None = None) -> list[RecordingWithDecimalMark]:
    """Return the recordings of the first table with the columns; with trailing number lines, one recording."""
    names = [entry["name"] for entry in wanted.values() if "name" in entry]
    places = [entry["column"] - 1 for entry in wanted.values() if "column" in entry]
    table: Table
    blocks: list[NumberBlock]
    table, blocks = (find_table_and_blocks_by_column_names(tables, names, also=places, file=path) if names
                     else find_table_and_blocks_by_column_indices(tables, places, file=path))
    # The trailing number lines continue the only block of the table.
    if end is not None and (len(blocks) > 1 or not blocks[0].rows or blocks[0].rows[-1].line != table.rows[-1].line
                            or not has_same_units_in_trailing_lines(table.rows, end)):
        raise NotPlainNumbersError
    # A short block is a summary with the same header.
    blocks = [block for block in blocks if len(block.rows) >= MIN_POINTS] or blocks
    chosen: list[list[ChannelColumn]] = []
    for block in blocks:
        order = iter(block.places[:len(names)]), iter(block.places[len(names):])
        positions = {channel: next(order["column" in entry]) for channel, entry in wanted.items()}
        chosen.append(_list_channel_columns_of_block(wanted, positions, block, bool(names), path))
    marks = _detect_decimal_mark_of_all_blocks(blocks, chosen, table.delimiter, decimal)
    unread = find_names_of_unread_columns(blocks, {column.index for columns in chosen for column in columns})
    metadata = {**(metadata or {}), "unread_columns": list(unread)} if unread else metadata
    found: list[RecordingWithDecimalMark] = []
    for block, columns in zip(blocks, chosen, strict=True):
        header, rows = block.header, list(block.rows)
        if alone or len(blocks) > 1:
            rows, columns = _select_and_renumber_chosen_columns(rows, columns)
            header = TableRow(header.line, tuple(column.header for column in columns))
        recording = build_recording_from_rows(header, rows, columns, file=path, delimiter=table.delimiter or ";",
                                              metadata=metadata, end=end, marks=marks)
        if block.below and found and _continues_recording(found[-1].recording, recording):
            found[-1] = replace(found[-1], recording=_concatenate_two_recordings(found[-1].recording, recording))
        else:
            found.append(RecordingWithDecimalMark(recording, marks, block.header.line, table.name))
    from_start = [channel for channel, entry in wanted.items() if entry.get("offset") == "start"]
    found = [replace(each, recording=each.recording.with_channels(
        **{channel: each.recording.channel(channel) - each.recording.channel(channel)[0] for channel in from_start}))
        for each in found]
    measures = {channel: entry["measure"] for channel, entry in wanted.items() if "measure" in entry}
    if not measures:
        return found
    with located_and_converted_errors(file=path):
        return [replace(each, recording=convert_recording_to_stretch_and_nominal(each.recording, measures))
                for each in found]


def _detect_decimal_mark_of_all_blocks(blocks: Sequence[NumberBlock], chosen: Sequence[Sequence[ChannelColumn]],
                                       delimiter: str | None, decimal: str | None) -> DecimalAndThousandsMarks:
    """Return decimal mark and thousands separators of all blocks; the columns that are read have precedence."""
    used = [cells for block, columns in zip(blocks, chosen, strict=True)
            for cells in list_cells_of_each_number_column(block.rows, columns)]
    places = {column.index for columns in chosen for column in columns}

    def iterate_cells_of_unread_columns() -> Iterator[list[str]]:
        """Yield the cells of each column of numbers that is not read."""
        for block in blocks:
            for place in range(len(block.header.cells)):
                if place not in places:
                    cells = [row.cells[place] for row in block.rows if place < len(row.cells)]
                    if 2 * sum(map(is_number_with_either_mark, cells[:100])) > len(cells[:100]):
                        yield cells

    return detect_decimal_and_thousands_marks(used, iterate_cells_of_unread_columns(), delimiter=delimiter,
                                              stated=decimal)


def _continues_recording(first: Recording, second: Recording) -> bool:
    """Return whether the second recording continues the first one: same labels, and no earlier time."""
    return ("time" in first and "time" in second and first.labels.keys() == second.labels.keys()
            and second.time[0] >= first.time[-1] > first.time[0])


def _concatenate_two_recordings(first: Recording, second: Recording) -> Recording:
    """Return one recording: samples of the first, then of the second recording, and the metadata of the first."""
    return Recording({name: np.concatenate([first.channel(name), second.channel(name)]) for name in first.channels},
                     {name: np.concatenate([first.labels[name], second.labels[name]]) for name in first.labels},
                     first.metadata)


def _list_channel_columns_of_block(wanted: Mapping[str, Mapping[str, Any]], places: Mapping[str, int],
                                   block: NumberBlock, named: bool, path: Path) -> list[ChannelColumn]:
    """Return the column of each channel under the header (without names: the first row of numbers)."""
    chosen: list[ChannelColumn] = []
    faults: list[InputError] = []
    header = block.header
    for channel, entry in wanted.items():
        field, index = f"columns.{channel}", places[channel]
        if index >= len(header.cells):
            raise InputError(f"there is no column {entry['column']}; the table has {len(header.cells)} columns",
                             file=path, line=header.line, field=field)
        cell = header.cells[index] if named and header.cells[index] else str(index + 1)
        if index in [column.index for column in chosen]:
            raise InputError(f"column {cell!r} is named for two channels; name another column for each channel",
                             file=path, line=header.line, field=field)
        if channel in LABELS:
            chosen.append(ChannelColumn(channel, index, cell))
            continue
        unit = entry.get("unit", split_header_and_known_unit(cell)[1] or block.find_known_unit_in_unit_row(index)
                         or split_header_with_brackets(cell)[1])
        try:
            factor, offset = get_si_conversion(channel, unit, entry.get("scale"))
        except InputError as error:
            key, value = ("name", f'"{entry["name"]}"') if "name" in entry else ("column", entry["column"])
            faults.append(InputError(
                f'column {cell!r}: {error.problem}; or give it as {{ {key} = {value}, unit = "..." }}',
                file=path, line=header.line, field=field))
            continue
        sign = entry.get("sign", 1)
        stated = entry.get("offset", 0.0)
        added = 0.0 if isinstance(stated, str) else stated * factor / entry.get("scale", 1.0)
        chosen.append(ChannelColumn(channel, index, cell, sign * factor, sign * offset + added))
    if faults:
        # One error lists all faults, so that the user can correct them together.
        raise InputError("; ".join(fault.problem for fault in faults), file=path, line=header.line,
                         field=faults[0].field if len(faults) == 1 else "columns")
    return chosen


def _select_and_renumber_chosen_columns(rows: Sequence[TableRow],
                                        chosen: Sequence[ChannelColumn]) -> tuple[list[TableRow], list[ChannelColumn]]:
    """Return the rows reduced to the chosen columns, without blank rows, and these columns with positions 0, 1, 2, ...

    A sheet may have other content around a table.
    """
    return (select_cells_and_drop_blank_rows(rows, [column.index for column in chosen]),
            [ChannelColumn(column.channel, i, column.header, column.factor, column.offset)
             for i, column in enumerate(chosen)])
