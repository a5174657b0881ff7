"""Segments of a tool's motion, and the straight lines (legs) of displacement against time that they define."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from tissue_sim.errors import InputError

#: Segment -> quantity of its number, and whether the number is required.
KINDS: dict[str, tuple[str, bool]] = {
    "approach": ("length", False), "ramp": ("length", True), "hold": ("time", True), "unload": ("length", False),
    "reload": ("length", False), "retract": ("length", True),
}
#: Example for messages.
EXAMPLE = "ramp 10mm @0.248mm/s; hold 60s; unload"


@dataclass(frozen=True)
class ProtocolSegment:
    """One segment of the tool's motion.

    Attributes:
        kind: a name in `KINDS`.
        amount: m, or s for a hold: depth at which ramp, unload and reload end; height above the touch at which approach
            starts and retract ends. None: unload to the touch, reload to the largest depth so far.
        speed: m/s; None: that of the segment before.
        position: position in the text, for messages.
    """

    kind: str
    amount: float | None = None
    speed: float | None = None
    position: str = field(default="", compare=False)


@dataclass(frozen=True)
class ProtocolRepeat:
    """Segments that are repeated `times` times."""

    times: int
    segments: tuple[ProtocolSegment, ...]


@dataclass(frozen=True)
class MotionLeg:
    """Part of a protocol in which the displacement is linear in time.

    Attributes:
        segment: segment that the leg belongs to.
        start, end: tool displacement, m; negative above the touch.
        speed: m/s; 0 in a hold.
        duration: s.
        cycle: number of the load cycle, from 1; a cycle begins where the tool turns into the tissue again.
    """

    segment: ProtocolSegment
    start: float
    end: float
    speed: float
    duration: float
    cycle: int


def iterate_motion_legs(steps: Sequence[ProtocolSegment | ProtocolRepeat], speed: float) -> Iterator[MotionLeg]:
    """Yield the legs of a protocol, one for each segment, with repeats expanded.

    Args:
        steps: segments and repeats in order.
        speed: m/s, for segments before the first stated speed.

    Raises:
        InputError: a segment that cannot follow the one before, such as an unload at the touch.
    """
    here, deepest, cycle, withdrawn, begun = 0.0, 0.0, 1, False, False
    for segment in _iterate_segments_with_repeats(steps):
        speed = speed if segment.speed is None else segment.speed
        if segment.kind == "approach" and not begun:
            here = -_require_approach_height(segment)
        begun = True
        end = _find_end_displacement(segment, here, deepest)
        if end > here and withdrawn:
            cycle, withdrawn = cycle + 1, False
        withdrawn = withdrawn or end < here
        if segment.kind == "hold":
            yield MotionLeg(segment, here, end, 0.0, segment.amount or 0.0, cycle)
        else:
            yield MotionLeg(segment, here, end, speed, abs(end - here) / speed, cycle)
        here, deepest = end, max(deepest, end)


def make_protocol_error(position: str, problem: str) -> InputError:
    """Return the error of a protocol with position, problem and an example; the caller raises it."""
    example = f"{' For' if problem.endswith('?') else '; for'} example {EXAMPLE!r}"
    return InputError(f"{position + ': ' if position else ''}{problem}{example}", field="protocol")


def _iterate_segments_with_repeats(steps: Sequence[ProtocolSegment | ProtocolRepeat]) -> Iterator[ProtocolSegment]:
    """Yield the segments in order; yield those of a repeat as often as the repeat states."""
    for step in steps:
        for _ in range(step.times if isinstance(step, ProtocolRepeat) else 1):
            yield from step.segments if isinstance(step, ProtocolRepeat) else (step,)


def _require_approach_height(segment: ProtocolSegment) -> float:
    """Return the height above the touch at which an approach starts, m; raise an error if none is given."""
    if segment.amount is None:
        raise make_protocol_error(segment.position, "the first approach needs the height above the touch at which it "
                                  "starts, such as approach 2mm")
    return segment.amount


def _find_end_displacement(segment: ProtocolSegment, here: float, deepest: float) -> float:
    """Return the displacement at the end of a segment, m; `here`: at its start, `deepest`: largest so far."""
    kind, amount = segment.kind, segment.amount
    match kind:
        case "hold":
            return here
        case "approach":
            if here >= 0 or (amount is not None and not math.isclose(amount, -here, rel_tol=1e-9)):
                height = "above the touch" if amount is None else f"{_format_mm(amount)} above the touch"
                raise make_protocol_error(segment.position, f"an approach starts {height}, but the tool is at "
                                          f"{_format_mm(here)}; retract to that height first")
            return 0.0
        case "ramp" | "reload":
            if amount is None and deepest <= 0:
                raise make_protocol_error(segment.position,
                                          "a reload needs an earlier ramp or a depth; ramp first, or name "
                                          "a depth")
            end = deepest if amount is None else amount
            if end <= here:
                raise make_protocol_error(segment.position, f"a {kind} must go deeper, but the tool is at "
                                          f"{_format_mm(here)} already; name a larger depth, or unload "
                                          "before it")
            return end
        case "unload" | "retract":
            end = (-1.0 if kind == "retract" else 1.0) * (amount or 0.0)
            if end >= here:
                article = "an" if kind == "unload" else "a"
                raise make_protocol_error(segment.position, f"{article} {kind} must go outwards, but the tool is at "
                                          f"{_format_mm(here)} already; its end is {_format_mm(end)}")
            return end
    raise make_protocol_error(segment.position, f"unknown segment {kind!r}")


def _format_mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
