"""Segments of a tool's motion, and the straight lines (legs) that they make one after another."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from tissue_sim.errors import InputError

#: Segment -> the quantity that its number is, and whether the number must be there.
KINDS: dict[str, tuple[str, bool]] = {
    "approach": ("length", False), "ramp": ("length", True), "hold": ("time", True), "unload": ("length", False),
    "reload": ("length", False), "retract": ("length", True),
}
EXAMPLE = "ramp 10mm @0.248mm/s; hold 60s; unload"


@dataclass(frozen=True)
class Segment:
    """One stretch of the tool's motion.

    Attributes:
        kind: a name in `KINDS`.
        amount: m, or s of a hold. Depth at which ramp, unload and reload end; height above the touch at which approach
            starts and retract ends. None: unload to the touch, reload to the largest depth so far.
        speed: m/s; None: the one before.
        place: where it stands in a text, for messages.
    """

    kind: str
    amount: float | None = None
    speed: float | None = None
    place: str = field(default="", compare=False)


@dataclass(frozen=True)
class Repeat:
    """Segments that are done `times` times."""

    times: int
    segments: tuple[Segment, ...]


@dataclass(frozen=True)
class Leg:
    """A straight line of displacement against time.

    Attributes:
        segment: what it belongs to.
        start, end: tool displacement, m; below zero the tool is above the touch.
        speed: m/s; 0 in a hold.
        duration: s.
        cycle: from 1; the next one begins where the tool turns into the tissue again.
    """

    segment: Segment
    start: float
    end: float
    speed: float
    duration: float
    cycle: int


def legs(steps: Sequence[Segment | Repeat], speed: float) -> Iterator[Leg]:
    """The legs of a protocol, one a segment, repeats written out.

    Args:
        steps: in their order.
        speed: m/s until a segment names one.

    Raises:
        InputError: a segment that cannot follow the one before, such as an unload at the touch.
    """
    here, deepest, cycle, withdrawn, begun = 0.0, 0.0, 1, False, False
    for segment in _in_order(steps):
        speed = speed if segment.speed is None else segment.speed
        if segment.kind == "approach" and not begun:
            here = -_start_of_approach(segment)
        begun = True
        end = _end(segment, here, deepest)
        if end > here and withdrawn:
            cycle, withdrawn = cycle + 1, False
        withdrawn = withdrawn or end < here
        if segment.kind == "hold":
            yield Leg(segment, here, end, 0.0, segment.amount or 0.0, cycle)
        else:
            yield Leg(segment, here, end, speed, abs(end - here) / speed, cycle)
        here, deepest = end, max(deepest, end)


def fault(place: str, problem: str) -> InputError:
    """The error of a protocol: where, what, and an example."""
    example = f"{' For' if problem.endswith('?') else '; for'} example {EXAMPLE!r}"
    return InputError(f"{place + ': ' if place else ''}{problem}{example}", field="protocol")


def _in_order(steps: Sequence[Segment | Repeat]) -> Iterator[Segment]:
    for step in steps:
        for _ in range(step.times if isinstance(step, Repeat) else 1):
            yield from step.segments if isinstance(step, Repeat) else (step,)


def _start_of_approach(segment: Segment) -> float:
    if segment.amount is None:
        raise fault(segment.place, "the first approach needs the height above the touch at which it starts, such as "
                                   "approach 2mm")
    return segment.amount


def _end(segment: Segment, here: float, deepest: float) -> float:
    """Displacement at which a segment ends, m, that starts at `here`."""
    kind, amount = segment.kind, segment.amount
    match kind:
        case "hold":
            return here
        case "approach":
            if here >= 0 or (amount is not None and not math.isclose(amount, -here, rel_tol=1e-9)):
                height = "above the touch" if amount is None else f"{_mm(amount)} above the touch"
                raise fault(segment.place, f"an approach starts {height}, and the tool is at {_mm(here)}; retract to "
                                           "there first")
            return 0.0
        case "ramp" | "reload":
            if amount is None and deepest <= 0:
                raise fault(segment.place, "there is nothing to reload yet; ramp first, or name a depth")
            end = deepest if amount is None else amount
            if end <= here:
                raise fault(segment.place, f"a {kind} goes deeper, and the tool is at {_mm(here)} already; name a "
                                           "larger depth, or unload before it")
            return end
        case "unload" | "retract":
            end = (-1.0 if kind == "retract" else 1.0) * (amount or 0.0)
            if end >= here:
                raise fault(segment.place, f"{'an' if kind == 'unload' else 'a'} {kind} to {_mm(end)} goes outwards, "
                                           f"and the tool is at {_mm(here)} already")
            return end
    raise fault(segment.place, f"unknown segment {kind!r}")


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
