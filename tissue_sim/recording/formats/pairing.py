"""Find columns of one recording: the motion, the load and the time in a run of numbers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.cell_units import CellUnits, split_quantity
from tissue_sim.recording.formats.columns import column_number
from tissue_sim.recording.formats.gauge_length import displacement_of_strain, gauge_length, stretch_of_displacement
from tissue_sim.recording.formats.guesses import ColumnGuess, ColumnHints
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.kind_hints import title_hints
from tissue_sim.recording.formats.kind_words import named_tests
from tissue_sim.recording.formats.number_text import is_number
from tissue_sim.recording.formats.sizes import size_signature, sizes_without_unit
from tissue_sim.recording.formats.sources import Numbers
from tissue_sim.recording.formats.speed_text import speeds_in
from tissue_sim.recording.formats.statements import constant_columns
from tissue_sim.recording.formats.temperature import has_temperature
from tissue_sim.recording.formats.vocabulary import Machine, plain, role_of, source_of
from tissue_sim.recording.measures import ENGINEERING, MEASURES, measure_of
from tissue_sim.recording.recording import CHANNELS
from tissue_sim.units import UNITS, known_unit

#: Role of a column -> channel of a recording. The strain of a test is one less than its stretch.
_CHANNEL = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
            "strain": "stretch", "shear strain": "shear strain", "stress": "nominal stress",
            "temperature": "temperature"}
#: Largest relative difference of a stated speed from the speed in the file.
_SPEED_TOLERANCE = 0.01
#: A shear strain keeps the measure that its header names, which has no conversion.
_CHANNEL_OF_MEASURE = {"shear strain": "stretch"}


class KnownColumn(NamedTuple):
    """A column whose header determines its role.

    Attributes:
        place: position, from 0. role, rank: see `role_of`. variant: source and measure of the column; two columns
            of a role with different variants belong to one recording.
    """

    place: int
    role: str
    rank: int
    variant: tuple[str, str] = ("", "")


@dataclass(frozen=True)
class Group:
    """Columns of one recording in a run of numbers.

    Attributes:
        numbers: the run. columns: columns that are read. others: headers of further columns with a role.
        rivals: columns of the same quantity as a column that is read, in the order of their ranks. Strains of other
            measures are the same quantity.
        speed: constant speed that replaces a column of the motion, m/s, and its source; None: not needed.
        stated: key -> value with unit, as the file states them about these numbers.
    """

    numbers: Numbers
    columns: tuple[ColumnGuess, ...]
    others: tuple[str, ...]
    rivals: tuple[ColumnGuess, ...] = ()
    speed: tuple[float, str] | None = None
    stated: Mapping[str, str] = field(default_factory=dict)

    @property
    def line(self) -> int:
        """Line of the header, or of the first row of numbers."""
        return (self.numbers.header or self.numbers.rows[0]).line

    @property
    def signature(self) -> tuple:
        """Key of columns, sizes and words for a test, which is equal for tables that are replicates."""
        sheet = self.numbers.table.name
        sizes = size_signature(self.stated) if sheet else ()
        tests = sorted({each.title for each in named_tests(title_hints(self.numbers))}) if sheet else ()
        return (*sizes, *tests, self.speed,
                *((each.channel, each.header or each.place, each.unit) for each in self.columns))


def find_groups(numbers: Numbers, machine: Machine | None, stated: ColumnHints, statements: Mapping[str, str]
                ) -> list[Group]:
    """Return the recordings in adjacent columns: a motion, a load, and optionally the time.

    Args:
        statements: key -> value with unit, as the file states them about these numbers.
    """
    if stated.columns:
        named = [column for channel, name in stated.columns.items()
                 if (column := _stated_column(numbers, channel, name, stated))]
        return [_stated_group(numbers, named, stated, statements)] if len(named) == len(stated.columns) else []
    # A constant column "Height" is the size of the specimen, not the position of the crosshead.
    sizes = {place for place, _ in constant_columns(numbers)}
    roles = [KnownColumn(place, *known, _variant(numbers, place, known[0])) for place in numbers.columns
             if place not in sizes and (known := role_of(numbers.bare_name(place), numbers.unit(place), machine))]
    groups: list[Group] = []
    time = None
    for part in _adjacent(roles):
        chosen = _best(part)
        speed, gauge = None, None
        pair: tuple[str, ...] | None = _pair(chosen, stated)
        if pair is None and (speed := _speed_for(chosen, numbers, stated)):
            pair = ("force",)
        elif derived := _derived_pair(part, chosen, pair):
            gauge = gauge_length(numbers, statements, stated)
            pair = derived if gauge is not None else pair
        if pair is None:
            continue
        time = chosen.get("time", time)
        wanted = {**({"time": time} if time is not None else {}), **{role: chosen[role] for role in pair},
                  **({"temperature": chosen["temperature"]} if has_temperature(numbers, chosen) else {})}
        rank = {each.place: each.rank for each in part}
        columns = tuple(replace(_column(numbers, place, role, machine, stated), rank=rank.get(place, 0))
                        for role, place in wanted.items())
        if gauge is not None:
            columns = tuple(_with_gauge_length(column, pair[0], gauge) for column in columns)
        others = tuple(numbers.name(each.place) for each in part if each.place not in wanted.values())
        same = {*pair, *(("displacement",) if gauge is not None and pair[1] == "force" else ())}
        rivals = tuple(replace(_column(numbers, each.place, each.role, machine, stated), rank=each.rank)
                       for each in sorted(part, key=lambda each: each.rank)
                       if each.role in same and each.place not in wanted.values())
        if gauge is not None:
            rivals = tuple(_with_gauge_length(column, pair[0], gauge) for column in rivals)
        elif pair == ("displacement", "force") and (length := gauge_length(numbers, statements, stated)) is not None:
            # A strain that is not the displacement over the gauge length comes from another sensor.
            rivals = (*rivals, *(replace(displacement_of_strain(strain, length), rank=rank[chosen["displacement"]])
                                 for each in part if each.role in ("strain", "shear strain")
                                 and each.variant[1] not in MEASURES
                                 and not (strain := _column(numbers, each.place, each.role, machine, stated)).missing))
        groups.append(Group(numbers, columns, others, rivals, speed))
    return groups


def _stated_group(numbers: Numbers, named: Sequence[ColumnGuess], stated: ColumnHints,
                  statements: Mapping[str, str]) -> Group:
    """The recording of the columns that the user names."""
    roles = {column.role: column for column in named}
    motion = next((role for role, load in (("strain", "force"), ("shear strain", "force"), ("displacement", "stress"))
                   if {role, load} <= roles.keys()), None)
    mechanical = {"displacement", "force"} <= roles.keys()
    gauge = gauge_length(numbers, statements, stated) if motion is not None and not mechanical else None
    if gauge is not None and motion is not None and roles[motion].measure is None:
        named = [_with_gauge_length(column, motion, gauge) for column in named]
    return Group(numbers, tuple(named), (), (), _speed_for(roles, numbers, stated))


def _derived_pair(part: Sequence[KnownColumn], chosen: Mapping[str, int], pair: tuple[str, ...] | None
                  ) -> tuple[str, str] | None:
    """Roles of a motion and a load that belong together once the gauge length is known: a strain and a force, or a
    displacement and a stress; None: no such columns.

    A strain that is measured on the specimen replaces a displacement that is not.
    """
    by_place = {each.place: each for each in part}
    strain = next((by_place[chosen[role]] for role in ("strain", "shear strain") if role in chosen), None)
    if strain is not None and strain.variant[1] not in MEASURES and "force" in chosen and (
            pair is None or (pair == ("displacement", "force") and strain.variant[0] == "specimen"
                             and by_place[chosen["displacement"]].variant[0] != "specimen")):
        return strain.role, "force"
    return ("displacement", "stress") if pair is None and {"displacement", "stress"} <= chosen.keys() else None


def _with_gauge_length(column: ColumnGuess, motion: str, gauge: tuple[float, str]) -> ColumnGuess:
    """Convert the column of the motion by the gauge length; other columns are unchanged."""
    if column.role != motion or column.missing:
        return column
    convert = stretch_of_displacement if motion == "displacement" else displacement_of_strain
    return convert(column, gauge)


def _variant(numbers: Numbers, place: int, role: str) -> tuple[str, str]:
    words = plain(numbers.name(place))
    return source_of(words), measure_of(words, role) or ""


def _speed_for(roles: Collection[str], numbers: Numbers, stated: ColumnHints) -> tuple[float, str] | None:
    """The constant speed of a table of time and force without a motion, m/s, and its source; None: not such a table, or
    no speed is known."""
    if not {"time", "force"} <= set(roles) or set(roles) & {"displacement", "stretch", "strain", "shear strain"}:
        return None
    speeds = speeds_in((*numbers.above, *numbers.below))
    if stated.speed is not None:
        if speeds and not any(abs(speed / stated.speed - 1.0) <= _SPEED_TOLERANCE for speed in speeds):
            lines = "; ".join(speeds.values())
            raise InputError(f"speed of {1e3 * stated.speed:g} mm/s contradicts the file ({lines}); leave the flag "
                             "out, or that line (--skip-lines)", field="--speed-mm-s")
        return stated.speed, "stated"
    return next(((speed, f"in the file: {line}") for speed, line in speeds.items()), None) if len(speeds) == 1 else None


def _adjacent(roles: Sequence[KnownColumn]) -> list[list[KnownColumn]]:
    """Columns of adjacent recordings: a new one begins where a role is repeated in the same variant and as
    surely, if the columns before have a motion and a load, and the columns from there on have them too."""
    parts: list[list[KnownColumn]] = [[]]
    for i, known in enumerate(roles):
        same = [each for each in parts[-1] if _like(each.role) == _like(known.role) and each.rank <= known.rank
                and each.variant == known.variant]
        if same and _complete(parts[-1]) and _complete(_until_repeated(roles[i:])):
            parts.append([])
        parts[-1].append(known)
    return parts


def _until_repeated(roles: Sequence[KnownColumn]) -> list[KnownColumn]:
    seen: list[KnownColumn] = []
    for each in roles:
        if any(_like(other.role) == _like(each.role) and other.variant == each.variant for other in seen):
            break
        seen.append(each)
    return seen


def _like(role: str) -> str:
    return "strain" if role in ("strain", "stretch", "shear strain") else role


def _complete(part: Sequence[KnownColumn]) -> bool:
    roles = {_like(each.role) for each in part}
    return bool(roles & {"displacement", "strain"}) and bool(roles & {"force", "stress"})


def _best(part: Sequence[KnownColumn]) -> dict[str, int]:
    """Role -> place of the column whose name says it most surely, the first of several."""
    best: dict[str, KnownColumn] = {}
    for each in part:
        if each.role not in best or each.rank < best[each.role].rank:
            best[each.role] = each
    return {role: each.place for role, each in best.items()}


def _pair(chosen: Mapping[str, int], stated: ColumnHints) -> tuple[str, str] | None:
    """Roles of the motion and the load that belong together; what the load frame measured before what is derived."""
    sheared = stated.kind == "simple_shear" or "shear strain" in chosen
    mechanical = [("displacement", "force")]
    direct = [("shear strain" if sheared else "stretch", "stress"), ("strain", "stress"), ("stretch", "stress")]
    pairs = [*direct, *mechanical] if stated.direct else [*mechanical, *direct]
    return next((pair for pair in pairs if set(pair) <= set(chosen)), None)


def _column(numbers: Numbers, place: int, role: str, machine: Machine | None, stated: ColumnHints, *,
            is_named: bool = False) -> ColumnGuess:
    channel = _CHANNEL[role]
    unit, header = numbers.unit(place), numbers.name(place)
    reason = f"header {header!r}" if header else f"column {place + 1}"
    if is_named:
        reason = f"stated ({reason})" if header else "stated"
    said = {name: values.get(role, values.get(channel)) for name, values in
            (("unit", stated.units), ("scale", stated.scales), ("sign", stated.signs))}
    if said["unit"] is not None:
        unit, reason = str(said["unit"]), f"{reason}; unit as stated"
    elif unit is None and machine is not None and role in machine.units:
        unit, reason = machine.units[role], f"{reason} without unit: {machine.title} writes {machine.units[role]}"
    elif numbers.units is not None:
        reason += ", unit behind each number" if isinstance(numbers.units, CellUnits) else ", unit in the row below"
    if unit is not None and said["unit"] is None and unit not in UNITS and _is_remark(unit, role):
        # "Strain (true)", "Load (corrected)", "ln(lambda)": the brackets hold no unit.
        unit = "-" if CHANNELS[channel] == "ratio" else None
    column = ColumnGuess(channel, header, place + 1, unit, role, int(said["sign"] or 1),
                         None if said["scale"] is None else float(said["scale"]), None, bool(header), reason,
                         other_unit=None if said["unit"] is not None else _other_unit(numbers, place, unit))
    return with_measure(column, stated.measures.get(role, stated.measures.get(channel)))


def _other_unit(numbers: Numbers, place: int, unit: str | None) -> str | None:
    """The unit in the row of units, if it has another size than that of the header; None: no contradiction."""
    cells = () if numbers.units is None else numbers.units.cells
    below = known_unit(cells[place]) if place < len(cells) else None
    if below is None or unit not in UNITS or UNITS[below] == UNITS[unit]:
        return None
    return below


def _is_remark(text: str, role: str) -> bool:
    words = plain(text)
    return bool(measure_of(words, role) or source_of(words)) or words in ("lambda", "λ")


def with_measure(column: ColumnGuess, stated: str | None = None) -> ColumnGuess:
    """The column with the offset or the conversion that its measure of strain or stress needs.

    Args:
        column: without either. stated: measure that replaces that of the header.
    """
    measure = stated or measure_of(plain(column.header), column.role)
    if column.role == "stretch" and measure == ENGINEERING and not stated:
        measure = None
    own = MEASURES.get(measure or "")
    reason = f"{column.reason}; measure as stated" if stated else column.reason
    if own is not None and own.channel in (column.channel, _CHANNEL_OF_MEASURE.get(column.channel)):
        return replace(column, measure=measure, role="strain" if column.channel == "stretch" else column.role,
                       reason=f"{reason}; a {own.title}: {own.formula}")
    if column.channel == "stretch" and (column.role == "strain" or measure == ENGINEERING):
        return replace(column, role="strain", offset=100.0 if column.unit == "%" else 1.0,
                       reason=f"{reason}; a strain, which 1 makes a stretch")
    return replace(column, reason=reason)


def _stated_column(numbers: Numbers, channel: str, name: str | int, stated: ColumnHints) -> ColumnGuess | None:
    """Return the column that the user names; None: this table has no such column."""
    place = _place(numbers, name)
    if place is None or place not in numbers.columns:
        return None
    role = {"nominal stress": "stress"}.get(channel, channel)
    return _column(numbers, place, role, None, stated, is_named=True)


def _place(numbers: Numbers, name: str | int) -> int | None:
    """Place from 0 of the column with this header, number or letter; None: there is none."""
    places = [] if isinstance(name, int) or numbers.header is None else matches(numbers.header.cells, name)
    if places:
        return places[0]
    try:
        place = column_number(int(name) if isinstance(name, str) and name.isdigit() else name) - 1
    except InputError:
        return None
    return place if place < numbers.width else None


def no_pair(found: Sequence[Numbers], machine: Machine | None, stated: ColumnHints,
            statements: Callable[[Numbers], Mapping[str, str]]) -> str:
    """Return the message for a file without a recording, which lists all missing information.

    Args:
        statements: table -> key and value with unit, as the file states them about it.
    """
    numbers = max(found, key=lambda each: len(each.rows))
    names = [numbers.name(place) for place in numbers.columns]
    has = (f"the columns are {', '.join(map(repr, names))}" if any(names)
           else f"its {len(numbers.columns)} columns of numbers have no names")
    if stated.columns:
        missing = [(channel, name) for channel, name in stated.columns.items()
                   if _stated_column(numbers, channel, name, stated) is None]
        broken = [f"column {channel} = {name} cannot be read: {said}" for channel, name in missing
                  if (said := _unreadable(numbers, _place(numbers, name)))]
        absent = [f"{channel} = {name}" for channel, name in missing if not _unreadable(numbers, _place(numbers, name))]
        return "; ".join([*broken, *([f"has no column {' and none '.join(absent)}: {has}"] if absent else [])])
    bare = [numbers.bare_name(place).casefold().replace(" ", "").replace("_", "") for place in numbers.columns]
    if any({f"{word}1", f"{word}2"} <= set(bare) for word in ("lambda", "stretch", "λ")):
        return (f"is a biaxial test ({has}), of which there is no kind here; of its rows, those with a free second "
                "side are uniaxial_tension")
    sizes = {place for place, _ in constant_columns(numbers)}
    known = {role for place in numbers.columns if place not in sizes
             if (role := (role_of(numbers.bare_name(place), numbers.unit(place), machine) or [None])[0])}
    lacks = [what for what, roles in (("a motion (displacement, stretch, strain)",
                                       {"displacement", "stretch", "strain", "shear strain"}),
                                      ("a load (force, stress)", {"force", "stress"})) if not known & roles]
    if not lacks and not known & {"stretch"}:
        seen = [text for size, text in sizes_without_unit(statements(numbers)).items()
                if size in ("height", "length", "gauge length", "thickness", "gap")]
        which = f"of which the file states {', '.join(map(repr, seen))} without a known unit" if seen else \
            "which its columns and the text above them do not state"
        return (f"needs the gauge length, {which}: {has}; state it (--height-mm), for a strain and a force, or a "
                "displacement and a stress, belong together by it")
    true = [name for place in numbers.columns
            if measure_of(plain(name := numbers.name(place)), "stress") in MEASURES]
    if lacks and true and "stress" in known:
        return (f"has a true stress in {', '.join(map(repr, true))}, which needs the stretch to become a nominal "
                f"stress: {has}; add a column of stretch, strain or displacement")
    if "force" in known and "time" in known and len(lacks) == 1:
        return (f"shows no column with a motion (displacement, stretch, strain): {has}; name it, with its unit, such "
                "as --column displacement=2 --unit displacement=mm, or state the constant speed (--speed-mm-s)")
    wanted = " and ".join(lacks) if lacks else "a motion and a load that belong together"
    broken = [said for place in range(numbers.width) if place not in numbers.columns
              and (said := _unreadable(numbers, place))]
    if lacks and broken:
        return f"has columns that cannot be read: {'; '.join(broken)}; {has}"
    return (f"shows no column with {wanted}: {has}; name them, with units, such as --column displacement=2 --unit "
            "displacement=mm --column force=3 --unit force=N")


def _unreadable(numbers: Numbers, place: int | None) -> str:
    """Which cell of a column is not a number, in words; empty for a column that is not there."""
    if place is None:
        return ""
    row = next((row for row in numbers.rows if place < len(row.cells) and row.cells[place]
                and not is_number(row.cells[place])), None)
    name = numbers.name(place)
    if row is None:
        return ""
    pair = split_quantity(row.cells[place])
    fault = "which is not a number" if pair is None else \
        f"and other cells have another unit than {pair[1]} or none; give all cells of the column one unit"
    return f"line {row.line}: {f'{name!r} holds ' if name else ''}{row.cells[place][:40]!r}, {fault}"


def alike(groups: Sequence[Group]) -> list[list[Group]]:
    """Tables with the same columns together, of a spreadsheet those of specimens of one size."""
    together: dict[tuple, list[Group]] = {}
    for group in groups:
        together.setdefault(group.signature, []).append(group)
    return list(together.values())
