"""Lines of a campaign that follow from the signals: samples left out, contact offset, relaxation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from calibration.importing.imported import ImportedTest, Line, Part
from calibration.importing.zero import PRELOAD
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.contact_error import INTERVAL_DEVIATIONS, contact_error
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import Control
from tissue_sim.recording.segments import loading_of

#: Bounds of a fitted contact offset, in its standard deviations.
_OFFSET_BOUNDS = 3.0
#: Relaxed fractions from which a fit starts.
_FRACTIONS = (0.1, 0.9)


def leave_out_lines(parts: Sequence[Part]) -> list[Line]:
    """``leave_out`` of a test: the outliers of its recordings, with the reason of the first one."""
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


class _Offset(NamedTuple):
    """Standard deviation and largest value of a contact offset, mm, and the reason to fit it."""

    prior: float
    bound: float
    reason: str


def offset_lines(tests: Sequence[ImportedTest], *, bounded: bool) -> list[Line]:
    """Keys of ``[fit]`` by which contact is found where the displacement was zeroed at a preload, or where the interval
    of contact after air is too wide for the modulus.

    Args:
        bounded: whether the method takes bounds of the offset.
    """
    found = [*_of_preloads(tests), *(_of_wide_intervals(tests) if bounded else ())]
    if not found:
        return []
    widest = max(found, key=lambda each: each.prior)
    lines = [Line("offset", "fit", widest.reason),
             Line("offset_prior_mm", float(f"{widest.prior:.2g}"), "covers that distance")]
    if bounded:
        lines.append(Line("offset_bounds_mm", float(f"{widest.bound:.2g}"), "largest offset"))
    return lines


def _of_preloads(tests: Sequence[ImportedTest]) -> Iterator[_Offset]:
    for test in tests:
        if test.zero is None or test.zero.value != PRELOAD:
            continue
        shift = 1e3 * abs(test.zero.shift)
        side = "after contact" if test.zero.load > 0 else "before the force of the specimen is zero"
        yield _Offset(shift, _OFFSET_BOUNDS * shift, f"{test.name}: the displacement was zeroed at a preload of "
                      f"{test.zero.load:.3g} N, about {shift:.2g} mm {side}")


def _of_wide_intervals(tests: Sequence[ImportedTest]) -> Iterator[_Offset]:
    """Contact that is found after air, and whose interval changes the modulus by more than its tolerance."""
    for test in tests:
        if not any(line.key == "contact" for line in test.lines):
            continue
        for part in test.parts:
            for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
                contact = motion.contact
                if contact is None or motion.channel != "displacement":
                    continue
                kept = recording if motion.kept is None else recording.select(motion.kept)
                way, load, _ = loading_of(kept, KINDS.get(test.kind) if test.kind else None)
                time = kept.time if "time" in kept else None
                way, load = contact.counted_from(way, load, time)
                pressed = way >= 0
                error = contact_error(way[pressed], load[pressed], None if time is None else time[pressed], contact)
                half = 0.5e3 * (contact.interval[1] - contact.interval[0])
                if error > MODULUS_TOLERANCE:
                    yield _Offset(half / INTERVAL_DEVIATIONS, half, f"{test.name}: contact is known to "
                                  f"{half:.2g} mm, which changes the modulus by {100 * error:.2g} %")


def start_lines(tests: Sequence[ImportedTest]) -> list[Line]:
    """Key of ``[fit]`` by which relaxation and creep are fitted, where an elastic law cannot describe them."""
    for test in tests:
        for part in test.parts:
            for motion in part.motions:
                control = motion.screening.control
                if control is not None and motion.rate is not None and needs_memory(control):
                    lost = control.creep / (1 + control.creep) if control.pattern == "creep" else control.relaxation
                    low, high = _FRACTIONS
                    start = {"viscoelastic.terms[0].g": float(f"{min(max(1.2 * lost, low), high):.2g}"),
                             "viscoelastic.terms[0].tau_s": float(f"{control.time_constant:.3g}")}
                    reason = control.sentence.partition("; state")[0]
                    return [Line("start", start, f"{test.name}: {reason}")]
    return []


def needs_memory(control: Control) -> bool:
    """Return whether an elastic law describes neither the test nor its loading alone, and a hold shows relaxation."""
    if control.time_constant is None:
        return False
    return not control.is_elastic or (control.pattern == "creep" and control.loading < MIN_POINTS)
