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
from tissue_sim.recording.formats.sizes import (
    SizeOrSpeedInMillimetres,
    find_size_texts_without_known_unit,
    find_used_and_contradicting_sizes_in_mm,
)
from tissue_sim.recording.formats.statements import DIMENSIONS

#: Key -> name and unit of the size.
_NAMES = {"radius_mm": ("radius", "mm"), "area_mm2": ("cross-section", "mm²"), "height_mm": ("height", "mm")}
#: Key -> names of sizes in a file that give the value of the key.
_GIVEN_BY = {"radius_mm": ("diameter", "radius", "circumference", "area"), "area_mm2": ("area", "width", "thickness"),
             "height_mm": ("height", "thickness", "length", "gauge length")}


def copy_interpretation_with_size_assumptions(found: FileInterpretation, wishes: ImportOptions) -> FileInterpretation:
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
    for key, several in find_used_and_contradicting_sizes_in_mm(reading.stated, reading.kind.kind).items():
        name, unit = _NAMES[key]
        first, *others = several
        is_stated = section if key != "height_mm" else bool(given & {key, "shape"})
        assumptions.append(Assumption(
            f"size of the specimen ({name})", f"{first.value:g} {unit}", (first.reason,), (),
            tuple(AlternativeValue(f"{each.value:g} {unit} ({each.reason})",
                                   _compute_modulus_ratio_or_none(key, first, each, reading),
                                   _format_size_flag_with_value(each)) for each in others),
                                   _format_size_flag_with_value(first), is_stated))
    return tuple(assumptions)


def explain_unusable_size_or_empty(reading: TableGroup, key: str) -> str:
    """Return why a size in the file cannot be used for `key` (unknown unit, or sizes without names); else empty."""
    seen = find_size_texts_without_known_unit(reading.stated)
    found = next((seen[name] for name in _GIVEN_BY.get(key, ()) if name in seen), "")
    if found:
        return f"the file states {found!r} without a known unit"
    product = reading.stated.get(DIMENSIONS)
    return f"the file states {product!r}, which does not name the sizes" if product else ""


def _format_size_flag_with_value(size: SizeOrSpeedInMillimetres) -> str:
    """Return the command-line flag that states a size, with its value, such as ``--height-mm 10``."""
    return f"--{size.key.replace('_', '-')} {size.value:g}"


def _compute_modulus_ratio_or_none(key: str, first: SizeOrSpeedInMillimetres, other: SizeOrSpeedInMillimetres,
                                   reading: TableGroup) -> float | None:
    """Return the modulus with size `other` divided by that with size `first`; None if the test has no closed form."""
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    if kind is None or kind.closed_form is None:
        return None
    ratio = other.value / first.value
    return {"radius_mm": 1.0 / ratio**2, "area_mm2": 1.0 / ratio, "height_mm": ratio}.get(key, math.nan)
