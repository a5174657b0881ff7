"""Numbers as text: decimal points or commas, and thousands separators."""

from __future__ import annotations

import math
import re

#: Marks that may be the decimal mark; the other one of the two may separate thousands.
DECIMAL_MARKS = (".", ",")
#: Blanks that separate thousands: plain, no-break, narrow no-break, thin and figure space.
_BLANKS = "\u0020\u00a0\u202f\u2009\u2007"
#: Apostrophes that separate thousands, as in Switzerland.
_APOSTROPHES = "'\u2019\u02bc"
#: Spellings of one mark, all replaced by the first; a typographic minus becomes a hyphen.
_SPELLINGS = {**dict.fromkeys(_BLANKS[1:], " "), **dict.fromkeys(_APOSTROPHES[1:], "'"), "\u2212": "-",
              "\u00d7": "x", "\u00b7": "*"}
_TABLE = str.maketrans(_SPELLINGS)
#: A number with an exponent that `float` does not read: ``1.2D-03`` of Fortran, ``1.2 x 10^-3``.
_EXPONENT = re.compile(r"(?P<number>[+-]?(?:\d+[.,]?\d*|[.,]\d+))(?: ?(?P<letter>[eEdD]) ?| ?[x*] ?10\^)"
                       r"(?P<power>[+-]?\d{1,3})", re.ASCII)


def _grouped(decimal: str) -> re.Pattern[str]:
    separators = re.escape("".join(mark for mark in ",.' " if mark != decimal))
    mark = re.escape(decimal)
    return re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:(?P<separator>[{separators}])\d{{3}})(?:(?P=separator)\d{{3}})*"
                      rf"(?:{mark}\d*)?", re.ASCII)


#: Decimal mark -> pattern of a number with thousands separators: groups of exactly three digits, one separator.
_GROUPED = {mark: _grouped(mark) for mark in DECIMAL_MARKS}


class ExactNumber(str):
    """Text of a number that the file stores as a number, so that its decimal mark is a point."""

    __slots__ = ()


def with_plain_marks(text: str) -> str:
    """A long text in which each mark of a number has its ASCII spelling."""
    # Some replacements of the whole text take a tenth of the time of str.translate.
    for spelling, plain in _SPELLINGS.items():
        text = text.replace(spelling, plain)
    return text


def parse_number(cell: str, decimal: str = ".") -> float:
    """The number in a cell; NaN if the cell holds no number with this decimal mark.

    Thousands separators are the other one of the two decimal marks, any blank, or an apostrophe. They must separate
    groups of exactly three digits, and the first group must not begin with zero. Exponents are those of `float`, of
    Fortran (``1.2D-03``), and powers of ten (``1.2 x 10^-3``).

    Args:
        cell: text without blanks at its ends. decimal: ``"."`` or ``","``.
    """
    if isinstance(cell, ExactNumber):
        decimal = "."
    plain = cell if cell.isascii() else cell.translate(_TABLE)
    # float() also takes 1_000 and digits of other scripts, which are typing errors in a table.
    if "_" in plain or not plain.isascii():
        return math.nan
    if decimal != "." and "." in plain:
        return _parse_grouped(plain, decimal)
    try:
        return float(plain if decimal == "." else plain.replace(decimal, ".", 1))
    except ValueError:
        return _parse_unusual(plain, decimal)


def thousands_separator(cell: str, decimal: str) -> str:
    """The thousands separator of a number, in its plain spelling; empty if it has none."""
    match = None if isinstance(cell, ExactNumber) else _GROUPED[decimal].fullmatch(cell.translate(_TABLE))
    return match["separator"] if match else ""


def is_number(cell: str) -> bool:
    """Return whether a cell is a number with one of the two decimal marks, with or without thousands separators."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        if not cell[-1:].isdigit() and cell[-1:] not in DECIMAL_MARKS:
            return False
        plain = cell.translate(_TABLE)
        return any(pattern.fullmatch(plain) or not math.isnan(parse_number(cell, mark))
                   for mark, pattern in _GROUPED.items())
    return True


def any_number(cell: str) -> float:
    """The number in a cell that stands alone: the decimal mark is a point where both readings are possible."""
    value = parse_number(cell, ".")
    return value if math.isfinite(value) and not thousands_separator(cell, ".") else _first_finite(
        parse_number(cell, ","), value)


def _first_finite(first: float, second: float) -> float:
    return first if math.isfinite(first) else second


def _parse_unusual(plain: str, decimal: str) -> float:
    """A number that `float` does not read: with thousands separators or another exponent; NaN: none."""
    match = _EXPONENT.fullmatch(plain)
    if match is None:
        return _parse_grouped(plain, decimal)
    has_mark = not set(match["number"]).isdisjoint(DECIMAL_MARKS)
    # Fortran writes a decimal mark; "3D10" is the name of a specimen.
    if (has_mark and decimal not in match["number"]) or (not has_mark and match["letter"] in ("d", "D")):
        return math.nan
    return float(f"{match['number'].replace(decimal, '.')}e{match['power']}")


def _parse_grouped(plain: str, decimal: str) -> float:
    match = _GROUPED[decimal].fullmatch(plain)
    if match is None:
        return math.nan
    return float(plain.replace(match["separator"], "").replace(decimal, "."))
