"""Which way a measurement counts, and what kind of test it shows."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from tissue_sim.recording.formats.guesses import ColumnGuess, KindGuess
from tissue_sim.recording.formats.vocabulary import Machine
from tissue_sim.recording.oscillation import find_oscillation
from tissue_sim.recording.recording import Recording

#: Kind of test -> words that say so, in the languages of the machines.
_KINDS = {
    "simple_shear": r"shear|scher|cisaillement",
    "uniaxial_tension": r"tensile|tension|zug|zugversuch|pull|stretching|traction|elongation",
    "needle_indentation": r"indent\w*|needle|punch|penetrat\w*|puncture|eindr\w*",
    "lubricated_compression": r"compress\w*|druck\w*|stauch\w*|unconfined",
}
#: In names of files also their short forms.
_SHORT = {"simple_shear": r"ss", "uniaxial_tension": r"ut", "lubricated_compression": r"uc"}
_BETWEEN_PLATES = ("taken as homogeneous, between plates that slip; where they hold the specimen it is "
                   "bonded_compression, and friction_compression between")
#: A travel that begins farther from zero than this share of itself counts from a zero of the machine.
_AWAY = 0.02


def guess_kind(recordings: Sequence[Recording], columns: Sequence[ColumnGuess], hints: Sequence[str],
               machine: Machine | None) -> KindGuess:
    """The kind of test that a table shows.

    Args:
        recordings: of it, signs as in the file. columns: of it.
        hints: texts in which words count, the surest first: headers, what stands above them, name of the file.
        machine: that wrote it.
    """
    roles = {column.role for column in columns}
    if "shear strain" in roles:
        return KindGuess("simple_shear", "it has a shear strain")
    if "stretch" in roles:
        values = np.concatenate([each.channel("stretch") for each in recordings])
        low, high = 1.0 - values.min(), values.max() - 1.0
        if low > 0.1 * high and high > 0.1 * low:
            return KindGuess("uniaxial_tension", "stretches on both sides of 1: tension and compression")
        return KindGuess("uniaxial_tension", "stretches above 1") if high > low else \
            KindGuess("lubricated_compression", f"stretches below 1; {_BETWEEN_PLATES}")
    for hint, where in zip(hints, ("in the headers", "above the numbers", "in the name of the file"), strict=True):
        text = re.sub(r"[\W_]+", " ", hint.casefold())
        short = _SHORT if hint is hints[-1] else {}
        hits = [(kind, match[0]) for kind, words in _KINDS.items()
                if (match := re.search(rf"\b({words}|{short.get(kind, words)})\b", text))]
        if len({kind for kind, _ in hits}) == 1:
            kind, word = hits[0]
            between = f"; {_BETWEEN_PLATES}" if kind == "lubricated_compression" else ""
            return KindGuess(kind, f"{word!r} {where}{between}")
    if recordings and {"displacement", "force"} <= roles and (machine is None or machine.compresses_negative):
        motion, load = (_excursion(np.asarray(recordings[0].channel(name))) for name in ("displacement", "force"))
        if motion < 0 and load < 0 and machine is not None:
            return KindGuess("lubricated_compression", f"travel and load are negative, as {machine.title} counts "
                             f"compression; {_BETWEEN_PLATES}")
    if "strain" in roles and recordings and _excursion(recordings[0].channel("stretch")) < 0:
        return KindGuess("lubricated_compression", f"strains are negative; {_BETWEEN_PLATES}")
    return KindGuess(None, "nothing in the file says how the specimen was loaded")


def oriented(columns: Sequence[ColumnGuess], recordings: Sequence[Recording], kind: str | None,
             stated: Collection[str]) -> tuple[ColumnGuess, ...]:
    """Columns with signs and zeros by which travel and force grow under load, and stretch and stress carry their sign.

    Args:
        columns: as the file has them. recordings: read so. kind: of test. stated: channels whose sign a person states.
    """
    turned: dict[str, ColumnGuess] = {}
    for column in columns:
        if column.channel == "displacement":
            column = _travel(column, recordings, stated)
        elif column.role == "strain" and kind == "lubricated_compression" and "stretch" not in stated \
                and _most(each.channel("stretch").max() - 1.0 > 1.0 - each.channel("stretch").min()
                          for each in recordings):
            column = replace(column, sign=-1, reason=f"{column.reason}; positive in compression, so turned")
        turned[column.channel] = column
    for channel in ("force", "nominal stress"):
        if channel in turned and channel not in stated:
            turned[channel] = _load(turned[channel], recordings, turned)
    return tuple(turned.values())


def _travel(column: ColumnGuess, recordings: Sequence[Recording], stated: Collection[str]) -> ColumnGuess:
    ways = [each.channel("displacement") for each in recordings]
    static = [offset for each in recordings if (offset := _static_offset(each)) is not None]
    if 2 * len(static) > len(recordings):
        return column if "displacement" in stated or sum(static) >= 0 else replace(
            column, sign=-1, reason=f"{column.reason}; it oscillates around a negative offset, so turned")
    if "displacement" not in stated and _most(_excursion(way) < 0 for way in ways):
        column = replace(column, sign=-1, reason=f"{column.reason}; it falls under load, so turned")
    if any(abs(way[0]) > _AWAY * np.ptp(way) for way in ways):
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


def _load(column: ColumnGuess, recordings: Sequence[Recording], columns: Mapping[str, ColumnGuess]) -> ColumnGuess:
    """Loads go with their motion, out of rest: one that goes against it is turned."""
    rest = {"stretch": 1.0, "shear strain": 0.0}
    motion = next(name for name in ("displacement", "stretch", "shear strain") if name in columns)

    def against(recording: Recording) -> bool:
        way, load = recording.channel(motion), recording.channel(column.channel)
        way = columns[motion].sign * (way - rest.get(motion, way[0]))
        return float(np.sum(way * (load - load[np.argmin(np.abs(way))]))) < 0

    if _most(against(recording) for recording in recordings):
        return replace(column, sign=-1, reason=f"{column.reason}; against the motion, so turned")
    return column


def _most(answers: Iterable[bool]) -> bool:
    answers = list(answers)
    return 2 * sum(answers) > len(answers)


def _excursion(values: np.ndarray) -> float:
    """The value farthest from the first one, less that."""
    away = values - values[0]
    return float(away[np.argmax(np.abs(away))])
