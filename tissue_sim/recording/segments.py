"""Divide a test into segments: approach, preload, preconditioning, ramps, holds, unloadings and failure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.public_names import OldName
from tissue_sim.recording.contact import Contact, find_contact
from tissue_sim.recording.control import (
    detect_controlled_quantity_and_creep,
    find_creep_intervals,
    find_final_oscillation_or_none,
)
from tissue_sim.recording.curve_units import FORCE_UNITS, STRESS_UNITS, UNITS_OF_LOAD, CurveUnits
from tissue_sim.recording.failure import Failure, find_failure
from tissue_sim.recording.recording import MOTIONS, SECOND_MOTIONS, Recording
from tissue_sim.recording.segmentation import (
    compute_corner_tolerance_of_force,
    label_reloads_and_cycles,
    label_samples_ramp_hold_unload,
)

#: Names of segments, in the order of a test.
SEGMENTS = ("approach", "preload", "preconditioning", "ramp", "hold", "unload", "reload", "failure")


@dataclass(frozen=True)
class SegmentSettings:
    """Settings of `find_segments_of_arrays`.

    Attributes:
        preload_force: largest force of a preload, as a fraction of the largest force.
        preload_displacement: largest displacement of a preload from contact, as a fraction of the largest one.
        equal_peaks: largest difference of the peaks of cycles that precondition the specimen, as a fraction of the
            range of the displacement.
        fewest_cycles: fewest cycles with equal peaks that precondition the specimen.
        fewest_samples: fewest samples of a recording in which contact and failure are searched.
    """

    preload_force: float = 0.05
    preload_displacement: float = 0.15
    equal_peaks: float = 0.05
    fewest_cycles: int = 2
    fewest_samples: int = 12


#: Settings that the functions of this module use.
_SETTINGS = SegmentSettings()


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Segments of a test: labels and cycles of its samples, contact, failure and warnings.

    Attributes:
        labels: name of the segment of each sample, in `SEGMENTS` or a label of the file, shape (n,).
        cycles: number of the cycle, from 1, shape (n,).
        contact: contact of the tool; None for a recording on both sides of zero, or with few samples.
        failure: failure of the specimen; None: intact.
        stated: whether the labels are those of the file.
        units: units of motion and load in messages.
        warnings: sentences for the user.
    """

    labels: np.ndarray
    cycles: np.ndarray
    contact: Contact | None
    failure: Failure | None
    stated: bool
    units: CurveUnits
    warnings: tuple[str, ...]

    @property
    def has_air(self) -> bool:
        """Whether the recording has samples in the air, before contact."""
        return self.contact is not None and self.contact.has_air_before_contact

    #: Old name.
    runs = OldName("iterate_segment_names_and_bounds")

    def iterate_segment_names_and_bounds(self) -> Iterator[tuple[str, int, int]]:
        """Yield name, first sample and end (not included) of each segment, in order."""
        edges = np.flatnonzero(np.append(True, self.labels[1:] != self.labels[:-1]))
        for first, last in pairwise([*edges.tolist(), self.labels.size]):
            yield str(self.labels[first]), first, last


def find_segments(recording: Recording, kind: TestKind | str | None = None, *,
                  unknown_units: frozenset[str] = frozenset()) -> Segmentation:
    """Find the segments of a measured or simulated recording.

    Labels of the recording are kept. Without labels, the motion, the contact and the failure give the segments. Samples
    before contact are the approach. A preload is a hold under a small force during the first loading, or a hold under
    load before the first motion. Two or more cycles with equal peaks precondition the specimen for the following ones.

    Args:
        recording: with displacement and force, or stretch or shear strain and nominal stress.
        kind: kind of test, which determines the sign of strain and stress; None: the largest strain is a loading.
        unknown_units: channels with the numbers of the file, whose unit is unknown.

    Raises:
        InputError: an unknown kind, a recording without motion and load.
    """
    kind = KINDS.find(kind, "kind") if isinstance(kind, str) else kind
    motion, load, units = get_positive_motion_load_and_units(recording, kind)
    if unknown_units:
        units = units.with_numbers_of_file(motion=not unknown_units.isdisjoint(MOTIONS),
                                           load=not unknown_units.isdisjoint(UNITS_OF_LOAD))
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    stated = "segment" in recording.labels
    if is_table_of_two_axes(recording) and not stated:
        return make_segmentation_of_one_loading(len(recording), units)
    return find_segments_of_arrays(motion, load, time, recording.labels["segment"] if stated else None,
                                   units=units)


def is_table_of_two_axes(recording: Recording) -> bool:
    """Return whether a recording has two axes and no time, so that its order states no loading and unloading."""
    return any(name in recording for name in SECOND_MOTIONS) and not (
        "time" in recording and np.ptp(recording.time) > 0)


def make_segmentation_of_one_loading(size: int, units: CurveUnits) -> Segmentation:
    """Return the segmentation of a recording that is one loading from contact on."""
    labels, cycles = np.full(size, "ramp"), np.ones(size, int)
    for values in (labels, cycles):
        values.flags.writeable = False
    return Segmentation(labels, cycles, None, None, False, units, ())


def find_segments_of_arrays(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None,
                            labels: np.ndarray | None = None, *, units: CurveUnits = FORCE_UNITS,
                            control: str = "find") -> Segmentation:
    """Find the segments of arrays; see `find_segments`.

    Args:
        displacement: displacement, m (or strain, or angle, rad), positive under load, shape (n,).
        force: force, N (or stress, Pa, or torque, N m), positive under load, shape (n,).
        time: time, s, shape (n,); None: even steps.
        labels: segments of the file, shape (n,); None: the segments are found.
        units: units of motion and load in messages.
        control: controlled quantity, ``"displacement"`` or ``"force"``; ``"find"``: the signals show it.
    """
    clock = np.arange(displacement.size, dtype=float) if time is None else time
    warnings: list[str] = []
    ordered = _is_in_time_order_and_one_sided(displacement, force, time)
    contact = failure = None
    if ordered and displacement.size >= _SETTINGS.fewest_samples and np.ptp(displacement) > 0:
        failure = find_failure(displacement, force, time)
        end = max(displacement.size if failure is None else failure.index + 1, _SETTINGS.fewest_samples)
        contact = find_contact(displacement[:end], force[:end], None if time is None else time[:end])
    if contact is not None and contact.status != "before":
        warnings.append(contact.in_words(units))
    stated = labels is not None
    if control == "find" and ordered and time is not None and not stated:
        found = detect_controlled_quantity_and_creep(displacement, force, time).quantity
        control = "displacement" if found is None else found
    driven, tolerance = displacement, None
    if control == "force" and time is not None:
        driven, tolerance = force, compute_corner_tolerance_of_force(force)
    if labels is not None:
        labels = np.char.lower(np.asarray(labels).astype(str))
        cycles = label_reloads_and_cycles(label_samples_ramp_hold_unload(clock, driven, tolerance))[1]
    elif not ordered:
        labels, cycles = np.full(displacement.size, "ramp"), np.ones(displacement.size, int)
    else:
        # Without a time a hold is at least three samples: two near samples occur in each digitised curve.
        labels = label_samples_ramp_hold_unload(clock, driven, tolerance, shortest_hold=2.0 if time is None else 0.0)
        for first, last in find_creep_intervals(displacement, force, time):
            labels[first:last] = "hold"
        labels, cycles = label_reloads_and_cycles(labels)
        labels = labels.astype("U15")
        if contact is not None and contact.status != "none":
            _label_approach_and_preload_in_place(labels, displacement, force, contact, warnings, units)
        if cycles.max() > _SETTINGS.fewest_cycles and not _is_oscillation_around_offset(displacement, force, time):
            _label_preconditioning_in_place(labels, cycles, displacement, warnings)
        if contact is not None and contact.has_air_before_contact:
            # Later cycles pass through air again.
            in_air = (cycles > 1) & (displacement < contact.displacement)
            labels[np.isin(labels, ("ramp", "reload")) & in_air] = "approach"
    if failure is not None:
        warnings.append(failure.in_words(units))
        if not stated:
            labels[failure.index + 1:] = "failure"
    for values in (labels, cycles):
        values.flags.writeable = False
    return Segmentation(labels, cycles, contact, failure, stated, units, tuple(warnings))


def _is_oscillation_around_offset(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None) -> bool:
    """Return whether the cycles are an oscillation around an offset, which does not precondition."""
    found = find_final_oscillation_or_none(displacement, force, time)
    return found is not None and not found.returns


def _is_in_time_order_and_one_sided(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None) -> bool:
    """Return whether the samples are in the order of time, and the specimen is loaded to one side."""
    reach, least = float(np.abs(displacement).max()) or 1.0, int(np.argmin(displacement))
    both_sides = displacement[least] < -0.2 * reach and force[least] < -0.2 * float(np.abs(force).max())
    table = time is None and (displacement[-1] < displacement[0] or
                              float(np.diff(displacement).min(initial=0.0)) < -0.5 * reach)
    return not both_sides and not table


def get_positive_motion_load_and_units(recording: Recording,
                                       kind: TestKind | None) -> tuple[np.ndarray, np.ndarray, CurveUnits]:
    """Return motion (strain instead of stretch) and load, positive under load, shapes (n,), and their units."""
    pairs = [*(kind.channels if kind is not None else ())] or [
        pair for one in KINDS.values() for pair in one.channels]
    pair = next((pair for pair in pairs if all(name in recording for name in pair)), pairs[0])
    (motion, load), units = (recording.channel(name) for name in pair[:2]), UNITS_OF_LOAD[pair[1]]
    if units is not STRESS_UNITS:
        return motion, load, units
    strain = motion - MOTIONS[pair[0]]
    sign = kind.sign if kind is not None else float(np.sign(strain[np.argmax(np.abs(strain))])) or 1.0
    return sign * strain, sign * load, units


def _label_approach_and_preload_in_place(labels: np.ndarray, displacement: np.ndarray, force: np.ndarray,
                                         contact: Contact, warnings: list[str], units: CurveUnits) -> None:
    """Label the approach and the preload, in place."""
    largest = float(force.max())
    first_motion = int(np.argmax(labels != "hold")) if np.any(labels != "hold") else labels.size
    start = contact.index if contact.has_air_before_contact else 0
    if contact.has_air_before_contact:
        labels[:start] = "approach"
    elif first_motion and abs(float(np.median(force[:first_motion]))) > max(0.005 * largest, 5 * contact.noise):
        labels[:first_motion] = "preload"
        load = units.format_load(float(np.median(force[:first_motion])), 3)
        warnings.append(f"the recording begins at rest under {load}, and no samples in the air show the zero of the "
                        "force: a settled preload, and contact was before it; state its displacement with contact, or "
                        "record some air")
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    runs = list(pairwise(edges.tolist()))
    travel = float(displacement.max()) - float(displacement[start])
    for (first, last), following in pairwise(runs):
        stops = labels[first] == "hold" and labels[following[0]] == "ramp" and first > start
        limit = _SETTINGS.preload_force * (largest - contact.force_zero)
        little = np.median(force[first:last]) - contact.force_zero < limit
        if stops and little and displacement[first] - displacement[start] < _SETTINGS.preload_displacement * travel:
            labels[start:last] = "preload"
            return
        if labels[first] == "unload":
            return


def _label_preconditioning_in_place(labels: np.ndarray, cycles: np.ndarray, displacement: np.ndarray,
                                    warnings: list[str]) -> None:
    """Label cycles with equal peaks before a last cycle as preconditioning, in place."""
    count = int(cycles.max())
    peaks = np.array([displacement[cycles == number].max() for number in range(1, count + 1)])
    alike = np.abs(peaks - peaks[0]) <= _SETTINGS.equal_peaks * np.ptp(displacement)
    before = int(np.argmin(alike)) if not alike.all() else count - 1
    if before < _SETTINGS.fewest_cycles:
        return
    samples = (cycles <= before) & ~np.isin(labels, ("approach", "preload"))
    labels[samples] = "preconditioning"
    labels[(cycles == before + 1) & (labels == "reload")] = "ramp"
    kind = "an equal" if alike.all() else "a higher" if peaks[before] > peaks[0] else "a lower"
    warnings.append(f"cycles 1 to {before} have equal peaks and are taken as preconditioning of cycle "
                    f"{before + 1}, which has {kind} peak")
