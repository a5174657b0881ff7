"""Read long texts fast: the beginning cell by cell, and an end of numbers alone as one array.

Reading the end as an array takes a tenth of the time and memory.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tissue_sim.recording.formats.number_text import normalize_number_marks

#: Number of lines of the beginning; a shorter text is read cell by cell completely.
BEGINNING = 2000


@dataclass(frozen=True)
class LongTextSettings:
    """Settings of `split_long`.

    Attributes:
        chunk_characters: characters that are processed together.
        group_digits: digits of a group of thousands.
    """

    chunk_characters: int = 4_000_000
    group_digits: int = 3


#: Settings that the functions of this module use.
_SETTINGS = LongTextSettings()
_DELIMITERS = "\t;|,"
_AT_EDGES = tuple(pair for edge in (b"\t", b";", b"|", b",", b"\n") for pair in (b" " + edge, edge + b" "))
_BLANKS = re.compile(rb" *([\t;|,\n]) *")
_PLAIN = b"+-.0123456789eEdD\n"
#: Marks that may separate thousands, in the spelling of `tissue_sim.recording.formats.number_text`.
_SEPARATORS = b" ',"


class NotPlainError(Exception):
    """The text must be read cell by cell, because a part of it is not plain numbers."""


@dataclass(frozen=True)
class PlainEnd:
    """Lines with an equal number of cells, each a number of digits, signs, marks and exponents.

    Attributes:
        text: the complete text.
        place: position in the text at which the end begins.
        delimiter: character between the cells.
        cells: number of cells in each line.
        marks: marks in the numbers, of ``.``, ``,``, blank and apostrophe.
    """

    text: str = field(repr=False)
    place: int
    delimiter: str
    cells: int
    marks: str

    def numbers(self, places: Sequence[int], decimal: str) -> np.ndarray | None:
        """Return the numbers in the given columns (from 0), shape (lines, columns); None if a cell is not a number.

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
    """Divide a text into its beginning and its plain end.

    Args:
        text: with any line ends.
        skipped: number of lines at the top that are ignored.

    Returns:
        The beginning and the end; the complete text and None if the text is short, or if its end is not plain.
    """
    last = place = 0
    for _ in range(skipped + BEGINNING):
        last, place = place, text.find("\n", place) + 1
        if not place:
            return text, None
    if '"' in text[last:place]:  # a quoted cell may continue in the next line
        return text, None
    line = text[place:text.find("\n", place) + 1]
    # The first delimiter in the list that occurs in a line is used: next to another one, a comma is decimal.
    delimiter = next((each for each in _DELIMITERS if each in line), None)
    end = None if delimiter is None else _plain_end(text, place, delimiter)
    return (text, None) if end is None else (text[:place], end)


def _plain_end(text: str, place: int, delimiter: str) -> PlainEnd | None:
    """Return the end of a text from a position on; None if the end is not plain."""
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
        # The cell between two adjacent delimiters is empty.
        if between[0] == 0 or (np.diff(between) == 1).any() or (np.diff(ends, prepend=-1) != cells).any():
            return None
    return PlainEnd(text, place, delimiter, cells, "".join(sorted(found))) if cells >= 2 else None


def _without_groups(piece: bytes, separator: str, decimal: str, delimiter: str) -> bytes | None:
    """Remove a thousands separator from lines; None if a separator is not between groups of three digits.

    As in `tissue_sim.recording.formats.number_text.parse_number`, a number begins with one to three digits. The
    first digit is not zero, and all further groups have three digits up to the decimal mark or the end of the cell.
    """
    edge = b"\n" * (_SETTINGS.group_digits + 1)
    letters = np.frombuffer(edge + piece + edge, dtype=np.uint8)
    is_digit = (letters >= ord("0")) & (letters <= ord("9"))
    at = np.flatnonzero(letters == ord(separator))
    if not at.size:
        return piece
    # Number of digits before each separator, counted up to one more than the digits of a group.
    before = np.cumprod([is_digit[at - i] for i in range(1, _SETTINGS.group_digits + 2)], axis=0).sum(axis=0)
    start = letters[at - before - 1]
    follows = start == ord(separator)
    begins = np.isin(start, np.frombuffer(f"\n+-{delimiter}".encode(), dtype=np.uint8))
    is_first = begins & (before >= 1) & (before <= _SETTINGS.group_digits) & (letters[at - before] != ord("0"))
    after = np.all([is_digit[at + i] for i in range(1, _SETTINGS.group_digits + 1)], axis=0)
    end = np.isin(letters[at + _SETTINGS.group_digits + 1], np.frombuffer(f"\n{delimiter}{decimal}{separator}".encode(),
                                                          dtype=np.uint8))
    if not np.all((is_first | (follows & (before == _SETTINGS.group_digits))) & after & end):
        return None
    return piece.replace(separator.encode(), b"")


def _pieces(text: str, place: int) -> Iterator[bytes]:
    """Yield complete lines from a position on, with ``\\n`` at their ends and without blanks around cells.

    Blanks, apostrophes and minus signs are converted to ASCII; any other character becomes a question mark.
    """
    while place < len(text):
        end = text.find("\n", place + _SETTINGS.chunk_characters) + 1 or len(text)
        content = text[place:end]
        if not content.isascii():
            content = normalize_number_marks(content)
        piece = content.encode("ascii", "replace").replace(b"\r\n", b"\n")
        if b" " in piece and any(pair in piece for pair in _AT_EDGES):
            piece = _BLANKS.sub(rb"\1", piece)
        piece = piece.strip(b" ")
        yield piece.rstrip(b"\n") + b"\n" if end == len(text) else piece
        place = end
