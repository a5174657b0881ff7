"""Interpret a file of measurements from its content: its tables, and the meaning of their columns.

Every finding is an assumption. It becomes an option of `tissue_sim.read_recordings` with its reason, so that a person
can see and correct it; everything that is missing is reported together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, located
from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.cleaning import clean, counted_from_start, start_of
from tissue_sim.recording.formats.columns import MarkedRecording
from tissue_sim.recording.formats.decimal_mark import NumberMarks, find_marks, marks_with_text
from tissue_sim.recording.formats.guesses import ColumnGuess, ColumnHints, Reading, Understanding
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.interpretation import (
    column_assumptions,
    format_assumption,
    settle_rivals,
    speed_assumption,
)
from tissue_sim.recording.formats.kind_guess import guess_kind, kind_assumption, require_one_test
from tissue_sim.recording.formats.kind_hints import file_hints, header_hint, label_hints, title_hints
from tissue_sim.recording.formats.kind_words import Hint
from tissue_sim.recording.formats.materials import by_material, with_different_titles
from tissue_sim.recording.formats.orientation import oriented
from tissue_sim.recording.formats.pairing import Group, alike, find_groups, no_pair
from tissue_sim.recording.formats.sources import Numbers, Source, find_numbers, open_source
from tissue_sim.recording.formats.statements import (
    Statements,
    add_unstated,
    listed_sizes,
    merged,
    row_statements,
    states_sizes,
    table_statements,
)
from tissue_sim.recording.formats.sweeps import is_sweep, sweep_sentence
from tissue_sim.recording.formats.table import Row
from tissue_sim.recording.formats.table_reader import TableReader
from tissue_sim.recording.formats.vocabulary import MACHINES, Machine, find_machine

#: Number of rows of a table that determine the decimal mark of the lines around the table.
_MARKED_ROWS = 2000
_NAMING = ("displacement", "stretch", "shear strain", "force", "nominal stress")


def understand(path: str | Path, stated: ColumnHints | None = None) -> Understanding:
    """Interpret the content of a text, spreadsheet or container.

    Args:
        path: the file. stated: hints of the user.

    Raises:
        InputError: the file does not exist, or has no recording; lists all missing information.
    """
    path, stated = Path(path), stated or ColumnHints()
    source = open_source(path, delimiter=stated.delimiter, sheet=stated.sheet, skip_lines=stated.skip_lines)
    found = find_numbers(source)
    if not found:
        raise InputError("holds no table of numbers in columns", file=path)
    words = "\n".join(text for numbers in found[:8] for text in _words(numbers))
    machine = MACHINES.get(stated.format or "") or (None if stated.format == "table" else find_machine(words))
    found, warnings = _without_sweeps(found, path)
    tables = [group for numbers in found
              for group in find_groups(numbers, machine, stated, _statements(numbers, numbers.columns, stated))]
    titles = file_hints(source, found)
    if not tables:
        kind = guess_kind((), (), [*title_hints(found[0]), *titles], machine, stated.kind)
        if kind.refused is not None:
            raise kind.refused.refusal().located(file=path)
        raise InputError(no_pair(found, machine, stated, lambda each: _statements(each, each.columns, stated)),
                         file=path)
    tables = _with_statements(source, found, tables, stated)
    with located(file=path):
        together = alike(tables)
        parts = [_reading(source, group, stated, machine, titles, _unused(group[0].numbers, tables))
                 for group in together]
        readings, refused = _of_known_tests([reading for several, _ in parts for reading in several], stated)
        readings = with_different_titles(readings, together, stated)
    every = [marks for _, marks in parts]
    marks = next((each for each in every if each.is_open), next((each for each in every if each.thousands), every[0]))
    if len(readings) > 1:
        readings = _named(readings)
    return Understanding(path, machine.name if machine else "table", source.kind, source.tables[0].delimiter,
                         marks.decimal if source.kind == "text" else None, source.encoding, readings,
                         (*warnings, *refused, *_warnings(source, readings)),
                         (format_assumption(machine, stated), *marks.assumptions()))


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


def _of_known_tests(readings: Sequence[Reading], stated: ColumnHints) -> tuple[tuple[Reading, ...], tuple[str, ...]]:
    """The readings whose kind of test may be registered, and sentences on the others.

    Raises:
        InputError: all are of tests without a kind.
    """
    kept = tuple(reading for reading in readings if reading.kind.refused is None)
    refused = [reading.kind.refused.refusal() for reading in readings if reading.kind.refused is not None]
    if stated.any_test:
        return tuple(readings), ()
    if not kept:
        raise refused[0]
    return kept, tuple(dict.fromkeys(f"a table is left out: {each.problem}" for each in refused))


def _with_statements(source: Source, found: Sequence[Numbers], groups: Sequence[Group], stated: ColumnHints
                     ) -> list[Group]:
    """The tables with what the file states about each; a table without sizes takes those of the table before it."""
    sheets = {id(numbers.table) for numbers in found}
    elsewhere = [row for table in source.tables if id(table) not in sheets for row in table.rows]
    read = {id(group.numbers) for group in groups}
    # Numbers that are no recording may be a summary of the specimens.
    elsewhere += [row for numbers in found if id(numbers) not in read for row in numbers.lines]
    # Rows below the last table may state the sizes of all.
    trailing = [row for group in groups[-1:] for row in group.numbers.below]
    around = _rows_of_blocks([group.numbers for group in groups])
    complete: list[Group] = []
    for i, group in enumerate(groups):
        above, below, shared = around[id(group.numbers)]
        places = [column.place - 1 for column in group.columns]
        decimal = stated.decimal or _probable_mark(group.numbers, places)
        own = replace(group.numbers, above=above, below=() if shared else below)
        statements: Mapping[str, str] = table_statements(own, places, decimal=decimal, table=i, tables=len(groups))
        # A list with a row for each table states more about a table than the rows before it.
        lists = listed_sizes((*groups[0].numbers.above, *trailing, *elsewhere), decimal, i, len(groups))
        statements = merged(lists, statements)
        every = Statements(merged(complete[-1].stated if complete else {}, statements))
        if shared:
            row_statements(below, every, decimal, i, len(groups))
        last = group.numbers is groups[-1].numbers
        add_unstated(elsewhere if last else [*trailing, *elsewhere], every, decimal, i, len(groups))
        complete.append(replace(group, stated=every))
    return complete


def _rows_of_blocks(tables: Sequence[Numbers]) -> dict[int, tuple[tuple[Row, ...], tuple[Row, ...], bool]]:
    """Identity of each table of numbers -> the rows above and below it, and whether those below are about all tables.

    Rows below the last of several tables of a sheet replace nothing that is stated above. Where no size is stated above
    the first table, and sizes are stated below each, those between two tables are about the upper one.
    """
    found: dict[int, tuple[tuple[Row, ...], tuple[Row, ...], bool]] = {}
    for sheet in dict.fromkeys(id(numbers.table) for numbers in tables):
        blocks = list({id(each): each for each in tables if id(each.table) == sheet}.values())
        after = [*(each.above for each in blocks[1:]), blocks[-1].below]
        if len(blocks) > 1 and not states_sizes(blocks[0].above) and all(map(states_sizes, after)):
            found |= {id(each): ((), rows, False) for each, rows in zip(blocks, after, strict=True)}
            continue
        found |= {id(each): (each.above, each.below, bool(each.below) and len(blocks) > 1) for each in blocks}
    return found


def _statements(numbers: Numbers, places: Sequence[int], stated: ColumnHints) -> Mapping[str, str]:
    """Key -> value with unit, as the file states them about a table; see `table_statements`.

    Args:
        places: columns, from 0, whose first rows tell the decimal mark of the lines around the table.
    """
    return table_statements(numbers, (), decimal=stated.decimal or _probable_mark(numbers, places))


def _probable_mark(numbers: Numbers, places: Sequence[int]) -> str | None:
    """The decimal mark that the first rows of a table show; None: they have no marks, or fit both."""
    rows = numbers.rows[:_MARKED_ROWS]
    marks = find_marks([[row.cells[place] for row in rows if place < len(row.cells)] for place in places],
                       delimiter=numbers.table.delimiter)
    return marks.decimal if (marks.evidence or marks.is_certain) and not marks.is_open else None


def _reading(source: Source, groups: Sequence[Group], stated: ColumnHints, machine: Machine | None,
             titles: Sequence[Hint], unused: tuple[str, ...]) -> tuple[list[Reading], NumberMarks]:
    """Return the readings of the tables, with signs for a positive load, and the marks of the numbers.

    Tables whose titles name different materials are readings of their own.
    """
    first = groups[0]
    sheets = tuple(dict.fromkeys(group.numbers.table.name for group in groups if group.numbers.table.name))
    by_name = _told_apart(groups)
    columns = tuple(replace(column, by_name=by_name) for column in first.columns)
    options = _options(source, first, stated, sheets, by_name=by_name)
    reader = TableReader(source.file, options, None if first.speed is None else first.speed[0])
    columns, marked, remarks = reader.readable(_checked_shear(columns))
    marks = _settled(marked, groups)
    if marks.decimal != marked[0].marks.decimal:
        columns, marked, remarks = TableReader(source.file, {**options, "decimal": marks.decimal},
                                               reader.speed).readable(columns)
    if marks.thousands or (marks.example and not marks.is_certain):
        options["decimal"] = marks.decimal
    recordings = tuple(each.recording for each in marked)
    screened, before = [clean(each) for each in recordings], recordings
    kind = guess_kind([rest for rest, _ in screened], columns, _hints(source, first, columns, titles), machine,
                      stated.kind)
    if kind.is_stated and kind.against:
        remarks = (*remarks, f"kind of test as stated ({kind.kind}), though {'; '.join(kind.against)}")
    elif not kind.is_stated and not stated.any_test:
        require_one_test([title_hints(group.numbers) for group in groups if kind.refused is None])
    if kind.kind == "simple_shear" and any(_is_strain(column) for column in columns):
        columns = tuple(replace(column, channel="shear strain", offset=None,
                                reason=column.reason.replace("; a strain, which 1 makes a stretch", "; sheared"))
                        if _is_strain(column) else column for column in columns)
        recordings = reader.recordings(_checked_shear(columns))
    signed = {column.channel for column in columns if stated.signs.keys() & {column.channel, column.role}}
    columns, recordings, rivals, compared = settle_rivals(reader.recordings, columns, recordings, first.rivals)
    # No sign and no zero depends on outliers or saturated samples.
    screened = screened if recordings is before else [clean(each) for each in recordings]
    turned = oriented(columns, [rest for rest, _ in screened],
                      [start_of(each, found, "displacement") if "displacement" in each else None
                       for each, (_, found) in zip(recordings, screened, strict=True)], kind.kind, signed)
    recordings = reader.turned(recordings, columns, turned)
    columns, zeroed = turned, [column.channel for column in turned if column.offset == "start"]
    recordings = tuple(counted_from_start(each, zeroed) for each in recordings)
    moved = () if first.speed is None else (speed_assumption(first.speed, [rest for rest, _ in screened]),)
    remarks = (*remarks, *(sentence for each in moved for sentence in each.against))
    assumptions = (*column_assumptions(reader.recordings, columns, recordings, first.rivals, stated), *moved, *rivals,
                   kind_assumption(kind))
    kept = {**options, "columns": {column.channel: column.entry() for column in columns}}
    if marks.is_open:
        # The user decides.
        kept.pop("decimal", None)
    reading = Reading("", columns, first.others, read_only(kept), recordings, kind, first.line, sheets,
                      read_only(first.stated), (*remarks, *compared), assumptions=assumptions, unused=unused,
                      speed=first.speed)
    return by_material(reading, groups, [(each.sheet, each.line) for each in marked], stated), marks


def _options(source: Source, first: Group, stated: ColumnHints, sheets: Sequence[str], *, by_name: bool
             ) -> dict[str, Any]:
    """Options of `read_recordings` but for the columns."""
    options: dict[str, Any] = {}
    if sheets and (len(source.tables) > 1 or stated.sheet is not None):
        options["sheet"] = list(sheets) if len(sheets) > 1 else sheets[0]
    if source.kind == "text" and first.numbers.table.delimiter in ("|", " "):
        options["delimiter"] = first.numbers.table.delimiter
    if not by_name and first.line > 1:
        options["skip_lines"] = first.line if first.numbers.header is not None else first.line - 1
    elif stated.skip_lines:
        options["skip_lines"] = stated.skip_lines
    if stated.decimal is not None:
        options["decimal"] = stated.decimal
    if stated.curve is not None:
        options["curve"] = stated.curve
    return options


def _settled(marked: Sequence[MarkedRecording], groups: Sequence[Group]) -> NumberMarks:
    """The marks of the numbers; where these are open, quantities outside of the table decide."""
    every = [each.marks for each in marked]
    found = next((marks for marks in every if marks.is_open or marks.thousands), every[0])
    if not found.is_open:
        return found
    rows = [row for group in groups for row in (*group.numbers.above, *group.numbers.below)]
    return marks_with_text(found, "\n".join(" ".join(row.cells) for row in rows))


def _hints(source: Source, first: Group, columns: Sequence[ColumnGuess], titles: Sequence[Hint]) -> list[Hint]:
    """Texts in which words for a test count, the surest first; the name of the file comes last."""
    above, sheet = title_hints(first.numbers)
    return [header_hint([each.header for each in columns], first.others), above, sheet,
            *(title for title in titles if title.text != above.text), *label_hints(first.numbers),
            Hint(source.file.stem, "in the name of the file", is_file_name=True)]


def _is_strain(column: ColumnGuess) -> bool:
    """Return whether a stretch was recorded as a strain or a displacement."""
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


def _told_apart(groups: Sequence[Group]) -> bool:
    """Return whether the names of the columns find these tables and no other column."""
    for group in groups:
        header = group.numbers.header
        if header is None or not all(column.header for column in group.columns):
            return False
        count = sum(other.numbers is group.numbers for other in groups)
        if any(len(matches(header.cells, column.header)) != count for column in group.columns):
            return False
    return True


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
    """Return the rows above the numbers as lines of text."""
    rows = [*numbers.above[-40:], *(row for row in (numbers.header, numbers.units) if row is not None)]
    return [" ".join(row.cells) for row in rows]


def _warnings(source: Source, readings: Sequence[Reading]) -> tuple[str, ...]:
    found = []
    tables = {name for reading in readings for name in reading.sheets}
    empty = [table.name for table in source.tables if table.name and table.name not in tables]
    if empty and len(source.tables) > 1:
        found.append(f"no recording in {'sheet' if len(empty) == 1 else 'sheets'} {', '.join(map(repr, empty))}")
    return tuple(found)
