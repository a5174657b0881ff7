"""Find the titles of the tables in a file, and the materials that the titles name."""

from __future__ import annotations

import re
from collections.abc import Sequence

from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.recording.formats.vocabulary import normalize_header_text

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
