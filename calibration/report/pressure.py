"""Pressures for people: Pa, kPa, MPa or GPa, whichever leaves one to three digits before the point."""

from __future__ import annotations

import math

#: Unit -> its size in Pa, largest first.
PRESSURE_UNITS = {"GPa": 1e9, "MPa": 1e6, "kPa": 1e3, "Pa": 1.0}


def pressure_unit(pressure: float) -> tuple[str, float]:
    """Unit that suits a pressure in Pa, and its size in Pa; Pa for zero and for what is not finite."""
    size = abs(pressure)
    if math.isfinite(size):
        # As it will be written: 999.999 Pa is 1 kPa.
        size = float(f"{size:.4g}")
        for unit, factor in PRESSURE_UNITS.items():
            if size >= factor:
                return unit, factor
    return "Pa", 1.0


def format_pressure(pressure: float, digits: int = 5) -> str:
    """``8429.6`` Pa -> ``'8.4296 kPa'``."""
    unit, factor = pressure_unit(pressure)
    return f"{pressure / factor:.{digits}g} {unit}"
