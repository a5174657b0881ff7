"""Long texts: their beginning is looked at cell by cell; their end, where it is numbers and nothing else, is read at
once, in a tenth of the time and memory."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tissue_sim.recording.formats.number_text import with_plain_marks

#: Lines of the beginning; a text of fewer is looked at cell by cell from end to end.
BEGINNING = 2000
#: Characters of the end that are worked on together.
_PIECE = 4_000_000
_DELIMITERS = "\t;|,"
_AT_EDGES = tuple(pair for edge in (b"\t", b";", b"|", b",", b"\n") for pair in (b" " + edge, edge + b" "))
_BLANKS = re.compile(rb" *([\t;|,\n]) *")
_PLAIN = b"+-.0123456789eEdD\n"
#: Marks that may separate thousands, in the spelling of `tissue_sim.recording.formats.number_text`.
_SEPARATORS = b" ',"
#: Digits of a group of thousands.
_GROUP = 3


class NotPlainError(Exception):
    """Not all of the text can be read in this way: it is to be looked at cell by cell."""


@dataclass(frozen=True)
class PlainEnd:
    """Lines of as many cells each, none of them empty, none of more than digits, signs, marks and exponents.

    Attributes:
        text, place: the whole, and where the end begins in it.
        delimiter: between the cells.
        cells: of each line.
        marks: those of ``.``, ``,``, blank and apostrophe that stand in the numbers.
    """

    text: str = field(repr=False)
    place: int
    delimiter: str
    cells: int
    marks: str

    def numbers(self, places: Sequence[int], decimal: str) -> np.ndarray | None:
        """The numbers at these places, from 0, of each line, shape (lines, places); None: some cell is none.

        Args:
            decimal: decimal mark. All other marks must separate thousands.
        """
        separators = [mark for mark in self.marks if mark != decimal]
        found = []
        for piece in _pieces(self.text, self.place):
            content: bytes | None = piece
            for separator in separators:
                content = None if content is None else _without_groups(content, separator, decimal, self.delimiter)
            if content is None:
                return None
            if decimal == ",":
                content = content.replace(b",", b".")
            if b"D" in content or b"d" in content:
                content = content.replace(b"D", b"E").replace(b"d", b"e")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    found.append(np.loadtxt(content.decode("ascii").splitlines(), delimiter=self.delimiter,
                                            comments=None, usecols=tuple(places), ndmin=2))
            except (ValueError, UserWarning):
                return None
        values = np.concatenate(found)
        return values if np.isfinite(values).all() else None


def split_long(text: str, skipped: int = 0) -> tuple[str, PlainEnd | None]:
    """The beginning of a text and its plain end; the whole and None where it is short, or its end is not plain.

    Args:
        text: with any line ends.
        skipped: lines at the top that do not count.
    """
    last = place = 0
    for _ in range(skipped + BEGINNING):
        last, place = place, text.find("\n", place) + 1
        if not place:
            return text, None
    if '"' in text[last:place]:  # perhaps of a cell that goes on below
        return text, None
    line = text[place:text.find("\n", place) + 1]
    # Of those in a line the first is the delimiter: a comma beside another one is a decimal comma.
    delimiter = next((each for each in _DELIMITERS if each in line), None)
    end = None if delimiter is None else _plain_end(text, place, delimiter)
    return (text, None) if end is None else (text[:place], end)


def _plain_end(text: str, place: int, delimiter: str) -> PlainEnd | None:
    sign, found, cells = delimiter.encode(), set(), 0
    marks = (b"." + _SEPARATORS).replace(sign, b"")
    for piece in _pieces(text, place):
        if piece.translate(None, _PLAIN + sign + marks):
            return None
        found |= {chr(mark) for mark in marks if mark in piece}
        letters = np.frombuffer(piece, dtype=np.uint8)
        between = np.flatnonzero((letters == sign[0]) | (letters == ord("\n")))
        ends = np.flatnonzero(letters[between] == ord("\n"))
        cells = cells or int(ends[0]) + 1
        # Of two beside each other the cell between is empty.
        if between[0] == 0 or (np.diff(between) == 1).any() or (np.diff(ends, prepend=-1) != cells).any():
            return None
    return PlainEnd(text, place, delimiter, cells, "".join(sorted(found))) if cells >= 2 else None


def _without_groups(piece: bytes, separator: str, decimal: str, delimiter: str) -> bytes | None:
    """The lines without a thousands separator; None where one of them does not separate groups of three digits.

    As in `tissue_sim.recording.formats.number_text.parse_number` a number begins with one to three digits, of which the
    first is not zero, and all further groups have three digits up to the decimal mark or the end of the cell.
    """
    edge = b"\n" * (_GROUP + 1)
    letters = np.frombuffer(edge + piece + edge, dtype=np.uint8)
    is_digit = (letters >= ord("0")) & (letters <= ord("9"))
    at = np.flatnonzero(letters == ord(separator))
    if not at.size:
        return piece
    # Digits in front of each separator, up to one more than a group has.
    before = np.cumprod([is_digit[at - i] for i in range(1, _GROUP + 2)], axis=0).sum(axis=0)
    start = letters[at - before - 1]
    follows = start == ord(separator)
    begins = np.isin(start, np.frombuffer(f"\n+-{delimiter}".encode(), dtype=np.uint8))
    is_first = begins & (before >= 1) & (before <= _GROUP) & (letters[at - before] != ord("0"))
    after = np.all([is_digit[at + i] for i in range(1, _GROUP + 1)], axis=0)
    end = np.isin(letters[at + _GROUP + 1], np.frombuffer(f"\n{delimiter}{decimal}{separator}".encode(),
                                                          dtype=np.uint8))
    if not np.all((is_first | (follows & (before == _GROUP))) & after & end):
        return None
    return piece.replace(separator.encode(), b"")


def _pieces(text: str, place: int) -> Iterator[bytes]:
    """Whole lines from a place on, with plain ends and no blanks about cells. Blanks, apostrophes and minus signs have
    their ASCII spelling; what else ASCII lacks becomes a question mark."""
    while place < len(text):
        end = text.find("\n", place + _PIECE) + 1 or len(text)
        content = text[place:end]
        if not content.isascii():
            content = with_plain_marks(content)
        piece = content.encode("ascii", "replace").replace(b"\r\n", b"\n")
        if b" " in piece and any(pair in piece for pair in _AT_EDGES):
            piece = _BLANKS.sub(rb"\1", piece)
        piece = piece.strip(b" ")
        yield piece.rstrip(b"\n") + b"\n" if end == len(text) else piece
        place = end
