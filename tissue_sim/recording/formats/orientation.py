"""Signs and zeros of the columns of a measurement."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.recording.formats.guesses import ColumnGuess
from tissue_sim.recording.oscillation import find_oscillation
from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class OrientationSettings:
    """Settings of `oriented`.

    Attributes:
        start_offset: largest first displacement, as a fraction of the travel, of a displacement that counts from zero;
            a larger one counts from a zero of the machine.
        at_rest: largest motion of a specimen at rest, as a fraction of the largest motion.
    """

    start_offset: float = 0.02
    at_rest: float = 0.05


#: Settings that the functions of this module use.
_SETTINGS = OrientationSettings()


def oriented(columns: Sequence[ColumnGuess], recordings: Sequence[Recording], starts: Sequence[float | None],
             kind: str | None, stated: Collection[str]) -> tuple[ColumnGuess, ...]:
    """Set signs and zeros of columns: travel and force grow under load, stretch and stress have their sign.

    Args:
        columns: as the file has them. recordings: read so, without outliers.
        starts: displacement of each recording at its first sample, m, also where that sample is an outlier; None: no
            displacement, or it is not known.
        kind: of test. stated: channels whose sign a person states.
    """
    turned: dict[str, ColumnGuess] = {}
    for column in columns:
        if column.channel == "displacement":
            column = _travel(column, recordings, starts, stated)
        elif column.channel == "stretch" and column.role != "stretch" and kind == "lubricated_compression" \
                and "stretch" not in stated \
                and _most(each.channel("stretch").max() - 1.0 > 1.0 - each.channel("stretch").min()
                          for each in recordings):
            column = replace(column, sign=-1, reason=f"{column.reason}; positive in compression, so turned")
        turned[column.channel] = column
    for channel in ("force", "nominal stress"):
        if channel in turned and channel not in stated:
            turned[channel] = _load(turned[channel], recordings, starts, turned)
    return tuple(turned.values())


def _travel(column: ColumnGuess, recordings: Sequence[Recording], starts: Sequence[float | None],
            stated: Collection[str]) -> ColumnGuess:
    ways = [each.channel("displacement") for each in recordings]
    static = [offset for each in recordings if (offset := _static_offset(each)) is not None]
    if 2 * len(static) > len(recordings):
        return column if "displacement" in stated or sum(static) >= 0 else replace(
            column, sign=-1, reason=f"{column.reason}; it oscillates around a negative offset, so turned")
    if "displacement" not in stated and _most(largest_excursion(way) < 0 for way in ways):
        column = replace(column, sign=-1, reason=f"{column.reason}; it falls under load, so turned")
    begins = [float(way[0]) if start is None else start for way, start in zip(ways, starts, strict=True)]
    if any(abs(start) > _SETTINGS.start_offset * np.ptp(way) for way, start in zip(ways, begins, strict=True)):
        column = replace(column, offset="start", reason=f"{column.reason}; begins away from zero, so counted from the "
                                                        "first sample")
    return column


def _static_offset(recording: Recording) -> float | None:
    """Mean displacement of a recording that oscillates from its first sample on, m.

    It is 0 for an oscillation around zero, and None for a recording that does not oscillate or starts from rest.
    """
    way = recording.channel("displacement")
    if not any(name in recording for name in ("force", "nominal stress")):
        return None
    load = recording.channel("force" if "force" in recording else "nominal stress")
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    found = find_oscillation(way, load, time)
    if found is None or found.returns or abs(way[0] - found.mean) > 1.1 * found.amplitude:
        return None
    return found.mean if abs(found.mean) > found.amplitude else 0.0


def _load(column: ColumnGuess, recordings: Sequence[Recording], starts: Sequence[float | None],
          columns: Mapping[str, ColumnGuess]) -> ColumnGuess:
    """Loads go with their motion, out of rest: one that goes against it is turned."""
    rest = {"stretch": 1.0, "shear strain": 0.0}
    # Without a column of the motion, the displacement is that of a constant speed.
    motion = next((name for name in ("displacement", "stretch", "shear strain") if name in columns), "displacement")
    direction = columns[motion].sign if motion in columns else 1

    def against(recording: Recording, start: float | None) -> bool:
        way, load = recording.channel(motion), recording.channel(column.channel)
        way = direction * (way - rest.get(motion, way[0] if start is None else start))
        nearest = int(np.argmin(np.abs(way)))
        # A recording that begins far from rest, or at an unknown place, after a lost first sample does not show its
        # load at rest.
        is_known = start is not None or motion in rest
        shows_rest = is_known and abs(way[nearest]) <= _SETTINGS.at_rest * float(np.abs(way).max())
        at_rest = float(load[nearest]) if shows_rest else 0.0
        return float(np.sum(way * (load - at_rest))) < 0

    if _most(against(recording, start) for recording, start in zip(recordings, starts, strict=True)):
        return replace(column, sign=-1, reason=f"{column.reason}; against the motion, so turned")
    return column


def _most(answers: Iterable[bool]) -> bool:
    answers = list(answers)
    return 2 * sum(answers) > len(answers)


def largest_excursion(values: np.ndarray) -> float:
    """Return the largest deviation from the first value, with its sign."""
    away = values - values[0]
    return float(away[np.argmax(np.abs(away))])
