"""Explain which columns of a file are missing for a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from tissue_sim.recording.formats.guesses import InterpretationOverrides
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, split_number_and_unit
from tissue_sim.recording.formats.pairing import find_column_named_by_user_or_none, find_column_position_or_none
from tissue_sim.recording.formats.sizes import find_size_texts_without_known_unit
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.recording.formats.statements import iterate_constant_size_columns
from tissue_sim.recording.formats.vocabulary import MachineFormat, find_role_and_rank_or_none, normalize_header_text
from tissue_sim.recording.measures import MEASURES, find_measure_name_in_header_or_none


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
        return (f"is a biaxial test ({has}), which has no registered kind; the rows with a stress-free second "
                "direction are of kind uniaxial_tension")
    sizes = {position for position, _ in iterate_constant_size_columns(numbers)}
    known = {role for position in numbers.columns if position not in sizes
             if (
                 role := (find_role_and_rank_or_none(
                     numbers.get_header_without_unit(position), numbers.get_unit_in_header_or_unit_row(position),
                     machine) or [None])[0])}
    missing_roles = [words for words, roles in (("a motion (displacement, stretch, strain)",
                                                 {"displacement", "stretch", "strain", "shear strain"}),
                                                ("a load (force, stress)", {"force", "stress"})) if not known & roles]
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
    return (f"shows no column with {wanted}: {has}; name the columns, such as --column "
            "displacement=2 --unit displacement=mm --column force=3 --unit force=N")


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
