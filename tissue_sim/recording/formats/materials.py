"""Readings of one file whose tables have titles of different materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.formats.assumption import Alternative, Assumption
from tissue_sim.recording.formats.guesses import ColumnHints, Reading
from tissue_sim.recording.formats.pairing import Group
from tissue_sim.recording.formats.sizes import size_signature
from tissue_sim.recording.formats.statements import Statements
from tissue_sim.recording.formats.titles import block_title, materials_of

#: Subject of the question on different titles.
_SUBJECT = "titles of the tables"


def by_material(reading: Reading, groups: Sequence[Group], places: Sequence[tuple[str, int]],
                stated: ColumnHints) -> list[Reading]:
    """One reading for each material that the titles of the tables name, and for each size of the specimen.

    Args:
        reading: of all the tables. groups: the tables, in the order of the file.
        places: (sheet, line of the header) of each recording.
        stated: `ColumnHints.one_material` keeps the tables together.
    """
    tables = _tables(groups, places)
    # A repeated header continues a recording, whose sizes may be stated below any of its parts. A statement about one
    # of several alike tables may contradict a statement about the others.
    reading = replace(reading, stated=read_only(_all_statements(groups)))
    if tables is None:
        return [reading]
    titles = [title for _, title in tables]
    materials = [""] * len(titles) if stated.one_material else materials_of(titles)
    keys = [(material, size_signature(group.stated, reading.kind.kind))
            for material, (group, _) in zip(materials, tables, strict=True)]
    if len(set(keys)) < 2:
        return [reading]
    numbers = _numbers(reading, len(places))
    different = list(dict.fromkeys(materials))
    question = _question(different, titles, materials, numbers) if len(different) > 1 else ()
    found = []
    for key in dict.fromkeys(keys):
        chosen = [i for i, each in enumerate(keys) if each == key]
        curves = [numbers[i] for i in chosen]
        name = materials[chosen[0]] or titles[chosen[0]] or f"table {curves[0]}"
        found.append(replace(
            reading, name=name, recordings=tuple(reading.recordings[i] for i in chosen),
            stated=read_only(_all_statements([tables[i][0] for i in chosen])),
            options=read_only({**reading.options, "curve": curves if len(curves) > 1 else curves[0]}),
            assumptions=(*reading.assumptions, *question)))
    return found


def with_different_titles(readings: Sequence[Reading], tables: Sequence[Sequence[Group]], stated: ColumnHints
                          ) -> tuple[Reading, ...]:
    """The readings with a question where tables of one kind of test differ in columns or units, and their titles name
    different materials.

    Args:
        readings: of all tables. tables: those with equal columns and units together.
    """
    alike = {(reading.kind.kind, *sorted(column.channel for column in reading.columns)) for reading in readings}
    if len(tables) < 2 or len(alike) > 1 or stated.one_material:
        return tuple(readings)
    titles = [block_title(group.numbers, [column.place - 1 for column in group.columns], side_by_side=False)
              for group, *_ in tables]
    materials = materials_of(titles)
    different = list(dict.fromkeys(materials))
    if len(different) < 2 or any(each.subject == _SUBJECT for reading in readings for each in reading.assumptions):
        return tuple(readings)
    listed = ", ".join(repr(titles[materials.index(each)]) for each in different)
    question = Assumption(
        _SUBJECT, f"different materials, imported one by one: {listed}",
        ("the titles differ by more than a running number",), (),
        (Alternative("replicates of one material", None, "--one-material"),), "--column and --unit of one of them")
    return tuple(replace(reading, assumptions=(*reading.assumptions, question)) for reading in readings)


def _all_statements(groups: Sequence[Group]) -> dict[str, str]:
    """Key -> value of what the file states about any of the tables."""
    found = Statements(groups[0].stated)
    for group in groups[1:]:
        for key, value in group.stated.items():
            found.add(key, value, f"line {group.line}")
    return found


def _question(different: Sequence[str], titles: Sequence[str], materials: Sequence[str], numbers: Sequence[int]
              ) -> tuple[Assumption, ...]:
    """Return whether tables with different names are of one material."""
    flags = {each: " ".join(f"--curve {number}" for number, material in zip(numbers, materials, strict=True)
                            if material == each) for each in different}
    listed = ", ".join(f"{titles[materials.index(each)]!r} ({flags[each]})" for each in different)
    return (Assumption(
        _SUBJECT, f"different materials, imported one by one: {listed}",
        ("the titles differ by more than a running number",), (),
        (Alternative("replicates of one material", None, "--one-material"),)),)


def _numbers(reading: Reading, count: int) -> list[int]:
    """Numbers from 1 of the recordings in the file."""
    curve = reading.options.get("curve")
    return list(range(1, count + 1)) if curve is None else [curve] if isinstance(curve, int) else list(curve)


def _tables(groups: Sequence[Group], places: Sequence[tuple[str, int]]) -> list[tuple[Group, str]] | None:
    """The table of each recording, with its title; None if a recording has no table here."""
    tables: dict[tuple[str, int], list[Group]] = {}
    for group in groups:
        tables.setdefault((group.numbers.table.name, group.line), []).append(group)
    several_sheets = len({sheet for sheet, _ in places}) > 1
    seen: dict[tuple[str, int], int] = {}
    found: list[tuple[Group, str]] = []
    for place in places:
        shared, number = tables.get(place, []), seen.get(place, 0)
        seen[place] = number + 1
        if number >= len(shared):
            return None
        group = shared[number]
        title = block_title(group.numbers, [column.place - 1 for column in group.columns], side_by_side=len(shared) > 1)
        found.append((group, f"{place[0]} {title}".strip() if several_sheets else title))
    return found
