"""Protocols as text: ``approach 2mm; repeat 3 (ramp 10mm @0.248mm/s; unload); hold 60s``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

from tissue_sim.errors import make_hint_with_similar_or_known_words
from tissue_sim.experiment.segments import KINDS, ProtocolRepeat, ProtocolSegment, make_protocol_error
from tissue_sim.public_names import make_getattr_for_old_names

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
