"""A file of measurements understood from its content: which tables it holds, and which columns are what.

Nothing here is certain. What is found is said as options of `tissue_sim.read_recordings`, each with its reason, so that
a person can see and correct it; what is not found is said, all at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.cleaning import clean, counted_from_kept
from tissue_sim.recording.formats.columns import read_blocks
from tissue_sim.recording.formats.guesses import ColumnGuess, KindGuess, Reading, Stated, Understanding
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.orientation import guess_kind, oriented
from tissue_sim.recording.formats.pairing import Group, alike, find_groups, no_pair
from tissue_sim.recording.formats.sources import Numbers, Source, find_numbers, open_source, stated_values
from tissue_sim.recording.formats.vocabulary import MACHINES, Machine, find_machine
from tissue_sim.recording.recording import Recording
from tissue_sim.units import UNITS

#: Of any channel, SI or in the units of the file.
_LARGEST = 1e20
_NAMING = ("displacement", "stretch", "shear strain", "force", "nominal stress")


def understand(path: str | Path, stated: Stated | None = None) -> Understanding:
    """What a text, spreadsheet or container holds.

    Raises:
        InputError: no such file, nothing in it that can be a recording; everything that is missing, at once.
    """
    path, stated = Path(path), stated or Stated()
    source = open_source(path, delimiter=stated.delimiter, sheet=stated.sheet, skip_lines=stated.skip_lines)
    found = find_numbers(source)
    if not found:
        raise InputError("holds no table of numbers in columns", file=path)
    words = "\n".join(text for numbers in found[:8] for text in _words(numbers))
    machine = MACHINES.get(stated.format or "") or find_machine(words)
    tables = [group for numbers in found for group in find_groups(numbers, machine, stated)]
    if not tables:
        raise InputError(no_pair(found, machine, stated), file=path)
    readings = tuple(_reading(source, group, stated, machine, words) for group in alike(tables))
    if len(readings) > 1:
        readings = _named(readings)
    delimiter = source.tables[0].delimiter
    cells = "".join(cell for column in readings[0].columns for row in found[0].rows[:200]
                    for cell in row.cells[column.place - 1:column.place])
    return Understanding(path, machine.name if machine else "table", source.kind, delimiter,
                         None if delimiter is None else "," if "," in cells else ".", source.encoding, readings,
                         _warnings(source, readings))


def _reading(source: Source, groups: Sequence[Group], stated: Stated, machine: Machine | None, words: str) -> Reading:
    """How to read the tables, with columns turned so that a load is positive."""
    first = groups[0]
    sheets = tuple(dict.fromkeys(group.numbers.table.name for group in groups if group.numbers.table.name))
    by_name = _told_apart(groups)
    columns = tuple(replace(column, by_name=by_name) for column in first.columns)
    options: dict[str, Any] = {}
    if sheets and (len(source.tables) > 1 or stated.sheet is not None):
        options["sheet"] = list(sheets) if len(sheets) > 1 else sheets[0]
    if source.kind == "text" and first.numbers.table.delimiter in ("|", " "):
        options["delimiter"] = first.numbers.table.delimiter
    header = first.numbers.header
    line = header.line if header is not None else first.numbers.rows[0].line
    if not by_name and line > 1:
        options["skip_lines"] = line if header is not None else line - 1
    columns, recordings, remarks = _readable(source.file, columns, options)
    stated_above = stated_values(first.numbers.above)
    # The name of the file says least: it comes last.
    hints = [" ".join(each.header for each in columns) + " " + " ".join(first.others),
             " ".join(row for number in (first.numbers,) for row in _words(number)), source.file.stem]
    kind = KindGuess(stated.kind, "stated") if stated.kind else guess_kind(_cleaned(recordings), columns, hints,
                                                                           machine)
    if kind.kind == "simple_shear" and any(column.role == "strain" for column in columns):
        columns = tuple(replace(column, channel="shear strain", offset=None,
                                reason=column.reason.replace("; a strain, which 1 makes a stretch", "; sheared"))
                        if column.role == "strain" else column for column in columns)
        recordings = _read(source.file, columns, options)
    signed = {column.channel for column in columns if stated.signs.keys() & {column.channel, column.role}}
    turned = oriented(columns, _cleaned(recordings), kind.kind, signed)
    recordings = _turned(source.file, recordings, columns, turned, options)
    zeroed = [column.channel for column in turned if column.offset == "start"]
    recordings = tuple(counted_from_kept(each, zeroed) for each in recordings)
    columns = turned
    options["columns"] = {column.channel: column.entry() for column in columns}
    return Reading("", columns, first.others, read_only(options), recordings, kind, line, sheets,
                   read_only(stated_above), remarks)


def _cleaned(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """The recordings without outliers and saturated samples, on which no sign and no zero may depend."""
    return tuple(clean(each)[0] for each in recordings)


def _told_apart(groups: Sequence[Group]) -> bool:
    """Whether the names of the columns find these tables and no other column."""
    for group in groups:
        header = group.numbers.header
        if header is None or not all(column.header for column in group.columns):
            return False
        beside = sum(other.numbers is group.numbers for other in groups)
        if any(len(matches(header.cells, column.header)) != beside for column in group.columns):
            return False
    return True


def _readable(path: Path, columns: tuple[ColumnGuess, ...], options: Mapping[str, Any]
              ) -> tuple[tuple[ColumnGuess, ...], tuple[Recording, ...], tuple[str, ...]]:
    """Columns and what they give, without a clock that runs backwards, and with a stretch that falls below zero taken
    for the strain that it is."""
    remarks: tuple[str, ...] = ()
    try:
        recordings = _read(path, columns, options)
    except InputError as error:
        if not error.problem.startswith("time runs backwards"):
            raise
        columns = tuple(column for column in columns if column.channel != "time")
        recordings = _read(path, columns, options)
        remarks = (f"the clock is left out: line {error.line}: {error.problem.split(' in column')[0]}",)
    if any(column.role == "stretch" for column in columns) and min(
            each.channel("stretch").min() for each in recordings) <= 0:
        columns = tuple(replace(column, role="strain", offset=1.0, reason=f"{column.reason}; not above zero, as a "
                                "stretch is; a strain, which 1 makes a stretch")
                        if column.role == "stretch" else column for column in columns)
        recordings = _read(path, columns, options)
    return columns, recordings, remarks


def _read(path: Path, columns: Sequence[ColumnGuess], options: Mapping[str, Any]) -> tuple[Recording, ...]:
    entries = {}
    for column in columns:
        # Where only a person knows the unit, the numbers as they stand show the shape of the test.
        entries[column.channel] = {**column.entry(), "scale": column.scale or 1.0} if column.missing else column.entry()
        if column.missing and column.unit not in UNITS:
            entries[column.channel].pop("unit", None)
    recordings = read_blocks(path, entries, **{key: value for key, value in options.items() if key != "columns"})
    for recording in recordings:
        for channel, values in recording.channels.items():
            if np.abs(values).max() > _LARGEST:
                raise InputError(f"{channel} reaches {values[np.argmax(np.abs(values))]:g}, which no machine measures: "
                                 "a cell is damaged", file=path)
    return recordings


def _turned(path: Path, recordings: tuple[Recording, ...], before: Sequence[ColumnGuess],
            after: Sequence[ColumnGuess], options: Mapping[str, Any]) -> tuple[Recording, ...]:
    """The recordings of columns of which some have got another sign."""
    other = [column for was, column in zip(before, after, strict=True) if column.entry() != was.entry()]
    if any(column.offset is not None for column in other):
        return _read(path, after, options)
    # From zero: no zero becomes a negative one.
    return tuple(each.with_channels(**{column.channel: 0.0 - each.channel(column.channel) for column in other})
                 if other else each for each in recordings)


def _named(readings: Sequence[Reading]) -> tuple[Reading, ...]:
    """Readings of one file with a name each: what their headers begin with, or their sheet."""
    named: list[Reading] = []
    for number, reading in enumerate(readings, start=1):
        heads = [column.header for column in reading.columns if column.channel in _NAMING]
        common = _common_beginning(heads)
        name = common or (reading.sheets[0] if len(reading.sheets) == 1 else "") or str(number)
        if name in [other.name for other in named]:
            name = f"{name}_{number}"
        named.append(replace(reading, name=name))
    return tuple(named)


def _common_beginning(heads: Sequence[str]) -> str:
    if len(heads) < 2 or not all(heads):
        return ""
    end = next((i for i, letters in enumerate(zip(*heads, strict=False)) if len(set(letters)) > 1), 0)
    common = heads[0][:end]
    # Whole words only.
    cut = max(common.rfind(mark) for mark in " -_.")
    return common[:cut].strip(" -_.") if cut > 0 else ""


def _words(numbers: Numbers) -> list[str]:
    """What stands above the numbers, as lines."""
    rows = [*numbers.above[-40:], *(row for row in (numbers.header, numbers.units) if row is not None)]
    return [" ".join(row.cells) for row in rows]


def _warnings(source: Source, readings: Sequence[Reading]) -> tuple[str, ...]:
    found = []
    tables = {name for reading in readings for name in reading.sheets}
    empty = [table.name for table in source.tables if table.name and table.name not in tables]
    if empty and len(source.tables) > 1:
        found.append(f"no recording in {'sheet' if len(empty) == 1 else 'sheets'} {', '.join(map(repr, empty))}")
    return tuple(found)
