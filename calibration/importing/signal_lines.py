"""Lines of a campaign that follow from the signals: samples left out, contact offset, relaxation."""

from __future__ import annotations

from collections.abc import Sequence

from calibration.importing.imported import ImportedTest, Line, Part
from calibration.importing.zero import PRELOAD
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import Control

#: Bounds of a contact offset that is fitted, in its standard deviation.
_BOUNDS = 3.0
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


def offset_lines(tests: Sequence[ImportedTest], *, bounded: bool) -> list[Line]:
    """Keys of ``[fit]`` by which contact before the zero of the displacement is found.

    Args:
        bounded: whether the method takes bounds of the offset.
    """
    preloads = [test for test in tests if test.zero is not None and test.zero.value == PRELOAD]
    if not preloads:
        return []
    test = max(preloads, key=lambda each: abs(each.zero.shift) if each.zero is not None else 0.0)
    assert test.zero is not None
    shift = 1e3 * abs(test.zero.shift)
    side = "after contact" if test.zero.load > 0 else "before the force of the specimen is zero"
    why = (f"{test.name}: the displacement was zeroed at a preload of {test.zero.load:.3g} N, about {shift:.2g} mm "
           f"{side}")
    lines = [Line("offset", "fit", why), Line("offset_prior_mm", float(f"{shift:.2g}"), "covers that distance")]
    if bounded:
        lines.append(Line("offset_bounds_mm", float(f"{_BOUNDS * shift:.2g}"), "three times that distance"))
    return lines


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
    """Whether an elastic law describes neither the recording nor its loading alone, and a hold shows the memory."""
    if control.time_constant is None:
        return False
    return not control.is_elastic or (control.pattern == "creep" and control.loading < MIN_POINTS)
