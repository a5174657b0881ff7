"""Segments of a protocol, and their text.

The text of a protocol is ``approach 2mm; repeat 3 (ramp 10mm @0.248mm/s; unload); hold 60s``, or with prescribed force
``ramp 2N @0.5N/s; hold 60s; unload``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, Final, Literal

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.public_names import make_getattr_for_old_names

#: Segment -> quantity of its number, and whether the number is required. A `length` of `LOADING_KINDS` may be a force.
KINDS: dict[str, tuple[str, bool]] = {
    "approach": ("length", False), "ramp": ("length", True), "hold": ("time", True), "unload": ("length", False),
    "reload": ("length", False), "retract": ("length", True),
}
#: Segments that prescribe a displacement or a force.
LOADING_KINDS = ("ramp", "unload", "reload")
#: Quantity that a segment prescribes.
Control = Literal["displacement", "force"]
#: Control of a segment that prescribes the displacement of the tool.
DISPLACEMENT: Final = "displacement"
#: Control of a segment that prescribes the force on the tool.
FORCE: Final = "force"
#: Example for messages.
EXAMPLE = "ramp 10mm @0.248mm/s; hold 60s; unload"

__getattr__ = make_getattr_for_old_names(__name__, {"write_protocol": "format_protocol"})


@dataclass(frozen=True)
class ProtocolSegment:
    """One segment of a protocol.

    Attributes:
        kind: a name in `KINDS`.
        amount: displacement, m, or force, N, at which ramp, unload and reload end; s for a hold; height above the
            touch, m, at which approach starts and retract ends. None: unload to zero, reload to the largest value so
            far.
        speed: m/s or N/s; None: that of the last segment with the same control.
        position: position in the text, for messages.
        control: quantity that the segment prescribes. None: in a hold, and in an unload or reload without amount and
            speed, that of the segment before; in every other segment the displacement.

    Raises:
        InputError: a hold with a control, or an approach or retract with another control than displacement.
    """

    kind: str
    amount: float | None = None
    speed: float | None = None
    position: str = field(default="", compare=False)
    control: Control | None = None

    def __post_init__(self):
        if self.kind == "hold":
            if self.control is not None:
                raise make_protocol_error(self.position, "a hold keeps the control of the segment before it; leave "
                                          "control out")
        elif self.kind not in LOADING_KINDS and self.control == FORCE:
            raise make_protocol_error(self.position, f"control of {self.kind} must be 'displacement'; got 'force'")
        elif self.control is None and (self.kind not in LOADING_KINDS
                                       or not (self.amount is None and self.speed is None)):
            object.__setattr__(self, "control", DISPLACEMENT)


@dataclass(frozen=True)
class ProtocolRepeat:
    """Segments that are repeated `times` times."""

    times: int
    segments: tuple[ProtocolSegment, ...]


def make_protocol_error(position: str, problem: str) -> InputError:
    """Return the error of a protocol with position, problem and an example; the caller raises it."""
    example = f"{' For' if problem.endswith('?') else '; for'} example {EXAMPLE!r}"
    return InputError(f"{position + ': ' if position else ''}{problem}{example}", field="protocol")


#: Unit -> factor to m.
_LENGTHS = {"mm": "0.001", "um": "0.000001", "m": "1"}
#: Unit -> factor to N.
_FORCES = {"N": "1", "mN": "0.001", "kN": "1000"}
#: Unit -> factor to s.
_TIMES = {"s": "1", "ms": "0.001", "min": "60", "h": "3600"}


def _make_rate_units(units: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Return units over time -> (factor, divisor) to SI."""
    return {f"{unit}/{time}": (factor, divisor) for time, divisor in _TIMES.items() for unit, factor in units.items()}


#: Quantity -> unit -> (factor, divisor) to SI.
_UNITS: dict[str, dict[str, tuple[str, str]]] = {
    "length": {unit: (factor, "1") for unit, factor in _LENGTHS.items()},
    "force": {unit: (factor, "1") for unit, factor in _FORCES.items()},
    "time": {unit: (factor, "1") for unit, factor in _TIMES.items()},
    "speed": _make_rate_units(_LENGTHS),
    "loading rate": _make_rate_units(_FORCES),
}
#: Quantity -> example for messages.
_EXAMPLES = {"length": "10mm", "force": "2N", "time": "60s", "speed": "0.248mm/s", "loading rate": "0.5N/s"}
#: Quantity of an amount or of a speed -> control of its segment.
_CONTROLS: dict[str, Control] = {"length": DISPLACEMENT, "speed": DISPLACEMENT, "force": FORCE, "loading rate": FORCE}
#: Control -> quantity of the speed.
_RATES = {DISPLACEMENT: "speed", FORCE: "loading rate"}
#: Largest number of units in a message.
_NAMED_UNITS = 6
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_WORD = re.compile(r"[^\W\d_]+(?:/[^\W\d_]+)?")
_BLANKS = re.compile(r"\s*")
#: Largest number of characters of the text that a message quotes.
_QUOTED = 16


def parse_protocol(text: str) -> tuple[ProtocolSegment | ProtocolRepeat, ...]:
    """Parse the text of a protocol.

    Segments are separated by ``;``, and ``repeat N ( ... )`` repeats the segments in its brackets N times. A segment is
    a word of `KINDS`, a length (mm, um, m) or a force (N, mN, kN), for a hold a time (s, ms, min, h); ``@`` with a
    speed, such as mm/s or mm/min, or with a loading rate, such as N/s or N/min, may follow, except in a hold.

    Raises:
        InputError: a syntax error, with its position (column, and line if there are several) and an example.
    """
    return _ProtocolParser(text).read_whole_text()


def format_protocol(steps: Sequence[ProtocolSegment | ProtocolRepeat]) -> str:
    """Return the text of a protocol, in mm, N and s with every digit; `parse_protocol` of it returns the steps."""
    return "; ".join(f"repeat {step.times} ({format_protocol(step.segments)})" if isinstance(step, ProtocolRepeat)
                     else _format_segment(step) for step in steps)


def _format_segment(segment: ProtocolSegment) -> str:
    """Return the text of a segment with lengths in mm, forces in N, and times in s."""
    def format_value(value: float, unit: str) -> str:
        return f"{Decimal(repr(float(value))) * 1000:g}mm" if unit == "mm" else f"{float(value)!r}{unit}"

    unit = "N" if segment.control == FORCE else "mm"
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
        quantities = (quantity, "force") if word in LOADING_KINDS else (quantity,)
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

    def read_amount_or_none(self, quantities: tuple[str, ...], *, needed: bool, zero: bool,
                            after: str) -> tuple[float | None, str]:
        """Read a number with a unit of one of some quantities.

        Returns:
            The value in SI and its quantity; None and an empty text if there is no number.
        """
        self.skip_blanks()
        start, expected = self.at, " or a ".join(quantities)
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
            known = [name for each in quantities for name in list(_UNITS[each])[:_NAMED_UNITS // len(quantities)]]
            raise self._make_error(at, f"{_quote_shortened_text(unit)} is not a unit of {' or '.join(quantities)}; use "
                                   f"{', '.join(known)}")
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
