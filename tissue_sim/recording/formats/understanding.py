"""Interpret a file of measurements: find its tables, and the meaning of their columns.

Each result is an assumption with a reason and an option of `tissue_sim.read_recordings`, which the user can correct.
All missing information is reported in one message.

Tables of dynamic moduli: see `tissue_sim.recording.formats.modulus_tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.recording.cleaning import (
    find_first_sample_value_or_none,
    remove_outliers_and_saturation,
    subtract_start_values,
)
from tissue_sim.recording.formats.blocks import find_positions_of_cells_with_name
from tissue_sim.recording.formats.columns import RecordingWithDecimalMark
from tissue_sim.recording.formats.decimal_mark import (
    DecimalAndThousandsMarks,
    detect_decimal_and_thousands_marks,
    resolve_marks_by_quantities_outside_table,
)
from tissue_sim.recording.formats.guesses import ColumnGuess, FileInterpretation, InterpretationOverrides, TableGroup
from tissue_sim.recording.formats.interpretation import (
    compare_columns_and_replace_constant_ones,
    iterate_column_assumptions,
    make_constant_speed_assumption,
    make_machine_assumption,
)
from tissue_sim.recording.formats.kind_guess import (
    check_kind_and_list_remarks,
    collect_label_hints,
    guess_kind,
    make_header_hint_without_unregistered_tests,
    make_hints_from_file_top_and_text_sheets,
    make_hints_from_text_above_and_sheet_name,
    make_kind_assumption,
    set_column_signs_and_zeros,
)
from tissue_sim.recording.formats.kind_words import KindHint
from tissue_sim.recording.formats.materials import (
    add_material_question_if_titles_differ,
    split_table_group_by_material_and_size,
)
from tissue_sim.recording.formats.modulus_tables import split_off_modulus_tables
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, split_number_and_unit
from tissue_sim.recording.formats.pairing import (
    RecordingColumns,
    find_column_named_by_user_or_none,
    find_column_position_or_none,
    find_recording_columns,
    group_replicate_recording_columns,
)
from tissue_sim.recording.formats.sizes import find_size_texts_without_known_unit
from tissue_sim.recording.formats.sources import FileContent, NumberTable, list_all_number_tables, read_file_content
from tissue_sim.recording.formats.statements import (
    FileStatementsByKey,
    add_rows_statements_except_known_sizes,
    add_statements_of_rows,
    collect_statements_about_table,
    copy_second_with_missing_sizes,
    do_rows_state_specimen_size,
    find_listed_sizes_of_one_recording,
    iterate_constant_size_columns,
)
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.formats.table_reader import FileReaderForChosenColumns
from tissue_sim.recording.formats.vocabulary import (
    MACHINES,
    MachineFormat,
    find_role_and_rank_or_none,
    identify_machine,
    normalize_header_text,
)
from tissue_sim.recording.measures import MEASURES, find_measure_name_in_header_or_none
from tissue_sim.recording.recording import LOADS, MOTIONS
from tissue_sim.settings import make_shallow_read_only_copy

#: Largest number of columns whose values a message states.
_LISTED_COLUMNS = 5
#: Largest number of characters of each of these values.
_LISTED_CHARACTERS = 6


def explain_missing_columns(found: Sequence[NumberTable], machine: MachineFormat | None,
                            hints: InterpretationOverrides,
                            statements: Callable[[NumberTable], Mapping[str, str]]) -> str:
    """Return the message for a file without a recording, which lists all missing information.

    Args:
        found: tables of numbers in the file; the longest table is described.
        machine: machine that wrote the file; None: unknown.
        hints: hints of the user.
        statements: function that returns the statements (key -> value with unit) about a table.
    """
    numbers = max(found, key=lambda each: len(each.rows))
    names = [numbers.get_column_header(position) for position in numbers.columns]
    has = (f"the columns are {', '.join(map(repr, names))}" if any(names)
           else f"its {len(numbers.columns)} columns of numbers have no names")
    if hints.columns:
        missing = [(channel, name) for channel, name in hints.columns.items()
                   if find_column_named_by_user_or_none(numbers, channel, name, hints) is None]
        broken = [f"column {channel} = {name} cannot be read: {said}" for channel, name in missing
                  if (said := _describe_first_unreadable_cell_or_empty(numbers,
                                                                       find_column_position_or_none(numbers, name)))]
        absent = [f"{channel} = {name}" for channel, name in missing
                  if not _describe_first_unreadable_cell_or_empty(numbers, find_column_position_or_none(numbers, name))]
        return "; ".join([*broken, *([f"has no column {' and none '.join(absent)}: {has}"] if absent else [])])
    bare = [numbers.get_header_without_unit(position).casefold().replace(" ", "").replace("_", "")
            for position in numbers.columns]
    if any({f"{word}1", f"{word}2"} <= set(bare) for word in ("lambda", "stretch", "λ")):
        return (f"is a biaxial test without a motion or a load of one axis ({has}). Name the columns of both axes "
                "with --column. Rows with a stress-free second axis are of kind uniaxial_tension")
    if any(name in ("creepcompliance", "relaxationmodulus") for name in bare):
        return (f"contains a creep compliance or a relaxation modulus ({has}), which import cannot read; multiply a "
                "compliance by the held stress, or a modulus by the held strain, and add a column of the held quantity")
    sizes = {position for position, _ in iterate_constant_size_columns(numbers)}
    known = {role for position in numbers.columns if position not in sizes
             if (
                 role := (find_role_and_rank_or_none(
                     numbers.get_header_without_unit(position), numbers.get_unit_in_header_or_unit_row(position),
                     machine) or [None])[0])}
    missing_roles = [words for words, roles in (("a motion (displacement, stretch, strain)",
                                                 {"displacement", "stretch", "strain", "shear strain", "angle"}),
                                                ("a load (force, stress)", {"force", "stress", "torque"}))
                     if not known & roles]
    if not missing_roles and not known & {"stretch"}:
        seen = [text for size, text in find_size_texts_without_known_unit(statements(numbers)).items()
                if size in ("height", "length", "gauge length", "thickness", "gap")]
        gauge = f"of which the file states {', '.join(map(repr, seen))} without a known unit" if seen else \
            "which its columns and the text above them do not state"
        return (f"needs the gauge length, {gauge}: {has}; state the gauge length (--height-mm), which relates a strain "
                "to a force, or a displacement to a stress")
    true = [name for position in numbers.columns
            if find_measure_name_in_header_or_none(normalize_header_text(name := numbers.get_column_header(position)),
                                                   "stress") in MEASURES]
    if missing_roles and true and "stress" in known:
        return (f"has a true stress in {', '.join(map(repr, true))}, whose conversion to a nominal stress needs the "
                f"stretch: {has}; add a column of stretch, strain or displacement")
    if "force" in known and "time" in known and len(missing_roles) == 1:
        return (f"shows no column with a motion (displacement, stretch, strain): {has}; name the column, "
                "such as --column displacement=2 --unit displacement=mm, or state the constant speed "
                "(--speed-mm-s)")
    wanted = " and ".join(missing_roles) if missing_roles else "a matching pair of motion and load"
    broken = [said for position in range(numbers.column_count) if position not in numbers.columns
              and (said := _describe_first_unreadable_cell_or_empty(numbers, position))]
    if missing_roles and broken:
        return f"has columns that cannot be read: {'; '.join(broken)}; {has}"
    remedy = "name the columns, such as --column displacement=2 --unit displacement=mm --column force=3 --unit force=N"
    if not any(names):
        last = ", ".join(cell[:_LISTED_CHARACTERS] for cell in numbers.rows[-1].cells[:_LISTED_COLUMNS])
        return f"shows no column with a motion and a load: {has}; {remedy} (the last row is {last})"
    return f"shows no column with {wanted}: {has}; {remedy}"


def _describe_first_unreadable_cell_or_empty(numbers: NumberTable, position: int | None) -> str:
    """Return a description of the first cell of a column that is not a number; empty without such a cell."""
    if position is None:
        return ""
    row = next((row for row in numbers.rows if position < len(row.cells) and row.cells[position]
                and not is_number_with_either_mark(row.cells[position])), None)
    name = numbers.get_column_header(position)
    if row is None:
        return ""
    pair = split_number_and_unit(row.cells[position])
    fault = "which is not a number" if pair is None else \
        f"and other cells have another unit than {pair[1]} or none; give all cells of the column one unit"
    return f"line {row.line}: {f'{name!r} holds ' if name else ''}{row.cells[position][:40]!r}, {fault}"


#: Number of rows of a table that determine the decimal mark of the lines above and below the table.
_MARKED_ROWS = 2000
#: Channels whose headers may begin with the name of the specimen.
_NAMING_CHANNELS = (*MOTIONS, *LOADS)


def interpret_file(path: str | Path, hints: InterpretationOverrides | None = None) -> FileInterpretation:
    """Interpret the content of a text, spreadsheet or container.

    Args:
        path: the file.
        hints: hints of the user; None: no hints.

    Raises:
        InputError: the file does not exist or has no recording; the message lists all missing information.
    """
    path, hints = Path(path), hints or InterpretationOverrides()
    source = read_file_content(path, delimiter=hints.delimiter, sheet=hints.sheet, skip_lines=hints.skip_lines)
    found = list_all_number_tables(source)
    if not found:
        raise InputError("holds no table of numbers in columns; expected rows of numbers below a header", file=path)
    words = "\n".join(text for numbers in found[:8] for text in _list_text_of_rows_above_and_header(numbers))
    machine = MACHINES.get(hints.format or "") or (None if hints.format == "table" else identify_machine(words))
    titles = make_hints_from_file_top_and_text_sheets(source, found)
    found, moduli, warnings = split_off_modulus_tables(source, found, hints, titles)
    if not found:
        return FileInterpretation(path, machine.name if machine else "table", source.kind, source.tables[0].delimiter,
                                  None, source.encoding, _make_table_group_names_unique(moduli) if len(moduli) > 1
                                  else tuple(moduli), warnings, (make_machine_assumption(machine, hints),))
    tables = [group for numbers in found
              for group in find_recording_columns(numbers, machine, hints, _find_statements(numbers, hints))]
    if not tables:
        kind = guess_kind((), (), [*make_hints_from_text_above_and_sheet_name(found[0]), *titles], machine, hints.kind)
        if kind.refused is not None:
            raise kind.refused.make_refusal_error().with_location(file=path)
        text = explain_missing_columns(found, machine, hints, lambda each: _find_statements(each, hints))
        raise InputError(text, file=path)
    tables = _make_tables_with_statements(source, found, tables, hints)
    with located_and_converted_errors(file=path):
        together = [part for same in group_replicate_recording_columns(tables)
                    for part in _split_by_positions_if_headers_repeat(same)]
        parts = [_interpret_tables_with_equal_columns(
            source, same, hints, machine, titles, _list_unused_headers(same[0].numbers, tables)) for same in together]
        readings, refused = _split_off_unregistered_tests([one for several, _ in parts for one in several], hints)
        readings = (*add_material_question_if_titles_differ(readings, together, hints), *moduli)
    every = [marks for _, marks in parts]
    marks = next((each for each in every if each.is_open), next((each for each in every if each.thousands), every[0]))
    if len(readings) > 1:
        readings = _make_table_group_names_unique(readings)
    return FileInterpretation(path, machine.name if machine else "table", source.kind, source.tables[0].delimiter,
                              marks.decimal if source.kind == "text" else None, source.encoding, readings,
                              (*warnings, *refused, *_make_warnings_of_sheets_without_recording(source, readings)),
                              (make_machine_assumption(machine, hints), *marks.list_assumptions()))


def _split_off_unregistered_tests(readings: Sequence[TableGroup], hints: InterpretationOverrides
                             ) -> tuple[tuple[TableGroup, ...], tuple[str, ...]]:
    """Return the readings of tests with a registered kind, and a sentence about each omitted reading.

    Raises:
        InputError: all readings are of tests without a registered kind.
    """
    kept = tuple(reading for reading in readings if reading.kind.refused is None)
    refused = [reading.kind.refused.make_refusal_error() for reading in readings if reading.kind.refused is not None]
    if hints.any_test:
        return tuple(readings), ()
    if not kept:
        raise refused[0]
    return kept, tuple(dict.fromkeys(f"a table is omitted: {each.problem}" for each in refused))


def _make_tables_with_statements(source: FileContent, found: Sequence[NumberTable], groups: Sequence[RecordingColumns],
                                 hints: InterpretationOverrides) -> list[RecordingColumns]:
    """Return the tables with their statements; a table without sizes has the sizes of the previous table."""
    sheets = {id(numbers.table) for numbers in found}
    elsewhere = [row for table in source.tables if id(table) not in sheets for row in table.rows]
    read = {id(group.numbers) for group in groups}
    # A table of numbers without a recording may be a list of specimens.
    elsewhere += [row for numbers in found if id(numbers) not in read for row in numbers.all_rows_above_in_and_below]
    # Rows below the last table may state the sizes of all tables.
    trailing = [row for group in groups[-1:] for row in group.numbers.below]
    around, count = _get_rows_above_and_below_each_table([group.numbers for group in groups]), len(groups)
    complete: list[RecordingColumns] = []
    for i, group in enumerate(groups):
        above, below, shared = around[id(group.numbers)]
        positions = [column.place - 1 for column in group.columns]
        decimal = hints.decimal or _find_unambiguous_decimal_mark_or_none(group.numbers, positions)
        own = replace(group.numbers, above=above, below=() if shared else below)
        nearby = collect_statements_about_table(own, positions, decimal=decimal, table=i, tables=count)
        # The rows above a table have precedence over a list with one row for each table.
        lists = find_listed_sizes_of_one_recording((*groups[0].numbers.above, *trailing, *elsewhere), decimal, i, count)
        statements = copy_second_with_missing_sizes(lists, nearby)
        previous = complete[-1].stated if complete else {}
        every = FileStatementsByKey(copy_second_with_missing_sizes(previous, statements))
        if shared:
            add_statements_of_rows(below, every, decimal, i, count)
        last = group.numbers is groups[-1].numbers
        add_rows_statements_except_known_sizes(elsewhere if last else [*trailing, *elsewhere], every, decimal, i, count)
        complete.append(replace(group, stated=every))
    return complete


def _get_rows_above_and_below_each_table(tables: Sequence[NumberTable]
                                         ) -> dict[int, tuple[tuple[TableRow, ...], tuple[TableRow, ...], bool]]:
    """Assign the rows between the tables of a sheet to the tables.

    Rows between two tables belong to the lower table. Exception: if no size is stated above the first table, and sizes
    are stated below each table, the rows belong to the upper table. The rows below the last of several tables are about
    all tables.

    Returns:
        Identity of each table of numbers -> rows above, rows below, and whether the rows below are about all tables.
    """
    found: dict[int, tuple[tuple[TableRow, ...], tuple[TableRow, ...], bool]] = {}
    for sheet in dict.fromkeys(id(numbers.table) for numbers in tables):
        blocks = list({id(each): each for each in tables if id(each.table) == sheet}.values())
        after = [*(each.above for each in blocks[1:]), blocks[-1].below]
        if len(blocks) > 1 and not do_rows_state_specimen_size(blocks[0].above) \
            and all(map(do_rows_state_specimen_size, after)):
            found |= {id(each): ((), rows, False) for each, rows in zip(blocks, after, strict=True)}
            continue
        found |= {id(each): (each.above, each.below, bool(each.below) and len(blocks) > 1) for each in blocks}
    return found


def _find_statements(numbers: NumberTable, hints: InterpretationOverrides) -> Mapping[str, str]:
    """Return the statements (key -> value with unit) about a table; see `collect_statements_about_table`."""
    decimal = hints.decimal or _find_unambiguous_decimal_mark_or_none(numbers, numbers.columns)
    return collect_statements_about_table(numbers, (), decimal=decimal)


def _find_unambiguous_decimal_mark_or_none(numbers: NumberTable, positions: Sequence[int]) -> str | None:
    """Return the decimal mark of the first rows of a table; None: no marks, or both decimal marks are possible."""
    rows = numbers.rows[:_MARKED_ROWS]
    cells = [[row.cells[position] for row in rows if position < len(row.cells)] for position in positions]
    marks = detect_decimal_and_thousands_marks(cells, delimiter=numbers.table.delimiter)
    return marks.decimal if (marks.evidence or marks.is_certain) and not marks.is_open else None


def _interpret_tables_with_equal_columns(
        source: FileContent, groups: Sequence[RecordingColumns], hints: InterpretationOverrides,
        machine: MachineFormat | None, titles: Sequence[KindHint], unused: tuple[str, ...]
        ) -> tuple[list[TableGroup], DecimalAndThousandsMarks]:
    """Read tables with equal columns; return one group for each material and size, and the decimal mark of the numbers.

    The signs are chosen so that the load is positive. Each material that the titles name is a separate group.

    Args:
        source: content of the file.
        groups: tables with equal columns.
        hints: hints of the user.
        machine: machine that wrote the file; None: unknown.
        titles: texts with words for a test outside of the tables.
        unused: headers of the columns that are not read.
    """
    first = groups[0]
    sheets = tuple(dict.fromkeys(group.numbers.table.name for group in groups if group.numbers.table.name))
    by_name = _do_headers_identify_columns(groups)
    columns = tuple(replace(column, by_name=by_name) for column in first.columns)
    options = _build_read_options_without_columns(source, first, hints, sheets, by_name=by_name)
    reader = FileReaderForChosenColumns(source.file, options, None if first.speed is None else first.speed[0])
    columns, marked, remarks = reader.read_repairing_time_and_stretch(_require_no_measure_of_shear_strain(columns))
    marks = _resolve_marks_by_numbers_outside_table(marked, groups)
    if marks.decimal != marked[0].marks.decimal:
        again = FileReaderForChosenColumns(source.file, {**options, "decimal": marks.decimal}, reader.speed)
        columns, marked, remarks = again.read_repairing_time_and_stretch(columns)
    if marks.thousands or (marks.example and not marks.is_certain):
        options["decimal"] = marks.decimal
    recordings = tuple(each.recording for each in marked)
    screened, before = [remove_outliers_and_saturation(each) for each in recordings], recordings
    kind = guess_kind([rest for rest, _ in screened], columns, _collect_kind_hints(source, first, columns, titles),
                      machine, hints.kind)
    remarks = (*remarks, *check_kind_and_list_remarks(kind, [each.numbers for each in groups], any_test=hints.any_test))
    if kind.kind == "simple_shear" and any(_is_stretch_from_strain_or_displacement(column) for column in columns):
        columns = _change_stretch_to_shear_strain(columns)
        recordings = reader.read_recordings(_require_no_measure_of_shear_strain(columns))
    signed = {column.channel for column in columns if hints.signs.keys() & {column.channel, column.role}}
    columns, recordings, rivals, compared = compare_columns_and_replace_constant_ones(
        reader.read_recordings, columns, recordings, first.rivals)
    # Signs and zeros are determined without outliers and saturated samples.
    screened = screened if recordings is before else [remove_outliers_and_saturation(each) for each in recordings]
    remaining = [rest for rest, _ in screened]
    starts = [find_first_sample_value_or_none(each, found, "displacement") if "displacement" in each else None
              for each, (_, found) in zip(recordings, screened, strict=True)]
    turned = set_column_signs_and_zeros(columns, remaining, starts, kind.kind, signed)
    recordings = reader.negate_or_reread_changed_channels(recordings, columns, turned)
    columns, zeroed = turned, [column.channel for column in turned if column.offset == "start"]
    recordings = tuple(subtract_start_values(each, zeroed) for each in recordings)
    moved = () if first.speed is None else (make_constant_speed_assumption(first.speed, remaining),)
    remarks = (*remarks, *(sentence for each in moved for sentence in each.against))
    assumptions = (*iterate_column_assumptions(reader.read_recordings, columns, recordings, first.rivals, hints),
                   *moved, *rivals, make_kind_assumption(kind))
    kept = {**options, "columns": {column.channel: column.to_campaign_entry() for column in columns}}
    if marks.is_open:  # an ambiguous decimal mark is a question to the user
        kept.pop("decimal", None)
    reading = TableGroup("", columns, first.others, make_shallow_read_only_copy(kept), recordings, kind,
                         first.line_number_of_header_or_first_row, sheets, make_shallow_read_only_copy(first.stated),
                         (*remarks, *compared), assumptions=assumptions, unused=unused, speed=first.speed)
    lines = [(each.sheet, each.line) for each in marked]
    return split_table_group_by_material_and_size(reading, groups, lines, hints), marks


def _build_read_options_without_columns(source: FileContent, first: RecordingColumns,
                                        hints: InterpretationOverrides,
                                        sheets: Sequence[str], *, by_name: bool) -> dict[str, Any]:
    """Return the options of `tissue_sim.read_recordings` except the columns."""
    options: dict[str, Any] = {}
    if sheets and (len(source.tables) > 1 or hints.sheet is not None):
        options["sheet"] = list(sheets) if len(sheets) > 1 else sheets[0]
    if source.kind == "text" and first.numbers.table.delimiter in ("|", " "):
        options["delimiter"] = first.numbers.table.delimiter
    if not by_name and first.line_number_of_header_or_first_row > 1:
        options["skip_lines"] = first.line_number_of_header_or_first_row - (1 if first.numbers.header is None else 0)
    elif hints.skip_lines:
        options["skip_lines"] = hints.skip_lines
    if hints.decimal is not None:
        options["decimal"] = hints.decimal
    if hints.curve is not None:
        options["curve"] = hints.curve
    return options


def _resolve_marks_by_numbers_outside_table(marked: Sequence[RecordingWithDecimalMark],
                                            groups: Sequence[RecordingColumns]) -> DecimalAndThousandsMarks:
    """Return the marks of the numbers; ambiguous marks are resolved by numbers outside of the table if possible."""
    every = [each.marks for each in marked]
    found = next((marks for marks in every if marks.is_open or marks.thousands), every[0])
    if not found.is_open:
        return found
    rows = [row for group in groups for row in (*group.numbers.above, *group.numbers.below)]
    return resolve_marks_by_quantities_outside_table(found, "\n".join(" ".join(row.cells) for row in rows))


def _collect_kind_hints(source: FileContent, first: RecordingColumns, columns: Sequence[ColumnGuess],
                        titles: Sequence[KindHint]) -> list[KindHint]:
    """Return the texts with words for a test in the order of decreasing reliability; the last is the file name."""
    above, sheet = make_hints_from_text_above_and_sheet_name(first.numbers)
    return [make_header_hint_without_unregistered_tests([each.header for each in columns], first.others), above, sheet,
            *(title for title in titles if title.text != above.text), *collect_label_hints(first.numbers),
            KindHint(source.file.stem, "in the name of the file", is_file_name=True)]


def _is_stretch_from_strain_or_displacement(column: ColumnGuess) -> bool:
    """Return whether a stretch was recorded as a strain or a displacement."""
    return column.channel == "stretch" and column.role != "stretch"


def _change_stretch_to_shear_strain(columns: tuple[ColumnGuess, ...]) -> tuple[ColumnGuess, ...]:
    """Return the columns with shear strain in place of each stretch that was recorded as a strain or a displacement."""
    return tuple(replace(column, channel="shear strain", offset=None,
                         reason=column.reason.replace("; a strain, which 1 makes a stretch", "; sheared"))
                 if _is_stretch_from_strain_or_displacement(column) else column for column in columns)


def _require_no_measure_of_shear_strain(columns: tuple[ColumnGuess, ...]) -> tuple[ColumnGuess, ...]:
    """Return the columns unchanged, after a check that no shear strain has a measure that requires a conversion.

    Raises:
        InputError: the measure is neither an angle nor displacement over height.
    """
    for column in columns:
        if column.channel == "shear strain" and column.measure:
            raise InputError(f"column {column.header!r} holds a shear strain with a measure that cannot be converted; "
                             "give displacement over height")
    return columns


def _list_unused_headers(numbers: NumberTable, tables: Sequence[RecordingColumns]) -> tuple[str, ...]:
    """Return the headers of the columns that no recording reads; the position (from 1) without a header."""
    used = {column.place for group in tables if group.numbers is numbers for column in group.columns}
    return tuple(numbers.get_column_header(position) or str(position + 1)
                 for position in numbers.columns if position + 1 not in used)


def _split_by_positions_if_headers_repeat(groups: list[RecordingColumns]) -> list[list[RecordingColumns]]:
    """Return tables with equal headers in lists that are read at once: all by their headers, or by their positions."""
    if _do_headers_identify_columns(groups):
        return [groups]
    by_positions: dict[tuple[int, ...], list[RecordingColumns]] = {}
    for group in groups:
        by_positions.setdefault(tuple(column.place for column in group.columns), []).append(group)
    return list(by_positions.values())


def _do_headers_identify_columns(groups: Sequence[RecordingColumns]) -> bool:
    """Return whether the headers of the columns identify exactly the columns of these tables."""
    for group in groups:
        header = group.numbers.header
        if header is None or not all(column.header for column in group.columns):
            return False
        count = sum(other.numbers is group.numbers for other in groups)
        if any(len(find_positions_of_cells_with_name(header.cells, column.header)) != count
               for column in group.columns):
            return False
    return True


def _make_table_group_names_unique(readings: Sequence[TableGroup]) -> tuple[TableGroup, ...]:
    """Return the readings with unique names: common beginning of the headers, name of the sheet, or number."""
    named: list[TableGroup] = []
    for number, reading in enumerate(readings, start=1):
        heads = [column.header for column in reading.columns if column.channel in _NAMING_CHANNELS]
        common = _find_common_prefix(heads)
        name = reading.name or common or (reading.sheets[0] if len(reading.sheets) == 1 else "") or str(number)
        if name in [other.name for other in named]:
            name = f"{name}_{number}"
        named.append(replace(reading, name=name))
    return tuple(named)


def _find_common_prefix(heads: Sequence[str]) -> str:
    """Return the common beginning of all headers, cut after the last complete word; empty without one."""
    if len(heads) < 2 or not all(heads):
        return ""
    end = next((i for i, letters in enumerate(zip(*heads, strict=False)) if len(set(letters)) > 1), 0)
    common = heads[0][:end]
    cut = max(common.rfind(mark) for mark in " -_.")
    return common[:cut].strip(" -_.") if cut > 0 else ""


def _list_text_of_rows_above_and_header(numbers: NumberTable) -> list[str]:
    """Return the rows above the numbers as lines of text."""
    rows = [*numbers.above[-40:], *(row for row in (numbers.header, numbers.units) if row is not None)]
    return [" ".join(row.cells) for row in rows]


def _make_warnings_of_sheets_without_recording(source: FileContent, readings: Sequence[TableGroup]) -> tuple[str, ...]:
    """Return a warning if sheets have no recording."""
    tables = {name for reading in readings for name in reading.sheets}
    empty = [table.name for table in source.tables if table.name and table.name not in tables]
    if not empty or len(source.tables) < 2:
        return ()
    return (f"no recording in {'sheet' if len(empty) == 1 else 'sheets'} {', '.join(map(repr, empty))}",)
