"""Select the samples of a recording for a fit, and write notes about the selection.

Outliers are removed, preload and control are detected, and the samples between contact and failure or those of the
first loading are selected.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.control import detect_controlled_quantity_and_creep
from tissue_sim.recording.curve_units import FORCE_UNITS, STRESS_UNITS
from tissue_sim.recording.recording import (
    MIN_POINTS,
    Recording,
    get_recorded_kind_if_different_or_empty,
    get_recorded_tool_if_different_or_empty,
)
from tissue_sim.recording.screening import (
    ControlledQuantityFindings,
    LoadAtZeroAndContactShift,
    Preload,
    Screening,
    estimate_load_at_zero_displacement,
)
from tissue_sim.recording.segments import (
    Segmentation,
    find_segments_of_arrays,
    make_segmentation_of_one_loading,
)

#: Minimum displacement to the opposite side of a specimen loaded in both directions, as a fraction of the largest.
OTHER_SIDE = 0.05
#: Displacement and load of the first sample that is kept, as a fraction of their ranges, above which the loading before
#: it changes the relaxation after it.
_FAR = 0.1


def select_sample_indices_for_elastic_law(samples: np.ndarray, driven: np.ndarray, screening: Screening,
                                          path: Path, *, both_sides: bool) -> np.ndarray:
    """Select the samples to which a law without memory is fitted: the first loading, or all of an oscillation.

    Samples after the first saturated one and after the start of creep under constant load are left out.

    Args:
        samples: indices of the usable samples, shape (k,).
        driven: controlled displacement, m, or force, N, of all samples, shape (n,).
        screening: findings about the signals.
        path: file of the recording, for messages.
        both_sides: whether the specimen is loaded in both directions.

    Returns:
        Indices of the selected samples.

    Raises:
        InputError: fewer than five samples, or an oscillation with a phase lag.
    """
    control = screening.control
    samples = samples[samples < screening.kept_count_before_saturation_or_infinity]
    if control is not None and control.has_dissipative_oscillation:
        raise InputError(f"{path.name}: {control.sentence}", field="recordings")
    if control is not None and control.pattern == "oscillation":
        return samples
    if control is not None and control.pattern == "creep":
        samples = samples[samples < control.loading]
        if samples.size < MIN_POINTS:
            raise InputError(f"{path.name} must have at least {MIN_POINTS} samples of loading before its creep; got "
                             f"{samples.size}. {control.sentence}", field="recordings")
    loads = find_loading_indices_of_one_or_both_sides(driven[samples], both_sides=both_sides) if samples.size \
        else samples
    if loads.size < MIN_POINTS:
        raise InputError(f"{path.name} must have at least {MIN_POINTS} samples of loading; its largest strain is in "
                         f"sample {loads.size}, and later samples count as unloading. Sort the file by time",
                         field="recordings")
    return samples[loads]


def reject_left_out_start_of_loading(displacement: np.ndarray, force: np.ndarray, screening: Screening,
                                     path: Path) -> None:
    """Raise an error if the loading from rest is missing in a recording of a material with memory.

    The force of a material with memory depends on the complete history; the rate of an unrecorded loading is unknown.

    Args:
        displacement: displacement of the kept samples, m, positive under load, shape (n,).
        force: force of the kept samples, N, positive under load, shape (n,).
        screening: findings about the signals.
        path: file of the recording, for messages.

    Raises:
        InputError: sample 1 is left out and the next sample is far from rest.
    """
    starts_loaded = displacement[0] > _FAR * np.ptp(displacement) and force[0] > _FAR * np.ptp(force)
    if 1 in screening.left_out_sample_numbers and starts_loaded:
        lost = next((each.sentence for each in screening.left_out if 1 in each.samples), "sample 1 left out")
        raise InputError(f"{path.name}: the loading from rest must be recorded for a material with a memory. {lost}, "
                         "and the next sample is under load. Correct that sample in the file", field="recordings")


def find_loading_indices_of_one_or_both_sides(displacement: np.ndarray, both_sides: bool) -> np.ndarray:
    """Return the indices of the samples of the first loading, which ends at the largest displacement.

    A specimen loaded in both directions has a second loading from rest to the opposite extreme, which is included. The
    unloading between the two loadings is left out.

    Args:
        displacement: displacement, m, shape (n,).
        both_sides: whether the specimen is loaded in both directions.
    """
    last, other = int(np.argmax(displacement)), int(np.argmin(displacement))
    if not both_sides or -displacement[other] < OTHER_SIDE * displacement[last]:
        return np.arange(last + 1)
    first, second = sorted((last, other))
    # The unloading ends at the last change of sign of the displacement before the second extreme.
    turned = np.flatnonzero(displacement[first:second] * displacement[second] <= 0)
    if first + 1 < MIN_POINTS:
        # The recording begins at one extreme: the motion to the other extreme is one loading.
        return np.arange(first, second + 1)
    return np.append(np.arange(first + 1), np.arange(first + turned[-1] + 1, second + 1))


def check_displacement_range(displacement: np.ndarray, height: float, test: Test, path: Path) -> None:
    """Raise an `InputError` for a constant displacement, or one that exceeds the height of the specimen.

    Args:
        displacement: displacement of the loading, m, positive under load, shape (n,).
        height: height of the specimen, m.
        test: test of the recording.
        path: file of the recording, for messages.
    """
    if np.ptp(displacement) == 0:
        raise InputError(f"{path.name} has a constant displacement in all {displacement.size} samples of loading; "
                         "check which column is read as displacement", field="recordings")
    largest = float(displacement.max())
    if not test.kind.has_gripped_ends and largest >= height:
        raise InputError(f"{path.name}: the stretch must be above zero; got {1 - largest:g}"
                         if test.specimen is None else
                         f"{path.name}: the displacement must be smaller than the height {height * 1e3:g} mm of the "
                         f"specimen {test.specimen.name!r}; got {largest * 1e3:g} mm", field="recordings")
    # A gripped specimen in tension has the length height + displacement, which must be positive.
    if test.kind.has_gripped_ends and not test.kind.loads_in_both_directions and float(displacement.min()) <= -height:
        number = int(np.argmin(displacement)) + 1
        shortest = 1.0 + float(displacement.min()) / height
        raise InputError(f"{path.name}: the stretch must be above zero; got {shortest:g} in sample {number} of the "
                         "loading. Check that sample and the size of the specimen, or leave the sample out with "
                         "leave_out", field="recordings")
    if largest <= 0:
        raise InputError(f"{path.name} contains no loading: its largest strain is {largest / height:g}. Check the kind "
                         "of test, or change the sign of the column with sign = -1", field="recordings")


#: Minimum standard deviation of the prior of a contact offset that covers a preload, as a fraction of the shift.
_COVERS = 0.5


def remove_left_out_and_outlier_samples(recording: Recording, name: str, test: Test) -> tuple[Recording, Screening]:
    """Remove the samples that the test leaves out and the detected outliers.

    Args:
        recording: recording as read from the file.
        name: name of the recording in the campaign, ``test/recording``.
        test: test to which the recording belongs.

    Returns:
        The cleaned recording and the findings.

    Raises:
        InputError: see `tissue_sim.recording.cleaning.remove_outliers_and_saturation`.
    """
    columns = test.reading.get("columns") or {}
    zeroed = [channel for channel, entry in columns.items() if entry.get("offset") == "start"]
    own = name.removeprefix(f"{test.name}/")
    try:
        return remove_outliers_and_saturation(recording, test.leave_out.get(own, test.leave_out.get("")), zeroed,
                                              None if test.control == "find" else test.control)
    except InputError as error:
        raise InputError(f"{own}: {error.problem}", file=error.file, field=error.field) from None


def check_recording_names_of_leave_out(test: Test, names: Sequence[str], campaign: Campaign) -> None:
    """Check that the recordings named in `leave_out` of a test belong to the test.

    Args:
        test: the test.
        names: names of the recordings of the test in the campaign.
        campaign: the campaign, for messages.

    Raises:
        InputError: `leave_out` names an unknown recording, or names none although the test has several.
    """
    own = [name.removeprefix(f"{test.name}/") for name in names]
    field = f"{test.place}.leave_out"
    if "" in test.leave_out and len(own) > 1:
        raise InputError(f"leave_out must name the recording, because the test has {len(own)} recordings; write "
                         f"{{ \"{own[0]}\" = [...] }}", file=campaign.path, field=field)
    for name in test.leave_out:
        if name and name not in own:
            raise InputError(f"leave_out must name a recording of the test ({', '.join(own)}); got {name!r}",
                             file=campaign.path, field=f"{field}.{name}")


def add_controlled_quantity_to_screening(screening: Screening, motion: np.ndarray, load: np.ndarray,
                                         time: np.ndarray | None, test: Test) -> Screening:
    """Return the findings with the controlled quantity (displacement or force), detected or stated by the test.

    Args:
        screening: findings so far.
        motion: displacement of the kept samples, positive under load, shape (n,).
        load: force of the kept samples, positive under load, shape (n,).
        time: time, s, shape (n,), or None.
        test: test that may state the controlled quantity.
    """
    control = ControlledQuantityFindings(None, "ramp") if test.kind.has_several_motions and time is None else \
        detect_controlled_quantity_and_creep(motion, load, time)
    return replace(screening, control=control if test.control == "find" else replace(control, equal_samples=0))


def add_load_at_zero_to_screening(screening: Screening, motion: np.ndarray, load: np.ndarray, campaign: Campaign, *,
                                  allows_reversed_load: bool, stressed: bool) -> Screening:
    """Return the findings with a nonzero load at zero displacement, if a recording starts in contact under load.

    Args:
        screening: findings so far.
        motion: displacement, measured from contact if the campaign detects it, positive under load, shape (n,).
        load: force, positive under load, shape (n,).
        campaign: campaign with the prior of the contact offset.
        allows_reversed_load: whether the test can load the specimen in the opposite direction.
        stressed: whether strain and stress were recorded.
    """
    found = estimate_load_at_zero_displacement(motion, load)
    if found is None:
        return screening
    fit = campaign.fit
    # A default prior is widened to the preload, see
    # `calibration.campaign.measured.make_campaign_with_scaled_offset_defaults`.
    covers = fit.offset == "fit" and not stressed and (found.load > 0 or allows_reversed_load) and (
        "offset_prior" in fit.offset_usual or fit.offset_prior >= _COVERS * abs(found.shift))
    # An inverse fit has a contact offset in each recording, unless the campaign states a deviation of zero.
    fits_contact = fit.method != "analytical" and campaign.noise.contact_jitter != 0
    sentence = _describe_negative_initial_load_with_remedy(found, stressed=stressed, covers=covers) if found.load < 0 \
        else \
        _describe_preload_with_remedy(found, stressed=stressed, covers=covers, fits_contact=fits_contact)
    return replace(screening, preload=Preload(*found, covers, sentence))


def _describe_negative_initial_load_with_remedy(found: LoadAtZeroAndContactShift, *, stressed: bool,
                                                covers: bool) -> str:
    """Describe a recording that begins under a force against the direction of loading, with cause and remedy."""
    load = f"{1e-3 * found.load:.3g} kPa" if stressed else f"{found.load:.3g} N"
    finding = (f"the recording begins under {load}, {100 * found.fraction:.0f} % of its range, against the direction "
               "of loading: the load cell was not zeroed")
    if covers:
        return f"{finding}, or the specimen was strained in the opposite direction; the contact offset is fitted"
    remedy = "correct the stress of the file" if stressed else "set an offset of the force in columns"
    return f"{finding}; the moduli are wrong; {remedy}"


def _describe_preload_with_remedy(found: LoadAtZeroAndContactShift, *, stressed: bool, covers: bool,
                                  fits_contact: bool) -> str:
    """Describe a recording that begins under load, with remedy."""
    load, shift = (f"{1e-3 * found.load:.3g} kPa", f"a strain of {found.shift:.3g}") if stressed else \
        (f"{found.load:.3g} N", f"{1e3 * found.shift:.2g} mm")
    finding = (f"the recording begins under {load}, {100 * found.fraction:.0f} % of its range: the displacement was "
               f"zeroed at a preload, {shift} after contact, or the load cell was not zeroed")
    if covers:
        return f"{finding}; the contact offset is fitted"
    remedy = "correct the strain and stress of the file" if stressed else (
        f"set offset = \"fit\" and offset_prior_mm = {1e3 * found.shift:.2g} in [fit] for a preload, or an offset of "
        "the force in columns for a load cell")
    effect = "the moduli are wrong unless the fitted contact offset covers that distance" if fits_contact else \
        "the moduli are wrong"
    return f"{finding}; {effect}; {remedy}"


def make_screening_notes_by_subject(screening: Screening, recording: Recording, *, remembering: bool) -> dict[str, str]:
    """Return the notes for the user about the signals of a recording, by subject.

    Args:
        screening: findings about the signals.
        recording: recording whose metadata name the columns that are not read.
        remembering: whether the material has memory; if so, relaxation and creep need no note.
    """
    unread = recording.metadata.get("unread_columns")
    names = ", ".join(map(repr, unread)) if isinstance(unread, list | tuple) else ""
    subjects = {"outliers": [*(each.sentence for each in screening.left_out), *screening.kept_outlier_warnings],
                "saturation": [each.sentence for each in screening.saturation],
                "preload": [screening.preload.sentence] if screening.preload is not None else [],
                "control": [screening.control.sentence] if screening.control is not None and not remembering else [],
                "columns": [f"columns that are not used: {names}"] if names else []}
    return {subject: "; ".join(dict.fromkeys(filter(None, sentences)))
            for subject, sentences in subjects.items() if any(sentences)}


@dataclass(frozen=True, eq=False)
class SegmentedRecording:
    """All samples of a recording in the coordinates of the fit.

    Attributes:
        time: time, s, shape (n,), or None.
        displacement: displacement, m, positive under load, measured from contact if the campaign requests it, shape
            (n,).
        force: force, N, positive under load, shape (n,).
        segmentation: segments, contact and failure found in the recording.
        used: mask of the samples that are compared with a model, shape (n,).
        notes: subject -> note for the user.
        recorded_force: force before subtraction of a zero, N, shape (n,).
        shift: displacement that was subtracted, m.
    """

    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    segmentation: Segmentation
    used: np.ndarray
    notes: Mapping[str, str]
    recorded_force: np.ndarray
    shift: float = 0.0


def segment_recording_from_contact(test: Test, displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None,
                                   labels: np.ndarray | None, *, stressed: bool, remembering: bool, path: Path
                                   ) -> SegmentedRecording:
    """Segment a recording and apply the settings of its test for contact and failure.

    The displacement is measured from the recorded, detected or stated contact. Samples after a failure are cut if the
    test requests it. Preconditioning cycles are left out for a material without memory.

    Args:
        test: test with the settings.
        displacement: displacement, m (strain), positive under load, shape (n,).
        force: force, N (stress, Pa), positive under load, shape (n,).
        time: time, s, shape (n,), or None.
        labels: labels of the segments in the file, shape (n,), or None.
        stressed: whether strain and stress were recorded.
        remembering: whether the model has memory.
        path: file of the recording, for messages.

    Raises:
        InputError: the contact cannot be detected, the contact is stated in mm for a recording of stress, or a failure
            occurs and the test sets ``failure = 'refuse'``.
    """
    units = STRESS_UNITS if stressed else FORCE_UNITS
    # The order of a table of several motions without time states no loading and unloading.
    found = make_segmentation_of_one_loading(displacement.size, units) if (
        test.kind.has_several_motions and time is None and labels is None) else find_segments_of_arrays(
        displacement, force, time, labels, units=units, control=test.control)
    contact, used = found.contact, np.ones(displacement.size, bool)
    notes: dict[str, str] = {}
    recorded, shift = force, 0.0
    if isinstance(test.contact, float):
        if stressed:
            raise InputError(f"contact must be 'recorded' or 'find' for a recording of strain and stress such as "
                             f"{path.name}; got a displacement in mm", field="contact")
        shift = test.contact
        displacement, used = displacement - shift, displacement >= shift
    elif test.contact == "find":
        if contact is None or contact.status in ("unclear", "none"):
            reason = "the recording has few samples or loads in both directions" if contact is None else \
                contact.in_words(units)
            raise InputError(f"{path.name}: {reason}; state the contact in mm, or set contact = 'recorded'",
                             field="contact")
        if contact.status == "before":
            notes["contact"] = (f"{contact.in_words(units)}; the recorded displacement is used"
                                + ("" if stressed else ", so state the contact in mm if the first displacement is not "
                                   "0"))
        if contact.has_air_before_contact:
            used, shift = np.arange(displacement.size) >= contact.index, contact.displacement
            displacement, force = contact.subtract_contact_zero_and_drift(displacement, force, time)
            # In later cycles the tool may lift off again.
            used &= remembering | (displacement >= 0)
    if not used.any():
        raise InputError(f"{path.name} ends before its contact at {1e3 * shift:g} mm", field="contact")
    failure = found.failure
    if failure is not None:
        words = f"{failure.in_words(units)} (sample {failure.index + 1} of {force.size})"
        if test.failure == "refuse":
            raise InputError(f"{path.name}: {words}; cut the file there, or set failure = 'cut'", field="failure")
        notes["failure"] = f"{words}; " + (
            "the recording is fitted up to this sample" if test.failure == "cut" else
            "later samples are fitted too (failure = 'keep'), although no law describes damaged material")
        if test.failure == "cut":
            used &= np.arange(force.size) <= failure.index
    after = found.labels != "preconditioning"
    if not remembering and not after.all() and (used & after).any():
        used &= after
        cycles = next((line for line in found.warnings if "preconditioning" in line),
                      "the recording has preconditioning cycles")
        notes["preconditioning"] = f"{cycles}; these cycles are left out"
    return SegmentedRecording(time, displacement, force, found, used, notes, recorded, shift)


def get_notes_with_fit_before_contact_warning(recording: SegmentedRecording, first: int, *,
                                              stressed: bool) -> dict[str, str]:
    """Return the notes of a recording, with a warning if the first fitted sample lies before contact.

    Args:
        recording: the segmented recording.
        first: index of the first fitted sample.
        stressed: whether strain and stress were recorded.
    """
    contact, notes = recording.segmentation.contact, dict(recording.notes)
    if contact is None or not contact.has_air_before_contact:
        return notes
    position = recording.displacement[first] + recording.shift
    if position < contact.interval[0]:
        scale, unit = (1.0, " (strain)") if stressed else (1e3, " mm")
        low, high = (scale * end for end in contact.interval)
        notes["contact"] = (
            f"the fit begins {scale * (contact.displacement - position):.3g}{unit} before contact, which is found at "
            f"{scale * contact.displacement:.4g}{unit} (95 %: {low:.4g} to {high:.4g}), so moduli are too small; set "
            "contact = \"find\" in its test" + ("" if stressed else ", or state it in mm"))
    return notes


def make_kind_and_tool_mismatch_notes(recording: Recording, test: Test) -> dict[str, str]:
    """Return notes if the metadata of a recording state another kind of test or another tool than the campaign."""
    notes = {}
    if kind := get_recorded_kind_if_different_or_empty(recording, test.kind.name):
        notes["kind"] = f"the file states the kind {kind}; the fit uses {test.kind.name}"
    tool = None if test.experiment is None else test.experiment.tool
    if tool is not None and (other := get_recorded_tool_if_different_or_empty(recording, tool.shape, tool.radius)):
        notes["tool"] = f"the file states a {other}; the fit uses another tool"
    return notes


def format_notes_summary_by_test_and_subject(recordings: Iterable[tuple[str, str, Mapping[str, str]]]) -> str:
    """Summarise the notes of all recordings in one sentence per test and subject.

    Args:
        recordings: (test, name of the recording, its notes) of each recording.

    Returns:
        The sentences, each with a leading space; empty without notes.
    """
    several: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for test, name, notes in recordings:
        for subject, sentence in notes.items():
            several.setdefault((test, subject), []).append((name, sentence))
    lines = []
    for same in several.values():
        (name, sentence), others = same[0], len(same) - 1
        more = f" The same applies to {others} more recording{'s' if others > 1 else ''} of this test." if others \
            else ""
        lines.append(f" {name}: {sentence}.{more}")
    return "".join(lines)
