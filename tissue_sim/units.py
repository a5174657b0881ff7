"""Units at the rim: names as they stand in headers and keys, factors to SI."""

from __future__ import annotations

import math
import re

from tissue_sim.errors import InputError, nearest

# unit -> (quantity, factor to SI, offset added after the factor)
UNITS: dict[str, tuple[str, float, float]] = {
    "s": ("time", 1.0, 0.0), "ms": ("time", 1e-3, 0.0), "us": ("time", 1e-6, 0.0), "min": ("time", 60.0, 0.0),
    "m": ("length", 1.0, 0.0), "cm": ("length", 1e-2, 0.0), "mm": ("length", 1e-3, 0.0), "um": ("length", 1e-6, 0.0),
    "nm": ("length", 1e-9, 0.0),
    "N": ("force", 1.0, 0.0), "kN": ("force", 1e3, 0.0), "mN": ("force", 1e-3, 0.0), "uN": ("force", 1e-6, 0.0),
    "nN": ("force", 1e-9, 0.0),
    "Nm": ("torque", 1.0, 0.0), "mNm": ("torque", 1e-3, 0.0), "Nmm": ("torque", 1e-3, 0.0),
    "Pa": ("stress", 1.0, 0.0), "kPa": ("stress", 1e3, 0.0), "MPa": ("stress", 1e6, 0.0), "GPa": ("stress", 1e9, 0.0),
    "N/mm^2": ("stress", 1e6, 0.0), "N/mm2": ("stress", 1e6, 0.0),
    "-": ("ratio", 1.0, 0.0), "1": ("ratio", 1.0, 0.0), "%": ("ratio", 1e-2, 0.0),
    "degC": ("temperature", 1.0, 273.15), "K": ("temperature", 1.0, 0.0),
}
_SPELLINGS = {"µm": "um", "μm": "um", "µN": "uN", "μN": "uN", "°C": "degC", "sec": "s", "N.mm": "Nmm",
              "N/mm²": "N/mm^2"}
#: SI unit -> unit in which people are shown a value, and that many of them in one SI unit; any other as it is.
_SHOWN = {"Pa": ("kPa", 1e-3), "1/Pa": ("1/MPa", 1e6), "m": ("mm", 1e3), "m2/s": ("mm²/s", 1e6), "m/N": ("mm/N", 1e3),
          "rad": ("deg", 180.0 / math.pi), "1": ("", 1.0)}
_HEADER = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*$")


def to_si(unit: str, quantity: str | None = None) -> tuple[float, float]:
    """Factor and offset that take a value in `unit` to SI.

    Args:
        unit: such as ``mm``, ``kPa``, ``degC``.
        quantity: ``length``, ``force``, ...: when given, a unit of another quantity is refused.

    Raises:
        InputError: unknown unit, or a unit of another quantity.
    """
    unit = _SPELLINGS.get(unit.strip(), unit.strip())
    if unit not in UNITS:
        raise InputError(f"unknown unit {unit!r}{nearest(unit, UNITS)}")
    found, factor, offset = UNITS[unit]
    if quantity is not None and found != quantity:
        wanted = ", ".join(name for name, entry in UNITS.items() if entry[0] == quantity)
        raise InputError(f"unit {unit!r} is a {found}, expected a {quantity} ({wanted})")
    return factor, offset


def shown(unit: str) -> tuple[str, float]:
    """The unit in which people are shown values of an SI unit, and the factor that takes them there."""
    return _SHOWN.get(unit, (unit, 1.0))


def split_header(header: str) -> tuple[str, str | None]:
    """``'Load (N)'`` -> ``('Load', 'N')``; ``'Stretch'`` -> ``('Stretch', None)``."""
    match = _HEADER.match(header.strip())
    if not match:
        return header.strip(), None
    return match["name"].strip(), match["unit"].strip()
