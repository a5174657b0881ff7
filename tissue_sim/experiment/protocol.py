"""Protocol: prescribed displacement of the tool against time, as segments or as text.

The text of a protocol is ``approach 2mm; repeat 3 (ramp 10mm @0.248mm/s; unload); hold 60s``. A segment defines
straight lines (legs) of displacement against time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words, require_positive_length
from tissue_sim.public_names import OldName, make_getattr_for_old_names

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


#: Unit -> factor to m.
_LENGTHS = {"mm": "0.001", "um": "0.000001", "m": "1"}
#: Unit -> factor to s.
_TIMES = {"s": "1", "ms": "0.001", "min": "60", "h": "3600"}
#: Quantity -> unit -> (factor, divisor) to SI.
_UNITS: dict[str, dict[str, tuple[str, str]]] = {
    "length": {unit: (factor, "1") for unit, factor in _LENGTHS.items()},
    "time": {unit: (factor, "1") for unit, factor in _TIMES.items()},
    "speed": {f"{length}/{time}": (factor, divisor) for time, divisor in _TIMES.items()
              for length, factor in _LENGTHS.items()},
}
#: Quantity -> example for messages.
_EXAMPLES = {"length": "10mm", "time": "60s", "speed": "0.248mm/s"}
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_WORD = re.compile(r"[^\W\d_]+(?:/[^\W\d_]+)?")
_BLANKS = re.compile(r"\s*")
#: Largest number of characters of the text that a message quotes.
_QUOTED = 16

__getattr__ = make_getattr_for_old_names(__name__, {"write_protocol": "format_protocol"})


def parse_protocol(text: str) -> tuple[ProtocolSegment | ProtocolRepeat, ...]:
    """Parse the text of a protocol.

    Segments are separated by ``;``, and ``repeat N ( ... )`` repeats the segments in its brackets N times. A segment is
    a word of `KINDS`, a length (mm, um, m; for a hold a time in s, ms, min, h), and for a motion ``@`` with a speed,
    such as mm/s or mm/min.

    Raises:
        InputError: a syntax error, with its position (column, and line if there are several) and an example.
    """
    return _ProtocolParser(text).read_whole_text()


def format_protocol(steps: Sequence[ProtocolSegment | ProtocolRepeat]) -> str:
    """Return the text of a protocol, in mm and s with every digit; `parse_protocol` of this text returns the steps."""
    return "; ".join(f"repeat {step.times} ({format_protocol(step.segments)})" if isinstance(step, ProtocolRepeat)
                     else _format_segment(step) for step in steps)


def _format_segment(segment: ProtocolSegment) -> str:
    """Return the text of a segment with its lengths in mm, speed in mm/s and time in s."""
    def format_metres_as_mm(value: float) -> str:
        return f"{Decimal(repr(float(value))) * 1000:g}mm"

    hold = KINDS[segment.kind][0] == "time"
    amount = "" if segment.amount is None else f" {segment.amount!r}s" if hold \
        else f" {format_metres_as_mm(segment.amount)}"
    return f"{segment.kind}{amount}{'' if segment.speed is None else f' @{format_metres_as_mm(segment.speed)}/s'}"


class _ProtocolParser:
    """Parser that reads a text from left to right; `at` is the index of the next character."""

    def __init__(self, text: str):
        self.text, self.at = text, 0

    def read_whole_text(self) -> tuple[ProtocolSegment | ProtocolRepeat, ...]:
        """Return the steps of the whole text; raise an error at a bracket that closes nothing."""
        steps = self.read_steps()
        if self.at < len(self.text):
            raise self._make_error(self.at, "this bracket closes nothing; take it out")
        return steps

    def read_steps(self, repeated: bool = False) -> tuple[Any, ...]:
        """Read steps up to the end, or up to a closing bracket, which is not consumed."""
        steps: list[ProtocolSegment | ProtocolRepeat] = []
        while True:
            if steps and self.is_at_end_or_closing_bracket():
                return tuple(steps)
            steps.append(self.read_step(repeated))
            if self.is_at_end_or_closing_bracket():
                return tuple(steps)
            if not self.match_symbol_and_advance(";"):
                raise self._make_error(self.at, "expected ';' between two segments")

    def read_step(self, repeated: bool) -> ProtocolSegment | ProtocolRepeat:
        """Read a segment or a repeat; `repeated`: inside a repeat, where no other repeat is allowed."""
        self.skip_blanks()
        start = self.at
        word = self.match_text_or_none_and_advance(_WORD)
        if word != "repeat":
            return self.read_segment(start, word)
        if repeated:
            raise self._make_error(start, "a repeat must not be inside of another repeat; write one of them out")
        return self.read_repeat(start)

    def read_segment(self, start: int, word: str | None) -> ProtocolSegment:
        """Read amount and speed of a segment; its first word `word` begins at index `start` of the text."""
        if word is None:
            raise self._make_error(start, f"expected a segment, one of {', '.join(KINDS)} or repeat")
        if word not in KINDS:
            raise self._make_error(start, f"unknown segment {_quote_shortened_text(word)}"
                                   f"{make_hint_with_similar_or_known_words(word, (*KINDS, 'repeat'))}")
        quantity, needed = KINDS[word]
        amount = self.read_amount_or_none(quantity, needed=needed, zero=word == "unload", after=word)
        speed = None
        sign = self.at
        if self.match_symbol_and_advance("@"):
            if word == "hold":
                raise self._make_error(sign, "a hold has no speed; remove it")
            speed = self.read_amount_or_none("speed", needed=True, zero=False, after="@")
        return ProtocolSegment(word, amount, speed, position=self.describe_line_and_column(start))

    def read_repeat(self, start: int) -> ProtocolRepeat:
        """Read number and segments of a repeat; its word ``repeat`` begins at index `start` of the text."""
        self.skip_blanks()
        at = self.at
        count = self.match_text_or_none_and_advance(_NUMBER)
        if count is None or not count.isdecimal() or not 1 <= float(count) <= 1e9:
            raise self._make_error(at, "expected the number of repetitions, an integer of at least 1, as in repeat 3 "
                                   "(ramp 5mm; unload)")
        if not self.match_symbol_and_advance("("):
            raise self._make_error(self.at, "expected the repeated segments in brackets, as in repeat 3 (ramp 5mm; "
                                   "unload)")
        segments = self.read_steps(repeated=True)
        if not self.match_symbol_and_advance(")"):
            raise self._make_error(start, "the brackets of this repeat are not closed; add ')'")
        return ProtocolRepeat(int(count), segments)

    def read_amount_or_none(self, quantity: str, *, needed: bool, zero: bool, after: str) -> float | None:
        """Read a number with its unit; returns the value in SI, or None if there is no number."""
        self.skip_blanks()
        start, units = self.at, _UNITS[quantity]
        number = self.match_text_or_none_and_advance(_NUMBER)
        if number is None:
            if needed:
                raise self._make_error(start, f"expected a {quantity} after {after!r}, such as {_EXAMPLES[quantity]}")
            return None
        self.skip_blanks()
        at = self.at
        unit = self.match_text_or_none_and_advance(_WORD)
        if unit is None:
            comma = self.text[at:at + 1] == ","
            problem = ("the decimal mark must be a point, not a comma" if comma
                       else f"{_quote_shortened_text(number)} has no unit")
            raise self._make_error(at, f"{problem}; expected a {quantity} such as {_EXAMPLES[quantity]}")
        entry = units.get(unit.replace("µ", "u").replace("μ", "u"))
        if entry is None:
            raise self._make_error(at, f"{_quote_shortened_text(unit)} is not a unit of {quantity}; use "
                                   f"{', '.join(list(units)[:5])}")
        value = _convert_decimal_text_to_si(number, *entry)
        if not (0 < value < math.inf or (zero and value == 0)):
            remedy = "; use retract for a height above the touch" if quantity == "length" else ""
            raise self._make_error(start,
                                   f"{_quote_shortened_text(number)} is not a finite {quantity} above zero{remedy}")
        self.skip_blanks()
        return value

    def is_at_end_or_closing_bracket(self) -> bool:
        """Return whether the text or the bracket ends at the present position."""
        self.skip_blanks()
        return self.at == len(self.text) or self.text[self.at] == ")"

    def match_symbol_and_advance(self, sign: str) -> bool:
        """Return whether the text continues with a sign, and move past the sign."""
        self.skip_blanks()
        found = self.text.startswith(sign, self.at)
        self.at += found
        return found

    def match_text_or_none_and_advance(self, pattern: re.Pattern) -> str | None:
        """Return the match of a pattern at the present position, and move past the match; None without a match."""
        match = pattern.match(self.text, self.at)
        if match:
            self.at = match.end()
        return match[0] if match else None

    def skip_blanks(self) -> None:
        """Move past white space."""
        self.match_text_or_none_and_advance(_BLANKS)

    def describe_line_and_column(self, at: int) -> str:
        """Return the column (from 1), and the line of a text with several lines, of an index of the text."""
        column = f"column {at - self.text.rfind(chr(10), 0, at)}"
        return f"line {1 + self.text.count(chr(10), 0, at)}, {column}" if "\n" in self.text.strip() else column

    def _make_error(self, at: int, problem: str):
        """Return the error for a problem at the index `at` of the text; the caller raises it."""
        rest = self.text[at:].strip()
        found = f"at {_quote_shortened_text(rest)}" if rest else "at the end"
        return make_protocol_error(f"{self.describe_line_and_column(at)}, {found}", problem)


def _quote_shortened_text(text: str) -> str:
    return repr(text if len(text) <= _QUOTED else f"{text[:_QUOTED]}...")


def _convert_decimal_text_to_si(number: str, factor: str, divisor: str) -> float:
    """Return number * factor / divisor, rounded once, so that 0.248 mm/s is 0.248e-3 m/s to the last digit."""
    value = float(number)
    if value == 0 or not math.isfinite(value):
        return value
    return float(Decimal(number) * Decimal(factor) / Decimal(divisor))


#: Tool speed of the reference study, m/s.
STUDY_SPEED = 0.248e-3
#: Largest number of samples of a protocol.
MOST_SAMPLES = 100_000


@dataclass(frozen=True)
class HoldTimeStepSettings:
    """Distribution of the time steps of a hold.

    Attributes:
        growth: ratio of each time step to the step before, 1. A smaller ratio resolves the relaxation with more
            samples.
        largest_first: largest first time step over the duration of the hold, 1.
    """

    growth: float = 1.25
    largest_first: float = 0.05


#: Distribution of every hold.
HOLD_STEPS = HoldTimeStepSettings()


@dataclass(frozen=True, eq=False)
class Protocol:
    """Displacement that the stage reports against time, linear between samples.

    With an ideal rig this is the displacement of the tool; otherwise `Rig.compute_unloaded_tool_displacement` computes
    the displacement of the tool. The motion of a measured recording is ``Protocol(recording.time,
    recording.displacement)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,). Negative values are above the touch, where a bonded plate
            pulls.
        segment: name of the segment that each sample belongs to, shape (n,), or None.
        cycle: number of the load cycle of each sample, shape (n,), or None.

    Raises:
        InputError: lists of different lengths, a value that is not finite, time that does not increase.
    """

    time: np.ndarray
    displacement: np.ndarray
    segment: np.ndarray | None = None
    cycle: np.ndarray | None = None

    def __post_init__(self):
        for name in ("time", "displacement"):
            self._store_read_only_array(name, np.array(getattr(self, name), dtype=float))
        if self.time.ndim != 1 or self.time.shape != self.displacement.shape or self.time.size == 0:
            raise InputError(f"time and displacement must be two lists of the same length; got {self.time.shape} and "
                             f"{self.displacement.shape}.", field="protocol")
        if not (np.isfinite(self.time).all() and np.isfinite(self.displacement).all()):
            raise InputError("time and displacement must be finite; remove samples that are not finite "
                             "numbers", field="protocol")
        if (np.diff(self.time) <= 0).any():
            raise InputError("must increase from sample to sample.", field="protocol.time")
        for name, kind, words in (("segment", "U", "names"), ("cycle", "iu", "whole numbers")):
            if getattr(self, name) is None:
                continue
            labels = np.array(getattr(self, name))
            if labels.shape != self.time.shape or labels.dtype.kind not in kind:
                raise InputError(f"expected {self.time.size} {words}, one for each sample", field=f"protocol.{name}")
            self._store_read_only_array(name, labels)

    def _store_read_only_array(self, name: str, array: np.ndarray) -> None:
        """Store an array as the attribute `name` of this frozen object, and make the array read-only."""
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    #: Old name.
    at = OldName("resample_at_fractional_samples")

    def resample_at_fractional_samples(self, samples: np.ndarray) -> Protocol:
        """Return the protocol interpolated at fractional sample numbers.

        Args:
            samples: fractional sample numbers, ascending, shape (m,). A sample between two has the labels of the later
                one.
        """
        numbers, later = np.arange(self.time.size), np.ceil(samples).astype(int)
        segment, cycle = (None if each is None else each[later] for each in (self.segment, self.cycle))
        return Protocol(np.interp(samples, numbers, self.time), np.interp(samples, numbers, self.displacement), segment,
                        cycle)

    @classmethod
    def ramp(cls, depth: float, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """Make a ramp to `depth`, m, at `speed`, m/s, with `points` samples, the first at rest.

        Examples:
            >>> ramp = Protocol.ramp(0.002, points=3, speed=1e-3)
            >>> ramp.time, ramp.displacement
            (array([0., 1., 2.]), array([0.   , 0.001, 0.002]))
        """
        require_positive_length(depth, "protocol.depth")
        _require_valid_points_and_speed(points, speed)
        displacement = np.linspace(0.0, depth, points)
        return cls(displacement / speed, displacement)

    @classmethod
    def parse(cls, text: str, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """Make a protocol from text, such as ``"ramp 10mm @0.248mm/s; hold 60s; unload"``.

        A moving segment has `points` samples at equal distances, with its start. The time steps of a hold grow by
        `HoldTimeStepSettings.growth`, from the last time step of the motion before (at most
        `HoldTimeStepSettings.largest_first` of the hold), and are scaled so that the last one ends the hold. A sample
        where two segments meet belongs to the first of them.

        Args:
            text: segments; see `tissue_sim.experiment.protocol.parse_protocol`.
            points: samples of each moving segment.
            speed: m/s, for segments before the first stated speed.

        Raises:
            InputError: an error in the text, with its position and an example.

        Examples:
            >>> protocol = Protocol.parse("ramp 2mm @1mm/s; hold 3s", points=3)
            >>> float(protocol.time[-1]), float(protocol.displacement.max())
            (5.0, 0.002)
        """
        _require_valid_points_and_speed(points, speed)
        if points > MOST_SAMPLES:
            raise InputError(f"must be at most {MOST_SAMPLES}; got {points}.", field="protocol.points")
        time: list[float] = []
        displacement: list[float] = []
        segment: list[str] = []
        cycle: list[int] = []
        now, step = 0.0, math.inf
        for leg in iterate_motion_legs(parse_protocol(text), speed):
            if not time:
                time, displacement, segment, cycle = [now], [leg.start], [leg.segment.kind], [leg.cycle]
            samples, since = _sample_leg_displacements_and_times(leg, now, points, step)
            if len(time) + since.size > MOST_SAMPLES:
                raise make_protocol_error(leg.segment.position,
                                          f"the protocol has more than {MOST_SAMPLES} samples at this "
                                          "segment; shorten it or use fewer points")
            if leg.speed:
                step = float(since[-1] / since.size)
            time += (now + since).tolist()
            displacement += samples.tolist()
            segment += [leg.segment.kind] * since.size
            cycle += [leg.cycle] * since.size
            now = time[-1]
        return cls(np.array(time), np.array(displacement), np.array(segment), np.array(cycle))

    @property
    def depth(self) -> float:
        """Largest displacement of the protocol, m."""
        return float(self.displacement.max())

    @property
    def labels(self) -> dict[str, np.ndarray]:
        """``segment`` and ``cycle``, if known, as labels of a `Recording`."""
        return {name: values for name in ("segment", "cycle") if (values := getattr(self, name)) is not None}


def _sample_leg_displacements_and_times(leg: MotionLeg, now: float, points: int,
                                        step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return displacements and times of the samples of a leg, without the sample at its start.

    Args:
        leg: straight line of displacement against time.
        now: time at the start of the leg, s.
        points: number of samples of a moving leg, with its start.
        step: time step of the motion before, s.

    Returns:
        Displacement, m, and time since `now`, s, shapes (n,).
    """
    position = leg.segment.position
    if not math.isfinite(now + leg.duration):
        raise make_protocol_error(position, f"the end time of this {leg.segment.kind} is not finite; correct its speed")
    if leg.speed:
        samples = np.linspace(leg.start, leg.end, points)[1:]
        since = np.abs(samples - leg.start) / leg.speed
    else:
        since = _compute_hold_sample_times(leg.duration, step)
        samples = np.full(since.size, leg.end)
    if (np.diff(now + since, prepend=now) <= 0).any():
        raise make_protocol_error(position, f"this {leg.segment.kind} is too short: its samples coincide at {now:g} s")
    return samples, since


def _compute_hold_sample_times(duration: float, step: float) -> np.ndarray:
    """Return the times of the samples of a hold, s, from its start; the last one equals `duration`."""
    first = min(max(step / duration, 1e-9), HOLD_STEPS.largest_first)
    count = math.ceil(math.log1p((HOLD_STEPS.growth - 1) / first) / math.log(HOLD_STEPS.growth))
    growth = HOLD_STEPS.growth ** np.arange(1, count + 1) - 1
    return duration * (growth / growth[-1])


def _require_valid_points_and_speed(points: int, speed: float) -> None:
    """Raise an `InputError` unless there are at least 2 points and the speed is positive and finite."""
    require_positive_length(speed, "protocol.speed")
    if points < 2:
        raise InputError(f"must be at least 2; got {points}.", field="protocol.points")
