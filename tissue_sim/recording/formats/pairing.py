"""Columns that belong together: the motion, the load and the time of a recording in a run of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.columns import column_number
from tissue_sim.recording.formats.guesses import ColumnGuess, Stated
from tissue_sim.recording.formats.header import matches
from tissue_sim.recording.formats.number_text import is_number
from tissue_sim.recording.formats.sizes import size_signature
from tissue_sim.recording.formats.sources import Numbers
from tissue_sim.recording.formats.statements import constant_columns
from tissue_sim.recording.formats.vocabulary import Machine, role_of

#: Role of a column -> channel of a recording. The strain of a test is one less than its stretch.
_CHANNEL = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
            "strain": "stretch", "shear strain": "shear strain", "stress": "nominal stress",
            "temperature": "temperature"}


@dataclass(frozen=True)
class Group:
    """Columns of one recording in a run of numbers, and what the file states about it (key -> value with unit)."""

    numbers: Numbers
    columns: tuple[ColumnGuess, ...]
    others: tuple[str, ...]
    stated: Mapping[str, str] = field(default_factory=dict)

    @property
    def line(self) -> int:
        """Line of the header, or of the first row of numbers."""
        return (self.numbers.header or self.numbers.rows[0]).line

    @property
    def signature(self) -> tuple:
        sizes = size_signature(self.stated) if self.numbers.table.name else ()
        return (*sizes, *((each.channel, each.header or each.place, each.unit) for each in self.columns))


def find_groups(numbers: Numbers, machine: Machine | None, stated: Stated) -> list[Group]:
    """The recordings beside each other: a motion, a load, and the time where there is one."""
    if stated.columns:
        named = [column for channel, name in stated.columns.items()
                 if (column := _stated_column(numbers, channel, name, stated))]
        return [Group(numbers, tuple(named), ())] if len(named) == len(stated.columns) else []
    # A constant column "Height" is the size of the specimen, not the position of the crosshead.
    sizes = {place for place, _ in constant_columns(numbers)}
    roles = [(place, *known) for place in numbers.columns
             if place not in sizes and (known := role_of(numbers.bare_name(place), numbers.unit(place), machine))]
    groups: list[Group] = []
    time = None
    for part in _beside(roles):
        chosen = _best(part)
        pair = _pair(chosen, stated)
        if pair is None:
            continue
        time = chosen.get("time", time)
        wanted = {**({"time": time} if time is not None else {}), **{role: chosen[role] for role in pair},
                  **({"temperature": chosen["temperature"]} if "temperature" in chosen else {})}
        columns = tuple(_column(numbers, place, role, machine, stated) for role, place in wanted.items())
        others = tuple(numbers.name(place) for place, *_ in part if place not in wanted.values())
        groups.append(Group(numbers, columns, others))
    return groups


def _beside(roles: Sequence[tuple[int, str, int]]) -> list[list[tuple[int, str, int]]]:
    """Columns of recordings beside each other: a new one begins where a role comes again as surely, if what stood
    before has a motion and a load, and what follows has them too."""
    parts: list[list[tuple[int, str, int]]] = [[]]
    for i, (place, role, rank) in enumerate(roles):
        same = [each for each in parts[-1] if _like(each[1]) == _like(role) and each[2] <= rank]
        if same and _complete(parts[-1]) and _complete(_until_repeated(roles[i:])):
            parts.append([])
        parts[-1].append((place, role, rank))
    return parts


def _until_repeated(roles: Sequence[tuple[int, str, int]]) -> list[tuple[int, str, int]]:
    seen: list[tuple[int, str, int]] = []
    for each in roles:
        if any(_like(other[1]) == _like(each[1]) for other in seen):
            break
        seen.append(each)
    return seen


def _like(role: str) -> str:
    return "strain" if role in ("strain", "stretch", "shear strain") else role


def _complete(part: Sequence[tuple[int, str, int]]) -> bool:
    roles = {_like(role) for _, role, _ in part}
    return bool(roles & {"displacement", "strain"}) and bool(roles & {"force", "stress"})


def _best(part: Sequence[tuple[int, str, int]]) -> dict[str, int]:
    """Role -> place of the column whose name says it most surely, the first of several."""
    best: dict[str, tuple[int, int]] = {}
    for place, role, rank in part:
        if role not in best or rank < best[role][0]:
            best[role] = (rank, place)
    return {role: place for role, (_, place) in best.items()}


def _pair(chosen: Mapping[str, int], stated: Stated) -> tuple[str, str] | None:
    """Roles of the motion and the load that belong together; what the load frame measured before what is derived."""
    sheared = stated.kind == "simple_shear" or "shear strain" in chosen
    mechanical = [("displacement", "force")]
    direct = [("shear strain" if sheared else "stretch", "stress"), ("strain", "stress"), ("stretch", "stress")]
    pairs = [*direct, *mechanical] if stated.direct else [*mechanical, *direct]
    return next((pair for pair in pairs if set(pair) <= set(chosen)), None)


def _column(numbers: Numbers, place: int, role: str, machine: Machine | None, stated: Stated) -> ColumnGuess:
    channel = _CHANNEL[role]
    unit, header = numbers.unit(place), numbers.name(place)
    reason = f"header {header!r}" if header else f"column {place + 1}"
    said = {name: values.get(role, values.get(channel)) for name, values in
            (("unit", stated.units), ("scale", stated.scales), ("sign", stated.signs))}
    if said["unit"] is not None:
        unit, reason = str(said["unit"]), f"{reason}; unit as stated"
    elif unit is None and machine is not None and role in machine.units:
        unit, reason = machine.units[role], f"{reason} without unit: {machine.title} writes {machine.units[role]}"
    elif numbers.units is not None:
        reason += ", unit in the row below"
    offset: float | None = None
    if role == "strain" and channel == "stretch":
        offset = 100.0 if unit == "%" else 1.0
        reason += "; a strain, which 1 makes a stretch"
    return ColumnGuess(channel, header, place + 1, unit, role, int(said["sign"] or 1),
                       None if said["scale"] is None else float(said["scale"]), offset, bool(header), reason)


def _stated_column(numbers: Numbers, channel: str, name: str | int, stated: Stated) -> ColumnGuess | None:
    """The column that a person names; None: this table has none of that name."""
    place = _place(numbers, name)
    if place is None or place not in numbers.columns:
        return None
    role = {"nominal stress": "stress"}.get(channel, channel)
    column = _column(numbers, place, role, None, stated)
    return replace(column, reason=f"stated{f' (header {column.header!r})' if column.header else ''}")


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


def no_pair(found: Sequence[Numbers], machine: Machine | None, stated: Stated) -> str:
    """Why no table is a recording, everything that is missing in one sentence."""
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
    known = {role for place in numbers.columns
             if (role := (role_of(numbers.bare_name(place), numbers.unit(place), machine) or [None])[0])}
    lacks = [what for what, roles in (("a motion (displacement, stretch, strain)",
                                       {"displacement", "stretch", "strain", "shear strain"}),
                                      ("a load (force, stress)", {"force", "stress"})) if not known & roles]
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
    return "" if row is None else (f"line {row.line}: {f'{name!r} holds ' if name else ''}{row.cells[place][:40]!r}, "
                                   "which is not a number")


def alike(groups: Sequence[Group]) -> list[list[Group]]:
    """Tables with the same columns together, of a spreadsheet those of specimens of one size."""
    together: dict[tuple, list[Group]] = {}
    for group in groups:
        together.setdefault(group.signature, []).append(group)
    return list(together.values())
