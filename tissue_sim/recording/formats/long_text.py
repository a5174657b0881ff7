"""Long texts: their beginning is looked at cell by cell; their end, where it is numbers and nothing else, is read at
once, in a tenth of the time and memory."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

#: Lines of the beginning; a text of fewer is looked at cell by cell from end to end.
BEGINNING = 2000
#: Characters of the end that are worked on together.
_PIECE = 4_000_000
_DELIMITERS = "\t;|,"
_BLANKS = re.compile(rb" *([\t;|,\n]) *")
_PLAIN = b"+-.0123456789eE\n"


class NotPlainError(Exception):
    """Not all of the text can be read in this way: it is to be looked at cell by cell."""


@dataclass(frozen=True)
class PlainEnd:
    """Lines of as many cells each, none of them empty, none of more than digits, signs and points.

    Attributes:
        text, place: the whole, and where the end begins in it.
        delimiter: between the cells.
        cells: of each line.
        mark: the only one of the marks ``.`` and ``,`` in the numbers; empty where there is none.
    """

    text: str = field(repr=False)
    place: int
    delimiter: str
    cells: int
    mark: str

    def numbers(self, places: Sequence[int]) -> np.ndarray | None:
        """The numbers at these places, from 0, of each line, shape (lines, places); None: some cell is none."""
        found = []
        for piece in _pieces(self.text, self.place):
            content = piece.replace(b",", b".") if self.mark == "," else piece
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
    sign, marks, cells = delimiter.encode(), set(), 0
    decimals = b"" if delimiter == "," else b","
    for piece in _pieces(text, place):
        if piece.translate(None, _PLAIN + sign + decimals):
            return None
        marks |= {mark for mark in (b".", decimals) if mark and mark in piece}
        letters = np.frombuffer(piece, dtype=np.uint8)
        between = np.flatnonzero((letters == sign[0]) | (letters == ord("\n")))
        ends = np.flatnonzero(letters[between] == ord("\n"))
        cells = cells or int(ends[0]) + 1
        # Of two beside each other the cell between is empty.
        if between[0] == 0 or (np.diff(between) == 1).any() or (np.diff(ends, prepend=-1) != cells).any():
            return None
    if cells < 2 or len(marks) > 1:
        return None
    return PlainEnd(text, place, delimiter, cells, "".join(mark.decode() for mark in marks))


def _pieces(text: str, place: int) -> Iterator[bytes]:
    """Whole lines from a place on, with plain ends and no blanks about cells; what ASCII lacks becomes a question mark.
    """
    while place < len(text):
        end = text.find("\n", place + _PIECE) + 1 or len(text)
        piece = text[place:end].encode("ascii", "replace").replace(b"\r\n", b"\n")
        if b" " in piece:
            piece = _BLANKS.sub(rb"\1", piece).strip(b" ")
        yield piece.rstrip(b"\n") + b"\n" if end == len(text) else piece
        place = end
