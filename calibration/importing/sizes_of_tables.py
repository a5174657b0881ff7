"""Compare the sizes that a file lists for its tables with the forces in the tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.importing.imported import ImportOptions
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE, AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.recording.formats.sizes import find_sizes_and_speed_in_mm
from tissue_sim.recording.recording import Recording

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
