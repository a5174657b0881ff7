"""Units for people: one of each quantity through a whole report, whichever leaves readable numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.campaign.campaign import Test
    from calibration.fit.fit import Fit, JitterStatement
    from calibration.fit.result import CalibrationResult

#: Unit -> its size in SI, largest first.
PRESSURE_UNITS = {"GPa": 1e9, "MPa": 1e6, "kPa": 1e3, "Pa": 1.0}
_FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "µN": 1e-6, "nN": 1e-9}
_LENGTH_UNITS = {"mm": 1e-3, "µm": 1e-6, "nm": 1e-9}
#: An error is some hundredth of what it is an error of.
_ERROR_SHARE = 1e-2


@dataclass(frozen=True)
class Unit:
    """A unit's name, empty for a number, and its size in SI."""

    name: str
    size: float

    def text(self, value: float, digits: int) -> str:
        """A number in SI with so many significant digits: ``0.047 N``."""
        return f"{float(f'{value / self.size:.{digits}g}'):g} {self.name}".rstrip()

    def label(self, name: str) -> str:
        """Of an axis or a column: ``force [N]``."""
        return f"{name} [{self.name}]" if self.name else name


@dataclass(frozen=True)
class Units:
    """Those of one report."""

    length: Unit
    force: Unit
    pressure: Unit

    @classmethod
    def of(cls, result: CalibrationResult) -> Units:
        """Pressure: by the shear modulus of the best law. Force and length: mm and N, smaller ones where the tests
        are: 2 µm of travel are no 0.002 mm."""
        return cls.of_fit(result.best)

    @classmethod
    def of_fit(cls, fit: Fit) -> Units:
        """As `of`, by one fit."""
        travel = max((region.end * 1e-3 for region in fit.regions), default=1e-3)
        force = 1.0 if fit.RMSE_N is None else fit.RMSE_N / _ERROR_SHARE
        return cls.of_sizes(travel, force, fit.mu0)

    @classmethod
    def of_sizes(cls, travel: float, force: float, modulus: float) -> Units:
        """As `of`, by the size of displacements, m, forces, N, and stiffness, Pa."""
        return cls(_unit(_LENGTH_UNITS, 10 * travel), _unit(_FORCE_UNITS, 10 * force), Unit(*pressure_unit(modulus)))

    def load(self, test: Test) -> Unit:
        """Of a force, or of a stress where the test has no specimen."""
        return self.pressure if test.specimen is None else self.force

    def travel(self, test: Test) -> Unit:
        """Of a displacement, or of a strain where the test has no specimen."""
        return Unit("", 1.0) if test.specimen is None else self.length

    def scatter(self, jitter: JitterStatement, tests: Sequence[Test]) -> tuple[str, str]:
        """Scatter of contact point and zero: a length and a force, or a strain and a stress where no test has a
        specimen."""
        test = self.typical(tests)
        contact = jitter.contact_mm * 1e-3
        return self.travel(test).text(contact, 2) + (" of strain" if test.specimen is None else ""), \
            self.load(test).text(jitter.zero_N, 2)

    @staticmethod
    def typical(tests: Sequence[Test]) -> Test:
        """The first test with a specimen, of which what the recordings share is written; the first where none has."""
        return next((test for test in tests if test.specimen is not None), tests[0])

    def of_parameter(self, unit: str) -> Unit:
        """That in which a parameter is written whose unit in SI is `unit`."""
        known = {"Pa": self.pressure, "N": self.force, "m": self.length, "1": Unit("", 1.0),
                 "m/N": Unit("mm/N", 1e-3), "m2/s": Unit("mm²/s", 1e-6), "N s/m": Unit("N s/mm", 1e3),
                 "1/m": Unit("1/mm", 1e3), "rad": Unit("°", math.pi / 180)}
        return known.get(unit, Unit(unit, 1.0))


def _unit(units: Mapping[str, float], size: float) -> Unit:
    """The largest unit that `size` reaches; the smallest where it reaches none."""
    return Unit(*next((pair for pair in units.items() if size >= pair[1]), [*units.items()][-1]))


def pressure_unit(pressure: float) -> tuple[str, float]:
    """Unit that suits a pressure in Pa, and its size in Pa; Pa for zero and for what is not finite."""
    # As it will be written: 999.999 Pa is 1 kPa.
    size = float(f"{abs(pressure):.4g}") if math.isfinite(pressure) else 0.0
    unit = _unit(PRESSURE_UNITS, size)
    return unit.name, unit.size


def format_pressure(pressure: float, digits: int = 5) -> str:
    """``8429.6`` Pa -> ``'8.4296 kPa'``."""
    unit, factor = pressure_unit(pressure)
    return f"{pressure / factor:.{digits}g} {unit}"
