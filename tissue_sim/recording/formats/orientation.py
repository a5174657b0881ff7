"""Determine the signs and zeros of the columns of a measurement."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.recording.formats.guesses import ColumnGuess
from tissue_sim.recording.oscillation import find_final_oscillation_or_none
from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class SignAndZeroSettings:
    """Settings of `set_column_signs_and_zeros`.

    Attributes:
        start_offset: largest first displacement, as a fraction of the travel, of a displacement that counts from
            contact. A larger first displacement is subtracted, because it refers to a zero of the machine.
        at_rest: largest motion of a specimen at rest, as a fraction of the largest motion.
    """

    start_offset: float = 0.02
    at_rest: float = 0.05


#: Settings that the functions of this module use.
_SETTINGS = SignAndZeroSettings()


def set_column_signs_and_zeros(columns: Sequence[ColumnGuess], recordings: Sequence[Recording],
                               starts: Sequence[float | None],
                               kind: str | None, stated: Collection[str]) -> tuple[ColumnGuess, ...]:
    """Set signs and zeros of columns: displacement and force increase under load; stretch and stress keep their sign.

    Args:
        columns: columns with the signs of the file.
        recordings: recordings of these columns without outliers.
        starts: displacement of each recording at its first sample, m, also if the sample is an outlier; None: no
            displacement, or an unknown value.
        kind: kind of test; None: unknown.
        stated: channels whose sign the user states.
    """
    turned: dict[str, ColumnGuess] = {}
    for column in columns:
        if column.channel == "displacement":
            column = _set_sign_and_zero_of_displacement_column(column, recordings, starts, stated)
        elif column.channel == "stretch" and column.role != "stretch" and kind == "lubricated_compression" \
                and "stretch" not in stated \
                and _is_majority_true(each.channel("stretch").max() - 1.0 > 1.0 - each.channel("stretch").min()
                                      for each in recordings):
            column = replace(column, sign=-1, reason=f"{column.reason}; positive in compression, so turned")
        turned[column.channel] = column
    for channel in ("force", "nominal stress"):
        if channel in turned and channel not in stated:
            turned[channel] = _set_sign_of_load_column(turned[channel], recordings, starts, turned)
    return tuple(turned.values())


def _set_sign_and_zero_of_displacement_column(column: ColumnGuess, recordings: Sequence[Recording],
                                              starts: Sequence[float | None], stated: Collection[str]) -> ColumnGuess:
    """Return the column of the displacement with its sign and zero; see `set_column_signs_and_zeros`."""
    displacements = [each.channel("displacement") for each in recordings]
    static = [offset for each in recordings if (offset := _compute_mean_displacement_if_oscillating(each)) is not None]
    if 2 * len(static) > len(recordings):
        return column if "displacement" in stated or sum(static) >= 0 else replace(
            column, sign=-1, reason=f"{column.reason}; it oscillates around a negative offset, so turned")
    if "displacement" not in stated \
        and _is_majority_true(compute_largest_deviation_from_first_value(each) < 0 for each in displacements):
        column = replace(column, sign=-1, reason=f"{column.reason}; it falls under load, so turned")
    begins = [float(each[0]) if start is None else start for each, start in zip(displacements, starts, strict=True)]
    if any(abs(start) > _SETTINGS.start_offset * np.ptp(each)
           for each, start in zip(displacements, begins, strict=True)):
        column = replace(column, offset="start", reason=f"{column.reason}; begins away from zero, so counted from the "
                         "first sample")
    return column


def _compute_mean_displacement_if_oscillating(recording: Recording) -> float | None:
    """Return the mean displacement, m, of a recording that oscillates from its first sample on.

    The result is 0 for an oscillation around zero, and None without an oscillation or for a start from rest.
    """
    displacement = recording.channel("displacement")
    if not any(name in recording for name in ("force", "nominal stress")):
        return None
    load = recording.channel("force" if "force" in recording else "nominal stress")
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    found = find_final_oscillation_or_none(displacement, load, time)
    if found is None or found.returns or abs(displacement[0] - found.mean) > 1.1 * found.amplitude:
        return None
    return found.mean if abs(found.mean) > found.amplitude else 0.0


def _set_sign_of_load_column(column: ColumnGuess, recordings: Sequence[Recording], starts: Sequence[float | None],
                             columns: Mapping[str, ColumnGuess]) -> ColumnGuess:
    """Return the column of a load with the sign for which load and motion, measured from rest, are correlated."""
    rest = {"stretch": 1.0, "shear strain": 0.0}
    # Without a column of the motion, the displacement is that of a constant speed.
    motion = next((name for name in ("displacement", "stretch", "shear strain") if name in columns), "displacement")
    direction = columns[motion].sign if motion in columns else 1

    def is_against_motion(recording: Recording, start: float | None) -> bool:
        """Return whether motion and load, both measured from rest, have a negative correlation."""
        path, load = recording.channel(motion), recording.channel(column.channel)
        path = direction * (path - rest.get(motion, path[0] if start is None else start))
        nearest = int(np.argmin(np.abs(path)))
        # The load at rest is unknown if the recording begins far from rest, or if the first sample is lost.
        is_known = start is not None or motion in rest
        shows_rest = is_known and abs(path[nearest]) <= _SETTINGS.at_rest * float(np.abs(path).max())
        at_rest = float(load[nearest]) if shows_rest else 0.0
        return float(np.sum(path * (load - at_rest))) < 0

    if _is_majority_true(is_against_motion(recording, start) for recording,
                         start in zip(recordings, starts, strict=True)):
        return replace(column, sign=-1, reason=f"{column.reason}; against the motion, so turned")
    return column


def _is_majority_true(answers: Iterable[bool]) -> bool:
    """Return whether more than half of the booleans are true."""
    answers = list(answers)
    return 2 * sum(answers) > len(answers)


def compute_largest_deviation_from_first_value(values: np.ndarray) -> float:
    """Return the deviation from the first value with the largest magnitude, with its sign."""
    away = values - values[0]
    return float(away[np.argmax(np.abs(away))])
