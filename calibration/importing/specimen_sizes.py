"""Sizes of the specimens of an import: assumptions with contradictions, and comparison of listed sizes with forces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calibration.importing.imported import ImportOptions
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE, AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.recording.formats.sizes import (
    SizeOrSpeedInMillimetres,
    find_size_texts_without_known_unit,
    find_sizes_and_speed_in_mm,
    find_used_and_contradicting_sizes_in_mm,
)
from tissue_sim.recording.formats.statements import DIMENSIONS
from tissue_sim.recording.recording import SIZE_DEPENDENT, Recording

#: Ratio of the logarithmic ranges of stiffness and size, below which the forces do not depend on the sizes.
_LEAST_RANGE_RATIO = 1.0 / 3.0


def copy_with_question_on_contradicting_sizes(found: FileInterpretation, wishes: ImportOptions) -> FileInterpretation:
    """Return a copy with a question if tables of different sizes have about the same stiffness; else the argument.

    The stiffness of a homogeneous specimen is proportional to its cross-section over its height. Tables whose
    stiffnesses differ by less than a third of that ratio show one specimen, or a list of sizes that belongs to others.
    """
    is_stated = "height_mm" in wishes.specimen and not {"radius_mm", "area_mm2"}.isdisjoint(wishes.specimen)
    if len(found.readings) < 2 or is_stated:
        return found
    sized = [(reading, size) for reading in found.readings
             if (size := _compute_area_over_height_mm_or_none(reading)) is not None]
    if len(sized) < len(found.readings):
        return found
    sizes = [size for _, size in sized]
    stiffnesses = _fit_stiffnesses_to_common_displacement([reading.recordings[0] for reading, _ in sized])
    apart, together = _compute_logarithmic_range(sizes), _compute_logarithmic_range(stiffnesses)
    if apart <= np.log1p(MODULUS_TOLERANCE) or together >= _LEAST_RANGE_RATIO * apart:
        return found
    question = Assumption(
        "sizes of the tables", "a specimen for each table, with the sizes that the file states for it", (), (
            f"cross-section over height differs by {100 * np.expm1(apart):.0f} % between the tables, and the stiffness "
            f"by {100 * np.expm1(together):.0f} % only: the file contradicts itself",),
        (AlternativeValue("one specimen for all tables", None, "--height-mm ... --radius-mm ... or --area-mm2 ..."),),
        "import one table at a time with --curve and its sizes as flags")
    return replace(found, readings=tuple(replace(reading, assumptions=(*reading.assumptions, question))
                                         for reading in found.readings))


def _compute_area_over_height_mm_or_none(reading: TableGroup) -> float | None:
    """Return cross-section divided by height, mm; None if a size is unknown, or force or displacement is missing."""
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    read = {column.channel for column in reading.columns if not column.missing_information_text_or_none}
    if kind is None or kind.closed_form is None or "force" not in read or any(
            not {"displacement", "force"} <= each.channels.keys() for each in reading.recordings):
        return None
    sizes = {key: size.value for key, size in find_sizes_and_speed_in_mm(reading.stated, reading.kind.kind).items()}
    area = sizes.get("area_mm2", np.pi * sizes["radius_mm"] ** 2 if "radius_mm" in sizes else None)
    return None if area is None or "height_mm" not in sizes else area / sizes["height_mm"]


def _fit_stiffnesses_to_common_displacement(recordings: Sequence[Recording]) -> list[float]:
    """Return the stiffness (slope of a line through zero, least squares) of each first loading, N/m.

    All loadings are used up to their largest common displacement. The result is [0.0] if a recording is invalid.
    """
    loadings = []
    for each in recordings:
        try:
            kept, _ = remove_outliers_and_saturation(each)
        except InputError:
            return [0.0]
        motion = np.abs(kept.displacement - kept.displacement[0])
        peak = int(np.argmax(motion)) + 1
        loadings.append((motion[:peak], np.abs(kept.force[:peak] - kept.force[0])))
    reach = min(float(motion.max()) for motion, _ in loadings)
    found = []
    for motion, load in loadings:
        inside = motion <= reach
        found.append(float(np.dot(motion[inside], load[inside]) / (np.sum(motion[inside] ** 2) or 1.0)))
    return found


def _compute_logarithmic_range(values: Sequence[float]) -> float:
    """Return the logarithm of the largest over the smallest value; infinite if a value is not positive."""
    return float(np.log(max(values) / min(values))) if min(values) > 0 else float("inf")


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
    if not any(column.channel in SIZE_DEPENDENT for column in reading.columns):
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
