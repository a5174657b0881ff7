"""Write the lines of a campaign that follow from the signals: omitted samples, contact offset, relaxation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from calibration.importing.imported import CampaignLine, ImportedTest, ReplicateFile
from calibration.importing.zero import PRELOAD
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.contact import (
    INTERVAL_DEVIATIONS,
    relative_modulus_error_from_contact,
)
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import ControlledQuantityFindings
from tissue_sim.recording.segments import get_positive_motion_load_and_stress_flag

#: Bounds of a fitted contact offset, in its standard deviations.
_OFFSET_BOUNDS = 3.0
#: Smallest and largest relaxed fraction of the stiffness at the start of a fit.
_FRACTIONS = (0.1, 0.9)


def make_outlier_leave_out_lines(parts: Sequence[ReplicateFile]) -> list[CampaignLine]:
    """Return the line ``leave_out`` of a test as a list of one line; an empty list without outliers.

    The line contains the sample numbers of the outliers, from 1, and the reason of the first outlier.
    """
    found: dict[str, list[int]] = {}
    reasons: list[str] = []
    for part in parts:
        several = len(part.motions) > 1
        for number, motion in enumerate(part.motions, start=1):
            samples = sorted({sample for each in motion.screening.left_out for sample in each.samples})
            if samples:
                found[f"{part.file.stem}_{number}" if several else part.file.stem] = samples
                reasons += [each.sentence for each in motion.screening.left_out]
    if not found:
        return []
    more = f"; and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    alone = sum(len(part.motions) for part in parts) == 1
    return [CampaignLine("leave_out", next(iter(found.values())) if alone else found, f"{reasons[0]}{more}")]


class _ZeroMeanContactOffsetPriorInMm(NamedTuple):
    """Zero-mean normal prior of a fitted contact offset.

    Attributes:
        prior: standard deviation, mm.
        bound: largest absolute value, mm.
        reason: reason of the fit in one sentence.
    """

    prior: float
    bound: float
    reason: str


def make_contact_offset_lines(tests: Sequence[ImportedTest], *, bounded: bool) -> list[CampaignLine]:
    """Return the lines of ``[fit]`` that fit a contact offset; an empty list if no offset is needed.

    The offset is fitted if the displacement was zeroed at a preload, or if the interval of contact after motion in air
    is too wide for the modulus.

    Args:
        tests: imported tests.
        bounded: whether the method supports bounds of the offset.
    """
    found = [*_iterate_offset_priors_from_preloads(tests),
             *(_iterate_offset_priors_of_unclear_contacts(tests) if bounded else ())]
    if not found:
        return []
    widest = max(found, key=lambda each: each.prior)
    lines = [CampaignLine("offset", "fit", widest.reason),
             CampaignLine("offset_prior_mm", float(f"{widest.prior:.2g}"), "covers that distance")]
    if bounded:
        lines.append(CampaignLine("offset_bounds_mm", float(f"{widest.bound:.2g}"), "largest offset"))
    return lines


def _iterate_offset_priors_from_preloads(tests: Sequence[ImportedTest]) -> Iterator[_ZeroMeanContactOffsetPriorInMm]:
    """Yield a prior of the contact offset, mm, for each test whose displacement was zeroed at a preload."""
    for test in tests:
        if test.zero is None or test.zero.value != PRELOAD:
            continue
        shift = 1e3 * abs(test.zero.shift)
        side = "after contact" if test.zero.load > 0 else "before the force of the specimen is zero"
        yield _ZeroMeanContactOffsetPriorInMm(shift, _OFFSET_BOUNDS * shift,
                                              f"{test.name}: the displacement was zeroed at a preload of "
                                              f"{test.zero.load:.3g} N, about {shift:.2g} mm {side}")


def _iterate_offset_priors_of_unclear_contacts(
        tests: Sequence[ImportedTest]) -> Iterator[_ZeroMeanContactOffsetPriorInMm]:
    """Yield a prior of the contact offset, mm, for each recording whose contact is too uncertain for the modulus.

    The limit is `MODULUS_TOLERANCE`; only tests with motion in air before contact are examined.
    """
    for test in tests:
        if not any(line.key == "contact" for line in test.lines):
            continue
        for part in test.parts:
            for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
                contact = motion.contact
                if contact is None or motion.channel != "displacement":
                    continue
                kept = recording if motion.kept is None else recording.select(motion.kept)
                kind = KINDS.get(test.kind) if test.kind else None
                displacement, load, _ = get_positive_motion_load_and_stress_flag(kept, kind)
                time = kept.time if "time" in kept else None
                displacement, load = contact.subtract_contact_zero_and_drift(displacement, load, time)
                pressed = displacement >= 0
                error = relative_modulus_error_from_contact(displacement[pressed], load[pressed],
                                                            None if time is None else time[pressed], contact)
                half = 0.5e3 * (contact.interval[1] - contact.interval[0])
                if error > MODULUS_TOLERANCE:
                    yield _ZeroMeanContactOffsetPriorInMm(half / INTERVAL_DEVIATIONS, half,
                                                          f"{test.name}: contact is known to "
                                                          f"{half:.2g} mm, which changes the modulus by "
                                                          f"{100 * error:.2g} %")


def make_prony_term_start_lines(tests: Sequence[ImportedTest]) -> list[CampaignLine]:
    """Return the line ``start`` of ``[fit]`` (start values of one Prony term) as a list of one line.

    The values are from the first test that an elastic law cannot describe; without such a test the list is empty.
    """
    for test in tests:
        for part in test.parts:
            for motion in part.motions:
                control = motion.screening.control
                if control is not None and motion.rate is not None and needs_viscoelasticity(control):
                    lost = control.creep / (1 + control.creep) if control.pattern == "creep" else control.relaxation
                    low, high = _FRACTIONS
                    start = {"viscoelastic.terms[0].g": float(f"{min(max(1.2 * lost, low), high):.2g}"),
                             "viscoelastic.terms[0].tau_s": float(f"{control.time_constant:.3g}")}
                    reason = control.sentence.partition("; state")[0]
                    return [CampaignLine("start", start, f"{test.name}: {reason}")]
    return []


def needs_viscoelasticity(control: ControlledQuantityFindings) -> bool:
    """Return whether a hold shows relaxation or creep that an elastic law cannot describe.

    A recording of creep needs viscoelasticity if its loading has too few samples for an elastic fit.
    """
    if control.time_constant is None:
        return False
    return not control.can_elastic_law_describe_loading or (control.pattern == "creep" and control.loading < MIN_POINTS)
