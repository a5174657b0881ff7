"""Recordings from contact to failure: what of each is compared with a model, and what a user has to know about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.recording.origin import other_kind, other_tool
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segments import Segmentation, segments_of


@dataclass(frozen=True, eq=False)
class SegmentedRecording:
    """All of a recording, in the coordinates that are fitted.

    Attributes:
        time: s, or None. displacement, force: positive under load, m and N, from contact where the campaign asks for
            that, shape (n,). segmentation: found in it. used: samples that are compared with a model.
        notes: subject -> what a user has to know. recorded_force: before a zero was taken off, N.
        shift: displacement that was taken off, m.
    """

    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    segmentation: Segmentation
    used: np.ndarray
    notes: Mapping[str, str]
    recorded_force: np.ndarray
    shift: float = 0.0


def segment_recording(test: Test, displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None,
                      labels: np.ndarray | None, *, stressed: bool, remembering: bool, path: Path
                      ) -> SegmentedRecording:
    """A recording as its test wants it: contact recorded, found or stated; cut at a failure; without preconditioning
    where the material does not remember it.

    Raises:
        InputError: a contact that shall be found and cannot be told, one in mm of a recording of stress, a failure that
            shall be refused.
    """
    found = segments_of(displacement, force, time, labels, stressed=stressed)
    contact, used = found.contact, np.ones(displacement.size, bool)
    notes: dict[str, str] = {}
    recorded, shift = force, 0.0
    if isinstance(test.contact, float):
        if stressed:
            raise InputError(f"{path.name} holds strain and stress, which have no contact in mm; give 'recorded' or "
                             "'find'", field="contact")
        shift = test.contact
        displacement, used = displacement - shift, displacement >= shift
    elif test.contact == "find":
        if contact is None or contact.status in ("unclear", "none"):
            reason = "it has few samples or loads to both sides" if contact is None else \
                contact.in_words(stressed=stressed)
            raise InputError(f"{path.name}: {reason}; state the contact in mm, or set contact = 'recorded'",
                             field="contact")
        if contact.status == "before":
            notes["contact"] = (f"{contact.in_words(stressed=stressed)}; displacement is taken as it was recorded"
                                + ("" if stressed else ", so state the contact in mm where its first sample is not 0"))
        if contact.found:
            used, shift = np.arange(displacement.size) >= contact.index, contact.displacement
            displacement, force = contact.counted_from(displacement, force, time)
            # A later cycle comes through air again.
            used &= remembering | (displacement >= 0)
    if not used.any():
        raise InputError(f"{path.name} ends before its contact at {1e3 * shift:g} mm", field="contact")
    failure = found.failure
    if failure is not None:
        words = f"{failure.in_words(stressed=stressed)} (sample {failure.index + 1} of {force.size})"
        if test.failure == "refuse":
            raise InputError(f"{path.name}: {words}; cut the file there, or set failure = 'cut'", field="failure")
        notes["failure"] = f"{words}; " + (
            "it is fitted up to there" if test.failure == "cut" else
            "it is fitted beyond, as failure = 'keep' asks: no law of an intact material describes that")
        if test.failure == "cut":
            used &= np.arange(force.size) <= failure.index
    after = found.labels != "preconditioning"
    if not remembering and not after.all() and (used & after).any():
        used &= after
        cycles = next((line for line in found.warnings if "preconditioning" in line),
                      "it has cycles of preconditioning")
        notes["preconditioning"] = f"{cycles}; these cycles are left out"
    return SegmentedRecording(time, displacement, force, found, used, notes, recorded, shift)


def with_air_noted(recording: SegmentedRecording, first: int, *, stressed: bool) -> dict[str, str]:
    """The notes, with one more where sample `first`, the first that is fitted, lies before contact."""
    contact, notes = recording.segmentation.contact, dict(recording.notes)
    if contact is None or not contact.found:
        return notes
    place = recording.displacement[first] + recording.shift
    if place < contact.interval[0]:
        scale, unit = (1.0, " (strain)") if stressed else (1e3, " mm")
        low, high = (scale * end for end in contact.interval)
        notes["contact"] = (
            f"the fit begins {scale * (contact.displacement - place):.3g}{unit} before contact, which is found at "
            f"{scale * contact.displacement:.4g}{unit} (95 %: {low:.4g} to {high:.4g}): moduli come out too small; set "
            "contact = \"find\" in its test" + ("" if stressed else ", or state it in mm"))
    return notes


def from_elsewhere(recording: Recording, test: Test) -> dict[str, str]:
    """Notes of a recording that says it was made in another kind of test, or with another tool."""
    notes = {}
    if kind := other_kind(recording, test.kind.name):
        notes["kind"] = f"it says that it is a {kind}, and it is fitted as a {test.kind.name}"
    tool = None if test.experiment is None else test.experiment.tool
    if tool is not None and (other := other_tool(recording, tool.shape, tool.radius)):
        notes["tool"] = f"it says that it was measured with a {other}, and it is fitted with another tool"
    return notes


def notes_in_short(recordings: Iterable[tuple[str, str, Mapping[str, str]]]) -> str:
    """One sentence for each test and subject, from (test, name of a recording, its notes); empty where all is well."""
    several: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for test, name, notes in recordings:
        for subject, sentence in notes.items():
            several.setdefault((test, subject), []).append((name, sentence))
    lines = []
    for same in several.values():
        (name, sentence), others = same[0], len(same) - 1
        more = f" So it is with {others} more recording{'s' if others > 1 else ''} of this test." if others else ""
        lines.append(f" {name}: {sentence}.{more}")
    return "".join(lines)
