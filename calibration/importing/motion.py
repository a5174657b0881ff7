"""The way of one recording: sampling, segments, cycles, contact and failure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from calibration.importing.findings import assumptions_of
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.cleaning import clean
from tissue_sim.recording.contact import Contact
from tissue_sim.recording.control import find_control
from tissue_sim.recording.failure import Failure
from tissue_sim.recording.formats.assumption import Assumption
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import Control, Screening
from tissue_sim.recording.segments import Segmentation, find_segments, loading_of

#: Channels that say how far a test has come, the first of which is taken, and where they rest.
MOTIONS = {"displacement": 0.0, "stretch": 1.0, "shear strain": 0.0}
#: Air shorter than this fraction of the displacement is ignored.
_AT_ONCE = 0.01


class Segment(NamedTuple):
    """A part of the way, from sample `first` to `last`."""

    name: str
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Motion:
    """What a recording does.

    Attributes:
        channel: the motion that was looked at. reach: largest and smallest value of it, SI, from rest.
        rate: samples a second, None without time. duration: s, or None. speed: of the first loading, SI, or None.
        found: segments, contact and failure of the samples that are kept. warnings: sentences.
        screening: samples left out, saturation, controlled quantity. kept: samples from 0 that are kept; None: all.
        assumptions: about this recording: zero, contact, controlled quantity, samples that are left out.
    """

    channel: str
    reach: tuple[float, float]
    rate: float | None
    duration: float | None
    speed: float | None
    found: Segmentation
    warnings: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()
    screening: Screening = field(default_factory=Screening)
    kept: np.ndarray | None = None

    def sample(self, index: int) -> int:
        """Sample of the recording, from 0, of one that is kept."""
        return index if self.kept is None else int(self.kept[index])

    @property
    def segments(self) -> tuple[Segment, ...]:
        """In order."""
        return tuple(Segment(name, self.sample(first), self.sample(end - 1)) for name, first, end in self.found.runs())

    @property
    def cycles(self) -> int:
        """The first loading, and those that begin after an unloading."""
        return int(self.found.cycles.max())

    @property
    def failure(self) -> Failure | None:
        """Of the specimen; None: intact."""
        return self.found.failure

    @property
    def contact(self) -> Contact | None:
        """Where it touched, in the displacement (the strain) of the file; None: not looked for."""
        return self.found.contact

    @property
    def air(self) -> bool | None:
        """Whether there is air, or slack, before the contact; None: it cannot be told."""
        contact = self.found.contact
        if contact is None or contact.status == "before":
            return False
        if contact.status == "unclear" and contact.interval[1] <= _AT_ONCE * max(map(abs, self.reach)):
            return False
        return True if contact.found else None


def describe_motion(recording: Recording, kind: str | None, controlled: str | None = None) -> Motion:
    """The way of a recording with a motion and a load, of a test of that kind.

    Args:
        controlled: quantity that the user states; None: found in the signals.
    """
    channel = next(name for name in MOTIONS if name in recording)
    size = len(recording)
    recording, screening = clean(recording, controlled=controlled)
    is_kept = np.ones(size, bool)
    is_kept[np.array(screening.samples, int) - 1] = False
    kept = np.flatnonzero(is_kept)
    way = np.array(recording.channel(channel)) - MOTIONS[channel]
    # Compression is recorded as a stretch below 1, and a table may begin at its far end.
    turned = -way if channel != "displacement" and abs(way.max()) < abs(way.min()) else way
    rate = duration = speed = None
    if "time" in recording and np.ptp(recording.time) > 0:
        time = recording.time
        duration = float(time[-1] - time[0])
        steps = np.diff(time)
        rate = float(1.0 / np.median(steps[steps > 0]))
        peak = int(np.argmax(turned))
        speed = abs(float((turned[peak] - turned[0]) / (time[peak] - time[0]))) if time[peak] > time[0] else None
    if rate is None and abs(way[0]) > abs(way[-1]):
        # A table without a clock has no order; from rest on it reads as a loading.
        recording = recording.select(slice(None, None, -1))
    control = _control(recording, kind)
    screening = replace(screening, control=control if controlled is None else replace(control, equal_samples=0))
    motion = Motion(channel, (float(way.max()), float(way.min())), rate, duration, speed,
                    find_segments(recording, kind), screening=screening, kept=None if kept.size == size else kept)
    assumptions = assumptions_of(screening, motion.contact, has_air=motion.air, stressed=motion.found.stressed,
                                 controlled=controlled)
    return replace(motion, warnings=tuple(_warnings(recording, motion)), assumptions=assumptions)


def _control(recording: Recording, kind: str | None) -> Control:
    way, load, _ = loading_of(recording, KINDS.get(kind) if kind else None)
    return find_control(way, load, recording.time if "time" in recording and np.ptp(recording.time) > 0 else None)


def _warnings(recording: Recording, motion: Motion) -> Iterator[str]:
    contact = motion.contact
    said = "" if contact is None else contact.in_words(stressed=motion.found.stressed)
    yield from motion.screening.remarks
    # Force curves of an AFM come counted from their contact, and no air that matters is no news.
    silent = "zeroing" in recording.metadata or motion.air is False
    yield from (warning for warning in motion.found.warnings if not (warning == said and silent))
    if np.ptp(recording.channel(motion.channel)) == 0:
        yield "the motion stands still"
