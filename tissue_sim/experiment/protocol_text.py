"""Segments of a protocol, and their text.

The text of a protocol is ``approach 2mm; repeat 3 (ramp 10mm @0.248mm/s; unload); hold 60s``, with prescribed force
``ramp 2N @0.5N/s; hold 60s; unload``, or with an oscillation ``ramp 2mm; sine 0.1mm @1Hz for 10 cycles``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, Final, Literal

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.protocol_waves import CHIRP, SINE, WAVE_KINDS, Spacing, Wave, make_sweep_values
from tissue_sim.public_names import make_getattr_for_old_names

#: Segment -> quantity of its number, and whether the number is required. A `length` of `LOADING_KINDS` may be a force.
KINDS: dict[str, tuple[str, bool]] = {
    "approach": ("length", False), "ramp": ("length", True), "hold": ("time", True), "unload": ("length", False),
    "reload": ("length", False), "retract": ("length", True),
}
#: Segments that prescribe a displacement or a force.
LOADING_KINDS = ("ramp", "unload", "reload")
#: Quantity that a segment prescribes.
Control = Literal["displacement", "force", "angle"]
#: Control of a segment that prescribes the displacement of the tool.
DISPLACEMENT: Final = "displacement"
#: Control of a segment that prescribes the force on the tool.
FORCE: Final = "force"
#: Control of a segment that prescribes the angle of a grip.
ANGLE: Final = "angle"
#: Example for messages.
EXAMPLE = "ramp 10mm @0.248mm/s; hold 60s; unload"
#: Example for messages about protocols of angles.
ANGLE_EXAMPLE = "ramp 30deg @1deg/s; hold 60s; unload"

__getattr__ = make_getattr_for_old_names(__name__, {"write_protocol": "format_protocol"})


@dataclass(frozen=True)
class ProtocolSegment:
    """One segment of a protocol.

    Attributes:
        kind: a name in `KINDS`, or in `tissue_sim.experiment.protocol_waves.WAVE_KINDS`.
        amount: displacement, m, force, N, or angle, rad, at which ramp, unload and reload end; s for a hold; height
            above the touch, m, at which approach starts and retract ends; amplitude of a sinusoid, m, N or rad. None:
            unload to zero, reload to the largest value so far.
        speed: m/s, N/s or rad/s; None: that of the last segment with the same control.
        position: position in the text, for messages.
        control: quantity that the segment prescribes. None: in a hold, and in an unload or reload without amount and
            speed, that of the segment before; in every other segment the displacement.
        wave: frequency and cycles of a sinusoid; None: a straight segment.

    Raises:
        InputError: a hold with a control, an approach or retract with another control than displacement, or a sinusoid
            without amplitude or `wave`.
    """

    kind: str
    amount: float | None = None
    speed: float | None = None
    position: str = field(default="", compare=False)
    control: Control | None = None
    wave: Wave | None = None

    def __post_init__(self):
        if (self.kind in WAVE_KINDS) != (self.wave is not None and self.amount is not None):
            raise make_protocol_error(self.position, f"{' and '.join(WAVE_KINDS)} need an amplitude and a wave, and "
                                      f"other segments have no wave; got {self.kind}")
        if self.kind in WAVE_KINDS:
            object.__setattr__(self, "control", self.control or DISPLACEMENT)
        elif self.kind == "hold":
            if self.control is not None:
                raise make_protocol_error(self.position, "a hold keeps the control of the segment before it; leave "
                                          "control out")
        elif self.kind not in LOADING_KINDS and self.control not in (None, DISPLACEMENT):
            raise make_protocol_error(self.position, f"control of {self.kind} must be 'displacement'; got "
                                      f"{self.control!r}")
        elif self.control is None and (self.kind not in LOADING_KINDS
                                       or not (self.amount is None and self.speed is None)):
            object.__setattr__(self, "control", DISPLACEMENT)


@dataclass(frozen=True)
class ProtocolRepeat:
    """Segments that are repeated `times` times."""

    times: int
    segments: tuple[ProtocolSegment, ...]


def make_protocol_error(position: str, problem: str, example: str = EXAMPLE) -> InputError:
    """Return the error of a protocol with position, problem and an example; the caller raises it."""
    remedy = f"{' For' if problem.endswith('?') else '; for'} example {example!r}"
    return InputError(f"{position + ': ' if position else ''}{problem}{remedy}", field="protocol")


#: Unit -> factor to m.
_LENGTHS = {"mm": "0.001", "um": "0.000001", "m": "1"}
#: Unit -> factor to N.
_FORCES = {"N": "1", "mN": "0.001", "kN": "1000"}
#: Unit -> factor to rad.
_ANGLES = {"deg": repr(math.pi / 180.0), "rad": "1"}
#: Unit -> factor to s.
_TIMES = {"s": "1", "ms": "0.001", "min": "60", "h": "3600"}


def _make_rate_units(units: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Return units over time -> (factor, divisor) to SI."""
    return {f"{unit}/{time}": (factor, divisor) for time, divisor in _TIMES.items() for unit, factor in units.items()}


#: Quantity -> unit -> (factor, divisor) to SI.
_UNITS: dict[str, dict[str, tuple[str, str]]] = {
    "length": {unit: (factor, "1") for unit, factor in _LENGTHS.items()},
    "force": {unit: (factor, "1") for unit, factor in _FORCES.items()},
    "angle": {unit: (factor, "1") for unit, factor in _ANGLES.items()},
    "time": {unit: (factor, "1") for unit, factor in _TIMES.items()},
    "speed": _make_rate_units(_LENGTHS),
    "loading rate": _make_rate_units(_FORCES),
    "angular speed": _make_rate_units(_ANGLES),
    "frequency": {"Hz": ("1", "1"), "mHz": ("0.001", "1"), "kHz": ("1000", "1")},
}
#: Quantity -> example for messages.
_EXAMPLES = {"length": "10mm", "force": "2N", "angle": "30deg", "time": "60s", "speed": "0.248mm/s",
             "loading rate": "0.5N/s", "angular speed": "1deg/s", "frequency": "1Hz"}
#: Quantity of an amount or of a speed -> control of its segment.
_CONTROLS: dict[str, Control] = {"length": DISPLACEMENT, "speed": DISPLACEMENT, "force": FORCE, "loading rate": FORCE,
                                 "angle": ANGLE, "angular speed": ANGLE}
#: Control -> quantity of the speed.
_RATES = {DISPLACEMENT: "speed", FORCE: "loading rate", ANGLE: "angular speed"}
#: Largest number of units in a message.
_NAMED_UNITS = 6
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_WORD = re.compile(r"[^\W\d_]+(?:/[^\W\d_]+)?")
_BLANKS = re.compile(r"\s*")
#: Largest number of repetitions, cycles or steps.
_MOST_COUNTED = 1e9
#: Largest number of steps of a sweep.
_MOST_STEPS = 1000
#: Largest number of characters of the text that a message quotes.
_QUOTED = 16


def parse_protocol(text: str) -> tuple[ProtocolSegment | ProtocolRepeat, ...]:
    """Parse the text of a protocol.

    Segments are separated by ``;``, and ``repeat N ( ... )`` repeats the segments in its brackets N times. A segment is
    a word of `KINDS`, a length (mm, um, m), a force (N, mN, kN) or an angle (deg, rad), for a hold a time (s, ms, min,
    h); ``@`` with a speed, such as mm/s or mm/min, a loading rate, such as N/s, or an angular speed, such as deg/s, may
    follow, except in a hold.

    ``sine 0.1mm @2Hz for 10 cycles`` oscillates about the present displacement, or with an amplitude in N about the
    present force. ``to`` makes a sweep of the frequency, ``sine 0.1mm @0.1Hz to 10Hz in 5 steps for 10 cycles``, or of
    the amplitude, ``sine 0.1mm to 1mm in 4 steps @1Hz for 5 cycles``; the steps have equal ratios. ``chirp 0.1mm @0.1Hz
    to 10Hz for 60s`` changes the frequency continuously; ``linear`` at its end makes it linear in time.

    Raises:
        InputError: a syntax error, with its position (column, and line if there are several) and an example.
    """
    return _ProtocolParser(text).read_whole_text()


def format_protocol(steps: Sequence[ProtocolSegment | ProtocolRepeat]) -> str:
    """Return the text of a protocol, in mm, N, rad and s with every digit; `parse_protocol` of it returns the steps."""
    return "; ".join(f"repeat {step.times} ({format_protocol(step.segments)})" if isinstance(step, ProtocolRepeat)
                     else _format_segment(step) for step in steps)


def _format_segment(segment: ProtocolSegment) -> str:
    """Return the text of a segment with lengths in mm, forces in N, angles in rad, and times in s."""
    def format_value(value: float, unit: str) -> str:
        return f"{Decimal(repr(float(value))) * 1000:g}mm" if unit == "mm" else f"{float(value)!r}{unit}"

    unit = {FORCE: "N", ANGLE: "rad"}.get(segment.control or DISPLACEMENT, "mm")
    if segment.wave is not None and segment.amount is not None:
        wave, text = segment.wave, f"{segment.kind} {format_value(segment.amount, unit)} @{segment.wave.frequency!r}Hz"
        if wave.end_frequency is None:
            return f"{text} for {wave.cycles} cycles"
        linear = " linear" if wave.spacing == "linear" else ""
        return f"{text} to {wave.end_frequency!r}Hz for {wave.duration!r}s{linear}"
    amount = "" if segment.amount is None else \
        f" {format_value(segment.amount, 's' if KINDS[segment.kind][0] == 'time' else unit)}"
    return f"{segment.kind}{amount}{'' if segment.speed is None else f' @{format_value(segment.speed, unit)}/s'}"


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
            steps += self.read_step(repeated)
            if self.is_at_end_or_closing_bracket():
                return tuple(steps)
            if not self.match_symbol_and_advance(";"):
                raise self._make_error(self.at, "expected ';' between two segments")

    def read_step(self, repeated: bool) -> Sequence[ProtocolSegment | ProtocolRepeat]:
        """Read a segment, the segments of a sweep, or a repeat; `repeated`: inside a repeat, which has no other."""
        self.skip_blanks()
        start = self.at
        word = self.match_text_or_none_and_advance(_WORD)
        if word in WAVE_KINDS:
            return self.read_waves(start, word)
        if word != "repeat":
            return [self.read_segment(start, word)]
        if repeated:
            raise self._make_error(start, "a repeat must not be inside of another repeat; write one of them out")
        return [self.read_repeat(start)]

    def read_segment(self, start: int, word: str | None) -> ProtocolSegment:
        """Read amount and speed of a segment; its first word `word` begins at index `start` of the text."""
        if word is None:
            raise self._make_error(start, f"expected a segment, one of {', '.join((*KINDS, *WAVE_KINDS))} or repeat")
        if word not in KINDS:
            raise self._make_error(start, f"unknown segment {_quote_shortened_text(word)}"
                                   f"{make_hint_with_similar_or_known_words(word, (*KINDS, *WAVE_KINDS, 'repeat'))}")
        quantity, needed = KINDS[word]
        quantities = (quantity, "force", "angle") if word in LOADING_KINDS else (quantity,)
        amount, quantity = self.read_amount_or_none(quantities, needed=needed, zero=word == "unload", after=word)
        control = _CONTROLS.get(quantity)
        speed = None
        sign = self.at
        if self.match_symbol_and_advance("@"):
            if word == "hold":
                raise self._make_error(sign, "a hold has no speed; remove it")
            rates = (_RATES[control],) if control else tuple(_RATES.values()) if word in LOADING_KINDS else ("speed",)
            speed, rate = self.read_amount_or_none(rates, needed=True, zero=False, after="@")
            control = _CONTROLS[rate]
        return ProtocolSegment(word, amount, speed, self.describe_line_and_column(start), control)

    def read_waves(self, start: int, word: str) -> list[ProtocolSegment]:
        """Read a chirp, or the sinusoids of a sweep; the first word `word` begins at index `start` of the text."""
        amplitudes, quantity = self.read_swept_values(("length", "force", "angle"), after=word)
        if not self.match_symbol_and_advance("@"):
            raise self._make_error(self.at, f"expected '@' and a frequency after the amplitude of a {word}, such as "
                                   "@1Hz")
        example = "as in sine 0.1mm @1Hz for 10 cycles" if word == SINE else "as in chirp 0.1mm @0.1Hz to 10Hz for 60s"
        waves: list[Wave]
        if word == CHIRP:
            first, _ = self.read_amount_or_none(("frequency",), needed=True, zero=False, after="@")
            self.require_word("to", f"a chirp needs its last frequency, {example}")
            last, _ = self.read_amount_or_none(("frequency",), needed=True, zero=False, after="to")
            self.require_word("for", f"a chirp needs its duration, {example}")
            duration, _ = self.read_amount_or_none(("time",), needed=True, zero=False, after="for")
            spacing: Spacing = "linear" if self.match_word_and_advance("linear") else "logarithmic"
            waves = [Wave.make_chirp(first or 0.0, last or 0.0, duration or 0.0, spacing)]
        else:
            frequencies, _ = self.read_swept_values(("frequency",), after="@")
            self.require_word("for", f"a sine needs its number of cycles, {example}")
            cycles = self.read_count(f"cycles, an integer of at least 1, {example}", _MOST_COUNTED)
            self.require_word("cycles", f"a sine needs the word cycles after their number, {example}", "cycle")
            waves = [Wave(frequency, cycles) for frequency in frequencies]
        if min(len(amplitudes), len(waves)) > 1 or (len(amplitudes) > 1 and word == CHIRP):
            raise self._make_error(start, "a segment must sweep the amplitude or the frequency; got both. Write one "
                                   "segment for each amplitude")
        position, control = self.describe_line_and_column(start), _CONTROLS[quantity]
        return [ProtocolSegment(word, amplitude, None, position, control, wave) for amplitude in amplitudes
                for wave in waves]

    def read_swept_values(self, quantities: tuple[str, ...], *, after: str) -> tuple[list[float], str]:
        """Read one value, or the first and last value of a sweep and the number of its steps; return the quantity."""
        first, quantity = self.read_amount_or_none(quantities, needed=True, zero=False, after=after)
        if not self.match_word_and_advance("to"):
            return [first or 0.0], quantity
        last, _ = self.read_amount_or_none((quantity,), needed=True, zero=False, after="to")
        example = "as in @0.1Hz to 10Hz in 5 steps"
        self.require_word("in", f"a sweep needs its number of steps, {example}")
        count = self.read_count(f"steps, an integer from 2 to {_MOST_STEPS}, {example}", _MOST_STEPS, 2)
        self.require_word("steps", f"a sweep needs the word steps after their number, {example}")
        return make_sweep_values(first or 0.0, last or 0.0, count), quantity

    def require_word(self, word: str, problem: str, other: str | None = None) -> None:
        """Read a word, or another form of the word; raise an error with a problem for any other text."""
        if not (self.match_word_and_advance(word) or self.match_word_and_advance(other or word)):
            raise self._make_error(self.at, problem)

    def match_word_and_advance(self, word: str) -> bool:
        """Return whether the text continues with a word, and move past the word."""
        self.skip_blanks()
        at = self.at
        found = self.match_text_or_none_and_advance(_WORD) == word
        self.at = self.at if found else at
        return found

    def read_count(self, expected: str, largest: float, smallest: int = 1) -> int:
        """Read an integer of a range; `expected` describes the integer in the message."""
        self.skip_blanks()
        at = self.at
        count = self.match_text_or_none_and_advance(_NUMBER)
        if count is None or not count.isdecimal() or not smallest <= float(count) <= largest:
            raise self._make_error(at, f"expected the number of {expected}")
        return int(count)

    def read_repeat(self, start: int) -> ProtocolRepeat:
        """Read number and segments of a repeat; its word ``repeat`` begins at index `start` of the text."""
        count = self.read_count("repetitions, an integer of at least 1, as in repeat 3 (ramp 5mm; unload)",
                                _MOST_COUNTED)
        if not self.match_symbol_and_advance("("):
            raise self._make_error(self.at, "expected the repeated segments in brackets, as in repeat 3 (ramp 5mm; "
                                   "unload)")
        segments = self.read_steps(repeated=True)
        if not self.match_symbol_and_advance(")"):
            raise self._make_error(start, "the brackets of this repeat are not closed; add ')'")
        return ProtocolRepeat(count, segments)

    def read_amount_or_none(self, quantities: tuple[str, ...], *, needed: bool, zero: bool,
                            after: str) -> tuple[float | None, str]:
        """Read a number with a unit of one of some quantities.

        Returns:
            The value in SI and its quantity; None and an empty text if there is no number.
        """
        self.skip_blanks()
        start, expected = self.at, " or a ".join(quantities[:2])
        example = _EXAMPLES[quantities[0]]
        number = self.match_text_or_none_and_advance(_NUMBER)
        if number is None:
            if needed:
                raise self._make_error(start, f"expected a {expected} after {after!r}, such as {example}")
            return None, ""
        self.skip_blanks()
        at = self.at
        unit = self.match_text_or_none_and_advance(_WORD)
        if unit is None:
            comma = self.text[at:at + 1] == ","
            problem = ("the decimal mark must be a point, not a comma" if comma
                       else f"{_quote_shortened_text(number)} has no unit")
            raise self._make_error(at, f"{problem}; expected a {expected} such as {example}")
        plain = unit.replace("µ", "u").replace("μ", "u")
        quantity = next((each for each in quantities if plain in _UNITS[each]), None)
        if quantity is None:
            named = quantities[:2]
            more = "".join(f", or an {each} such as {_EXAMPLES[each]}" for each in quantities[2:])
            known = [name for each in named for name in list(_UNITS[each])[:_NAMED_UNITS // len(named)]]
            raise self._make_error(at, f"{_quote_shortened_text(unit)} is not a unit of {' or '.join(named)}; use "
                                   f"{', '.join(known)}{more}")
        value = _convert_decimal_text_to_si(number, *_UNITS[quantity][plain])
        if not (0 < value < math.inf or (zero and value == 0)):
            remedy = "; use retract for a height above the touch" if quantity == "length" else ""
            raise self._make_error(start,
                                   f"{_quote_shortened_text(number)} is not a finite {quantity} above zero{remedy}")
        self.skip_blanks()
        return value, quantity

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
