"""The segments of a whole test: approach, contact, preload, preconditioning, ramps, holds, returns, failure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tissue_sim.experiment.kinds.kind import KINDS, STRETCH_STRESS, TestKind
from tissue_sim.recording.contact import Contact, find_contact
from tissue_sim.recording.control import creep_holds
from tissue_sim.recording.failure import Failure, find_failure
from tissue_sim.recording.oscillation import find_oscillation
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segmentation import count_cycles, label_motion

#: Names of segments, in the order of a test.
SEGMENTS = ("approach", "preload", "preconditioning", "ramp", "hold", "unload", "reload", "failure")
#: A stop is a preload up to these shares of the largest force and of the way from contact to the farthest.
_PRELOAD_FORCE, _PRELOAD_WAY = 0.05, 0.15
#: Cycles are alike, and precondition what comes after them, within this share of the way.
_ALIKE = 0.05
#: Fewest cycles alike that precondition.
_FEWEST_ALIKE = 2
#: Fewest samples of which structure is asked.
_FEWEST = 12


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What a test is made of.

    Attributes:
        labels: name of the segment of each sample, in `SEGMENTS` or in the words of its file, shape (n,).
        cycles: number of the cycle, from 1, shape (n,).
        contact: where it touches; None where the recording does not tell (both sides of zero, few samples).
        failure: of the specimen; None: intact.
        stated: whether the labels are those of the recording, not found.
        stressed: whether it was recorded as strain and stress.
        warnings: sentences on what a user should look at.
    """

    labels: np.ndarray
    cycles: np.ndarray
    contact: Contact | None
    failure: Failure | None
    stated: bool
    stressed: bool
    warnings: tuple[str, ...]

    @property
    def has_air(self) -> bool:
        """Whether contact comes after the first samples."""
        return self.contact is not None and self.contact.found

    def runs(self) -> Iterator[tuple[str, int, int]]:
        """Name, first sample and end (not included) of each segment, in order."""
        edges = np.flatnonzero(np.append(True, self.labels[1:] != self.labels[:-1]))
        for first, last in pairwise([*edges.tolist(), self.labels.size]):
            yield str(self.labels[first]), first, last


def find_segments(recording: Recording, kind: TestKind | str | None = None) -> Segmentation:
    """The segments of a recording, measured or simulated.

    Labels that the recording has are kept; else they are those of its motion, its contact and its failure. What is
    before contact is approach. A preload is a stop at little force on the way in, or under load before the first
    motion. Two cycles or more that go as far as each other precondition what comes after them.

    Args:
        recording: with displacement and force, or stretch or shear strain and nominal stress.
        kind: of test, which tells the sign of strain and stress; None: they load where they are largest.

    Raises:
        InputError: an unknown kind, a recording without motion and load.
    """
    kind = KINDS.find(kind, "kind") if isinstance(kind, str) else kind
    motion, load, stressed = loading_of(recording, kind)
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    stated = "segment" in recording.labels
    return segments_of(motion, load, time, recording.labels["segment"] if stated else None, stressed=stressed)


def segments_of(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None,
                labels: np.ndarray | None = None, *, stressed: bool = False) -> Segmentation:
    """As `find_segments`, of displacement and force, positive under load, m and N (strain and Pa: `stressed`)."""
    clock = np.arange(displacement.size, dtype=float) if time is None else time
    warnings: list[str] = []
    ordered = _is_ordered(displacement, force, time)
    contact = failure = None
    if ordered and displacement.size >= _FEWEST and np.ptp(displacement) > 0:
        failure = find_failure(displacement, force, time)
        end = max(displacement.size if failure is None else failure.index + 1, _FEWEST)
        contact = find_contact(displacement[:end], force[:end], None if time is None else time[:end])
    if contact is not None and contact.status != "before":
        warnings.append(contact.in_words(stressed=stressed))
    stated = labels is not None
    if labels is not None:
        labels = np.char.lower(np.asarray(labels).astype(str))
        cycles = count_cycles(label_motion(clock, displacement))[1]
    elif not ordered:
        labels, cycles = np.full(displacement.size, "ramp"), np.ones(displacement.size, int)
    else:
        labels = label_motion(clock, displacement)
        for first, last in creep_holds(displacement, force, time):
            labels[first:last] = "hold"
        labels, cycles = count_cycles(labels)
        labels = labels.astype("U15")
        if contact is not None and contact.status != "none":
            _label_preload(labels, displacement, force, contact, warnings, stressed)
        if cycles.max() > _FEWEST_ALIKE and not _oscillates(displacement, force, time):
            _label_preconditioning(labels, cycles, displacement, warnings)
        if contact is not None and contact.found:
            # A later cycle comes through air again.
            in_air = (cycles > 1) & (displacement < contact.displacement)
            labels[np.isin(labels, ("ramp", "reload")) & in_air] = "approach"
    if failure is not None:
        warnings.append(failure.in_words(stressed=stressed))
        if not stated:
            labels[failure.index + 1:] = "failure"
    for values in (labels, cycles):
        values.flags.writeable = False
    return Segmentation(labels, cycles, contact, failure, stated, stressed, tuple(warnings))


def _oscillates(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None) -> bool:
    """Whether the cycles are an oscillation around an offset, which does not precondition."""
    found = find_oscillation(displacement, force, time)
    return found is not None and not found.returns


def _is_ordered(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None) -> bool:
    """Whether samples are in the order of time, and load to one side."""
    reach, least = float(np.abs(displacement).max()) or 1.0, int(np.argmin(displacement))
    both_sides = displacement[least] < -0.2 * reach and force[least] < -0.2 * float(np.abs(force).max())
    table = time is None and (displacement[-1] < displacement[0] or
                              float(np.diff(displacement).min(initial=0.0)) < -0.5 * reach)
    return not both_sides and not table


def loading_of(recording: Recording, kind: TestKind | None) -> tuple[np.ndarray, np.ndarray, bool]:
    """Motion and load, positive under load, and whether they are strain and stress."""
    pairs = [*(kind.channels if kind is not None else ())] or [
        pair for one in KINDS.values() for pair in one.channels]
    pair = next((pair for pair in pairs if all(name in recording for name in pair)), pairs[0])
    motion, load = (recording.channel(name) for name in pair)
    if "displacement" in pair:
        return motion, load, False
    strain = motion - (1.0 if pair == STRETCH_STRESS else 0.0)
    sign = kind.sign if kind is not None else float(np.sign(strain[np.argmax(np.abs(strain))])) or 1.0
    return sign * strain, sign * load, True


def _label_preload(labels: np.ndarray, displacement: np.ndarray, force: np.ndarray, contact: Contact,
                   warnings: list[str], stressed: bool) -> None:
    """Names what is before contact, and a stop under little load, in place."""
    largest = float(force.max())
    first_motion = int(np.argmax(labels != "hold")) if np.any(labels != "hold") else labels.size
    start = contact.index if contact.found else 0
    if contact.found:
        labels[:start] = "approach"
    elif first_motion and abs(float(np.median(force[:first_motion]))) > max(0.005 * largest, 5 * contact.noise):
        labels[:first_motion] = "preload"
        load = f"{1e-3 * np.median(force[:first_motion]):.3g} kPa" if stressed else \
            f"{np.median(force[:first_motion]):.3g} N"
        warnings.append(f"the recording begins at rest under {load}, and no air tells the zero of the force: a settled "
                        "preload, and contact was before it; state where with contact, or record some air")
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    runs = list(pairwise(edges.tolist()))
    way = float(displacement.max()) - float(displacement[start])
    for (first, last), following in pairwise(runs):
        stops = labels[first] == "hold" and labels[following[0]] == "ramp" and first > start
        little = np.median(force[first:last]) - contact.force_zero < _PRELOAD_FORCE * (largest - contact.force_zero)
        if stops and little and displacement[first] - displacement[start] < _PRELOAD_WAY * way:
            labels[start:last] = "preload"
            return
        if labels[first] == "unload":
            return


def _label_preconditioning(labels: np.ndarray, cycles: np.ndarray, displacement: np.ndarray,
                           warnings: list[str]) -> None:
    """Names cycles that go as far as each other before another one, in place."""
    count = int(cycles.max())
    peaks = np.array([displacement[cycles == number].max() for number in range(1, count + 1)])
    alike = np.abs(peaks - peaks[0]) <= _ALIKE * np.ptp(displacement)
    before = int(np.argmin(alike)) if not alike.all() else count - 1
    if before < _FEWEST_ALIKE:
        return
    samples = (cycles <= before) & ~np.isin(labels, ("approach", "preload"))
    labels[samples] = "preconditioning"
    labels[(cycles == before + 1) & (labels == "reload")] = "ramp"
    kind = "goes as far" if alike.all() else "goes farther" if peaks[before] > peaks[0] else "goes less far"
    warnings.append(f"cycles 1 to {before} go as far as each other and are taken as preconditioning of cycle "
                    f"{before + 1}, which {kind}")
