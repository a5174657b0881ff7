"""Round numbers to the precision of their uncertainty by the rule of the Particle Data Group.

The three leading digits of the error decide: from 100 to 354 two digits of the error are kept, from 355 to 949 one
digit, and 950 to 999 is rounded to 1000 and two digits are kept. The value is rounded to the same decimal place (Review
of Particle Physics, Introduction, section 5.3).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TypeGuard

#: Standard deviations around the mean of a normal distribution that contain 95 % of its values.
NORMAL_95 = 1.96


@dataclass(frozen=True)
class NumberDigitSettings:
    """Settings of numbers in reports: digits without an error, and limits for powers of ten.

    Attributes:
        digits: significant digits of a number without a known error.
        min_plain: smallest number that is written without a power of ten.
        max_plain: limit from which numbers are written with a power of ten.
    """

    digits: int = 4
    min_plain: float = 1e-3
    max_plain: float = 1e6


_FORMAT = NumberDigitSettings()
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def find_last_kept_power_of_ten(error: float) -> int:
    """Return the power of ten of the last digit to keep for this error (> 0), such as -2 for 0.12."""
    power = math.floor(math.log10(error))
    three = error / 10.0**(power - 2)
    return power if 354.5 <= three < 949.5 else power - 1 if three < 354.5 else power


def format_value_and_error(value: float, error: float | None, unit: str = "", *, known: str = "") -> str:
    """Return a value with its error as text, such as ``0.988 ± 0.023 kPa`` or ``(4.6 ± 0.5) × 10⁻⁶``.

    Args:
        value: value in the written unit.
        error: standard error in the same unit; None or 0: the value has four digits and `known` follows.
        unit: name of the unit.
        known: reason for the missing error, such as ``on its bound``.
    """
    end = f" {unit}" if unit else ""
    if not _is_usable_error(error):
        return f"{value:.{_FORMAT.digits}g}{end}{f' ({known})' if known else ''}"
    place, power = find_last_kept_power_of_ten(error), _choose_common_power_of_ten(value, error)
    both = f"{_scale_and_round(value, place, power)} ± {_scale_and_round(error, place, power)}"
    return f"({both}){_format_power_of_ten(power)}{end}" if power else f"{both}{end}"


def format_value_rounded_by_error(value: float, error: float | None) -> str:
    """Return a value rounded to the precision of its error; four significant digits without an error."""
    if _is_usable_error(error) and not _choose_common_power_of_ten(value, error):
        return _scale_and_round(value, find_last_kept_power_of_ten(error), 0)
    return f"{value:.{_FORMAT.digits}g}"


def format_interval(low: float, high: float, error: float | None, value: float = 0.0) -> str:
    """Return an interval as text, such as ``0.937 to 1.040``, with the power of ten of the value.

    Args:
        low: lower end.
        high: upper end.
        error: standard error that sets the precision. If the interval is narrower because of a bound, its width / 3.92
            sets the precision.
        value: the estimate.
    """
    width = (high - low) / (2.0 * NORMAL_95)
    if not (_is_usable_error(error) and _is_usable_error(width)):
        return f"{low:.{_FORMAT.digits}g} to {high:.{_FORMAT.digits}g}"
    place, power = find_last_kept_power_of_ten(min(error, width)), _choose_common_power_of_ten(value, error)
    both = f"{_scale_and_round(low, place, power)} to {_scale_and_round(high, place, power)}"
    return f"({both}){_format_power_of_ten(power)}" if power else both


def format_error(error: float) -> str:
    """Return a standard error as text, rounded by the rule of this module, such as ``0.0053``."""
    is_plain = _is_usable_error(error) and _FORMAT.min_plain / 10 < error < _FORMAT.max_plain
    return _scale_and_round(error, find_last_kept_power_of_ten(error), 0) if is_plain else f"{error:.2g}"


def use_minus_signs(text: str) -> str:
    """Replace the hyphen before each number by a minus sign."""
    return re.sub(r"(?<![\w.-])-(?=\d)", "−", text)


def format_significant_digits_or_dash(value: float | None, digits: int) -> str:
    """Return a number as text with this many significant digits; ``-`` for None."""
    return "-" if value is None else f"{value:.{digits}g}"


def format_criterion_difference(gain: float) -> str:
    """Return the difference of an information criterion as text, such as ``24 964`` or ``−3.2``."""
    text = f"{gain:.2g}" if abs(gain) < 10 else f"{gain:,.0f}"
    return text.replace(",", "\u202f").replace("-", "−")


def format_odds_number(ratio: float) -> str:
    """Return the number of odds ``n : 1`` as text, such as ``4.9``, ``48 600`` or ``> 10⁶``."""
    if ratio > 1e6:
        return "> 10⁶"
    return format_criterion_difference(float(f"{ratio:.3g}")) if ratio >= 100 else f"{ratio:.2g}"


def _is_usable_error(error: float | None) -> TypeGuard[float]:
    """Return whether an error is a positive finite number."""
    return error is not None and error > 0 and math.isfinite(error)


def _choose_common_power_of_ten(value: float, error: float) -> int:
    """Return the power of ten that is factored out of value and error; 0 if none."""
    largest = max(abs(value), error)
    if _FORMAT.min_plain <= largest < _FORMAT.max_plain and find_last_kept_power_of_ten(error) > -7:
        return 0
    return math.floor(math.log10(largest))


def _scale_and_round(value: float, place: int, power: int) -> str:
    """Return text: the value rounded to the decimal place 10**place, then divided by 10**power."""
    scaled = round(value, -place) / 10.0**power + 0.0  # a rounded zero has no sign
    return f"{scaled:.{max(power - place, 0)}f}"


def _format_power_of_ten(power: int) -> str:
    """Return a power of ten as a factor, such as `` × 10⁻⁶``."""
    return f" × 10{str(power).translate(_SUPERSCRIPTS)}"
