"""Select the samples of a recording between contact and failure, and write notes about the selection."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.recording.recording import (
    Recording,
    get_recorded_kind_if_different_or_empty,
    get_recorded_tool_if_different_or_empty,
)
from tissue_sim.recording.segments import Segmentation, find_segments_of_arrays


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
    found = find_segments_of_arrays(displacement, force, time, labels, stressed=stressed)
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
                contact.in_words(stressed=stressed)
            raise InputError(f"{path.name}: {reason}; state the contact in mm, or set contact = 'recorded'",
                             field="contact")
        if contact.status == "before":
            notes["contact"] = (f"{contact.in_words(stressed=stressed)}; the recorded displacement is used"
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
        words = f"{failure.in_words(stressed=stressed)} (sample {failure.index + 1} of {force.size})"
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
