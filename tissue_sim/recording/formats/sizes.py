"""Parse the sizes of the specimen and the speed of the test from the statements and text of a file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from tissue_sim.experiment.kinds.kind import KINDS, SizeNames, TestKind
from tissue_sim.recording.formats.number_text import parse_number_preferring_point_or_nan
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.formats.vocabulary import classify_size_name, normalize_header_text
from tissue_sim.units import UNITS, find_known_unit_or_none, split_header_and_known_unit

#: Unit of a speed, without blanks, lower case -> m/s.
_SPEED_UNITS = {"mm/min": 1e-3 / 60.0, "mmmin-1": 1e-3 / 60.0, "mm/s": 1e-3, "mm/sec": 1e-3, "mms-1": 1e-3,
                "um/s": 1e-6, "µm/s": 1e-6, "μm/s": 1e-6, "cm/min": 1e-2 / 60.0, "cm/s": 1e-2, "m/s": 1.0,
                "in/min": 0.0254 / 60.0, "in/s": 0.0254}
#: Pattern of a number with a decimal point or comma.
_NUMBER = r"(\d+(?:[.,]\d+)?)"
#: Pattern of a unit of length.
_LENGTH = r"(?:mm|cm|um|µm|μm|in|m)"
#: ``0.5 mm/s``, ``30 mm min-1``.
_SPEED = re.compile(rf"(?<![\w.,]){_NUMBER}\W{{0,3}}({_LENGTH} ?/? ?(?:min|sec|s)(?:-1|\b))", re.IGNORECASE)
#: ``Speed (mm/min): 30``.
_UNIT_FIRST = re.compile(rf"[\[(]({_LENGTH}/(?:min|sec|s))[\])]\W{{0,3}}{_NUMBER}(?![\w.,])", re.IGNORECASE)
#: Words for speeds of other parts of a test than the loading.
_OTHER_SPEED = re.compile(r"\b(approach|return|retract\w*|unload\w*|pre\w*|jog|max\w*|data|rück\w*|"
                          r"vor(kraft|last|weg|spann)\w*|anfahr\w*|retour)\b", re.IGNORECASE)


def find_loading_speeds_and_their_lines(rows: Sequence[TableRow]) -> dict[float, str]:
    """Return speed of loading, m/s -> line, for each speed that the rows state."""
    found: dict[float, str] = {}
    for row in rows:
        line = " ".join(cell for cell in row.cells if cell).replace("⁻¹", "-1").replace("·", " ")
        if _OTHER_SPEED.search(line):
            continue
        pairs = [(number, unit) for number, unit in _SPEED.findall(line)]
        pairs += [(number, unit) for unit, number in _UNIT_FIRST.findall(line)]
        for number, unit in pairs:
            factor = _SPEED_UNITS.get(unit.casefold().replace(" ", ""), 0.0)
            # Twelve digits: 30 mm/min and 0.5 mm/s are the same speed.
            value = float(f"{float(number.replace(',', '.')) * factor:.12g}")
            if value > 0:
                found.setdefault(value, line)
    return found


@dataclass(frozen=True)
class SizeComparisonSettings:
    """Settings of the comparison of two statements of one size.

    Attributes:
        contradiction: largest relative difference of two equal sizes. A smaller value reports more contradictions.
        largest_rounding: largest relative rounding error that a number is assumed to have. A larger value accepts
            larger differences between numbers with few decimals.
    """

    contradiction: float = 0.005
    largest_rounding: float = 0.02


#: Settings that the functions of this module use.
_SETTINGS = SizeComparisonSettings()
#: A number, and optionally a unit.
_QUANTITY_PATTERN = re.compile(
    r"^(?P<number>[-+]?\d[\d.,'\u2019\u00a0\u202f]*(?:[eEdD][-+]?\d+)?)\s*(?P<unit>[^\d\s]\S*(?:\s*\^?2)?)?$")
#: A unit of area as a complete text: ``mm2``, ``[mm^2]``.
_AREA_UNIT_PATTERN = re.compile(r"^\(?\[?(?P<unit>m|cm|mm|in|um|µm)\s*(\^2|²|2)[\])]?$")
#: A unit of area at the end of a key: ``Area (mm2)``.
_AREA_UNIT_IN_KEY = re.compile(r"[\[(/,]?\s*\b(?P<unit>m|cm|mm|in|um|µm)\s*(\^2|²|2)[\])]?\s*(\(line \d+\))?$")
#: Words for a speed.
_SPEED_WORDS = re.compile(r"\b(speed|geschwindigkeit|prüfgeschwindigkeit|vitesse|rate)\b")
#: Words that indicate another speed than the speed of the test.
_OTHER_SPEED_WORDS = re.compile(r"\b(probe|tool|cell|wave|step|data|path|pre)\b")
#: Unit of speed -> factor to mm/s.
_SPEED_FACTORS = {"mm/min": 1.0 / 60.0, "mm/s": 1.0, "mm/sec": 1.0, "um/s": 1e-3, "µm/s": 1e-3, "in/min": 25.4 / 60.0,
                  "cm/min": 10.0 / 60.0}
#: Names of sizes while the kind of test is unknown.
_DEFAULT_SIZE_NAMES = SizeNames()
#: Size in mm or mm2, its relative rounding error, and the keys that state the size.
_Candidate = tuple[float, float, tuple[str, ...]]


@dataclass(frozen=True)
class SizeOrSpeedInMillimetres:
    """A size or speed: key of ``[[specimen]]`` or ``[[test]]``, value in the unit of the key, and source in words."""

    key: str
    value: float
    reason: str


@dataclass(frozen=True)
class _SizeInSiWithRounding:
    """A stated size: key in the file, value in m or m2, and relative rounding error of the value."""

    key: str
    value: float
    rounding: float


def find_sizes_and_speed_in_mm(statements: Mapping[str, str], kind: str | None) -> dict[str, SizeOrSpeedInMillimetres]:
    """Return the stated values of ``radius_mm`` or ``area_mm2``, ``height_mm`` and ``speed_mm_s``.

    Args:
        statements: key -> value; see `tissue_sim.recording.formats.statements.collect_statements_about_table`.
        kind: kind of test; None: unknown.

    Returns:
        Key -> size, for the sizes that the file states.
    """
    found = {key: several[0] for key, several in find_used_and_contradicting_sizes_in_mm(statements, kind).items()}
    for key, text in statements.items():
        if _SPEED_WORDS.search(normalize_header_text(key)) \
            and not _OTHER_SPEED_WORDS.search(normalize_header_text(key)):
            value, unit = _parse_speed_number_and_unit(key, text)
            if value is not None and unit in _SPEED_FACTORS and value > 0:
                found.setdefault("speed_mm_s", SizeOrSpeedInMillimetres("speed_mm_s", value * _SPEED_FACTORS[unit],
                                                                        f"in the file: {key}: {text}"))
    return found


def find_used_and_contradicting_sizes_in_mm(statements: Mapping[str, str],
                                            kind: str | None) -> dict[str, tuple[SizeOrSpeedInMillimetres, ...]]:
    """Return the stated radius or cross-section and the height, each with the statements that contradict it.

    Args:
        statements: key -> value; see `tissue_sim.recording.formats.statements.collect_statements_about_table`.
        kind: kind of test; None: unknown.

    Returns:
        ``radius_mm`` or ``area_mm2``, and ``height_mm`` -> sizes whose relative difference exceeds
        `SizeComparisonSettings.contradiction`. The first size is used; the others contradict it.
    """
    known: dict[str, list[_SizeInSiWithRounding]] = {}
    for key, text in statements.items():
        name = classify_size_name(key)
        one = None if name is None else _parse_stated_area_or_none(key, text) if name == "area" \
            else _parse_stated_length_or_none(key, text)
        if name is not None and one is not None:
            known.setdefault(name, []).append(one)
    found: dict[str, tuple[SizeOrSpeedInMillimetres, ...]] = {}
    test = None if kind is None else KINDS[kind]
    names = _DEFAULT_SIZE_NAMES if test is None else test.size_names
    height = next((name for name in names.height if name in known), None)
    if height is not None:
        found["height_mm"] = _make_sizes_of_distinct_candidates("height_mm",
                                                                [(1e3 * each.value, each.rounding, (each.key,))
                                                                 for each in known[height]], statements)
    # The cross-section of a gripped specimen may have any shape.
    flat = test is not None and test.has_gripped_ends and not names.is_round
    rectangles = _compute_rectangular_areas_mm2(known, test, height)
    radii: list[_Candidate] = [
             (1e3 * factor * each.value, each.rounding, (each.key,))
             for name, factor in (("diameter", 0.5), ("radius", 1.0), ("circumference", 0.5 / math.pi))
             for each in known.get(name, ())]
    areas: list[_Candidate] = [
             (1e6 * each.value, each.rounding, (each.key,)) for each in known.get("area", ())] + rectangles
    if radii or (areas and not flat):
        radii += [(math.sqrt(area / math.pi), 0.5 * rounding, keys) for area, rounding, keys in areas]
        found["radius_mm"] = _make_sizes_of_distinct_candidates("radius_mm", radii, statements)
    elif areas:
        found["area_mm2"] = _make_sizes_of_distinct_candidates("area_mm2", areas, statements)
    return found


def _compute_rectangular_areas_mm2(known: Mapping[str, Sequence[_SizeInSiWithRounding]], kind: TestKind | None,
                                   height: str | None) -> list[_Candidate]:
    """Return cross-sections of rectangular specimens, mm2: width * thickness, or width * length of a block.

    Args:
        known: name of a size -> its statements.
        kind: kind of test; None: unknown.
        height: name of the size that is the height; None: no stated height.
    """
    second = (_DEFAULT_SIZE_NAMES if kind is None else kind.size_names).second
    other = next((name for name in second if name in known and name != height), None)
    if other is None or "width" not in known or (kind is None and other == "thickness"):
        return []
    widths, lengths = (_remove_repeated_sizes([(1e3 * each.value, each.rounding, (each.key,)) for each in known[name]])
                       for name in ("width", other))
    # Equal numbers of widths and lengths are the rows of a list of specimens; otherwise, all products are candidates.
    pairs = zip(widths, lengths, strict=True) if len(widths) == len(lengths) else product(widths, lengths)
    return [(width * length, rounding + also, (*keys, *others))
            for (width, rounding, keys), (length, also, others) in pairs]


def _make_sizes_of_distinct_candidates(key: str, candidates: Sequence[_Candidate], statements: Mapping[str, str]
                                       ) -> tuple[SizeOrSpeedInMillimetres, ...]:
    """Return the first candidate as a `SizeOrSpeedInMillimetres`, and each one that contradicts all previous ones."""
    # Rounded to whole nanometres: 25 mm must not become 25.000000000000004 mm.
    return tuple(SizeOrSpeedInMillimetres(key, round(value, 6),
                                          "in the file: " + ", ".join(f"{name}: {statements[name]}" for name in keys))
                 for value, _, keys in _remove_repeated_sizes(candidates))


def _remove_repeated_sizes(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the candidates that differ from all previous candidates by more than the rounding errors."""
    kept: list[_Candidate] = []
    for value, rounding, keys in candidates:
        if all(abs(value / other - 1.0) > max(_SETTINGS.contradiction, rounding + also) for other, also, _ in kept):
            kept.append((value, rounding, keys))
    return kept


def find_size_texts_without_known_unit(statements: Mapping[str, str]) -> dict[str, str]:
    """Return name of a size, such as ``diameter`` -> its first statement with a missing or unknown unit."""
    found: dict[str, str] = {}
    for key, text in statements.items():
        name, pair = classify_size_name(key), parse_number_and_optional_unit_or_none(text)
        if name is not None and pair is not None and (
                (_parse_stated_area_or_none if name == "area" else _parse_stated_length_or_none)(key, text) is None
                and pair[0] > 0):
            found.setdefault(name, f"{key}: {text}")
    return found


def make_size_signature(statements: Mapping[str, str], kind: str | None = None) -> tuple[tuple[str, float], ...]:
    """Return the stated sizes, sorted by key, without the speed; equal for files or sheets with equal specimens."""
    return tuple(sorted((size.key, size.value) for size in find_sizes_and_speed_in_mm(statements, kind).values()
                        if size.key != "speed_mm_s"))


def parse_number_and_optional_unit_or_none(text: str) -> tuple[float, str | None] | None:
    """Return number and unit of a text such as ``50mm`` or ``12,5 mm``; None if the text is not a quantity."""
    match = _QUANTITY_PATTERN.match(text.strip())
    value = math.nan if match is None else parse_number_preferring_point_or_nan(match["number"].rstrip(",.' "))
    return None if match is None or math.isnan(value) else (value, match["unit"])


def _parse_stated_length_or_none(key: str, text: str) -> _SizeInSiWithRounding | None:
    """Return a stated length, m; None: not a length with a known unit."""
    pair = parse_number_and_optional_unit_or_none(text)
    unit = None if pair is None or pair[1] is None else find_known_unit_or_none(pair[1])
    if pair is None or unit is None or UNITS[unit][0] != "length" or not 0 < pair[0] < 1e9:
        return None
    return _SizeInSiWithRounding(key, pair[0] * UNITS[unit][1], _compute_relative_rounding(text, pair[0]))


def _parse_stated_area_or_none(key: str, text: str) -> _SizeInSiWithRounding | None:
    """Return a stated area, m2; None: not an area with a known unit."""
    number, _, rest = text.strip().partition(" ")
    pair = parse_number_and_optional_unit_or_none(text) or parse_number_and_optional_unit_or_none(number)
    match = (_AREA_UNIT_PATTERN.match((pair[1] or "") if pair else "") or _AREA_UNIT_PATTERN.match(rest.strip())
             or _AREA_UNIT_IN_KEY.search(key))
    if pair is None or match is None or not 0 < pair[0] < 1e9:
        return None
    factor = UNITS[find_known_unit_or_none(match["unit"]) or "mm"][1] ** 2
    return _SizeInSiWithRounding(key, pair[0] * factor, _compute_relative_rounding(text, pair[0]))


def _compute_relative_rounding(text: str, value: float) -> float:
    """Return half a unit of the last decimal over the value; 0 for a number without decimals."""
    match = re.match(r"[-+]?\d+[.,](\d+)", text.strip())
    return min(0.5 * 10.0 ** -len(match[1]) / value, _SETTINGS.largest_rounding) if match else 0.0


def _parse_speed_number_and_unit(key: str, text: str) -> tuple[float | None, str | None]:
    """Return number and unit of a stated speed; None for a missing one."""
    words = text.split()
    match = re.search(r"[\[(]([^\])]*)[\])]\s*$", key)
    unit = match[1] if match else words[1] if len(words) > 1 else split_header_and_known_unit(key)[1]
    pair = parse_number_and_optional_unit_or_none(words[0]) if words else None
    return (None if pair is None else pair[0]), unit
