"""Split the tables of a file by the materials that their titles name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import InterpretationOverrides, TableGroup
from tissue_sim.recording.formats.pairing import RecordingColumns
from tissue_sim.recording.formats.sizes import make_size_signature
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.recording.formats.statements import FileStatementsByKey
from tissue_sim.recording.formats.vocabulary import normalize_header_text
from tissue_sim.settings import make_shallow_read_only_copy

#: Words for one of several replicates. A number or a single letter after such a word is a running number.
_REPLICATE_WORDS = re.compile(
    r"^(replicate|replicates|rep|specimen|sample|run|test|trial|repeat|measurement|measure|cycle|block|part|"
    r"curve|segment|step|table|sheet|data|dataset|set|series|number|no|nr|n|num|id|name|label|title|"
    r"material|probe|probekörper|probenkörper|versuch|messung|wiederholung|tabelle|blatt|prüfung|reihe|"
    r"nummer|essai|éprouvette|échantillon|eprouvette|echantillon|mesure|feuille|feuil|numéro|numero|"
    r"répétition|muestra|probeta|ensayo|hoja|prueba|campione|provino|prova|foglio)$")
#: Words for kinds of tests and parts of a file, which are ignored in the name of a material.
_NEUTRAL_WORDS = re.compile(
    r"^(compression|compressive|tension|tensile|shear|uniaxial|unconfined|indentation|traction|cisaillement|"
    r"druckversuch|zugversuch|scherversuch|druck|zug|results|raw|rawdata|export|the|of|la|le|der|die|das|"
    r"de|du)$")
#: "key: value" or "key = value".
_KEY_VALUE = re.compile(r"^(?P<key>[^:=]{1,40}?)\s*[:=]\s*(?P<value>\S.*)$")
#: Words in keys whose value names a specimen or material.
_NAMING_KEYS = re.compile(
    r"\b(specimen|sample|probe|probenname|material|werkstoff|matériau|échantillon|éprouvette|muestra|"
    r"campione|name|label|bezeichnung)\b")
#: A time of day, or a year.
_DATE = re.compile(r"\d{1,2}:\d{2}|\b(19|20)\d{2}\b")
#: Units of properties of a material: a number with such a unit is not a running number.
_MATERIAL_UNITS = re.compile(r"^(%|kpa|pa|mpa|mm|um|mg|g|ml|wt|vol|mol|mm/s|°c|degc)$")
#: Number of rows above the header that are searched for a title.
_TITLE_ROWS = 12


def find_block_title_or_empty(numbers: NumberTable, places: Sequence[int], *, side_by_side: bool) -> str:
    """Return the title of a table; empty without a title.

    Args:
        numbers: rows of numbers and the rows above them.
        places: positions (from 0) of the columns of the recording.
        side_by_side: whether other tables are in the same rows; only the cells above `places` are then searched.
    """
    for row in reversed(numbers.above[-_TITLE_ROWS:]):
        cells = [cell for i, cell in enumerate(row.cells)
                 if cell and (not side_by_side or min(places) <= i <= max(places))]
        title = _get_title_of_one_or_two_cells(cells)
        if title and not _DATE.search(title):
            return title
    return ""


def _get_title_of_one_or_two_cells(cells: Sequence[str]) -> str:
    """Return the title in a row of one or two cells; empty without a title."""
    if not cells or len(cells) > 2:
        return ""
    first = cells[0].strip("# \t<>[]\"'")
    match = _KEY_VALUE.match(first) if len(cells) == 1 else None
    key, value = (match["key"], match["value"]) if match else (first, cells[1] if len(cells) == 2 else "")
    if value:
        return f"{key} {value}" if _NAMING_KEYS.search(normalize_header_text(key)) else ""
    return first if re.search(r"[^\W\d_]", first) else ""


def derive_material_name_of_each_title(titles: Sequence[str]) -> list[str]:
    """Return the name of the specimen or material for each title; replicates have equal names.

    The titles of replicates differ only in a running number or a word for replicate. A title without a name has the
    name of the previous title.
    """
    named = [_split_material_name_and_running_number(title) for title in titles]
    numbers: dict[str, list[int]] = {}
    for name, number in named:
        if number is not None:
            numbers.setdefault(name, []).append(number)
    found: list[str] = []
    for name, number in named:
        several = numbers.get(name, [])
        # Numbers with large differences, as in "gel 10" and "gel 50", are a property of the material.
        apart = number is not None and max(several) - min(several) > 2 * len(several) + 2
        name = f"{name} {number}" if apart and name else name
        found.append(name or (found[-1] if found else ""))
    first = next((name for name in found if name), "")
    return [name or first for name in found]


def _split_material_name_and_running_number(title: str) -> tuple[str, int | None]:
    """Return the name in a title without words for replicates, and the running number; None: no number."""
    words, kept, number = normalize_header_text(title).split(), [], None
    for i, word in enumerate(words):
        unit = i + 1 < len(words) and _MATERIAL_UNITS.match(words[i + 1]) is not None
        after = i > 0 and _REPLICATE_WORDS.match(words[i - 1]) is not None
        running = after and not unit and (word.isdigit() or len(word) == 1)
        if running or _REPLICATE_WORDS.match(word) or _NEUTRAL_WORDS.match(word):
            continue
        match = re.fullmatch(r"(\D*?)(\d{1,4})", word)
        if match and not unit and i == len(words) - 1 and not after:
            number = int(match[2])
            word = match[1]
        if word:
            kept.append(word)
    name = " ".join(kept)
    return ("" if len(name) == 1 else name), number


#: Subject of the assumption about different titles.
_SUBJECT = "titles of the tables"


def split_table_group_by_material_and_size(reading: TableGroup, groups: Sequence[RecordingColumns],
                                           places: Sequence[tuple[str, int]],
                                           hints: InterpretationOverrides) -> list[TableGroup]:
    """Split a group of tables into one group for each pair of material (by title) and specimen size.

    Args:
        reading: group of all tables.
        groups: tables in the order of the file.
        places: (sheet, line of the header) of each recording.
        hints: hints of the user; `InterpretationOverrides.one_material` disables the split by titles.

    Returns:
        The groups, or the one unchanged group. Several materials add a question to the user to each group.
    """
    tables = _find_table_and_title_of_each_recording(groups, places)
    # A recording may continue below a repeated header, and its size may be stated below any of its parts. Statements
    # about several equal tables may contradict each other.
    reading = replace(reading, stated=make_shallow_read_only_copy(_merge_table_statements(groups)))
    if tables is None:
        return [reading]
    titles = [title for _, title in tables]
    materials = [""] * len(titles) if hints.one_material else derive_material_name_of_each_title(titles)
    keys = [(material, make_size_signature(group.stated, reading.kind.kind))
            for material, (group, _) in zip(materials, tables, strict=True)]
    if len(set(keys)) < 2:
        return [reading]
    numbers = _list_curve_numbers(reading, len(places))
    different = list(dict.fromkeys(materials))
    question = _make_different_materials_assumption(different, titles, materials, numbers) if len(different) > 1 else ()
    found = []
    for key in dict.fromkeys(keys):
        chosen = [i for i, each in enumerate(keys) if each == key]
        curves = [numbers[i] for i in chosen]
        name = materials[chosen[0]] or titles[chosen[0]] or f"table {curves[0]}"
        found.append(replace(
            reading, name=name, recordings=tuple(reading.recordings[i] for i in chosen),
            stated=make_shallow_read_only_copy(_merge_table_statements([tables[i][0] for i in chosen])),
            options=make_shallow_read_only_copy({**reading.options, "curve": curves if len(curves) > 1 else curves[0]}),
            assumptions=(*reading.assumptions, *question)))
    return found


def add_material_question_if_titles_differ(readings: Sequence[TableGroup], tables: Sequence[Sequence[RecordingColumns]],
                                           hints: InterpretationOverrides
                                           ) -> tuple[TableGroup, ...]:
    """Add a question to groups of tables of one kind of test with different columns and titles of different materials.

    Args:
        readings: readings of all tables.
        tables: groups of tables with equal columns and units.
        hints: hints of the user; with `InterpretationOverrides.one_material`, no question is added.
    """
    alike = {(reading.kind.kind, *sorted(column.channel for column in reading.columns)) for reading in readings}
    if len(tables) < 2 or len(alike) > 1 or hints.one_material:
        return tuple(readings)
    titles = [find_block_title_or_empty(group.numbers, [column.place - 1 for column in group.columns],
                                        side_by_side=False)
              for group, *_ in tables]
    materials = derive_material_name_of_each_title(titles)
    different = list(dict.fromkeys(materials))
    if len(different) < 2 or any(each.subject == _SUBJECT for reading in readings for each in reading.assumptions):
        return tuple(readings)
    listed = ", ".join(repr(titles[materials.index(each)]) for each in different)
    question = Assumption(
        _SUBJECT, f"different materials, imported one by one: {listed}",
        ("the titles differ by more than a running number",), (),
        (AlternativeValue("replicates of one material", None, "--one-material"),), "--column and --unit of one of them")
    return tuple(replace(reading, assumptions=(*reading.assumptions, question)) for reading in readings)


def _merge_table_statements(groups: Sequence[RecordingColumns]) -> dict[str, str]:
    """Return the statements (key -> value) about all of the tables."""
    found = FileStatementsByKey(groups[0].stated)
    for group in groups[1:]:
        for key, value in group.stated.items():
            found.add_statement_with_location_if_repeated(key, value,
                                                          f"line {group.line_number_of_header_or_first_row}")
    return found


def _make_different_materials_assumption(different: Sequence[str], titles: Sequence[str], materials: Sequence[str],
                                         numbers: Sequence[int]
                                         ) -> tuple[Assumption, ...]:
    """Return a tuple of one assumption: different names are different materials; alternatively, one material."""
    flags = {each: " ".join(f"--curve {number}" for number, material in zip(numbers, materials, strict=True)
                            if material == each) for each in different}
    listed = ", ".join(f"{titles[materials.index(each)]!r} ({flags[each]})" for each in different)
    return (Assumption(
        _SUBJECT, f"different materials, imported one by one: {listed}",
        ("the titles differ by more than a running number",), (),
        (AlternativeValue("replicates of one material", None, "--one-material"),)),)


def _list_curve_numbers(reading: TableGroup, count: int) -> list[int]:
    """Return the numbers (from 1) of the recordings in the file; `count` is the number of recordings read."""
    curve = reading.options.get("curve")
    return list(range(1, count + 1)) if curve is None else [curve] if isinstance(curve, int) else list(curve)


def _find_table_and_title_of_each_recording(
        groups: Sequence[RecordingColumns],
        places: Sequence[tuple[str, int]]) -> list[tuple[RecordingColumns, str]] | None:
    """Return table and title of each recording; None if a recording has no table in `groups`.

    Args:
        groups: tables in the order of the file.
        places: (sheet, line of the header) of each recording.
    """
    tables: dict[tuple[str, int], list[RecordingColumns]] = {}
    for group in groups:
        tables.setdefault((group.numbers.table.name, group.line_number_of_header_or_first_row), []).append(group)
    several_sheets = len({sheet for sheet, _ in places}) > 1
    seen: dict[tuple[str, int], int] = {}
    found: list[tuple[RecordingColumns, str]] = []
    for place in places:
        shared, number = tables.get(place, []), seen.get(place, 0)
        seen[place] = number + 1
        if number >= len(shared):
            return None
        group = shared[number]
        title = find_block_title_or_empty(group.numbers, [column.place - 1 for column in group.columns],
                                          side_by_side=len(shared) > 1)
        found.append((group, f"{place[0]} {title}".strip() if several_sheets else title))
    return found
