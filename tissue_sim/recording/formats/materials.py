"""Readings of one file whose tables have titles of different materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.formats.assumption import Alternative, Assumption
from tissue_sim.recording.formats.guesses import Reading, Stated
from tissue_sim.recording.formats.pairing import Group
from tissue_sim.recording.formats.titles import block_title, materials_of


def by_material(reading: Reading, groups: Sequence[Group], places: Sequence[tuple[str, int]],
                stated: Stated) -> list[Reading]:
    """One reading for each material that the titles of the tables name.

    Args:
        reading: of all the tables. groups: the tables, in the order of the file.
        places: (sheet, line of the header) of each recording.
        stated: `Stated.one_material` keeps the tables together.
    """
    titles = _titles(groups, places)
    materials = materials_of(titles) if titles else []
    different = list(dict.fromkeys(materials))
    if len(different) < 2 or stated.one_material:
        return [reading]
    numbers = _numbers(reading, len(places))
    names = [next(title for title, material in zip(titles, materials, strict=True) if material == each)
             for each in different]
    listed = ", ".join(map(repr, names))
    question = Assumption(
        "titles of the tables", f"different materials ({listed}), to be imported one by one",
        ("their titles differ by more than a running number",), (),
        (Alternative("one material", None, "--one-material"),), flag=f"--curve {numbers[0]}, ...")
    found = []
    for name, material in zip(names, different, strict=True):
        chosen = [i for i, each in enumerate(materials) if each == material]
        curves = [numbers[i] for i in chosen]
        found.append(replace(
            reading, name=name, recordings=tuple(reading.recordings[i] for i in chosen),
            options=read_only({**reading.options, "curve": curves if len(curves) > 1 else curves[0]}),
            assumptions=(*reading.assumptions, question)))
    return found


def _numbers(reading: Reading, count: int) -> list[int]:
    """Numbers from 1 of the recordings in the file."""
    curve = reading.options.get("curve")
    return list(range(1, count + 1)) if curve is None else [curve] if isinstance(curve, int) else list(curve)


def _titles(groups: Sequence[Group], places: Sequence[tuple[str, int]]) -> list[str]:
    """The title of each recording; empty if a recording has no table here."""
    tables: dict[tuple[str, int], list[Group]] = {}
    for group in groups:
        tables.setdefault((group.numbers.table.name, group.line), []).append(group)
    several_sheets = len({sheet for sheet, _ in places}) > 1
    seen: dict[tuple[str, int], int] = {}
    titles = []
    for place in places:
        beside, number = tables.get(place, []), seen.get(place, 0)
        seen[place] = number + 1
        if number >= len(beside):
            return []
        group = beside[number]
        title = block_title(group.numbers, [column.place - 1 for column in group.columns], beside=len(beside) > 1)
        titles.append(f"{place[0]} {title}".strip() if several_sheets else title)
    return titles
