"""List the assumptions about the sizes of the specimen that a file states, with contradictions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from calibration.importing.imported import ImportOptions
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.recording.formats.sizes import SizeOrSpeed, find_distinct_sizes, find_sizes_without_unit
from tissue_sim.recording.formats.statements import DIMENSIONS

#: Key -> name and unit of the size.
_NAMES = {"radius_mm": ("radius", "mm"), "area_mm2": ("cross-section", "mm²"), "height_mm": ("height", "mm")}
#: Key -> names of sizes in a file that give the value of the key.
_GIVEN_BY = {"radius_mm": ("diameter", "radius", "circumference", "area"), "area_mm2": ("area", "width", "thickness"),
             "height_mm": ("height", "thickness", "length", "gauge length")}


def add_size_assumptions(found: FileInterpretation, wishes: ImportOptions) -> FileInterpretation:
    """Return a copy of the interpretation with one assumption for each size of the specimen that the file states."""
    return replace(found, readings=tuple(
        replace(reading, assumptions=(*reading.assumptions, *list_size_assumptions(reading, wishes.specimen)))
        for reading in found.readings))


def list_size_assumptions(reading: TableGroup, stated: Mapping[str, Any]) -> tuple[Assumption, ...]:
    """Return one assumption for each size of the specimen that the file of a reading states.

    Args:
        reading: reading of the tables of a file.
        stated: keys of ``[[specimen]]`` that the user states.
    """
    if not any(column.channel in ("displacement", "force") for column in reading.columns):
        return ()
    given = {key for key in reading.specimen if key != "shape"} | set(stated)
    section = bool(given & {"radius_mm", "area_mm2"}) or "shape" in given
    assumptions = []
    for key, several in find_distinct_sizes(reading.stated, reading.kind.kind).items():
        name, unit = _NAMES[key]
        first, *others = several
        is_stated = section if key != "height_mm" else bool(given & {key, "shape"})
        assumptions.append(Assumption(
            f"size of the specimen ({name})", f"{first.value:g} {unit}", (first.reason,), (),
            tuple(AlternativeValue(f"{each.value:g} {unit} ({each.reason})",
                                   _compute_modulus_ratio(key, first, each, reading),
                                   _get_size_flag(each)) for each in others), _get_size_flag(first), is_stated))
    return tuple(assumptions)


def explain_unclear_size(reading: TableGroup, key: str) -> str:
    """Return why a size in the file cannot be used for `key` (unknown unit, or sizes without names); else empty."""
    seen = find_sizes_without_unit(reading.stated)
    found = next((seen[name] for name in _GIVEN_BY.get(key, ()) if name in seen), "")
    if found:
        return f"the file states {found!r} without a known unit"
    product = reading.stated.get(DIMENSIONS)
    return f"the file states {product!r}, which does not name the sizes" if product else ""


def _get_size_flag(size: SizeOrSpeed) -> str:
    """Return the command-line flag that states a size, with its value, such as ``--height-mm 10``."""
    return f"--{size.key.replace('_', '-')} {size.value:g}"


def _compute_modulus_ratio(key: str, first: SizeOrSpeed, other: SizeOrSpeed, reading: TableGroup) -> float | None:
    """Return the modulus with size `other` divided by that with size `first`; None if the test has no closed form."""
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    if kind is None or kind.closed_form is None:
        return None
    ratio = other.value / first.value
    return {"radius_mm": 1.0 / ratio**2, "area_mm2": 1.0 / ratio, "height_mm": ratio}.get(key, math.nan)
