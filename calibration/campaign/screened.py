"""Remove outliers from the recordings of a campaign, detect preload and control, and write notes about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.control import detect_controlled_quantity_and_creep
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import (
    LoadAtZeroAndContactShift,
    Preload,
    Screening,
    estimate_load_at_zero_displacement,
)

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
    control = detect_controlled_quantity_and_creep(motion, load, time)
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
