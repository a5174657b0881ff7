"""Legs of a protocol: parts in which the prescribed displacement or force is linear in time or sinusoidal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from tissue_sim.experiment.protocol_text import (
    ANGLE,
    ANGLE_EXAMPLE,
    DISPLACEMENT,
    EXAMPLE,
    FORCE,
    Control,
    ProtocolRepeat,
    ProtocolSegment,
    make_protocol_error,
)
from tissue_sim.experiment.protocol_waves import WAVE_KINDS, Wave


@dataclass(frozen=True)
class MotionLeg:
    """Part of a protocol in which the displacement, the force or the angle is linear in time or sinusoidal.

    Attributes:
        segment: segment that the leg belongs to.
        start, end: tool displacement, m, negative above the touch; force, N; or angle, rad.
        speed: m/s, N/s or rad/s; 0 in a hold; the largest speed of a sinusoid.
        duration: s.
        cycle: number of the load cycle, from 1; a cycle begins where the tool turns into the tissue again. Each cycle
            of a sinusoid is a load cycle; the number is that of the first one.
        control: prescribed quantity.
        amplitude: of a sinusoid about `start`, m or N.
        wave: sinusoid; None: the leg is straight.
    """

    segment: ProtocolSegment
    start: float
    end: float
    speed: float
    duration: float
    cycle: int
    control: Control = DISPLACEMENT
    amplitude: float = 0.0
    wave: Wave | None = None


#: Displacement, m, force, N, and angle, rad, at the start.
_ZERO: dict[Control, float] = {DISPLACEMENT: 0.0, FORCE: 0.0, ANGLE: 0.0}


@dataclass(frozen=True)
class LoadingState:
    """State of a protocol between two legs.

    Attributes:
        speed: control -> speed of the last leg with that control, m/s or N/s; no entry: none was stated.
        here: control -> present displacement, m, or force, N. The value of a control without an entry depends on the
            response of the specimen.
        largest: control -> largest value so far, for the controls in `here`.
        control: control of the last leg.
        cycle: number of the present load cycle, from 1.
        is_withdrawn: whether the last motion was outwards.
        is_begun: whether a segment precedes.
    """

    speed: Mapping[Control, float]
    here: Mapping[Control, float] = field(default_factory=lambda: dict(_ZERO))
    largest: Mapping[Control, float] = field(default_factory=lambda: dict(_ZERO))
    control: Control = DISPLACEMENT
    cycle: int = 1
    is_withdrawn: bool = False
    is_begun: bool = False


def iterate_motion_legs(steps: Sequence[ProtocolSegment | ProtocolRepeat], speed: float, *,
                        allows_force: bool = False) -> Iterator[MotionLeg]:
    """Yield the legs of a protocol, one for each segment, with repeats expanded.

    Args:
        steps: segments and repeats in order.
        speed: m/s, for segments before the first stated speed.
        allows_force: whether segments may prescribe a force.

    Raises:
        InputError: a segment that cannot follow the one before, such as an unload at the touch; a segment that
            prescribes an angle, a sinusoid, or a force if this is not allowed; a segment that starts from the response
            of the specimen.
    """
    state = LoadingState({DISPLACEMENT: speed})
    for segment in iterate_segments_with_repeats(steps):
        leg, state = make_leg_or_none(segment, state)
        if leg is None and allows_force:
            raise make_protocol_error(segment.position, f"segments must prescribe either displacements or forces here; "
                                      f"got a {segment.kind} with another control than the segment before. Keep one "
                                      "control after the contact")
        control = DISPLACEMENT if leg is None else leg.control
        if leg is None or control == ANGLE or (control == FORCE and not allows_force):
            quantity = f"an {ANGLE}" if control == ANGLE else f"a {FORCE}"
            raise make_protocol_error(segment.position, f"segments must prescribe displacements here; got a "
                                      f"{segment.kind} that prescribes {quantity}. State lengths such as 10mm")
        if leg.wave is not None:
            raise make_protocol_error(segment.position, "segments must be straight here, because the machine moves at "
                                      f"constant speeds; got a {segment.kind}. Write ramps and unloads")
        yield leg


def iterate_segments_with_repeats(steps: Sequence[ProtocolSegment | ProtocolRepeat]) -> Iterator[ProtocolSegment]:
    """Yield the segments in order; yield those of a repeat as often as the repeat states."""
    for step in steps:
        for _ in range(step.times if isinstance(step, ProtocolRepeat) else 1):
            yield from step.segments if isinstance(step, ProtocolRepeat) else (step,)


def make_leg_or_none(segment: ProtocolSegment, state: LoadingState) -> tuple[MotionLeg | None, LoadingState]:
    """Make the leg of a segment.

    Returns:
        The leg, and the state after it; None and the given state if the leg starts from a value that depends on the
        response of the specimen.

    Raises:
        InputError: the segment cannot follow the one before.
    """
    control = segment.control or state.control
    if segment.kind != "hold" and segment.speed is not None:
        state = replace(state, speed={**state.speed, control: segment.speed})
    if segment.kind == "approach" and not state.is_begun:
        height = -_require_approach_height(segment)
        state = replace(state, here={**state.here, DISPLACEMENT: height})
    if control not in state.here:
        return None, state
    here, largest = state.here[control], state.largest[control]
    end = _find_end(segment, here, largest, control)
    cycle, is_withdrawn = state.cycle, state.is_withdrawn
    if end > here and is_withdrawn:
        cycle, is_withdrawn = cycle + 1, False
    amplitude = 0.0
    if segment.wave is not None:
        wave, amplitude = segment.wave, segment.amount or 0.0
        cycle, is_withdrawn = cycle + is_withdrawn, True
        fastest = 2.0 * math.pi * amplitude * max(wave.frequency, wave.end_frequency or 0.0)
        leg = MotionLeg(segment, here, here, fastest, wave.duration, cycle, control, amplitude, wave)
        cycle += wave.cycles - 1
    elif segment.kind == "hold":
        leg = MotionLeg(segment, here, end, 0.0, segment.amount or 0.0, cycle, control)
    elif control in state.speed:
        speed = state.speed[control]
        leg = MotionLeg(segment, here, end, speed, abs(end - here) / speed, cycle, control)
    else:
        quantity, rate = ("an angle", "an angular speed, such as ramp 30deg @1deg/s") if control == ANGLE else (
            "a force", "a loading rate, such as ramp 2N @0.5N/s")
        raise make_protocol_error(segment.position, f"the first {segment.kind} that prescribes {quantity} needs {rate}",
                                  ANGLE_EXAMPLE if control == ANGLE else EXAMPLE)
    highest = max(largest, end + amplitude)
    known, most = {control: end}, {control: highest}
    if control == DISPLACEMENT and here <= end <= 0.0 and highest <= 0.0 and FORCE in state.here:
        # The tool has not touched the specimen yet.
        known[FORCE], most[FORCE] = state.here[FORCE], state.largest[FORCE]
    return leg, LoadingState(state.speed, known, most, control, cycle, is_withdrawn or end < here, True)


def _require_approach_height(segment: ProtocolSegment) -> float:
    """Return the height above the touch at which an approach starts, m; raise an error if none is given."""
    if segment.amount is None:
        raise make_protocol_error(segment.position, "the first approach needs the height above the touch at which it "
                                  "starts, such as approach 2mm")
    return segment.amount


def _find_end(segment: ProtocolSegment, here: float, largest: float, control: Control) -> float:
    """Return the displacement, m, force, N, or angle, rad, at the end of a segment.

    Args:
        segment: the segment.
        here: value at its start.
        largest: largest value so far.
        control: prescribed quantity.
    """
    kind, amount, has_no_length = segment.kind, segment.amount, control != DISPLACEMENT
    now = f"the {control} is {_format_value(here, control)}" if has_no_length else f"the tool is at {_format_mm(here)}"
    if kind == "hold" or kind in WAVE_KINDS:
        return here
    match kind:
        case "approach":
            if here >= 0 or (amount is not None and not math.isclose(amount, -here, rel_tol=1e-9)):
                height = "above the touch" if amount is None else f"{_format_mm(amount)} above the touch"
                raise make_protocol_error(segment.position, f"an approach starts {height}, but {now}; retract to that "
                                          "height first")
            return 0.0
        case "ramp" | "reload":
            aim = control if has_no_length else "depth"
            if amount is None and largest <= 0:
                raise make_protocol_error(segment.position, f"a reload needs an earlier ramp or a {aim}; ramp first, "
                                          f"or name a {aim}")
            end = largest if amount is None else amount
            if end <= here:
                change = f"increase the {control}" if has_no_length else "go deeper"
                raise make_protocol_error(segment.position, f"a {kind} must {change}, but {now} already; name a larger "
                                          f"{aim}, or unload before it")
            return end
        case "unload" | "retract":
            end = (-1.0 if kind == "retract" else 1.0) * (amount or 0.0)
            if end >= here:
                article, change = "an" if kind == "unload" else "a", (
                    f"reduce the {control}" if has_no_length else "go outwards")
                raise make_protocol_error(segment.position, f"{article} {kind} must {change}, but {now} already; its "
                                          f"end is {_format_value(end, control)}")
            return end
    raise make_protocol_error(segment.position, f"unknown segment {kind!r}")


def _format_mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"


def _format_value(value: float, control: Control) -> str:
    """Return a displacement in mm, a force in N, or an angle in degrees with its unit."""
    if control == DISPLACEMENT:
        return _format_mm(value)
    return f"{value:.6g} N" if control == FORCE else f"{math.degrees(value):.6g} deg"
