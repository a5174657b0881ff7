"""The way of one recording: sampling, segments, cycles, contact and failure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.recording.contact import Contact
from tissue_sim.recording.failure import Failure
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segments import segments_of

#: Channels that say how far a test has come, the first of which is taken, and where they rest.
MOTIONS = {"displacement": 0.0, "stretch": 1.0, "shear strain": 0.0}
#: A first force of more than this share of the range is no zero of the sensor.
_PRELOAD = 0.05
_AT_ONCE = 0.01


@dataclass(frozen=True)
class Segment:
    """A part of the way, as `tissue_sim.recording.segments` names them, from sample `first` to `last`."""

    name: str
    first: int
    last: int


@dataclass(frozen=True)
class Motion:
    """What a recording does.

    Attributes:
        channel: the motion that was looked at. reach: largest and smallest value of it, SI, from rest.
        rate: samples a second, None without time. duration: s, or None. speed: of the first loading, SI, or None.
        segments: in order. cycles: loadings that begin after an unloading, and the first.
        contact: where it touched, in the displacement of the file, m, and with which interval; None: not looked for.
        failure: of the specimen; None: it is intact.
        warnings: sentences.
    """

    channel: str
    reach: tuple[float, float]
    rate: float | None
    duration: float | None
    speed: float | None
    segments: tuple[Segment, ...]
    cycles: int
    contact: Contact | None = None
    failure: Failure | None = None
    warnings: tuple[str, ...] = ()


def describe_motion(recording: Recording) -> Motion:
    """The way of a recording with a motion and a load."""
    channel = next(name for name in MOTIONS if name in recording)
    way = np.array(recording.channel(channel)) - MOTIONS[channel]
    # Compression is recorded as a stretch below 1, and a table may begin at its far end.
    turned = -way if channel != "displacement" and abs(way.max()) < abs(way.min()) else way
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    stressed = channel != "displacement" or "force" not in recording
    load = recording.force if "force" in recording else recording.channel("nominal stress")
    found = segments_of(turned, load if turned is way else -load, time, recording.labels.get("segment"),
                        stressed=stressed)
    segments = tuple(Segment(name, first, end - 1) for name, first, end in found.runs())
    # Force curves of an AFM come counted from their contact.
    contact = None if stressed or "zeroing" in recording.metadata else found.contact
    rate = duration = speed = None
    if time is not None:
        duration = float(time[-1] - time[0])
        steps = np.diff(time)
        rate = float(1.0 / np.median(steps[steps > 0]))
        peak = int(np.argmax(turned))
        speed = abs(float((turned[peak] - turned[0]) / (time[peak] - time[0]))) if time[peak] > time[0] else None
    warnings = _warnings(recording, turned, contact, found.failure)
    warnings += tuple(line for line in found.warnings if "preconditioning" in line)
    return Motion(channel, (float(way.max()), float(way.min())), rate, duration, speed, segments,
                  int(found.cycles[-1]), contact, found.failure, warnings)


def touches_at_once(contact: Contact, way: np.ndarray) -> bool:
    """Whether there is no air, or none that matters: it ends within a hundredth of the way."""
    return contact.status == "before" or (contact.status == "unclear"
                                          and contact.interval[1] - way[0] <= _AT_ONCE * np.ptp(way))


def _warnings(recording: Recording, way: np.ndarray, contact: Contact | None,
              failure: Failure | None) -> tuple[str, ...]:
    found = [] if failure is None else [failure.in_words(stressed="displacement" not in recording)]
    if contact is not None and (contact.status == "none" or not (contact.found or touches_at_once(contact, way))):
        found.append(contact.in_words())
    if "force" in recording and not (contact is not None and contact.found):
        first, spread = abs(recording.force[0]), np.ptp(recording.force)
        if spread > 0 and first > _PRELOAD * spread:
            found.append(f"the force begins at {recording.force[0]:.3g} N, {100 * first / spread:.0f} % of its range: "
                         "a preload, or a sensor that was not zeroed")
    if np.ptp(way) == 0:
        found.append("the motion stands still")
    return tuple(found)
