"""Sizes of the specimen and speed of the test as a file states them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from tissue_sim.recording.formats.number_text import any_number
from tissue_sim.recording.formats.size_words import size_class
from tissue_sim.recording.formats.vocabulary import plain
from tissue_sim.units import UNITS, known_unit, loose_header

#: Relative difference of two statements of one size that is a contradiction.
CONTRADICTION = 0.005
#: Largest relative rounding that excuses a contradiction.
_LARGEST_ROUNDING = 0.02
_QUANTITY = re.compile(
    r"^(?P<number>[-+]?\d[\d.,'\u2019\u00a0\u202f]*(?:[eEdD][-+]?\d+)?)\s*(?P<unit>[^\d\s]\S*(?:\s*\^?2)?)?$")
_SQUARE = re.compile(r"^\(?\[?(?P<unit>m|cm|mm|in|um|µm)\s*(\^2|²|2)[\])]?$")
_IN_KEY = re.compile(r"[\[(/,]?\s*\b(?P<unit>m|cm|mm|in|um|µm)\s*(\^2|²|2)[\])]?\s*(\(line \d+\))?$")
#: Words of a speed, and of what is not the speed of the test.
_SPEED = re.compile(r"\b(speed|geschwindigkeit|prüfgeschwindigkeit|vitesse|rate)\b")
_NOT_SPEED = re.compile(r"\b(probe|tool|cell|wave|step|data|path|pre)\b")
_SPEEDS = {"mm/min": 1.0 / 60.0, "mm/s": 1.0, "mm/sec": 1.0, "um/s": 1e-3, "µm/s": 1e-3, "in/min": 25.4 / 60.0,
           "cm/min": 10.0 / 60.0}
#: Kind of test -> sizes that are its height, the first one that is stated counts.
_HEIGHTS = {"uniaxial_tension": ("gauge length", "length", "height"),
            "simple_shear": ("thickness", "height", "length", "gap")}
_ANY_HEIGHT = ("height", "thickness", "length", "gauge length", "gap")
#: Kinds whose specimen is gripped, so that its cross-section may have any shape.
_GRIPPED = ("uniaxial_tension", "simple_shear")
#: A size in mm or mm2, its relative rounding, and the keys that state it.
_Candidate = tuple[float, float, tuple[str, ...]]


@dataclass(frozen=True)
class Size:
    """A key of ``[[specimen]]`` or ``[[test]]``, its value in the key's unit, and where it comes from."""

    key: str
    value: float
    reason: str


@dataclass(frozen=True)
class _StatedSize:
    """Size in a file, m or m2, with its relative rounding."""

    key: str
    value: float
    rounding: float


def find_sizes(stated: Mapping[str, str], kind: str | None) -> dict[str, Size]:
    """``radius_mm`` or ``area_mm2``, ``height_mm`` and ``speed_mm_s``, as far as a file states them.

    Args:
        stated: key -> value, as of `tissue_sim.recording.formats.statements.table_statements`. kind: of test.
    """
    found = {key: several[0] for key, several in stated_sizes(stated, kind).items()}
    for key, text in stated.items():
        if _SPEED.search(plain(key)) and not _NOT_SPEED.search(plain(key)):
            value, unit = _speed(key, text)
            if value is not None and unit in _SPEEDS and value > 0:
                found.setdefault("speed_mm_s", Size("speed_mm_s", value * _SPEEDS[unit], f"in the file: {key}: {text}"))
    return found


def stated_sizes(stated: Mapping[str, str], kind: str | None) -> dict[str, tuple[Size, ...]]:
    """``radius_mm`` or ``area_mm2``, and ``height_mm`` -> the sizes that a file states for it, more than
    `CONTRADICTION` apart; the first one counts."""
    known: dict[str, list[_StatedSize]] = {}
    for key, text in stated.items():
        name = size_class(key)
        one = None if name is None else _area(key, text) if name == "area" else _length(key, text)
        if name is not None and one is not None:
            known.setdefault(name, []).append(one)
    found: dict[str, tuple[Size, ...]] = {}
    height = next((name for name in _HEIGHTS.get(kind or "", _ANY_HEIGHT) if name in known), None)
    if height is not None:
        found["height_mm"] = _different("height_mm", [(1e3 * each.value, each.rounding, (each.key,))
                                                      for each in known[height]], stated)
    flat = kind in _GRIPPED
    rectangles = _rectangles(known, kind, height)
    radii: list[_Candidate] = [
             (1e3 * factor * each.value, each.rounding, (each.key,))
             for name, factor in (("diameter", 0.5), ("radius", 1.0), ("circumference", 0.5 / math.pi))
             for each in known.get(name, ())]
    areas: list[_Candidate] = [
             (1e6 * each.value, each.rounding, (each.key,)) for each in known.get("area", ())] + rectangles
    if radii or (areas and not flat):
        radii += [(math.sqrt(area / math.pi), 0.5 * rounding, keys) for area, rounding, keys in areas]
        found["radius_mm"] = _different("radius_mm", radii, stated)
    elif areas:
        found["area_mm2"] = _different("area_mm2", areas, stated)
    return found


def _rectangles(known: Mapping[str, Sequence[_StatedSize]], kind: str | None, height: str | None
                ) -> list[_Candidate]:
    """Width times thickness, mm2; of a sheared or compressed block width times length."""
    second = {"simple_shear": ("length",), "uniaxial_tension": ("thickness",)}.get(
        kind or "", ("length", "depth", "thickness"))
    other = next((name for name in second if name in known and name != height), None)
    if other is None or "width" not in known or (kind is None and other == "thickness"):
        return []
    widths, lengths = (_distinct([(1e3 * each.value, each.rounding, (each.key,)) for each in known[name]])
                       for name in ("width", other))
    # As many of both are the rows of a list of specimens; otherwise any two may belong together.
    pairs = zip(widths, lengths, strict=True) if len(widths) == len(lengths) else product(widths, lengths)
    return [(width * length, rounding + also, (*keys, *others))
            for (width, rounding, keys), (length, also, others) in pairs]


def _different(key: str, candidates: Sequence[_Candidate], stated: Mapping[str, str]
               ) -> tuple[Size, ...]:
    """Return the first candidate, and each candidate that contradicts all previous ones."""
    # To whole nanometres: 25 mm must not become 25.000000000000004 mm.
    return tuple(Size(key, round(value, 6), "in the file: " + ", ".join(f"{name}: {stated[name]}" for name in keys))
                 for value, _, keys in _distinct(candidates))


def _distinct(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the candidates that differ from all previous ones by more than the rounding."""
    kept: list[_Candidate] = []
    for value, rounding, keys in candidates:
        if all(abs(value / other - 1.0) > max(CONTRADICTION, rounding + also) for other, also, _ in kept):
            kept.append((value, rounding, keys))
    return kept


def sizes_without_unit(stated: Mapping[str, str]) -> dict[str, str]:
    """Size, such as ``diameter`` -> statement of it whose unit is missing or unknown."""
    found: dict[str, str] = {}
    for key, text in stated.items():
        name, pair = size_class(key), quantity_in(text)
        if name is not None and pair is not None and (
                (_area if name == "area" else _length)(key, text) is None and pair[0] > 0):
            found.setdefault(name, f"{key}: {text}")
    return found


def size_signature(stated: Mapping[str, str], kind: str | None = None) -> tuple[tuple[str, float], ...]:
    """Return a key that is equal for files, or sheets, with equal sizes of the specimen for a kind of test."""
    return tuple(sorted((size.key, size.value) for size in find_sizes(stated, kind).values()
                        if size.key != "speed_mm_s"))


def quantity_in(text: str) -> tuple[float, str | None] | None:
    """Return number and unit of a text such as ``50mm`` or ``12,5 mm``; None for another text."""
    match = _QUANTITY.match(text.strip())
    value = math.nan if match is None else any_number(match["number"].rstrip(",.' "))
    return None if match is None or math.isnan(value) else (value, match["unit"])


def _length(key: str, text: str) -> _StatedSize | None:
    """m."""
    pair = quantity_in(text)
    unit = None if pair is None or pair[1] is None else known_unit(pair[1])
    if pair is None or unit is None or UNITS[unit][0] != "length" or not 0 < pair[0] < 1e9:
        return None
    return _StatedSize(key, pair[0] * UNITS[unit][1], _rounding(text, pair[0]))


def _area(key: str, text: str) -> _StatedSize | None:
    """m2."""
    number, _, rest = text.strip().partition(" ")
    pair = quantity_in(text) or quantity_in(number)
    match = _SQUARE.match((pair[1] or "") if pair else "") or _SQUARE.match(rest.strip()) or _IN_KEY.search(key)
    if pair is None or match is None or not 0 < pair[0] < 1e9:
        return None
    return _StatedSize(key, pair[0] * UNITS[known_unit(match["unit"]) or "mm"][1] ** 2, _rounding(text, pair[0]))


def _rounding(text: str, value: float) -> float:
    """Half a unit of the last decimal of a number, relative; 0 for a number without decimals."""
    match = re.match(r"[-+]?\d+[.,](\d+)", text.strip())
    return min(0.5 * 10.0 ** -len(match[1]) / value, _LARGEST_ROUNDING) if match else 0.0


def _speed(key: str, text: str) -> tuple[float | None, str | None]:
    words = text.split()
    match = re.search(r"[\[(]([^\])]*)[\])]\s*$", key)
    unit = match[1] if match else words[1] if len(words) > 1 else loose_header(key)[1]
    pair = quantity_in(words[0]) if words else None
    return (None if pair is None else pair[0]), unit
