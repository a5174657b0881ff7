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

from tissue_sim.errors import InputError, located
from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.cleaning import clean, counted_from_kept
from tissue_sim.recording.constant_speed import with_constant_speed
from tissue_sim.recording.formats.columns import read_blocks
from tissue_sim.recording.formats.guesses import ColumnGuess, Reading, Stated, Understanding
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.interpretation import column_assumptions, format_assumption, settle_rivals
from tissue_sim.recording.formats.kind_guess import guess_kind, kind_assumption, require_one_test
from tissue_sim.recording.formats.kind_hints import file_hints, header_hint, label_hints, title_hints
from tissue_sim.recording.formats.kind_words import Hint
from tissue_sim.recording.formats.orientation import oriented
from tissue_sim.recording.formats.pairing import Group, alike, find_groups, no_pair
from tissue_sim.recording.formats.sources import Numbers, Source, find_numbers, open_source, stated_values
from tissue_sim.recording.formats.sweeps import is_sweep, sweep_sentence
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
    machine = MACHINES.get(stated.format or "") or (None if stated.format == "table" else find_machine(words))
    found, warnings = _without_sweeps(found, path)
    tables = [group for numbers in found for group in find_groups(numbers, machine, stated)]
    titles = file_hints(source, found)
    if not tables:
        kind = guess_kind((), (), [*title_hints(found[0]), *titles], machine, stated.kind)
        if kind.refused is not None:
            raise kind.refused.refusal().located(file=path)
        raise InputError(no_pair(found, machine, stated), file=path)
    with located(file=path):
        readings, refused = _of_known_tests([
            _reading(source, group, stated, machine, titles, _unused(group[0].numbers, tables))
            for group in alike(tables)])
    if len(readings) > 1:
        readings = _named(readings)
    delimiter = source.tables[0].delimiter
    cells = "".join(cell for column in readings[0].columns for row in found[0].rows[:200]
                    for cell in row.cells[column.place - 1:column.place])
    return Understanding(path, machine.name if machine else "table", source.kind, delimiter,
                         None if delimiter is None else "," if "," in cells else ".", source.encoding, readings,
                         (*warnings, *refused, *_warnings(source, readings)),
                         (format_assumption(machine, stated),))


def _without_sweeps(found: Sequence[Numbers], path: Path) -> tuple[list[Numbers], tuple[str, ...]]:
    """The tables that may be recordings, and sentences on those that hold moduli over frequency or amplitude.

    Raises:
        InputError: all tables hold moduli.
    """
    headers = [[numbers.name(place) for place in numbers.columns] for numbers in found]
    sweeps = [names for names in headers if is_sweep(names)]
    if len(sweeps) == len(found):
        raise InputError(sweep_sentence(sweeps[0]), file=path, line=found[0].rows[0].line)
    return ([numbers for numbers, names in zip(found, headers, strict=True) if not is_sweep(names)],
            tuple(f"a table is left out: {sweep_sentence(names)}" for names in sweeps[:1]))


def _of_known_tests(readings: Sequence[Reading]) -> tuple[tuple[Reading, ...], tuple[str, ...]]:
    """The readings whose kind of test may be registered, and sentences on the others.

    Raises:
        InputError: all are of tests without a kind.
    """
    kept = tuple(reading for reading in readings if reading.kind.refused is None)
    refused = [reading.kind.refused.refusal() for reading in readings if reading.kind.refused is not None]
    if not kept:
        raise refused[0]
    return kept, tuple(dict.fromkeys(f"a table is left out: {each.problem}" for each in refused))


def _reading(source: Source, groups: Sequence[Group], stated: Stated, machine: Machine | None,
             titles: Sequence[Hint], unused: tuple[str, ...]) -> Reading:
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
    elif stated.skip_lines:
        options["skip_lines"] = stated.skip_lines
    columns, recordings, remarks = _readable(source.file, _checked_shear(columns), options, first.speed)
    stated_above = stated_values(first.numbers.above)
    kind = guess_kind(_cleaned(recordings), columns, _hints(source, first, columns, titles), machine, stated.kind)
    if kind.is_stated and kind.against:
        remarks = (*remarks, f"kind of test as stated ({kind.kind}), though {'; '.join(kind.against)}")
    elif not kind.is_stated:
        require_one_test([title_hints(group.numbers) for group in groups if kind.refused is None])
    if kind.kind == "simple_shear" and any(_is_strain(column) for column in columns):
        columns = tuple(replace(column, channel="shear strain", offset=None,
                                reason=column.reason.replace("; a strain, which 1 makes a stretch", "; sheared"))
                        if _is_strain(column) else column for column in columns)
        recordings = _read(source.file, _checked_shear(columns), options, first.speed)
    signed = {column.channel for column in columns if stated.signs.keys() & {column.channel, column.role}}

    def read(chosen: Sequence[ColumnGuess]) -> tuple[Recording, ...]:
        return _read(source.file, chosen, options, first.speed)

    columns, recordings, rivals, compared = settle_rivals(read, columns, recordings, first.rivals)
    turned = oriented(columns, _cleaned(recordings), kind.kind, signed)
    recordings = _turned(source.file, recordings, columns, turned, options, first.speed)
    zeroed = [column.channel for column in turned if column.offset == "start"]
    recordings = tuple(counted_from_kept(each, zeroed) for each in recordings)
    columns = turned
    options["columns"] = {column.channel: column.entry() for column in columns}
    assumptions = (*column_assumptions(read, columns, recordings, first.rivals, stated), *rivals, kind_assumption(kind))
    return Reading("", columns, first.others, read_only(options), recordings, kind, line, sheets,
                   read_only(stated_above), (*remarks, *compared), assumptions=assumptions, unused=unused,
                   speed=first.speed)


def _hints(source: Source, first: Group, columns: Sequence[ColumnGuess], titles: Sequence[Hint]) -> list[Hint]:
    """Texts in which words for a test count, the surest first; the name of the file says least."""
    above, sheet = title_hints(first.numbers)
    return [header_hint([each.header for each in columns], first.others), above, sheet,
            *(title for title in titles if title.text != above.text), *label_hints(first.numbers),
            Hint(source.file.stem, "in the name of the file", is_file_name=True)]


def _is_strain(column: ColumnGuess) -> bool:
    """Whether a stretch was recorded as a strain or a displacement."""
    return column.channel == "stretch" and column.role != "stretch"


def _checked_shear(columns: tuple[ColumnGuess, ...]) -> tuple[ColumnGuess, ...]:
    """The columns, of which a shear strain must be an angle or a displacement over a height.

    Raises:
        InputError: a shear strain of another measure.
    """
    for column in columns:
        if column.channel == "shear strain" and column.measure:
            raise InputError(f"column {column.header!r} holds a shear strain of another measure, which has no "
                             "conversion; give displacement over height")
    return columns


def _unused(numbers: Numbers, tables: Sequence[Group]) -> tuple[str, ...]:
    """Headers of the columns that no recording reads, places where there is none."""
    used = {column.place for group in tables if group.numbers is numbers for column in group.columns}
    return tuple(numbers.name(place) or str(place + 1) for place in numbers.columns if place + 1 not in used)


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


def _readable(path: Path, columns: tuple[ColumnGuess, ...], options: Mapping[str, Any],
              speed: tuple[float, str] | None
              ) -> tuple[tuple[ColumnGuess, ...], tuple[Recording, ...], tuple[str, ...]]:
    """Columns and what they give, without a clock that runs backwards, and with a stretch that falls below zero taken
    for the strain that it is."""
    remarks: tuple[str, ...] = ()
    try:
        recordings = _read(path, columns, options, speed)
    except InputError as error:
        if not error.problem.startswith("time runs backwards"):
            raise
        columns = tuple(column for column in columns if column.channel != "time")
        recordings = _read(path, columns, options, speed)
        remarks = (f"the clock is left out: line {error.line}: {error.problem.split(' in column')[0]}",)
    if any(column.role == "stretch" for column in columns) and min(
            each.channel("stretch").min() for each in recordings) <= 0:
        columns = tuple(replace(column, role="strain", offset=1.0, reason=f"{column.reason}; not above zero, as a "
                                "stretch is; a strain, which 1 makes a stretch")
                        if column.role == "stretch" else column for column in columns)
        recordings = _read(path, columns, options, speed)
    return columns, recordings, remarks


def _read(path: Path, columns: Sequence[ColumnGuess], options: Mapping[str, Any],
          speed: tuple[float, str] | None = None) -> tuple[Recording, ...]:
    entries = {}
    for column in columns:
        # Where only a person knows the unit, the numbers as they stand show the shape of the test.
        entries[column.channel] = {**column.entry(), "scale": column.scale or 1.0} if column.missing else column.entry()
        if column.missing and column.unit not in UNITS:
            entries[column.channel].pop("unit", None)
    recordings = read_blocks(path, entries, **{key: value for key, value in options.items() if key != "columns"})
    if speed is not None:
        recordings = tuple(with_constant_speed(each, speed[0], path) for each in recordings)
    for recording in recordings:
        for channel, values in recording.channels.items():
            if np.abs(values).max() > _LARGEST:
                raise InputError(f"{channel} reaches {values[np.argmax(np.abs(values))]:g}, which no machine measures: "
                                 "a cell is damaged", file=path)
    return recordings


def _turned(path: Path, recordings: tuple[Recording, ...], before: Sequence[ColumnGuess],
            after: Sequence[ColumnGuess], options: Mapping[str, Any],
            speed: tuple[float, str] | None) -> tuple[Recording, ...]:
    """The recordings of columns of which some have got another sign."""
    other = [column for was, column in zip(before, after, strict=True) if column.entry() != was.entry()]
    if any(column.offset is not None for column in other) or (other and any(column.measure for column in after)):
        return _read(path, after, options, speed)
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
