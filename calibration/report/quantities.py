"""Write quantities: display units, rounding, and symbols of parameters.

A whole report has one unit per quantity, so that numbers are readable. Numbers are rounded to the precision of their
uncertainty by the rule of the Particle Data Group: the three leading digits of the error decide. From 100 to 354 two
digits of the error are kept, from 355 to 949 one digit, and 950 to 999 is rounded to 1000 and two digits are kept. The
value is rounded to the same decimal place (Review of Particle Physics, Introduction, section 5.3). The symbol ``mu1@A``
becomes a Greek mu with index 1 that belongs to A.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeGuard

if TYPE_CHECKING:
    from calibration.campaign.campaign import Test
    from calibration.fit.fit import Fit, ReplicateJitterRecord
    from calibration.fit.result import CalibrationResult

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


_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "eta": "η", "theta": "θ",
          "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"}
_PARTS = re.compile(r"([A-Za-z]+)_?(\d*)$")


def get_symbol_letter_index_owner_and_slant(symbol: str) -> tuple[str, str, str, bool]:
    """Return a symbol in parts for a page, such as ``("μ", "1", "A", True)`` for ``mu1@A``.

    The parts are the letter or word, its index, the specimen, test or recording to which the symbol belongs (index and
    owner may be empty), and whether the letter is in italics.
    """
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    return _GREEK.get(name, name), index, owner, bool(index) or name in _GREEK


def format_mathtext_symbol(symbol: str) -> str:
    """Return a symbol as matplotlib mathtext (subscripts, Greek letters), with its specimen, test or recording."""
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    if not index and name not in _GREEK:
        return symbol.replace("$", r"\$")
    letter = f"\\{name}" if name in _GREEK else name
    index = f"_{{{index}}}" if index else ""
    return f"${letter}{index}$" + (f" ({owner})".replace("$", r"\$") if owner else "")


def format_plain_symbol(symbol: str) -> str:
    """Return a symbol in plain text, such as ``μ1`` or ``C10 (A)``."""
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    return f"{_GREEK.get(name, name)}{index}" + (f" ({owner})" if owner else "")


def _split_symbol_name_index_and_owner(symbol: str) -> tuple[str, str, str]:
    """Split a symbol into name, index and owner; a symbol of another form is returned as the name without index."""
    front, _, owner = symbol.partition("@")
    found = _PARTS.match(front)
    return (found[1], found[2], owner) if found else (front, "", owner)


#: Unit -> its size in SI, largest first.
PRESSURE_UNITS = {"GPa": 1e9, "MPa": 1e6, "kPa": 1e3, "Pa": 1.0}
_FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "µN": 1e-6, "nN": 1e-9}
_LENGTH_UNITS = {"mm": 1e-3, "µm": 1e-6, "nm": 1e-9}
#: Assumed ratio of the residual error to the force, to estimate the size of the forces.
_RELATIVE_ERROR = 1e-2


@dataclass(frozen=True)
class DisplayUnit:
    """Display unit of a quantity.

    Attributes:
        name: name of the unit; empty for dimensionless numbers.
        size: value of one unit in SI.
    """

    name: str
    size: float

    def format_quantity(self, value: float, digits: int) -> str:
        """Return a value (SI) in this unit with this many significant digits, such as ``0.047 N``."""
        return f"{float(f'{value / self.size:.{digits}g}'):g} {self.name}".rstrip()

    def format_axis_label(self, name: str) -> str:
        """Return the label of an axis or column, such as ``force [N]``."""
        return f"{name} [{self.name}]" if self.name else name


@dataclass(frozen=True)
class ReportUnits:
    """Display units of one report.

    Attributes:
        length: unit of displacements.
        force: unit of forces.
        pressure: unit of stresses and moduli.
    """

    length: DisplayUnit
    force: DisplayUnit
    pressure: DisplayUnit

    @classmethod
    def choose_for_best_fit(cls, result: CalibrationResult) -> ReportUnits:
        """Return the units for a calibration, which suit the best fit.

        The pressure unit suits the shear modulus of the best law. Length and force are in mm and N, or in smaller units
        for small tests, such as 2 µm instead of 0.002 mm.
        """
        return cls.choose_for_fit(result.best)

    @classmethod
    def choose_for_fit(cls, fit: Fit) -> ReportUnits:
        """Return the units that suit the displacements, forces and shear modulus of one fit."""
        travel = max((region.end * 1e-3 for region in fit.regions), default=1e-3)
        force = 1.0 if fit.RMSE_N is None else fit.RMSE_N / _RELATIVE_ERROR
        return cls.choose_for_typical_sizes(travel, force, fit.mu0)

    @classmethod
    def choose_for_typical_sizes(cls, travel: float, force: float, modulus: float) -> ReportUnits:
        """Return the units that suit typical displacements (m), forces (N) and moduli (Pa)."""
        return cls(_choose_largest_fitting_unit(_LENGTH_UNITS, 10 * travel),
                   _choose_largest_fitting_unit(_FORCE_UNITS, 10 * force),
                   DisplayUnit(*choose_pressure_unit_name_and_size(modulus)))

    def get_load_unit(self, test: Test) -> DisplayUnit:
        """Return the unit of force, of stress for a test without specimen, or of differences of log moduli."""
        if test.modulus:
            return DisplayUnit("%", 1e-2)
        return self.pressure if test.states_stress else self.force

    def get_displacement_unit(self, test: Test) -> DisplayUnit:
        """Return the unit of displacement, of strain for a test without specimen, or of frequency."""
        if test.modulus:
            return DisplayUnit("Hz", 1.0)
        return DisplayUnit("", 1.0) if test.states_stress else self.length

    def format_contact_and_zero_scatter(self, jitter: ReplicateJitterRecord,
                                        tests: Sequence[Test]) -> tuple[str, str]:
        """Return two texts: standard deviations of contact point and of force zero between recordings, with units.

        The scatter is a length and a force, or a strain and a stress if no test has a specimen.
        """
        test = self.choose_first_specimen_test_or_first(tests)
        contact = jitter.contact_mm * 1e-3
        if test.modulus:
            return f"{contact:.2g} of strain", self.pressure.format_quantity(jitter.zero_N, 2)
        return self.get_displacement_unit(test).format_quantity(contact, 2) + (" of strain" if test.states_stress
                                                                               else ""), \
            self.get_load_unit(test).format_quantity(jitter.zero_N, 2)

    @staticmethod
    def choose_first_specimen_test_or_first(tests: Sequence[Test]) -> Test:
        """Return the test that decides the units of common quantities: the first with a specimen, else the first."""
        return next((test for test in tests if not test.states_stress),
                    next((test for test in tests if not test.modulus), tests[0]))

    def choose_display_unit_of_si_unit(self, unit: str) -> DisplayUnit:
        """Return the display unit of a parameter whose SI unit is `unit`."""
        known = {"Pa": self.pressure, "N": self.force, "m": self.length, "1": DisplayUnit("", 1.0),
                 "m/N": DisplayUnit("mm/N", 1e-3), "m2/s": DisplayUnit("mm²/s", 1e-6),
                 "N s/m": DisplayUnit("N s/mm", 1e3),
                 "1/m": DisplayUnit("1/mm", 1e3), "rad": DisplayUnit("°", math.pi / 180)}
        return known.get(unit, DisplayUnit(unit, 1.0))


def _choose_largest_fitting_unit(units: Mapping[str, float], size: float) -> DisplayUnit:
    """Return the largest unit that is not larger than `size`; the smallest unit if all are larger."""
    return DisplayUnit(*next((pair for pair in units.items() if size >= pair[1]), [*units.items()][-1]))


def choose_pressure_unit_name_and_size(pressure: float) -> tuple[str, float]:
    """Return (name, size in Pa) of the unit that suits a pressure in Pa; ``("Pa", 1.0)`` for 0, NaN and infinity."""
    # Round first: 999.999 Pa is written as 1 kPa.
    size = float(f"{abs(pressure):.4g}") if math.isfinite(pressure) else 0.0
    unit = _choose_largest_fitting_unit(PRESSURE_UNITS, size)
    return unit.name, unit.size


def format_pressure(pressure: float, digits: int = 5) -> str:
    """Return a pressure in Pa as text in a suitable unit, such as ``'8.4296 kPa'`` for 8429.6."""
    unit, factor = choose_pressure_unit_name_and_size(pressure)
    return f"{pressure / factor:.{digits}g} {unit}"
