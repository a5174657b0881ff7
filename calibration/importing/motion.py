"""Describe the motion of one recording: sampling, segments, cycles, contact and failure.

Findings are the assumptions about a recording that its signals support: samples left out, contact, and the controlled
quantity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.contact import Contact
from tissue_sim.recording.control import detect_controlled_quantity_and_creep
from tissue_sim.recording.curve_units import CurveUnits
from tissue_sim.recording.failure import Failure
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.recording import MOTIONS, Recording
from tissue_sim.recording.screening import EQUAL_LOAD, ControlledQuantityFindings, Screening, format_sample_numbers
from tissue_sim.recording.segments import (
    Segmentation,
    find_segments,
    get_positive_motion_load_and_units,
    is_table_of_two_axes,
)


def list_signal_based_assumptions(screening: Screening, contact: Contact | None, *, has_air: bool | None,
                                  units: CurveUnits, controlled: str | None = None) -> tuple[Assumption, ...]:
    """Return the assumptions about one recording that its signals show: omitted samples, contact, controlled quantity.

    Args:
        screening: findings on the recording, with the controlled quantity.
        contact: contact of the tool; None: not searched.
        has_air: whether motion in air precedes contact; None: unknown.
        units: units of motion and load in messages.
        controlled: controlled quantity as the user states; None: found in the signals.
    """
    return tuple(_iterate_signal_based_assumptions(screening, contact, has_air=has_air, units=units,
                                                   controlled=controlled))


def _iterate_signal_based_assumptions(screening: Screening, contact: Contact | None, *, has_air: bool | None,
                                      units: CurveUnits,
                                      controlled: str | None) -> Iterator[Assumption]:
    """Yield the assumptions about one recording; see `list_signal_based_assumptions`."""
    control = screening.control
    if screening.left_out_sample_numbers:
        sentences = [*(each.sentence for each in screening.left_out), *(each.sentence for each in screening.saturation)]
        yield Assumption("samples left out", format_sample_numbers(screening.left_out_sample_numbers), tuple(sentences))
    if contact is not None and contact.has_air_before_contact:
        yield Assumption("contact", "after air" if has_air else "at the first sample",
                         (contact.in_words(units),))
    if controlled is not None:
        yield Assumption("controlled quantity", controlled, (), flag=f"--control {controlled}", is_stated=True)
    elif control is not None and control.equal_samples:
        # The modulus at the held load, or that of the loading alone: the ratio is not known before a fit.
        yield Assumption("controlled quantity", "the force is held, and its column holds the set value",
                         (EQUAL_LOAD.format(control.equal_samples),), (),
                         (AlternativeValue("the load cell is saturated", None, "--control displacement"),),
                         "--control force")
    elif control is not None and control.quantity is not None:
        motion, load = ("angle", "torque") if units.load_name == "torque" else ("displacement", "force")
        quantity = {"displacement": motion, "force": load}.get(control.quantity, control.quantity)
        evidence = {"creep": f"the {load} is constant while the {motion} creeps",
                    "staircase": f"the {motion} is constant in several holds under load",
                    "ramp and hold": f"the {motion} is constant in a hold under load"}.get(
            control.pattern, f"the {quantity} is a line in time, the other channel is not")
        yield Assumption("controlled quantity", f"{quantity} ({control.pattern})", (evidence,))
    elif control is not None and control.pattern == "oscillation":
        yield Assumption("controlled quantity", "oscillation", (
            f"{control.frequency:.3g} Hz" + ("" if control.loss_factor is None else
                                             f", loss factor {control.loss_factor:.2f}"),))


#: Largest air before contact that is ignored, as a fraction of the largest displacement.
_NEGLIGIBLE_AIR = 0.01


class MotionSegmentSampleRange(NamedTuple):
    """Segment of the motion from sample `first` to `last` of the recording (indices from 0, both included)."""

    name: str
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Motion of the tool in one recording, with its segments, contact, failure, and warnings.

    Attributes:
        channel: channel of the motion: ``"displacement"``, ``"stretch"`` or ``"shear strain"``.
        reach: largest and smallest value of the motion, SI, measured from the value at rest.
        rate: samples per second; None without time.
        duration: s; None without time.
        speed: speed of the first loading, SI; None without time.
        found: segments, contact and failure of the samples that are kept.
        warnings: sentences for the user.
        screening: samples left out, saturation, controlled quantity.
        kept: indices of the samples that are kept, from 0, shape (n,); None: all.
        assumptions: assumptions about zero, contact, controlled quantity, and samples that are left out.
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

    def get_sample_index_in_file(self, index: int) -> int:
        """Return the index of a sample in the recording of the file, from its index among the kept samples (from 0)."""
        return index if self.kept is None else int(self.kept[index])

    @property
    def segments(self) -> tuple[MotionSegmentSampleRange, ...]:
        """Segments in the order of time, with indices of the recording of the file."""
        return tuple(MotionSegmentSampleRange(name, self.get_sample_index_in_file(first),
                                              self.get_sample_index_in_file(end - 1))
                     for name, first,
                     end in self.found.iterate_segment_names_and_bounds())

    @property
    def loading_cycle_count(self) -> int:
        """Number of loading cycles: the first loading, and each loading after an unloading."""
        return int(self.found.cycles.max())

    @property
    def failure(self) -> Failure | None:
        """Failure of the specimen; None if the specimen stays intact."""
        return self.found.failure

    @property
    def contact(self) -> Contact | None:
        """Record of the search for the first contact; None: contact was not searched.

        The `status` of the record may be ``unclear`` or ``none``. Its displacement is that of the file, or a strain.
        """
        return self.found.contact

    @property
    def starts_in_air_or_none_if_unclear(self) -> bool | None:
        """Whether the recording starts with motion in air or slack before contact; None if this is unclear."""
        contact = self.found.contact
        if contact is None or contact.status == "before":
            return False
        if contact.status == "unclear" and contact.interval[1] <= _NEGLIGIBLE_AIR * max(map(abs, self.reach)):
            return False
        return True if contact.has_air_before_contact else None


def analyse_recorded_motion(recording: Recording, kind: str | None, controlled: str | None = None,
                            unknown_units: frozenset[str] = frozenset()) -> RecordedMotion:
    """Analyse the motion of one recording: sampling, segments, contact, failure, warnings and assumptions.

    Args:
        recording: recording with a channel of `MOTIONS` and a force or stress.
        kind: kind of test; None: unknown.
        controlled: controlled quantity that the user states; None: found in the signals.
        unknown_units: channels with the numbers of the file, whose unit or scale is unknown.
    """
    channel = next(name for name in MOTIONS if name in recording)
    size = len(recording)
    recording, screening = remove_outliers_and_saturation(recording, controlled=controlled)
    is_kept = np.ones(size, bool)
    is_kept[np.array(screening.left_out_sample_numbers, int) - 1] = False
    kept = np.flatnonzero(is_kept)
    way = np.array(recording.channel(channel)) - MOTIONS[channel]
    # Compression is recorded as a stretch below 1, and a table may start at its largest strain.
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
        # A table without a clock has no order; starting from rest, the table is a loading.
        recording = recording.select(slice(None, None, -1))
    control = _get_control_findings(recording, kind)
    screening = replace(screening, control=control if controlled is None else replace(control, equal_samples=0))
    motion = RecordedMotion(channel, (float(way.max()), float(way.min())), rate, duration, speed,
                            find_segments(recording, kind, unknown_units=unknown_units), screening=screening,
                            kept=None if kept.size == size else kept)
    assumptions = list_signal_based_assumptions(screening, motion.contact,
                                                has_air=motion.starts_in_air_or_none_if_unclear,
                                                units=motion.found.units, controlled=controlled)
    return replace(motion, warnings=tuple(_iterate_motion_warnings(recording, motion)), assumptions=assumptions)


def _get_control_findings(recording: Recording, kind: str | None) -> ControlledQuantityFindings:
    """Return the findings about control: which quantity the machine controls, holds, creep and relaxation."""
    if is_table_of_two_axes(recording):
        return ControlledQuantityFindings(None, "ramp")
    motion, load, _ = get_positive_motion_load_and_units(recording, KINDS.get(kind) if kind else None)
    return detect_controlled_quantity_and_creep(motion, load, recording.time if "time" in recording
                                                and np.ptp(recording.time) > 0 else None)


def _iterate_motion_warnings(recording: Recording, motion: RecordedMotion) -> Iterator[str]:
    """Yield the warnings about one recording: screening, contact, segments."""
    contact = motion.contact
    said = "" if contact is None else contact.in_words(motion.found.units)
    yield from motion.screening.finding_sentences
    # Force curves of an AFM count from contact, and negligible air needs no warning.
    silent = "zeroing" in recording.metadata or motion.starts_in_air_or_none_if_unclear is False
    yield from (warning for warning in motion.found.warnings if not (warning == said and silent))
    if np.ptp(recording.channel(motion.channel)) == 0:
        yield "the motion is constant, so that the recording has no loading"
