"""Units in which messages state motion and load of a recording: mm and N, strain and kPa, degrees and mN m."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class CurveUnits:
    """Units of the motion and the load of a curve in messages and figures.

    Attributes:
        motion_name: name of the motion.
        motion_unit: unit of the motion, with a leading blank; empty for a strain.
        motion_factor: factor from SI to this unit.
        load_name: name of the load.
        load_unit: unit of the load.
        load_factor: factor from SI to this unit.
    """

    motion_name: str
    motion_unit: str
    motion_factor: float
    load_name: str
    load_unit: str
    load_factor: float

    def with_numbers_of_file(self, *, motion: bool, load: bool) -> CurveUnits:
        """Return these units for a recording whose `motion` or `load` has the numbers of the file, in unknown units."""
        units = replace(self, motion_unit=UNKNOWN_UNIT, motion_factor=1.0) if motion else self
        return replace(units, load_unit=UNKNOWN_UNIT.strip(), load_factor=1.0) if load else units

    @property
    def motion_label(self) -> str:
        """Label of an axis of the motion."""
        return f"{self.motion_name} [{self.motion_unit.strip()}]" if self.motion_unit else self.motion_name

    @property
    def load_label(self) -> str:
        """Label of an axis of the load."""
        return f"{self.load_name} [{self.load_unit}]"

    def format_motion(self, value: float, digits: int = 4) -> str:
        """Return a motion in SI with its unit."""
        return f"{self.motion_factor * value:.{digits}g}{self.motion_unit}"

    def format_load(self, value: float, digits: int = 4) -> str:
        """Return a load in SI with its unit."""
        return f"{self.load_factor * value:.{digits}g} {self.load_unit}"


#: Words after a number whose unit is unknown, with a leading blank.
UNKNOWN_UNIT = " (unit not stated)"
#: Displacement and force.
FORCE_UNITS = CurveUnits("displacement", " mm", 1e3, "force", "N", 1.0)
#: Strain and nominal stress.
STRESS_UNITS = CurveUnits("strain", "", 1.0, "stress", "kPa", 1e-3)
#: Angle and torque.
TORQUE_UNITS = CurveUnits("angle", " deg", math.degrees(1.0), "torque", "mN m", 1e3)
#: Channel of the load -> units.
UNITS_OF_LOAD = {"force": FORCE_UNITS, "nominal stress": STRESS_UNITS, "torque": TORQUE_UNITS}
