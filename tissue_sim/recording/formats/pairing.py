"""Find the columns of each recording in a table: motion, load, and optionally time and temperature.

Strain is converted to displacement, or displacement to stretch, by the gauge length.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.blocks import find_positions_of_cells_with_name
from tissue_sim.recording.formats.columns import parse_column_number_or_letters
from tissue_sim.recording.formats.guesses import ColumnGuess, InterpretationOverrides
from tissue_sim.recording.formats.kind_guess import make_hints_from_text_above_and_sheet_name
from tissue_sim.recording.formats.kind_words import find_named_tests
from tissue_sim.recording.formats.number_text import is_number_with_either_mark
from tissue_sim.recording.formats.sizes import (
    find_loading_speeds_and_their_lines,
    find_sizes_and_speed_in_mm,
    make_size_signature,
)
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.recording.formats.statements import iterate_constant_size_columns
from tissue_sim.recording.formats.table import UnitRowExtractedFromCells
from tissue_sim.recording.formats.vocabulary import (
    MachineFormat,
    classify_column_source_or_empty,
    find_role_and_rank_or_none,
    normalize_header_text,
)
from tissue_sim.recording.measures import ENGINEERING, MEASURES, find_measure_name_in_header_or_none
from tissue_sim.recording.recording import CHANNELS
from tissue_sim.units import UNITS, find_known_unit_or_none, find_quantity_of_unit_or_none, get_si_factor_and_offset


def find_gauge_length_and_source_or_none(numbers: NumberTable, statements: Mapping[str, str],
                                         hints: InterpretationOverrides) -> tuple[float, str] | None:
    """Return the gauge length, m, and its source: the user or the file; None: unknown.

    Args:
        numbers: table of numbers.
        statements: statements of the file about these numbers, key -> value with unit.
        hints: hints of the user; `InterpretationOverrides.height` is the gauge length.
    """
    if hints.height is not None:
        return hints.height, "stated"
    kinds = {each.kind for each in find_named_tests(make_hints_from_text_above_and_sheet_name(numbers)) if each.kind}
    kind = hints.kind or (kinds.pop() if len(kinds) == 1 else None)
    size = find_sizes_and_speed_in_mm(statements, kind).get("height_mm")
    return None if size is None or kind is None else (1e-3 * size.value, size.reason)


def make_displacement_column_from_strain(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """Return a column of engineering or shear strain as a displacement in mm, by the gauge length (m, source)."""
    length, source = gauge
    factor = (column.scale or 1.0) * get_si_factor_and_offset(column.unit or "-", "ratio")[0]
    return replace(column, channel="displacement", unit="mm", scale=round(1e3 * length * factor, 9), offset=None,
                   strain_unit=column.unit or "-",
                   reason=f"{_strip_conversion_from_reason(column)}; displacement = strain x {1e3 * length:g} mm "
                   f"({source})")


def make_stretch_column_from_displacement(column: ColumnGuess, gauge: tuple[float, str]) -> ColumnGuess:
    """Return a column of displacement as a stretch, by the gauge length (m, source)."""
    length, source = gauge
    factor = (column.scale or 1.0) * get_si_factor_and_offset(column.unit or "m", "length")[0]
    return replace(column, channel="stretch", unit="-", scale=factor / length, offset=1.0,
                   reason=f"{_strip_conversion_from_reason(column)}; stretch = 1 + displacement / {1e3 * length:g} mm "
                   f"({source})")


def _strip_conversion_from_reason(column: ColumnGuess) -> str:
    """Return the reason of a column guess without the sentence about its earlier conversion by the gauge length."""
    return column.reason.split("; a strain, ")[0]


def is_converted_by_gauge_length(column: ColumnGuess) -> bool:
    """Return whether the channel of a column was computed with the gauge length (strain <-> displacement)."""
    return (column.channel, column.role) in (("displacement", "strain"), ("displacement", "shear strain"),
                                             ("stretch", "displacement"))


def uses_gauge_length(columns: Sequence[ColumnGuess]) -> bool:
    """Return whether one of the columns was converted by the gauge length."""
    return any(is_converted_by_gauge_length(column) for column in columns)


def has_temperature_in_all_rows(numbers: NumberTable, places: Mapping[str, int]) -> bool:
    """Return whether a table has a temperature in all rows.

    Args:
        numbers: table of numbers.
        places: role -> position of its column, from 0.
    """
    if "temperature" not in places:
        return False
    place = places["temperature"]
    unit = numbers.get_unit_in_header_or_unit_row(place)
    if unit is not None and find_quantity_of_unit_or_none(unit) != "temperature":
        return False
    return all(place < len(row.cells) and is_number_with_either_mark(row.cells[place]) for row in numbers.rows)


#: Role of a column -> channel of a recording. A strain is read as the stretch (strain + 1).
_CHANNEL_OF_ROLE = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
                    "strain": "stretch", "shear strain": "shear strain", "stress": "nominal stress",
                    "angle": "angle", "torque": "torque",
                    "temperature": "temperature"}
#: Largest relative difference of a stated speed from the speed in the file.
_SPEED_TOLERANCE = 0.01
#: Channel -> channel with the measures that its header may name. The measure of a shear strain is not converted.
_CHANNEL_OF_MEASURE = {"shear strain": "stretch"}


class ColumnPositionWithRole(NamedTuple):
    """A column whose header determines its role.

    Attributes:
        position: position of the column, from 0.
        role: role; see `find_role_and_rank_or_none`.
        rank: rank; see `find_role_and_rank_or_none`.
        variant: source and measure of the column. Columns with one role and different variants belong to one
            recording.
    """

    position: int
    role: str
    rank: int
    variant: tuple[str, str] = ("", "")


@dataclass(frozen=True)
class RecordingColumns:
    """Columns of one recording in a table of numbers.

    Attributes:
        numbers: table of numbers.
        columns: columns that are read.
        others: headers of further columns with a role.
        rivals: columns with the same quantity as a column that is read, sorted by rank. Strains of different measures
            are the same quantity.
        speed: constant speed, m/s, that replaces a column of the motion, and its source; None: not needed.
        stated: statements of the file about these numbers, key -> value with unit.
    """

    numbers: NumberTable
    columns: tuple[ColumnGuess, ...]
    others: tuple[str, ...]
    rivals: tuple[ColumnGuess, ...] = ()
    speed: tuple[float, str] | None = None
    stated: Mapping[str, str] = field(default_factory=dict)

    @property
    def line_number_of_header_or_first_row(self) -> int:
        """Line number in the file (from 1) of the header or, without a header, of the first row of numbers."""
        return (self.numbers.header or self.numbers.rows[0]).line

    @property
    def signature_of_columns_sizes_and_tests(self) -> tuple:
        """Hashable key of columns, sizes and words for a test; the signatures of replicates are equal."""
        columns = [(each.channel, each.header or each.place, each.unit) for each in self.columns]
        if not self.numbers.table.name:
            return (self.speed, *columns)
        named = find_named_tests(make_hints_from_text_above_and_sheet_name(self.numbers))
        tests = sorted({each.kind_or_unregistered_title for each in named})
        return (*make_size_signature(self.stated), *tests, self.speed, *columns)


def find_recording_columns(numbers: NumberTable, machine: MachineFormat | None, hints: InterpretationOverrides,
                           statements: Mapping[str, str]) -> list[RecordingColumns]:
    """Return the columns of each recording in a table with one or several recordings side by side.

    Args:
        numbers: table of numbers.
        machine: machine that wrote the file; None: unknown.
        hints: hints of the user.
        statements: statements of the file about these numbers, key -> value with unit.
    """
    if hints.columns:
        named = [column for channel, name in hints.columns.items()
                 if (column := find_column_named_by_user_or_none(numbers, channel, name, hints))]
        return [_build_user_columns(numbers, named, hints, statements)] if len(named) == len(hints.columns) else []
    if (both := _find_columns_of_two_axes_or_none(numbers, machine, hints)) is not None:
        return [both]
    # A constant column "Height" is the size of the specimen, not the position of the crosshead.
    sizes = {position for position, _ in iterate_constant_size_columns(numbers)}
    roles = [ColumnPositionWithRole(position, *known, _find_source_and_measure_in_header(numbers, position, known[0]))
             for position in numbers.columns if position not in sizes
             and (known := find_role_and_rank_or_none(numbers.get_header_without_unit(position),
                                                      numbers.get_unit_in_header_or_unit_row(position), machine))]
    groups: list[RecordingColumns] = []
    time = None
    for part in _split_adjacent_recordings(roles):
        chosen = _select_best_column_position_per_role(part)
        speed, gauge = None, None
        pair: tuple[str, ...] | None = _select_motion_and_load_roles_or_none(chosen, hints)
        if pair is None and (speed := _get_stated_constant_speed_or_none(chosen, numbers, hints)):
            pair = ("force",)
        elif derived := _find_roles_needing_gauge_length(part, chosen, pair):
            gauge = find_gauge_length_and_source_or_none(numbers, statements, hints)
            pair = derived if gauge is not None else pair
        if pair is None:
            continue
        time = chosen.get("time", time)
        wanted = {**({"time": time} if time is not None else {}), **{role: chosen[role] for role in pair},
                  **({"temperature": chosen["temperature"]} if has_temperature_in_all_rows(numbers, chosen) else {})}
        rank = {each.position: each.rank for each in part}
        columns = tuple(replace(_interpret_column_of_known_role(numbers, position, role, machine, hints),
                                rank=rank.get(position, 0)) for role, position in wanted.items())
        if gauge is not None:
            columns = tuple(_convert_motion_column_by_gauge_length(column, pair[0], gauge) for column in columns)
        unread = [each for each in part if each.position not in wanted.values()]
        others = tuple(numbers.get_column_header(each.position) for each in unread)
        same = {*pair, *(("displacement",) if gauge is not None and pair[1] == "force" else ())}
        rivals = tuple(replace(_interpret_column_of_known_role(numbers, each.position, each.role, machine, hints),
                               rank=each.rank)
                       for each in sorted(unread, key=lambda each: each.rank) if each.role in same)
        if gauge is not None:
            rivals = tuple(_convert_motion_column_by_gauge_length(column, pair[0], gauge) for column in rivals)
        elif pair == ("displacement", "force") and (
                length := find_gauge_length_and_source_or_none(numbers, statements, hints)) is not None:
            # A strain that differs from displacement / gauge length was measured by another sensor.
            strains = [_interpret_column_of_known_role(numbers, each.position, each.role, machine, hints)
                       for each in part if each.role in ("strain", "shear strain") and each.variant[1] not in MEASURES]
            rivals = (*rivals,
                      *(replace(make_displacement_column_from_strain(strain, length), rank=rank[chosen["displacement"]])
                        for strain in strains if not strain.missing_information_text_or_none))
        groups.append(RecordingColumns(numbers, columns, others, rivals, speed))
    return groups


#: Header without unit -> quantity and axis, such as ``lambda1``, ``P 11``, ``stretch y`` or ``x strain``.
_AXIS_AT_END = re.compile(r"(?P<stem>.*?)\s?(?:axis |direction )?(?P<axis>11|22|xx|yy|1|2|x|y)")
_AXIS_AT_START = re.compile(r"(?:axis |direction )?(?P<axis>11|22|xx|yy|1|2|x|y) (?P<stem>.+)")
#: Index of the axis that a header names.
_AXES = {"1": 0, "11": 0, "x": 0, "xx": 0, "2": 1, "22": 1, "y": 1, "yy": 1}
#: Symbols of a quantity that are read only with the number of an axis.
_SYMBOLS = {"l": "stretch", "p": "stress", "s": "stress", "t": "stress", "pk1": "stress", "e": "strain",
            "u": "displacement"}
#: Roles of motion and load that match.
_MATCHING_ROLES = (("displacement", "force"), ("stretch", "stress"), ("strain", "stress"))


def _find_columns_of_two_axes_or_none(numbers: NumberTable, machine: MachineFormat | None,
                                      hints: InterpretationOverrides) -> RecordingColumns | None:
    """Return the columns of a biaxial test: a motion and a load for each of two axes; None: another table.

    Numbered columns may also belong to two specimens. They are axes if words name a kind with several motions, or if
    both stretches precede both stresses.

    Args:
        numbers: table of numbers.
        machine: machine that wrote the file; None: unknown.
        hints: hints of the user.
    """
    named = [hints.kind] if hints.kind is not None else [
        each.kind for each in find_named_tests(make_hints_from_text_above_and_sheet_name(numbers))]
    is_named = any(KINDS[kind].has_several_motions for kind in named if kind is not None)
    if hints.kind is not None and not is_named:
        return None
    found: dict[str, dict[int, int]] = {}
    is_lettered = True
    for position in numbers.columns:
        words = normalize_header_text(numbers.get_header_without_unit(position))
        match = _AXIS_AT_START.fullmatch(words) or _AXIS_AT_END.fullmatch(words)
        unit = numbers.get_unit_in_header_or_unit_row(position)
        if match is None or (role := _find_role_of_axis_or_none(match["stem"], unit, machine)) is None:
            continue
        found.setdefault(role, {}).setdefault(_AXES[match["axis"]], position)
        is_lettered &= match["axis"] not in ("1", "2")
    pairs = [pair for pair in _MATCHING_ROLES if all(found.get(role, {}).keys() == {0, 1} for role in pair)]
    motion, load = next(iter(reversed(pairs) if hints.direct else pairs), ("", ""))
    if not motion or not (is_named or is_lettered
                          or (load == "stress" and max(found[motion].values()) < min(found[load].values()))):
        return None
    time = next((position for position in numbers.columns if (known := find_role_and_rank_or_none(
        numbers.get_header_without_unit(position), numbers.get_unit_in_header_or_unit_row(position), machine))
        and known[0] == "time"), None)
    columns = [] if time is None else [_interpret_column_of_known_role(numbers, time, "time", machine, hints)]
    columns += [_move_to_axis(_interpret_column_of_known_role(numbers, found[role][axis], role, machine, hints), axis)
                for axis in (0, 1) for role in (motion, load)]
    read = {column.place - 1 for column in columns}
    others = tuple(numbers.get_column_header(position) for position in numbers.columns if position not in read)
    return RecordingColumns(numbers, tuple(columns), others)


def _find_role_of_axis_or_none(stem: str, unit: str | None, machine: MachineFormat | None) -> str | None:
    """Return the role of a column of one axis from its header without the axis; None: none of a motion or a load."""
    symbol = _SYMBOLS.get(stem)
    if symbol is not None and unit is None:
        return symbol
    known = find_role_and_rank_or_none(stem, unit, machine)
    return symbol if known is None else known[0]


def _move_to_axis(column: ColumnGuess, axis: int) -> ColumnGuess:
    """Return a column as that of an axis, 0 or 1."""
    return replace(column, channel=f"{column.channel} 2") if axis else column


def _build_user_columns(numbers: NumberTable, named: Sequence[ColumnGuess], hints: InterpretationOverrides,
                        statements: Mapping[str, str]) -> RecordingColumns:
    """Return the columns of the one recording whose columns the user names with flags."""
    roles = {column.role: column for column in named}
    motion = next((role for role, load in (("strain", "force"), ("shear strain", "force"), ("displacement", "stress"))
                   if {role, load} <= roles.keys()), None)
    mechanical = {"displacement", "force"} <= roles.keys()
    gauge = find_gauge_length_and_source_or_none(numbers, statements, hints) if motion and not mechanical else None
    if gauge is not None and motion is not None and roles[motion].measure is None:
        named = [_convert_motion_column_by_gauge_length(column, motion, gauge) for column in named]
    return RecordingColumns(numbers, tuple(named), (), (), _get_stated_constant_speed_or_none(roles, numbers, hints))


def _find_roles_needing_gauge_length(part: Sequence[ColumnPositionWithRole], chosen: Mapping[str, int],
                                     pair: tuple[str, ...] | None) -> tuple[str, str] | None:
    """Return roles of motion and load that match only with a known gauge length; None: no such columns.

    The roles are a strain and a force, or a displacement and a stress. A strain that was measured on the specimen
    replaces a displacement that was measured elsewhere.

    Args:
        part: columns of the recording.
        chosen: role -> position of its best column.
        pair: roles that match without the gauge length; None: no such roles.
    """
    by_place = {each.position: each for each in part}
    strain = next((by_place[chosen[role]] for role in ("strain", "shear strain") if role in chosen), None)
    if strain is not None and strain.variant[1] not in MEASURES and "force" in chosen and (
            pair is None or (pair == ("displacement", "force") and strain.variant[0] == "specimen"
                             and by_place[chosen["displacement"]].variant[0] != "specimen")):
        return strain.role, "force"
    return ("displacement", "stress") if pair is None and {"displacement", "stress"} <= chosen.keys() else None


def _convert_motion_column_by_gauge_length(column: ColumnGuess, motion: str, gauge: tuple[float, str]) -> ColumnGuess:
    """Convert a column of the motion by the gauge length (m, source); other columns are returned unchanged.

    A displacement becomes a stretch, and a strain a displacement.
    """
    if column.role != motion or column.missing_information_text_or_none:
        return column
    if motion == "displacement":
        return make_stretch_column_from_displacement(column, gauge)
    return make_displacement_column_from_strain(column, gauge)


def _find_source_and_measure_in_header(numbers: NumberTable, position: int, role: str) -> tuple[str, str]:
    """Return source and measure that the header of a column names; empty texts for missing words."""
    words = normalize_header_text(numbers.get_column_header(position))
    return classify_column_source_or_empty(words), find_measure_name_in_header_or_none(words, role) or ""


def _get_stated_constant_speed_or_none(roles: Collection[str], numbers: NumberTable,
                                       hints: InterpretationOverrides) -> tuple[float, str] | None:
    """Return constant speed (m/s) and its source for a table of time and force without a motion.

    Returns:
        None: another table, or an unknown speed.

    Raises:
        InputError: the speed in the file contradicts the speed that the user states.
    """
    if not {"time", "force"} <= set(roles) or set(roles) & {"displacement", "stretch", "strain", "shear strain"}:
        return None
    speeds = find_loading_speeds_and_their_lines((*numbers.above, *numbers.below))
    if hints.speed is not None:
        if speeds and not any(abs(speed / hints.speed - 1.0) <= _SPEED_TOLERANCE for speed in speeds):
            lines = "; ".join(speeds.values())
            raise InputError(f"speed of {1e3 * hints.speed:g} mm/s contradicts the file ({lines}); omit the flag, "
                             "or omit the line of the file (--skip-lines)", field="--speed-mm-s")
        return hints.speed, "stated"
    return next(((speed, f"in the file: {line}") for speed, line in speeds.items()), None) if len(speeds) == 1 else None


def _split_adjacent_recordings(roles: Sequence[ColumnPositionWithRole]) -> list[list[ColumnPositionWithRole]]:
    """Split the columns of a table into recordings side by side.

    A recording begins at a column that repeats a role and variant with an equal or a higher rank, if the previous
    columns have a motion and a load, and the following columns have a motion and a load, too.
    """
    parts: list[list[ColumnPositionWithRole]] = [[]]
    for i, known in enumerate(roles):
        is_repeated = any(_unify_role(each.role) == _unify_role(known.role) and each.rank <= known.rank
                          and each.variant == known.variant for each in parts[-1])
        if is_repeated and _has_motion_and_load(parts[-1]) and _has_motion_and_load(
                _take_columns_before_repeated_role(roles[i:])):
            parts.append([])
        parts[-1].append(known)
    return parts


def _take_columns_before_repeated_role(roles: Sequence[ColumnPositionWithRole]) -> list[ColumnPositionWithRole]:
    """Return the columns before the first column that repeats role and variant of any earlier column.

    Strain, stretch and shear strain count as one role.
    """
    seen: list[ColumnPositionWithRole] = []
    for each in roles:
        if any(_unify_role(other.role) == _unify_role(each.role) and other.variant == each.variant for other in seen):
            break
        seen.append(each)
    return seen


def _unify_role(role: str) -> str:
    """Return ``strain`` for the role of any measure of deformation, else the role without a change."""
    return "strain" if role in ("strain", "stretch", "shear strain") else role


def _has_motion_and_load(part: Sequence[ColumnPositionWithRole]) -> bool:
    """Return whether the columns include a motion and a load."""
    roles = {_unify_role(each.role) for each in part}
    return (bool(roles & {"displacement", "strain"}) and bool(roles & {"force", "stress"})) or {
        "angle", "torque"} <= roles


def _select_best_column_position_per_role(part: Sequence[ColumnPositionWithRole]) -> dict[str, int]:
    """Return role -> position of the column with the lowest rank; the first one of columns with equal ranks."""
    best: dict[str, ColumnPositionWithRole] = {}
    for each in part:
        if each.role not in best or each.rank < best[each.role].rank:
            best[each.role] = each
    return {role: each.position for role, each in best.items()}


def _select_motion_and_load_roles_or_none(chosen: Mapping[str, int],
                                          hints: InterpretationOverrides) -> tuple[str, str] | None:
    """Return matching roles of motion and load; None: no such columns.

    Displacement and force, the measured quantities, are preferred unless `InterpretationOverrides.direct` is true.
    """
    sheared = hints.kind == "simple_shear" or "shear strain" in chosen
    twisted = [("angle", "torque")]
    mechanical = [*twisted, ("displacement", "force")] if hints.kind == "torsion" else [("displacement", "force")]
    direct = [("shear strain" if sheared else "stretch", "stress"), ("strain", "stress"), ("stretch", "stress")]
    pairs = [*direct, *mechanical] if hints.direct else [*mechanical, *direct, *twisted]
    return next((pair for pair in pairs if set(pair) <= set(chosen)), None)


def _interpret_column_of_known_role(numbers: NumberTable, position: int, role: str, machine: MachineFormat | None,
                                    hints: InterpretationOverrides, *, is_named: bool = False) -> ColumnGuess:
    """Return the interpretation of a column with a given role.

    Args:
        numbers: table of numbers.
        position: position of the column, from 0.
        role: role of the column.
        machine: machine whose default units are used; None: no default units.
        hints: hints of the user: units, scales, signs, measures.
        is_named: whether the user names the column.
    """
    channel = _CHANNEL_OF_ROLE[role]
    unit, header = numbers.get_unit_in_header_or_unit_row(position), numbers.get_column_header(position)
    reason = f"header {header!r}" if header else f"column {position + 1}"
    if is_named:
        reason = f"stated ({reason})" if header else "stated"
    said = {name: values.get(role, values.get(channel)) for name, values in
            (("unit", hints.units), ("scale", hints.scales), ("sign", hints.signs))}
    if said["unit"] is not None:
        unit, reason = str(said["unit"]), f"{reason}; unit as stated"
    elif unit is None and machine is not None and role in machine.units:
        unit, reason = machine.units[role], f"{reason} without unit: {machine.title} writes {machine.units[role]}"
    elif numbers.units is not None:
        is_from_cells = isinstance(numbers.units, UnitRowExtractedFromCells)
        reason += ", unit after each number" if is_from_cells else ", unit in the row below"
    if unit is not None and said["unit"] is None and unit not in UNITS and _is_bracket_remark(unit, role):
        # "Strain (true)", "Load (corrected)", "ln(lambda)": the brackets hold no unit.
        unit = "-" if CHANNELS[channel] == "ratio" else None
    other_unit = None if said["unit"] is not None else _find_unit_below_differing_from_header(numbers, position, unit)
    column = ColumnGuess(channel, header, position + 1, unit, role, int(said["sign"] or 1),
                         None if said["scale"] is None else float(said["scale"]), None, bool(header), reason,
                         other_unit=other_unit)
    return add_measure_conversion_to_column(column, hints.measures.get(role, hints.measures.get(channel)))


def _find_unit_below_differing_from_header(numbers: NumberTable, position: int, unit: str | None) -> str | None:
    """Return the unit in the row of units if its size differs from the unit in the header; None: no contradiction."""
    cells = () if numbers.units is None else numbers.units.cells
    below = find_known_unit_or_none(cells[position]) if position < len(cells) else None
    if below is None or unit not in UNITS or UNITS[below] == UNITS[unit]:
        return None
    return below


def _is_bracket_remark(text: str, role: str) -> bool:
    """Return whether a text in brackets is a measure, a source or a symbol instead of a unit."""
    words = normalize_header_text(text)
    return bool(find_measure_name_in_header_or_none(words, role) or classify_column_source_or_empty(words)) \
        or words in ("lambda", "λ")


def add_measure_conversion_to_column(column: ColumnGuess, stated_measure: str | None = None) -> ColumnGuess:
    """Return the column with the conversion of its measure to stretch (strain + 1 if engineering) or nominal stress.

    Args:
        column: column without offset and measure.
        stated_measure: measure that replaces the measure in the header; None: the measure in the header.
    """
    measure = stated_measure or find_measure_name_in_header_or_none(normalize_header_text(column.header), column.role)
    if column.role == "stretch" and measure == ENGINEERING and not stated_measure:
        measure = None
    own = MEASURES.get(measure or "")
    reason = f"{column.reason}; measure as stated" if stated_measure else column.reason
    if own is not None and own.channel in (column.channel, _CHANNEL_OF_MEASURE.get(column.channel)):
        return replace(column, measure=measure, role="strain" if column.channel == "stretch" else column.role,
                       reason=f"{reason}; a {own.title}: {own.formula}")
    if column.channel == "stretch" and (column.role == "strain" or measure == ENGINEERING):
        return replace(column, role="strain", offset=100.0 if column.unit == "%" else 1.0,
                       reason=f"{reason}; a strain, which 1 makes a stretch")
    return replace(column, reason=reason)


def find_column_named_by_user_or_none(numbers: NumberTable, channel: str, name: str | int,
                                      hints: InterpretationOverrides) -> ColumnGuess | None:
    """Return the column that the user names; None: this table has no such column."""
    position = find_column_position_or_none(numbers, name)
    if position is None or position not in numbers.columns:
        return None
    base = channel.removesuffix(" 2")
    role = {"nominal stress": "stress"}.get(base, base)
    return _move_to_axis(_interpret_column_of_known_role(numbers, position, role, None, hints, is_named=True),
                         int(base != channel))


def find_column_position_or_none(numbers: NumberTable, name: str | int) -> int | None:
    """Return the position (from 0) of the column with this header, number (from 1) or letter; None: no such column."""
    if not isinstance(name, int) and numbers.header is not None:
        positions = find_positions_of_cells_with_name(numbers.header.cells, name)
        if positions:
            return positions[0]
    try:
        position = parse_column_number_or_letters(int(name) if isinstance(name, str) and name.isdigit() else name) - 1
    except InputError:
        return None
    return position if position < numbers.column_count else None


def group_replicate_recording_columns(groups: Sequence[RecordingColumns]) -> list[list[RecordingColumns]]:
    """Return lists of tables with equal columns; in a spreadsheet, also with equal sizes of the specimen."""
    together: dict[tuple, list[RecordingColumns]] = {}
    for group in groups:
        together.setdefault(group.signature_of_columns_sizes_and_tests, []).append(group)
    return list(together.values())
