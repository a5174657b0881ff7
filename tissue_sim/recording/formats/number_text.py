"""Parse numbers with decimal points or commas, thousands separators, and exponents."""

from __future__ import annotations

import math
import re

from tissue_sim.units import find_known_unit_or_none

#: Possible decimal marks. The mark that is not the decimal mark may be a thousands separator.
DECIMAL_MARKS = (".", ",")
#: Blanks that separate thousands: plain, no-break, narrow no-break, thin and figure space.
_BLANKS = "\u0020\u00a0\u202f\u2009\u2007"
#: Apostrophes that separate thousands, as in Switzerland.
_APOSTROPHES = "'\u2019\u02bc"
#: Character -> ASCII character with the same meaning.
_SPELLINGS = {**dict.fromkeys(_BLANKS[1:], " "), **dict.fromkeys(_APOSTROPHES[1:], "'"), "\u2212": "-",
              "\u00d7": "x", "\u00b7": "*"}
#: The same table for `str.translate`.
_SPELLING_TABLE = str.maketrans(_SPELLINGS)
#: A number and its unit in one cell.
_QUANTITY = re.compile(r"(?P<number>[-+\u2212]?[\d.,](?:[\d.,'\u2019\u00a0\u202f\u2009 ]*[\d.,])?(?:[eEdD][-+]?\d+)?)"
                       r"\s*(?P<unit>[\[(]?(?:[^\W\d_]\S*|%|\u00b0C)[\])]?)")
#: A number with an exponent that `float` does not read: ``1.2D-03`` of Fortran, ``1.2 x 10^-3``.
_EXPONENT_PATTERN = re.compile(r"(?P<number>[+-]?(?:\d+[.,]?\d*|[.,]\d+))(?: ?(?P<letter>[eEdD]) ?| ?[x*] ?10\^)"
                               r"(?P<power>[+-]?\d{1,3})", re.ASCII)
#: Matches each ASCII number that `float` does not read, and some other texts. It excludes quickly most cells of a table
#: that is split at a wrong delimiter.
_POSSIBLE_NUMBER = re.compile(r"[+-]?(?:[1-9]\d{0,2}[,.' ]\d{3}(?!\d)[\d,.' ]*"
                              r"|[\d.,]+ ?(?:[eEdD]|[x*] ?10\^) ?[+-]?\d{1,3})", re.ASCII)


def _compile_grouped_pattern(decimal: str) -> re.Pattern[str]:
    """Return the pattern of a number with thousands separators for a decimal mark."""
    separators = re.escape("".join(mark for mark in ",.' " if mark != decimal))
    mark = re.escape(decimal)
    return re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:(?P<separator>[{separators}])\d{{3}})(?:(?P=separator)\d{{3}})*"
                      rf"(?:{mark}\d*)?", re.ASCII)


#: Decimal mark -> pattern of a number with thousands separators: groups of exactly three digits, one separator.
_GROUPED_PATTERNS = {mark: _compile_grouped_pattern(mark) for mark in DECIMAL_MARKS}


class TextOfNumericCell(str):
    """Text of a number that the file stores as a number; its decimal mark is a point."""

    __slots__ = ()


def convert_number_characters_to_ascii(text: str) -> str:
    """Replace minus signs, blanks and apostrophes in a text by ASCII characters."""
    # For a long text, a few calls of str.replace take a tenth of the time of str.translate.
    for spelling, plain in _SPELLINGS.items():
        text = text.replace(spelling, plain)
    return text


def parse_number_or_nan(cell: str, decimal: str = ".") -> float:
    """Return the number in a cell; NaN if the cell is not a number with this decimal mark.

    A thousands separator is the other decimal mark, a blank, or an apostrophe. Thousands separators must separate
    groups of exactly three digits, and the first group must not begin with zero. Exponents may have the form of
    `float`, of Fortran (``1.2D-03``), or of a power of ten (``1.2 x 10^-3``).

    Args:
        cell: text without blanks at its ends.
        decimal: decimal mark, ``"."`` or ``","``.
    """
    if isinstance(cell, TextOfNumericCell):
        decimal = "."
    plain = cell if cell.isascii() else cell.translate(_SPELLING_TABLE)
    # float() also accepts 1_000 and digits of other scripts, which are typing errors in a table.
    if "_" in plain or not plain.isascii():
        return math.nan
    if decimal != "." and "." in plain:
        return _parse_grouped_number_or_nan(plain, decimal)
    try:
        return float(plain if decimal == "." else plain.replace(decimal, ".", 1))
    except ValueError:
        return _parse_grouped_or_exponent_number_or_nan(plain, decimal)


def find_thousands_separator_or_empty(cell: str, decimal: str) -> str:
    """Return the thousands separator of a number as an ASCII character; empty without a separator."""
    if isinstance(cell, TextOfNumericCell):
        return ""
    match = _GROUPED_PATTERNS[decimal].fullmatch(cell.translate(_SPELLING_TABLE))
    return match["separator"] if match else ""


def is_number_with_either_mark(cell: str) -> bool:
    """Return whether a cell is a number with one of the two decimal marks, with or without thousands separators."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        if not cell[-1:].isdigit() and cell[-1:] not in DECIMAL_MARKS:
            return False
        if cell.isascii() and _POSSIBLE_NUMBER.fullmatch(cell) is None:
            return False
        plain = cell.translate(_SPELLING_TABLE)
        return any(pattern.fullmatch(plain) or not math.isnan(parse_number_or_nan(cell, mark))
                   for mark, pattern in _GROUPED_PATTERNS.items())
    return True


def parse_number_preferring_point_or_nan(cell: str) -> float:
    """Return the number in a single cell; the decimal mark is a point if both decimal marks are possible."""
    value = parse_number_or_nan(cell, ".")
    return value if math.isfinite(value) and not find_thousands_separator_or_empty(cell, ".") \
        else _get_first_if_finite_else_second(
        parse_number_or_nan(cell, ","), value)


def _get_first_if_finite_else_second(first: float, second: float) -> float:
    """Return `first` if it is finite, else `second`."""
    return first if math.isfinite(first) else second


def _parse_grouped_or_exponent_number_or_nan(plain: str, decimal: str) -> float:
    """Parse a number with thousands separators or an exponent that `float` rejects; NaN: not a number."""
    match = _EXPONENT_PATTERN.fullmatch(plain)
    if match is None:
        return _parse_grouped_number_or_nan(plain, decimal)
    has_mark = not set(match["number"]).isdisjoint(DECIMAL_MARKS)
    # Fortran always writes a decimal mark: "3D10" is the name of a specimen.
    if (has_mark and decimal not in match["number"]) or (not has_mark and match["letter"] in ("d", "D")):
        return math.nan
    return float(f"{match['number'].replace(decimal, '.')}e{match['power']}")


def _parse_grouped_number_or_nan(plain: str, decimal: str) -> float:
    """Return a number with thousands separators; NaN: not such a number."""
    match = _GROUPED_PATTERNS[decimal].fullmatch(plain)
    if match is None:
        return math.nan
    return float(plain.replace(match["separator"], "").replace(decimal, "."))


def split_number_and_unit(cell: str) -> tuple[str, str] | None:
    """Return the number and the name of the unit in a cell, ``("12.3", "N")``; None: not a number with a known unit."""
    if cell.isascii() and "%" not in cell and cell.lower() == cell.upper():
        return None  # without a letter the cell has no unit
    match = _QUANTITY.fullmatch(cell)
    unit = None if match is None else find_known_unit_or_none(match["unit"])
    if match is None or unit is None or not is_number_with_either_mark(match["number"]):
        return None
    return match["number"], unit
