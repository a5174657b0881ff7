"""Choose display units: one unit per quantity for a whole report, so that numbers are readable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.campaign.campaign import Test
    from calibration.fit.fit import Fit, ReplicateJitterRecord
    from calibration.fit.result import CalibrationResult

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
        """Return the unit of force, or of stress for a test without specimen."""
        return self.pressure if test.specimen is None else self.force

    def get_displacement_unit(self, test: Test) -> DisplayUnit:
        """Return the unit of displacement, or of strain for a test without specimen."""
        return DisplayUnit("", 1.0) if test.specimen is None else self.length

    def format_contact_and_zero_scatter(self, jitter: ReplicateJitterRecord,
                                        tests: Sequence[Test]) -> tuple[str, str]:
        """Return two texts: standard deviations of contact point and of force zero between recordings, with units.

        The scatter is a length and a force, or a strain and a stress if no test has a specimen.
        """
        test = self.choose_first_specimen_test_or_first(tests)
        contact = jitter.contact_mm * 1e-3
        return self.get_displacement_unit(test).format_quantity(contact, 2) + (" of strain" if test.specimen is None
                                                                               else ""), \
            self.get_load_unit(test).format_quantity(jitter.zero_N, 2)

    @staticmethod
    def choose_first_specimen_test_or_first(tests: Sequence[Test]) -> Test:
        """Return the test that decides the units of common quantities: the first with a specimen, else the first."""
        return next((test for test in tests if test.specimen is not None), tests[0])

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
