"""Numbers with as many digits as their uncertainty leaves, by the rule of the Particle Data Group.

Of the three highest digits of the error: 100 to 354 leaves two, 355 to 949 one, 950 to 999 is rounded up to 1000 with
two; the value ends at the same place (Review of Particle Physics, Introduction, section 5.3).
"""

from __future__ import annotations

import math
from typing import TypeGuard

#: Digits of a number of which no error is known.
DIGITS = 4
#: Standard errors in a 95 % interval.
_WIDTH = 3.92
#: Smallest and largest numbers without a power of ten.
_SMALLEST, _LARGEST = 1e-3, 1e6
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def last_place(error: float) -> int:
    """Power of ten of the last digit that an error leaves, such as -2 for 0.12; the error is above zero."""
    power = math.floor(math.log10(error))
    three = error / 10.0**(power - 2)
    return power if 354.5 <= three < 949.5 else power - 1 if three < 354.5 else power


def value_and_error(value: float, error: float | None, unit: str = "", *, known: str = "") -> str:
    """``0.988 ± 0.023 kPa``, ``(4.6 ± 0.5) × 10⁻⁶``.

    Args:
        value, error: in the unit that is written. error None or 0: four digits of the value, and `known` instead.
        unit: written behind both.
        known: why there is no error, such as ``on its bound``.
    """
    end = f" {unit}" if unit else ""
    if not _usable(error):
        return f"{value:.{DIGITS}g}{end}{f' ({known})' if known else ''}"
    place, power = last_place(error), _power(value, error)
    both = f"{_at(value, place, power)} ± {_at(error, place, power)}"
    return f"({both}){_times(power)}{end}" if power else f"{both}{end}"


def value_text(value: float, error: float | None) -> str:
    """A value alone, to the place at which its error ends; four digits where no error is known."""
    return _at(value, last_place(error), 0) if _usable(error) and not _power(value, error) else f"{value:.{DIGITS}g}"


def interval_text(low: float, high: float, error: float | None, value: float = 0.0) -> str:
    """``0.937 to 1.040``: the ends to the place at which the error ends, with the power of ten of the value. Where a
    bound cuts the interval, its own width stands for the error."""
    width = (high - low) / _WIDTH
    if not (_usable(error) and _usable(width)):
        return f"{low:.{DIGITS}g} to {high:.{DIGITS}g}"
    place, power = last_place(min(error, width)), _power(value, error)
    both = f"{_at(low, place, power)} to {_at(high, place, power)}"
    return f"({both}){_times(power)}" if power else both


def error_text(error: float) -> str:
    """An error alone: ``0.0053``."""
    return _at(error, last_place(error), 0) if _usable(error) and _SMALLEST / 10 < error < _LARGEST else f"{error:.2g}"


def gain_text(gain: float) -> str:
    """A difference of a criterion: ``24 964``, ``−3.2``."""
    text = f"{gain:.2g}" if abs(gain) < 10 else f"{gain:,.0f}"
    return text.replace(",", "\u202f").replace("-", "−")


def ratio_text(ratio: float) -> str:
    """Odds: ``4.9``, ``48 600``, ``> 10⁶``."""
    return "> 10⁶" if ratio > 1e6 else gain_text(float(f"{ratio:.3g}")) if ratio >= 100 else f"{ratio:.2g}"


def _usable(error: float | None) -> TypeGuard[float]:
    return error is not None and error > 0 and math.isfinite(error)


def _power(value: float, error: float) -> int:
    """The power of ten that is taken out of value and error; 0: none."""
    largest = max(abs(value), error)
    if _SMALLEST <= largest < _LARGEST and last_place(error) > -7:
        return 0
    return math.floor(math.log10(largest))


def _at(value: float, place: int, power: int) -> str:
    scaled = round(value, -place) / 10.0**power + 0.0  # a rounded zero has no sign
    return f"{scaled:.{max(power - place, 0)}f}"


def _times(power: int) -> str:
    return f" × 10{str(power).translate(_SUPERSCRIPTS)}"
