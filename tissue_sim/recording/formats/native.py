"""Read the native CSV format: one header line with units, ``#`` comments, commas, decimal points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.files import read_text
from tissue_sim.recording.formats.columns import Curves, Sheets, read_recordings_from_columns
from tissue_sim.recording.formats.long_text import (
    NotPlainNumbersError,
    TrailingNumberLines,
    try_splitting_off_trailing_numbers,
)
from tissue_sim.recording.formats.number_text import is_number_with_either_mark
from tissue_sim.recording.formats.table import (
    ChannelColumn,
    TableRow,
    build_recording_from_rows,
    get_si_conversion,
    split_text_into_rows,
)
from tissue_sim.recording.recording import CHANNELS, LABELS, Recording
from tissue_sim.units import get_si_factor_and_offset, split_header_with_brackets

#: Header of a recording, for messages.
EXAMPLE = "time [s],displacement [mm],force [N]"
#: Name of a channel or label in lower case -> name.
_NAMES = {name.casefold(): name for name in (*CHANNELS, *LABELS)}


def read_native(path: str | Path, *, columns: Mapping[str, Any] | None = None, skip_lines: int = 0,
                delimiter: str | None = None, sheet: Sheets | None = None,
                curve: Curves | None = None, decimal: str | None = None) -> Recording | tuple[Recording, ...]:
    """Read a recording in the native CSV format; see docs/recordings.md.

    Args:
        path: the file.
        columns: columns of a file in any other format. With columns, the file is read by
            `tissue_sim.recording.formats.columns.read_recordings_from_columns`, which documents the remaining
            arguments.
        skip_lines: number of lines at the top that are ignored.
        delimiter: delimiter of the cells.
        sheet: sheet of a spreadsheet; only with `columns`.
        curve: number of the recording; only with `columns`.
        decimal: decimal mark; only with `columns`.

    Raises:
        InputError: an unknown or repeated column, a column without a unit, a wrong delimiter, or an invalid cell; with
            file and line.
    """
    path = Path(path)
    if columns is not None:
        return read_recordings_from_columns(path, columns, skip_lines=skip_lines, delimiter=delimiter, sheet=sheet,
                                            curve=curve,
                                            decimal=decimal)
    for key, value in (("sheet", sheet), ("curve", curve), ("decimal", decimal)):
        if value is not None:
            raise InputError(f"files of format 'native' have no {key}; leave it out", field=key)
    text = read_text(path, f"a recording with the header {EXAMPLE!r}")
    beginning, end = try_splitting_off_trailing_numbers(text)
    if end is not None and not any(end.units):
        with suppress(InputError, NotPlainNumbersError):
            return read_native_rows(_split_text_into_rows_without_comment_lines(beginning, path), path, end)
    return read_native_rows(_split_text_into_rows_without_comment_lines(text, path), path)


def read_native_rows(rows: Sequence[TableRow], path: Path, end: TrailingNumberLines | None = None) -> Recording:
    """Return the recording in rows of the native format.

    Args:
        rows: header and data rows.
        path: file name for messages.
        end: further lines of numbers below the rows; None: no such lines.

    Raises:
        InputError: see `read_native`.
        NotPlainNumbersError: `end` cannot be read like the rows.
    """
    if not rows:
        raise InputError(f"holds only comments, expected the header {EXAMPLE!r}", file=path)
    header, *data = rows
    return build_recording_from_rows(header, data, _identify_columns(header, path), file=path, end=end)


def _split_text_into_rows_without_comment_lines(text: str, path: Path) -> list[TableRow]:
    """Split the lines of a text into cells at commas; lines that begin with ``#`` are omitted."""
    # Comments become empty lines, so that the line numbers remain those of the file.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return split_text_into_rows("\n".join("" if line.lstrip().startswith("#") else line for line in lines), ",",
                                file=path)


def _identify_columns(header: TableRow, path: Path) -> list[ChannelColumn]:
    """Return the channel, position and conversion to SI of each column, in the order of the header.

    Raises:
        InputError: an invalid header; with file and line.
    """
    def make_header_error(problem: str) -> InputError:
        """Return an error with the file and the line of the header."""
        return InputError(problem, file=path, line=header.line)

    for delimiter, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(header.cells) == 1 and delimiter in header.cells[0]:
            raise make_header_error(f"the columns are separated by {word}, expected commas; replace the {word}, or "
                                    "name the columns with columns = {...}, which finds the delimiter")
    if all(is_number_with_either_mark(cell) for cell in header.cells if cell):
        raise make_header_error(f"the header is missing; expected a line such as {EXAMPLE!r} above the numbers")
    if not any(_find_channel_of_header(cell) for cell in header.cells) and len(header.cells) < 2:
        raise make_header_error(f"the header of a recording is missing; expected a line such as {EXAMPLE!r}. For a "
                                "file in another format, give its format or columns = {...}")
    columns: list[ChannelColumn] = []
    for index, cell in enumerate(header.cells):
        name, unit = split_header_with_brackets(cell)
        channel = _find_channel_of_header(cell)
        if channel is None:
            raise make_header_error(
                f"unknown column {name!r}{make_hint_with_similar_or_known_words(name, _NAMES.values())}")
        if channel in [column.channel for column in columns]:
            raise make_header_error(f"column {channel!r} appears twice; remove or rename one")
        try:
            columns.append(ChannelColumn(channel, index, cell, *_find_si_conversion(channel, unit)))
        except InputError as error:
            raise make_header_error(f"column {cell!r}: {error.problem}") from None
    return columns


def _find_channel_of_header(cell: str) -> str | None:
    """Return the channel or label that a header names; None: unknown."""
    name, _ = split_header_with_brackets(cell)
    return _NAMES.get(" ".join(name.casefold().replace("_", " ").split()))


def _find_si_conversion(channel: str, unit: str | None) -> tuple[float, float]:
    """Return factor and offset to SI units of a channel or label."""
    if channel in LABELS:
        return (1.0, 0.0) if unit is None else get_si_factor_and_offset(unit, "ratio")
    return get_si_conversion(channel, unit)
