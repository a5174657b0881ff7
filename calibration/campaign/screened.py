"""Recordings of a campaign without outliers and saturated samples, and the notes that say so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import clean
from tissue_sim.recording.control import find_control
from tissue_sim.recording.preload import LoadAtZero, load_at_zero
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import Preload, Screening

#: A prior of the contact offset covers a preload if its standard deviation is at least this fraction of the shift.
_COVERS = 0.5


def cleaned(recording: Recording, name: str, test: Test) -> tuple[Recording, Screening]:
    """A recording without the samples that its test leaves out, and the findings.

    Args:
        recording: as the file has it. name: of the recording in the campaign, ``test/recording``.

    Raises:
        InputError: as `tissue_sim.recording.cleaning.clean`.
    """
    columns = test.reading.get("columns") or {}
    zeroed = [channel for channel, entry in columns.items() if entry.get("offset") == "start"]
    own = name.removeprefix(f"{test.name}/")
    try:
        return clean(recording, test.leave_out.get(own, test.leave_out.get("")), zeroed,
                     None if test.control == "find" else test.control)
    except InputError as error:
        raise InputError(f"{own}: {error.problem}", file=error.file, field=error.field) from None


def check_left_out(test: Test, names: Sequence[str], campaign: Campaign) -> None:
    """Refuse samples to leave out of a recording that the test does not have.

    Args:
        names: of its recordings in the campaign.
    """
    own = [name.removeprefix(f"{test.name}/") for name in names]
    place = f"{test.place}.leave_out"
    if "" in test.leave_out and len(own) > 1:
        raise InputError(f"leave_out must name the recording, as the test has {len(own)}; write {{ \"{own[0]}\" = "
                         "[...] }", file=campaign.path, field=place)
    for name in test.leave_out:
        if name and name not in own:
            raise InputError(f"leave_out must name a recording of the test ({', '.join(own)}); got {name!r}",
                             file=campaign.path, field=f"{place}.{name}")


def with_control(screening: Screening, motion: np.ndarray, load: np.ndarray, time: np.ndarray | None, test: Test
                 ) -> Screening:
    """The findings with the controlled quantity.

    Args:
        motion, load: of the samples that are kept, positive under load, shape (n,). time: s, shape (n,), or None.
        test: that may state the quantity.
    """
    control = find_control(motion, load, time)
    return replace(screening, control=control if test.control == "find" else replace(control, equal_samples=0))


def with_preload(screening: Screening, motion: np.ndarray, load: np.ndarray, campaign: Campaign, *,
                 can_pull: bool, stressed: bool) -> Screening:
    """The findings with the load at the zero of the displacement, for a recording without air before contact.

    Args:
        motion, load: from contact, where the campaign finds it, positive under load, shape (n,).
        can_pull: whether a force against the direction of loading reaches the specimen.
    """
    found = load_at_zero(motion, load)
    if found is None:
        return screening
    fit = campaign.fit
    # A prior that is not stated is widened to the preload, see `calibration.campaign.measured.scale_offsets`.
    covers = fit.offset == "fit" and not stressed and (found.load > 0 or can_pull) and (
        "offset_prior" in fit.offset_usual or fit.offset_prior >= _COVERS * abs(found.shift))
    # An inverse fit has a contact offset in each recording, unless its deviation is stated as zero.
    fits_contact = fit.method != "analytical" and campaign.noise.contact_jitter != 0
    sentence = _against_words(found, stressed=stressed, covers=covers) if found.load < 0 else \
        _preload_words(found, stressed=stressed, covers=covers, fits_contact=fits_contact)
    return replace(screening, preload=Preload(*found, covers, sentence))


def _against_words(found: LoadAtZero, *, stressed: bool, covers: bool) -> str:
    load = f"{1e-3 * found.load:.3g} kPa" if stressed else f"{found.load:.3g} N"
    what = (f"the recording begins under {load}, {100 * found.fraction:.0f} % of its range, against the direction of "
            "loading: the load cell was not zeroed")
    if covers:
        return f"{what}, or the specimen was strained against it; the contact offset is fitted"
    remedy = "correct the stress of the file" if stressed else "set an offset of the force in columns"
    return f"{what}; the moduli are wrong; {remedy}"


def _preload_words(found: LoadAtZero, *, stressed: bool, covers: bool, fits_contact: bool) -> str:
    load, shift = (f"{1e-3 * found.load:.3g} kPa", f"a strain of {found.shift:.3g}") if stressed else \
        (f"{found.load:.3g} N", f"{1e3 * found.shift:.2g} mm")
    what = (f"the recording begins under {load}, {100 * found.fraction:.0f} % of its range: the displacement was "
            f"zeroed at a preload, {shift} after contact, or the load cell was not zeroed")
    if covers:
        return f"{what}; the contact offset is fitted"
    remedy = "correct the strain and stress of the file" if stressed else (
        f"set offset = \"fit\" and offset_prior_mm = {1e3 * found.shift:.2g} in [fit] for a preload, or an offset of "
        "the force in columns for a load cell")
    effect = "the moduli are wrong unless the fitted contact offset covers that distance" if fits_contact else \
        "the moduli are wrong"
    return f"{what}; {effect}; {remedy}"


def notes_of(screening: Screening, recording: Recording, *, remembering: bool) -> dict[str, str]:
    """Subject -> note of what a user has to know.

    Args:
        recording: whose metadata name the columns that are not read.
        remembering: whether the material has a memory, which describes relaxation and creep.
    """
    unread = recording.metadata.get("unread_columns")
    names = ", ".join(map(repr, unread)) if isinstance(unread, list | tuple) else ""
    subjects = {"outliers": [*(each.sentence for each in screening.left_out), *screening.doubts],
                "saturation": [each.sentence for each in screening.saturation],
                "preload": [screening.preload.sentence] if screening.preload is not None else [],
                "control": [screening.control.sentence] if screening.control is not None and not remembering else [],
                "columns": [f"columns that are not used: {names}"] if names else []}
    return {subject: "; ".join(dict.fromkeys(filter(None, sentences)))
            for subject, sentences in subjects.items() if any(sentences)}
