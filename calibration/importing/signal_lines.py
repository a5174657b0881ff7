"""Write the lines of a campaign that follow from the signals: omitted samples, contact offset, relaxation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from calibration.importing.imported import ImportedTest, Line, Part
from calibration.importing.zero import PRELOAD
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.contact_error import (
    INTERVAL_DEVIATIONS,
    relative_modulus_error_from_contact,
)
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import ControlFindings
from tissue_sim.recording.segments import get_motion_and_load

#: Bounds of a fitted contact offset, in its standard deviations.
_OFFSET_BOUNDS = 3.0
#: Smallest and largest relaxed fraction of the stiffness at the start of a fit.
_FRACTIONS = (0.1, 0.9)


def format_left_out_samples(parts: Sequence[Part]) -> list[Line]:
    """Return the line ``leave_out`` of a test: numbers of the outliers, and the reason of the first outlier.

    Without outliers, no line is returned.
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
    return [Line("leave_out", next(iter(found.values())) if alone else found, f"{reasons[0]}{more}")]


class _ContactOffset(NamedTuple):
    """Prior of a fitted contact offset.

    Attributes:
        prior: standard deviation, mm.
        bound: largest absolute value, mm.
        reason: reason of the fit in one sentence.
    """

    prior: float
    bound: float
    reason: str


def format_offset_settings(tests: Sequence[ImportedTest], *, bounded: bool) -> list[Line]:
    """Return the lines of ``[fit]`` that fit a contact offset.

    The offset is fitted if the displacement was zeroed at a preload, or if the interval of contact after motion in air
    is too wide for the modulus.

    Args:
        tests: imported tests.
        bounded: whether the method supports bounds of the offset.
    """
    found = [*_find_preload_offsets(tests), *(_find_wide_interval_offsets(tests) if bounded else ())]
    if not found:
        return []
    widest = max(found, key=lambda each: each.prior)
    lines = [Line("offset", "fit", widest.reason),
             Line("offset_prior_mm", float(f"{widest.prior:.2g}"), "covers that distance")]
    if bounded:
        lines.append(Line("offset_bounds_mm", float(f"{widest.bound:.2g}"), "largest offset"))
    return lines


def _find_preload_offsets(tests: Sequence[ImportedTest]) -> Iterator[_ContactOffset]:
    """Yield the contact offset of each test whose displacement was zeroed at a preload."""
    for test in tests:
        if test.zero is None or test.zero.value != PRELOAD:
            continue
        shift = 1e3 * abs(test.zero.shift)
        side = "after contact" if test.zero.load > 0 else "before the force of the specimen is zero"
        yield _ContactOffset(shift, _OFFSET_BOUNDS * shift, f"{test.name}: the displacement was zeroed at a preload of "
                      f"{test.zero.load:.3g} N, about {shift:.2g} mm {side}")


def _find_wide_interval_offsets(tests: Sequence[ImportedTest]) -> Iterator[_ContactOffset]:
    """Yield the contact offset of each recording whose interval of contact changes the modulus too much.

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
                displacement, load, _ = get_motion_and_load(kept, KINDS.get(test.kind) if test.kind else None)
                time = kept.time if "time" in kept else None
                displacement, load = contact.subtract_contact_and_zero(displacement, load, time)
                pressed = displacement >= 0
                error = relative_modulus_error_from_contact(displacement[pressed], load[pressed],
                                      None if time is None else time[pressed], contact)
                half = 0.5e3 * (contact.interval[1] - contact.interval[0])
                if error > MODULUS_TOLERANCE:
                    yield _ContactOffset(half / INTERVAL_DEVIATIONS, half, f"{test.name}: contact is known to "
                                  f"{half:.2g} mm, which changes the modulus by {100 * error:.2g} %")


def format_viscoelastic_start(tests: Sequence[ImportedTest]) -> list[Line]:
    """Return the line of ``[fit]`` that fits relaxation or creep if an elastic law cannot describe a test."""
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
                    return [Line("start", start, f"{test.name}: {reason}")]
    return []


def needs_viscoelasticity(control: ControlFindings) -> bool:
    """Return whether a hold shows relaxation, and an elastic law describes neither the test nor its loading."""
    if control.time_constant is None:
        return False
    return not control.is_elastic or (control.pattern == "creep" and control.loading < MIN_POINTS)
