"""The native CSV: one header line with units, ``#`` comments, commas, decimal points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, nearest
from tissue_sim.files import read_text
from tissue_sim.recording.formats.columns import Curves, Sheets, read_blocks
from tissue_sim.recording.formats.long_text import NotPlainError, PlainEnd, split_long
from tissue_sim.recording.formats.number_text import is_number
from tissue_sim.recording.formats.table import Column, Row, conversion, read_recording_table, split_rows
from tissue_sim.recording.recording import CHANNELS, LABELS, Recording
from tissue_sim.units import split_header, to_si

EXAMPLE = "time [s],displacement [mm],force [N]"
_NAMES = {name.casefold(): name for name in (*CHANNELS, *LABELS)}


def read_native(path: str | Path, *, columns: Mapping[str, Any] | None = None, skip_lines: int = 0,
                delimiter: str | None = None, sheet: Sheets | None = None,
                curve: Curves | None = None, decimal: str | None = None) -> Recording | tuple[Recording, ...]:
    """A recording in the project's own CSV; see docs/recordings.md.

    Args:
        path: the file.
        columns, skip_lines, delimiter, sheet, curve, decimal: as in
            `tissue_sim.recording.formats.columns.read_blocks`, which then reads the file, of whatever kind.

    Raises:
        InputError: unknown, repeated or unit-less column, wrong delimiter, or a bad cell; with file and line.
    """
    path = Path(path)
    if columns is not None:
        return read_blocks(path, columns, skip_lines=skip_lines, delimiter=delimiter, sheet=sheet, curve=curve,
                           decimal=decimal)
    for key, value in (("sheet", sheet), ("curve", curve), ("decimal", decimal)):
        if value is not None:
            raise InputError(f"files of format 'native' have no {key}; leave it out", field=key)
    text = read_text(path, f"a recording with the header {EXAMPLE!r}")
    beginning, end = split_long(text)
    if end is not None:
        with suppress(InputError, NotPlainError):
            return native_recording(_rows(beginning, path), path, end)
    return native_recording(_rows(text, path), path)


def native_recording(rows: Sequence[Row], path: Path, end: PlainEnd | None = None) -> Recording:
    """Return the recording in rows (the first one is the header) and in a plain end.

    Raises:
        InputError: as `read_native`. NotPlainError: of an end.
    """
    if not rows:
        raise InputError(f"holds only comments, expected the header {EXAMPLE!r}", file=path)
    header, *data = rows
    return read_recording_table(header, data, _columns(header, path), file=path, end=end)


def _rows(text: str, path: Path) -> list[Row]:
    # Comment lines are blanked, not removed, so that line numbers stay those of the file.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return split_rows("\n".join("" if line.lstrip().startswith("#") else line for line in lines), ",", file=path)


def _columns(header: Row, path: Path) -> list[Column]:
    def refuse(problem):
        return InputError(problem, file=path, line=header.line)

    for delimiter, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(header.cells) == 1 and delimiter in header.cells[0]:
            raise refuse(f"the columns are separated by {word}, expected commas; replace them, or name the columns "
                         "with columns = {...}, which finds the delimiter")
    if all(is_number(cell) for cell in header.cells if cell):
        raise refuse(f"numbers where the header should be, expected a line such as {EXAMPLE!r} above them")
    if not any(_channel(cell) for cell in header.cells) and len(header.cells) < 2:
        raise refuse(f"no header of a recording, expected a line such as {EXAMPLE!r}; for a foreign file give its "
                     "format or columns = {...}")
    columns: list[Column] = []
    for index, cell in enumerate(header.cells):
        name, unit = split_header(cell)
        channel = _channel(cell)
        if channel is None:
            raise refuse(f"unknown column {name!r}{nearest(name, _NAMES.values())}")
        if channel in [column.channel for column in columns]:
            raise refuse(f"column {channel!r} appears twice; remove or rename one")
        try:
            columns.append(Column(channel, index, cell, *_conversion(channel, unit)))
        except InputError as error:
            raise refuse(f"column {cell!r}: {error.problem}") from None
    return columns


def _channel(cell: str) -> str | None:
    name, _ = split_header(cell)
    return _NAMES.get(" ".join(name.casefold().replace("_", " ").split()))


def _conversion(channel: str, unit: str | None) -> tuple[float, float]:
    if channel in LABELS:
        return (1.0, 0.0) if unit is None else to_si(unit, "ratio")
    return conversion(channel, unit)
