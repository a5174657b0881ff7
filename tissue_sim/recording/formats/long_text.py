"""Read long texts fast: the beginning cell by cell, and an end of numbers as one array.

The cells of the end may be quoted, and may have units after their numbers. Reading the end as an array takes a tenth of
the time and memory.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tissue_sim.recording.formats.number_text import convert_number_characters_to_ascii, split_number_and_unit


@dataclass(frozen=True)
class LongTextSettings:
    """Settings of `try_splitting_off_trailing_numbers`.

    Attributes:
        beginning: number of lines that are read cell by cell. These lines determine marks and units, so that fewer
            lines may require a second reading of the complete text.
        chunk_characters: number of characters that are processed together. A larger value needs more memory.
        group_digits: number of digits of a group of thousands.
    """

    beginning: int = 2000
    chunk_characters: int = 4_000_000
    group_digits: int = 3


#: Settings that the functions of this module use.
_SETTINGS = LongTextSettings()
#: Delimiters in the order of preference: next to another delimiter, a comma is a decimal mark.
_DELIMITERS = "\t;|,"
#: Delimiter of a piece, which replaces the delimiter of the text.
_CELL_END = b"\t"
#: Blanks around the delimiters of a piece.
_BLANKS = re.compile(rb" *([\t\n]) *")
#: Blanks next to a delimiter of a piece, for a fast search.
_AT_EDGES = tuple(pair for edge in (b"\t", b"\n") for pair in (b" " + edge, edge + b" "))
#: Characters of a piece that are not marks.
_PLAIN = b"+-.0123456789eEdD\t\n"
#: Possible decimal marks and thousands separators, in the spelling of `tissue_sim.recording.formats.number_text`.
_MARKS = b". ',"


class NotPlainNumbersError(Exception):
    """The text must be read cell by cell, because a part of it is not plain numbers."""


@dataclass(frozen=True)
class TrailingNumberLines:
    """Lines at the end of a text with an equal number of cells, each a number, with quotation marks or a unit.

    Attributes:
        text: the complete text.
        start: position in the text at which the end begins.
        delimiter: delimiter of the cells.
        marks: marks in the numbers: ``.``, ``,``, blank and apostrophe.
        suffixes: text after each number of a column, such as ``b" N"``; empty without units.
        units: unit of each column after its numbers; empty without a unit.
    """

    text: str = field(repr=False)
    start: int
    delimiter: str
    marks: str
    suffixes: tuple[bytes, ...]
    units: tuple[str, ...]

    @property
    def cell_count_per_line(self) -> int:
        """Number of cells in each line."""
        return len(self.suffixes)

    def parse_columns_or_none(self, positions: Sequence[int], decimal: str) -> np.ndarray | None:
        """Return the numbers in the given columns, shape (lines, columns); None if a cell is not a number.

        Args:
            positions: positions of the columns, from 0.
            decimal: decimal mark. All other marks must separate thousands.
        """
        separators = [mark for mark in self.marks if mark != decimal]
        found = []
        for piece in _iterate_chunks_of_plain_tabbed_lines(self.text, self.start, self.delimiter):
            content: bytes | None = _remove_unit_suffixes(piece, self.suffixes)
            for separator in separators:
                content = None if content is None else _try_removing_thousands_separators(content, separator, decimal)
            if content is None:
                return None
            if decimal == ",":
                content = content.replace(b",", b".")
            if b"D" in content or b"d" in content:
                content = content.replace(b"D", b"E").replace(b"d", b"e")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    found.append(np.loadtxt(content.decode("ascii").splitlines(), delimiter=_CELL_END.decode(),
                                            comments=None, usecols=tuple(positions), ndmin=2))
            except (ValueError, UserWarning):
                return None
        values = np.concatenate(found)
        return values if np.isfinite(values).all() else None


def try_splitting_off_trailing_numbers(text: str, skipped: int = 0) -> tuple[str, TrailingNumberLines | None]:
    """Divide a text into its beginning and its trailing lines of plain numbers.

    Args:
        text: text with any line ends.
        skipped: number of lines at the top that are ignored.

    Returns:
        The beginning and the end; the complete text and None if the text is short, or if its end is not plain.
    """
    last = start = 0
    for _ in range(skipped + _SETTINGS.beginning):
        last, start = start, text.find("\n", start) + 1
        if not start:
            return text, None
    line = text[start:text.find("\n", start) + 1]
    delimiter = next((each for each in _DELIMITERS if each in line), None)
    if delimiter is None:
        return text, None
    try:
        # A quoted cell of the last line of the beginning may continue in the next line.
        _unquote_cells_and_separate_by_tabs(_encode_with_ascii_marks_and_line_feeds(text[last:start]), delimiter)
        return text[:start], _make_verified_trailing_number_lines(text, start, delimiter)
    except NotPlainNumbersError:
        return text, None


def _make_verified_trailing_number_lines(text: str, start: int, delimiter: str) -> TrailingNumberLines:
    """Return the lines of a text from position `start` on, after a check that all cells are numbers.

    Raises:
        NotPlainNumbersError: a cell that is not a number, or lines with different numbers of cells.
    """
    found: set[str] = set()
    suffixes: tuple[bytes, ...] = ()
    units: tuple[str, ...] = ()
    for piece in _iterate_chunks_of_plain_tabbed_lines(text, start, delimiter):
        if not suffixes:
            quantities = [_get_unit_suffix_and_unit(cell) for cell in piece[:piece.index(b"\n")].split(_CELL_END)]
            suffixes = tuple(suffix for suffix, _ in quantities)
            units = tuple(unit for _, unit in quantities)
            if len(suffixes) < 2:
                raise NotPlainNumbersError
        numbers = _remove_unit_suffixes(piece, suffixes)
        if numbers.translate(None, _PLAIN + _MARKS):
            raise NotPlainNumbersError
        found |= {chr(mark) for mark in _MARKS if mark in numbers}
        # A cell between two adjacent delimiters is empty.
        if (np.diff(_find_cell_ends_per_line(numbers, len(suffixes)).ravel(), prepend=-1) == 1).any():
            raise NotPlainNumbersError
    return TrailingNumberLines(text, start, delimiter, "".join(sorted(found)), suffixes, units)


def _get_unit_suffix_and_unit(cell: bytes) -> tuple[bytes, str]:
    """Return the text after the number in a cell, and its unit; both are empty without a known unit."""
    text = cell.decode("latin-1")
    pair = split_number_and_unit(text)
    return (b"", "") if pair is None else (text[len(pair[0]):].encode("latin-1"), pair[1])


def _find_cell_ends_per_line(piece: bytes, cells: int) -> np.ndarray:
    """Return the positions of the delimiters and line ends of a piece, shape (lines, cells).

    Raises:
        NotPlainNumbersError: a line with another number of cells.
    """
    letters = np.frombuffer(piece, dtype=np.uint8)
    ends = np.flatnonzero((letters == _CELL_END[0]) | (letters == ord("\n")))
    lines = np.flatnonzero(letters[ends] == ord("\n"))
    if not lines.size or (np.diff(lines, prepend=-1) != cells).any() or lines[-1] != ends.size - 1:
        raise NotPlainNumbersError
    return ends.reshape(-1, cells)


def _remove_unit_suffixes(piece: bytes, suffixes: Sequence[bytes]) -> bytes:
    """Remove the text after the numbers of each column from a piece.

    Raises:
        NotPlainNumbersError: a cell without the text of its column, or a line with another number of cells.
    """
    if not any(suffixes):
        return piece
    letters = np.frombuffer(piece, dtype=np.uint8)
    kept = np.ones(letters.size, dtype=bool)
    ends = _find_cell_ends_per_line(piece, len(suffixes))
    for column, suffix in enumerate(suffixes):
        for distance, letter in enumerate(reversed(suffix), start=1):
            positions = ends[:, column] - distance
            if positions[0] < 0 or (letters[positions] != letter).any():
                raise NotPlainNumbersError
            kept[positions] = False
    return letters[kept].tobytes()


def _try_removing_thousands_separators(piece: bytes, separator: str, decimal: str) -> bytes | None:
    """Remove a thousands separator from a piece; None if a separator is not between groups of three digits.

    As in `tissue_sim.recording.formats.number_text.parse_number_or_nan`, a number begins with one to three digits. The
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
    begins = np.isin(start, np.frombuffer(b"\n+-" + _CELL_END, dtype=np.uint8))
    is_first = begins & (before >= 1) & (before <= _SETTINGS.group_digits) & (letters[at - before] != ord("0"))
    after = np.all([is_digit[at + i] for i in range(1, _SETTINGS.group_digits + 1)], axis=0)
    end = np.isin(letters[at + _SETTINGS.group_digits + 1], np.frombuffer(
        b"\n" + _CELL_END + f"{decimal}{separator}".encode(), dtype=np.uint8))
    if not np.all((is_first | (follows & (before == _SETTINGS.group_digits))) & after & end):
        return None
    return piece.replace(separator.encode(), b"")


def _encode_with_ascii_marks_and_line_feeds(text: str) -> bytes:
    """Convert minus signs, blanks and apostrophes to ASCII, and line ends to line feeds; the result is Latin-1."""
    if not text.isascii():
        text = convert_number_characters_to_ascii(text)
    return text.encode("latin-1", "replace").replace(b"\r\n", b"\n")


def _unquote_cells_and_separate_by_tabs(piece: bytes, delimiter: str) -> bytes:
    """Replace the delimiters of a piece by tabs, and remove the quotation marks of quoted cells.

    Raises:
        NotPlainNumbersError: a quotation mark inside a cell, a quoted cell that continues in the next line, or a tab
            that is not a delimiter.
    """
    sign = delimiter.encode()
    if sign != _CELL_END and _CELL_END in piece:
        raise NotPlainNumbersError
    if b'"' not in piece:
        return piece if sign == _CELL_END else piece.replace(sign, _CELL_END)
    letters = np.frombuffer(piece, dtype=np.uint8).copy()
    is_quote = letters == ord('"')
    is_inside = np.cumsum(is_quote) % 2 == 1
    is_end = letters == ord("\n")
    is_delimiter = (letters == sign[0]) & ~is_inside
    is_edge = np.concatenate([[True], is_end | is_delimiter, [True]])
    opens = np.flatnonzero(is_quote & is_inside)
    closes = np.flatnonzero(is_quote & ~is_inside)
    # Position i of the piece is position i + 1 of `is_edge`.
    if is_inside[-1] or (is_end & is_inside).any() or not is_edge[opens].all() or not is_edge[closes + 2].all():
        raise NotPlainNumbersError
    if sign == _CELL_END and ((letters == sign[0]) & is_inside).any():
        raise NotPlainNumbersError
    letters[is_delimiter] = _CELL_END[0]
    return letters[~is_quote].tobytes()


def _iterate_chunks_of_plain_tabbed_lines(text: str, start: int, delimiter: str) -> Iterator[bytes]:
    """Yield complete lines from a position on, with tabs between cells and line feeds at their ends.

    Cells have neither quotation marks nor blanks at their ends. Blanks, apostrophes and minus signs are ASCII; any
    other character outside of Latin-1 is a question mark.

    Raises:
        NotPlainNumbersError: an invalid quotation mark or tab; see `_unquote_cells_and_separate_by_tabs`.
    """
    while start < len(text):
        end = text.find("\n", start + _SETTINGS.chunk_characters) + 1 or len(text)
        piece = _unquote_cells_and_separate_by_tabs(_encode_with_ascii_marks_and_line_feeds(text[start:end]), delimiter)
        if b" " in piece and any(pair in piece for pair in _AT_EDGES):
            piece = _BLANKS.sub(rb"\1", piece)
        piece = piece.strip(b" ")
        yield piece.rstrip(b"\n") + b"\n" if end == len(text) else piece
        start = end
