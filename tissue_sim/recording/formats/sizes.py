"""Sizes of the specimen and speed of the test as they stand above the numbers of a file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from tissue_sim.recording.formats.sources import quantity_in
from tissue_sim.recording.formats.vocabulary import plain
from tissue_sim.units import UNITS, known_unit, loose_header

_DIAMETER = r"diameter|\w*durchmesser|diamètre|diametro|d0"
_WIDTH, _THICKNESS = r"width|\w*breite|largeur|b0", r"thickness|\w*dicke|épaisseur|a0"
_AREA = r"area|cross section|\w*querschnitt|\w*querschnittsfläche|s0"
_LENGTH = (r"gauge length|gage length|grip separation|einspannlänge|messlänge|length|länge|longueur|l0|height|höhe|"
           r"hauteur")
_HEIGHT = r"height|\w*höhe|hauteur|thickness|\w*dicke|épaisseur|length|\w*länge|l0|h0|gap"
#: Of the machine, not of the specimen.
_NOT = re.compile(r"\b(probe|tool|punch|plate|platen|stempel|indenter|needle|cell|wave|step|data|path|pre)\b")
_SQUARE = re.compile(r"^(?P<number>[-+\d.,eE]+)?\s*\(?(?P<unit>m|cm|mm)\s*(\^2|²|2)\)?$")
_IN_KEY = re.compile(r"[\[(/,]?\s*\b(m|cm|mm)\s*(\^2|²|2)[\])]?\s*$")
_SPEEDS = {"mm/min": 1.0 / 60.0, "mm/s": 1.0, "mm/sec": 1.0, "um/s": 1e-3, "µm/s": 1e-3, "in/min": 25.4 / 60.0,
           "cm/min": 10.0 / 60.0}


@dataclass(frozen=True)
class Size:
    """A key of ``[[specimen]]`` or ``[[test]]``, its value in the key's unit, and where it comes from."""

    key: str
    value: float
    reason: str


def find_sizes(stated: Mapping[str, str], kind: str | None) -> dict[str, Size]:
    """``radius_mm`` or ``area_mm2``, ``height_mm`` and ``speed_mm_s``, as far as a file states them.

    Args:
        stated: key -> value, as of `tissue_sim.recording.formats.sources.stated_values`. kind: of test.
    """
    lengths = {key: value for key, text in stated.items() if not _NOT.search(plain(key))
               and (value := _length(text)) is not None}
    found: dict[str, Size] = {}

    def keep(key: str, value: float, *sources: str) -> None:
        # To whole nanometres: 25 mm must not become 25.000000000000004 mm.
        found[key] = Size(key, round(value, 6), "in the file: " + ", ".join(f"{name}: {stated[name]}"
                                                                          for name in sources))

    gripped = kind in ("uniaxial_tension", "simple_shear")
    height = _first(lengths, _THICKNESS + "|" + _HEIGHT if kind == "simple_shear" else _LENGTH if gripped else _HEIGHT)
    if height is not None:
        keep("height_mm", 1e3 * lengths[height], height)
    diameter, area = _first(lengths, _DIAMETER), next(iter(_areas(stated)), None)
    width, depth = _first(lengths, _WIDTH), _first(lengths, _LENGTH if kind == "simple_shear" else _THICKNESS)
    if diameter is not None:
        keep("radius_mm", 0.5e3 * lengths[diameter], diameter)
    elif area is not None:
        keep("area_mm2", area[1], area[0])
    elif gripped and width is not None and depth is not None:
        keep("area_mm2", 1e6 * lengths[width] * lengths[depth], width, depth)
    if "area_mm2" in found and not gripped:
        circle = found.pop("area_mm2")
        found["radius_mm"] = Size("radius_mm", round(math.sqrt(circle.value / math.pi), 6), circle.reason)
    for key, text in stated.items():
        if re.search(r"\b(speed|geschwindigkeit|prüfgeschwindigkeit|vitesse|rate)\b", plain(key)) \
                and not _NOT.search(plain(key)):
            value, unit = _speed(key, text)
            if value is not None and unit in _SPEEDS and value > 0:
                found.setdefault("speed_mm_s", Size("speed_mm_s", value * _SPEEDS[unit], f"in the file: {key}: {text}"))
    return found


def _first(lengths: Mapping[str, float], words: str) -> str | None:
    """The first key that is called one of the words, in their order."""
    for word in words.split("|"):
        for key in lengths:
            if re.search(rf"\b{word}\b", plain(key)):
                return key
    return None


def _length(text: str) -> float | None:
    """m."""
    pair = quantity_in(text)
    unit = None if pair is None or pair[1] is None else known_unit(pair[1])
    if pair is None or unit is None or UNITS[unit][0] != "length" or not 0 < pair[0] < 1e9:
        return None
    return pair[0] * UNITS[unit][1]


def _areas(stated: Mapping[str, str]) -> list[tuple[str, float]]:
    """Keys that are areas, and mm2."""
    found = []
    for key, text in stated.items():
        if not re.search(rf"\b({_AREA})\b", plain(key)) or _NOT.search(plain(key)):
            continue
        unit, pair = _IN_KEY.search(key) or _SQUARE.match(text), quantity_in(text.split()[0]) if text.split() else None
        if unit is not None and pair is not None and pair[0] > 0:
            name = unit["unit"] if "unit" in unit.groupdict() else unit[1]
            found.append((key, pair[0] * (UNITS[name][1] * 1e3) ** 2))
    return found


def _speed(key: str, text: str) -> tuple[float | None, str | None]:
    words = text.split()
    match = re.search(r"[\[(]([^\])]*)[\])]\s*$", key)
    unit = match[1] if match else words[1] if len(words) > 1 else loose_header(key)[1]
    pair = quantity_in(words[0]) if words else None
    return (None if pair is None else pair[0]), unit
