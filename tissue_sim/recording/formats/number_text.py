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
_SPELLINGS = str.maketrans({**dict.fromkeys(_BLANKS, " "), **dict.fromkeys(_APOSTROPHES, "'"), "\u2212": "-"})


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


def parse_number(cell: str, decimal: str = ".") -> float:
    """The number in a cell; NaN if the cell holds no number with this decimal mark.

    Thousands separators are the other one of the two decimal marks, any blank, or an apostrophe. They must separate
    groups of exactly three digits, and the first group must not begin with zero.

    Args:
        cell: text without blanks at its ends. decimal: ``"."`` or ``","``.
    """
    if isinstance(cell, ExactNumber):
        decimal = "."
    plain = cell if cell.isascii() else cell.translate(_SPELLINGS)
    # float() also takes 1_000 and digits of other scripts, which are typing errors in a table.
    if "_" in plain or not plain.isascii():
        return math.nan
    if decimal != "." and "." in plain:
        return _parse_grouped(plain, decimal)
    try:
        return float(plain if decimal == "." else plain.replace(decimal, ".", 1))
    except ValueError:
        return _parse_grouped(plain, decimal)


def thousands_separator(cell: str, decimal: str) -> str:
    """The thousands separator of a number, in its plain spelling; empty if it has none."""
    match = None if isinstance(cell, ExactNumber) else _GROUPED[decimal].fullmatch(cell.translate(_SPELLINGS))
    return match["separator"] if match else ""


def is_number(cell: str) -> bool:
    """Whether a cell is a number with one of the two decimal marks, with or without thousands separators."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        if not cell[-1:].isdigit() and cell[-1:] not in DECIMAL_MARKS:
            return False
        plain = cell.translate(_SPELLINGS)
        return any(pattern.fullmatch(plain) for pattern in _GROUPED.values()) or (
            plain != cell and not math.isnan(parse_number(cell)))
    return True


def any_number(cell: str) -> float:
    """The number in a cell that stands alone: the decimal mark is a point where both readings are possible."""
    value = parse_number(cell, ".")
    return value if math.isfinite(value) and not thousands_separator(cell, ".") else _first_finite(
        parse_number(cell, ","), value)


def _first_finite(first: float, second: float) -> float:
    return first if math.isfinite(first) else second


def _parse_grouped(plain: str, decimal: str) -> float:
    match = _GROUPED[decimal].fullmatch(plain)
    if match is None:
        return math.nan
    return float(plain.replace(match["separator"], "").replace(decimal, "."))
