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
from tissue_sim.recording.formats.columns import MarkedRecording, read_marked_blocks
from tissue_sim.recording.formats.decimal_mark import NumberMarks, find_marks, marks_beside
from tissue_sim.recording.formats.guesses import ColumnGuess, KindGuess, Reading, Stated, Understanding
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.materials import by_material
from tissue_sim.recording.formats.orientation import guess_kind, oriented
from tissue_sim.recording.formats.pairing import Group, alike, find_groups, no_pair
from tissue_sim.recording.formats.sources import Numbers, Source, find_numbers, open_source
from tissue_sim.recording.formats.statements import merged, table_statements
from tissue_sim.recording.formats.vocabulary import MACHINES, Machine, find_machine
from tissue_sim.recording.recording import Recording
from tissue_sim.units import UNITS

#: Of any channel, SI or in the units of the file.
_LARGEST = 1e20
#: Rows of a table from which the decimal mark of the lines around it is taken.
_MARKED_ROWS = 2000
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
    tables = _with_statements(source, found, tables, stated)
    parts = [_reading(source, group, stated, machine, words) for group in alike(tables)]
    readings = tuple(reading for several, _ in parts for reading in several)
    every = [marks for _, marks in parts]
    marks = next((each for each in every if each.is_open), next((each for each in every if each.thousands), every[0]))
    if len(readings) > 1:
        readings = _named(readings)
    return Understanding(path, machine.name if machine else "table", source.kind, source.tables[0].delimiter,
                         marks.decimal if source.kind == "text" else None, source.encoding, readings,
                         _warnings(source, readings), marks.assumptions())


def _with_statements(source: Source, found: Sequence[Numbers], groups: Sequence[Group], stated: Stated) -> list[Group]:
    """The tables with what the file states about each; a table without sizes takes those of the table before it."""
    sheets = {id(numbers.table) for numbers in found}
    elsewhere = [row for table in source.tables if id(table) not in sheets for row in table.rows]
    read = {id(group.numbers) for group in groups}
    # Numbers that are no recording may be a summary of the specimens.
    elsewhere += [row for numbers in found if id(numbers) not in read for row in numbers.lines]
    # Rows below the last table may state the sizes of all.
    trailing = [row for group in groups[-1:] for row in group.numbers.below]
    complete: list[Group] = []
    for i, group in enumerate(groups):
        used = [column.place - 1 for column in group.columns]
        last = group.numbers is groups[-1].numbers
        statements = table_statements(group.numbers, used, decimal=stated.decimal or _probable_mark(group), table=i,
                                      tables=len(groups), elsewhere=elsewhere if last else [*trailing, *elsewhere])
        before = complete[-1].stated if complete else {}
        complete.append(replace(group, stated=merged(before, statements)))
    return complete


def _probable_mark(group: Group) -> str | None:
    """The decimal mark that the first rows of a table show; None: they have no marks, or fit both."""
    rows = group.numbers.rows[:_MARKED_ROWS]
    marks = find_marks([[row.cells[column.place - 1] for row in rows if column.place <= len(row.cells)]
                        for column in group.columns], delimiter=group.numbers.table.delimiter)
    return marks.decimal if (marks.evidence or marks.is_certain) and not marks.is_open else None


def _reading(source: Source, groups: Sequence[Group], stated: Stated, machine: Machine | None, words: str
             ) -> tuple[list[Reading], NumberMarks]:
    """How to read the tables, with columns turned so that a load is positive, and the marks of their numbers.

    Tables whose titles name different materials are readings of their own.
    """
    first = groups[0]
    sheets = tuple(dict.fromkeys(group.numbers.table.name for group in groups if group.numbers.table.name))
    by_name = _told_apart(groups)
    columns = tuple(replace(column, by_name=by_name) for column in first.columns)
    options: dict[str, Any] = {}
    if sheets and (len(source.tables) > 1 or stated.sheet is not None):
        options["sheet"] = list(sheets) if len(sheets) > 1 else sheets[0]
    if source.kind == "text" and first.numbers.table.delimiter in ("|", " "):
        options["delimiter"] = first.numbers.table.delimiter
    header, line = first.numbers.header, first.line
    if not by_name and line > 1:
        options["skip_lines"] = line if header is not None else line - 1
    if stated.decimal is not None:
        options["decimal"] = stated.decimal
    if stated.curve is not None:
        options["curve"] = stated.curve
    columns, marked, remarks = _readable(source.file, columns, options)
    marks = _settled(marked, groups)
    if marks.decimal != marked[0].marks.decimal:
        columns, marked, remarks = _readable(source.file, columns, {**options, "decimal": marks.decimal})
    if marks.thousands or (marks.example and not marks.is_certain):
        options["decimal"] = marks.decimal
    recordings = _recordings_of(marked)
    # The name of the file says least: it comes last.
    hints = [" ".join(each.header for each in columns) + " " + " ".join(first.others),
             " ".join(row for number in (first.numbers,) for row in _words(number)), source.file.stem]
    kind = KindGuess(stated.kind, "stated") if stated.kind else guess_kind(recordings, columns, hints, machine)
    if kind.kind == "simple_shear" and any(column.role == "strain" for column in columns):
        columns = tuple(replace(column, channel="shear strain", offset=None,
                                reason=column.reason.replace("; a strain, which 1 makes a stretch", "; sheared"))
                        if column.role == "strain" else column for column in columns)
        recordings = _recordings_of(_read(source.file, columns, options))
    signed = {column.channel for column in columns if stated.signs.keys() & {column.channel, column.role}}
    turned = oriented(columns, recordings, kind.kind, signed)
    recordings = _turned(source.file, recordings, columns, turned, options)
    columns = turned
    options["columns"] = {column.channel: column.entry() for column in columns}
    if marks.is_open:
        del options["decimal"]
    reading = Reading("", columns, first.others, read_only(options), recordings, kind, line, sheets,
                      read_only(first.stated), remarks)
    return by_material(reading, groups, [(each.sheet, each.line) for each in marked], stated), marks


def _settled(marked: Sequence[MarkedRecording], groups: Sequence[Group]) -> NumberMarks:
    """The marks of the numbers; where these are open, quantities outside of the table decide."""
    every = [each.marks for each in marked]
    found = next((marks for marks in every if marks.is_open or marks.thousands), every[0])
    if not found.is_open:
        return found
    rows = [row for group in groups for row in (*group.numbers.above, *group.numbers.below)]
    return marks_beside(found, "\n".join(" ".join(row.cells) for row in rows))


def _recordings_of(marked: Sequence[MarkedRecording]) -> tuple[Recording, ...]:
    return tuple(each.recording for each in marked)


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
              ) -> tuple[tuple[ColumnGuess, ...], tuple[MarkedRecording, ...], tuple[str, ...]]:
    """Columns and what they give, without a clock that runs backwards, and with a stretch that falls below zero taken
    for the strain that it is."""
    remarks: tuple[str, ...] = ()
    try:
        marked = _read(path, columns, options)
    except InputError as error:
        if not error.problem.startswith("time runs backwards"):
            raise
        columns = tuple(column for column in columns if column.channel != "time")
        marked = _read(path, columns, options)
        remarks = (f"the clock is left out: line {error.line}: {error.problem.split(' in column')[0]}",)
    if any(column.role == "stretch" for column in columns) and min(
            each.recording.channel("stretch").min() for each in marked) <= 0:
        columns = tuple(replace(column, role="strain", offset=1.0, reason=f"{column.reason}; not above zero, as a "
                                "stretch is; a strain, which 1 makes a stretch")
                        if column.role == "stretch" else column for column in columns)
        marked = _read(path, columns, options)
    return columns, marked, remarks


def _read(path: Path, columns: Sequence[ColumnGuess], options: Mapping[str, Any]) -> tuple[MarkedRecording, ...]:
    entries = {}
    for column in columns:
        # Where only a person knows the unit, the numbers as they stand show the shape of the test.
        entries[column.channel] = {**column.entry(), "scale": column.scale or 1.0} if column.missing else column.entry()
        if column.missing and column.unit not in UNITS:
            entries[column.channel].pop("unit", None)
    marked = read_marked_blocks(path, entries, **{key: value for key, value in options.items() if key != "columns"})
    for each in marked:
        for channel, values in each.recording.channels.items():
            if np.abs(values).max() > _LARGEST:
                raise InputError(f"{channel} reaches {values[np.argmax(np.abs(values))]:g}, which no machine measures: "
                                 "a cell is damaged", file=path)
    return marked


def _turned(path: Path, recordings: tuple[Recording, ...], before: Sequence[ColumnGuess],
            after: Sequence[ColumnGuess], options: Mapping[str, Any]) -> tuple[Recording, ...]:
    """The recordings of columns of which some have got another sign."""
    other = [column for was, column in zip(before, after, strict=True) if column.entry() != was.entry()]
    if any(column.offset is not None for column in other):
        return _recordings_of(_read(path, after, options))
    # From zero: no zero becomes a negative one.
    return tuple(each.with_channels(**{column.channel: 0.0 - each.channel(column.channel) for column in other})
                 if other else each for each in recordings)


def _named(readings: Sequence[Reading]) -> tuple[Reading, ...]:
    """Readings of one file with a name each: what their headers begin with, or their sheet."""
    named: list[Reading] = []
    for number, reading in enumerate(readings, start=1):
        heads = [column.header for column in reading.columns if column.channel in _NAMING]
        common = _common_beginning(heads)
        name = reading.name or common or (reading.sheets[0] if len(reading.sheets) == 1 else "") or str(number)
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
