"""Units in files: names in headers and keys, and factors to SI."""

from __future__ import annotations

import math
import re

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words

#: Standard gravity, m/s2, for forces in grams (BIPM, SI brochure).
_G = 9.80665
#: Pound, kg (NIST SP 811).
_LB = 0.45359237
#: Inch, m.
_IN = 0.0254
#: Quantity -> unit -> factor to SI.
_FACTORS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": _IN, "mil": 1e-3 * _IN},
    # In a column of forces, grams are the reading of a balance.
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "pN": 1e-12, "cN": 1e-2, "dyn": 1e-5,
              "g": 1e-3 * _G, "gf": 1e-3 * _G, "mg": 1e-6 * _G, "kg": _G, "kgf": _G, "lb": _LB * _G, "lbf": _LB * _G,
              "ozf": _LB * _G / 16},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6, "Nmm": 1e-3},
    "frequency": {"Hz": 1.0, "mHz": 1e-3, "kHz": 1e3, "rad/s": 0.5 / math.pi, "1/min": 1.0 / 60.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "stress": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm^2": 1e6, "N/mm2": 1e6, "N/cm2": 1e4, "N/m2": 1.0,
               "bar": 1e5, "psi": _LB * _G / _IN**2, "ksi": 1e3 * _LB * _G / _IN**2, "g/mm2": 1e3 * _G,
               "kgf/cm2": 1e4 * _G},
    "ratio": {"-": 1.0, "1": 1.0, "%": 1e-2, "mm/mm": 1.0, "m/m": 1.0, "in/in": 1.0},
    # Outputs of a converter; the factor to the measured quantity depends on the sensor.
    "signal": {"V": 1.0, "mV": 1.0, "mV/V": 1.0, "counts": 1.0},
}
#: Unit -> (quantity, factor to SI, offset added after the factor).
UNITS: dict[str, tuple[str, float, float]] = {
    **{unit: (quantity, factor, 0.0) for quantity, units in _FACTORS.items() for unit, factor in units.items()},
    "degC": ("temperature", 1.0, 273.15), "K": ("temperature", 1.0, 0.0),
}
#: Other spelling -> name in `UNITS`.
_SPELLINGS = {"µm": "um", "μm": "um", "µN": "uN", "μN": "uN", "°C": "degC", "sec": "s", "N.mm": "Nmm", "N mm": "Nmm",
              "N m": "Nm", "mN m": "mNm", "mN·m": "mNm", "N·mm": "Nmm",
              "hz": "Hz", "Hertz": "Hz", "rad/sec": "rad/s", "rad s-1": "rad/s", "rad s^-1": "rad/s",
              "rad·s-1": "rad/s",
              "°": "deg", "degree": "deg", "degrees": "deg", "Grad": "deg", "radian": "rad", "radians": "rad",
              "turns": "rev", "N·m": "Nm", "N.m": "Nm", "µN.m": "uNm", "µNm": "uNm",
              "N/mm²": "N/mm^2", "N/cm²": "N/cm2", "N/m²": "N/m2", "kgf/cm²": "kgf/cm2",
              "S": "s", "Sec": "s", "SEC": "s", "secs": "s",
              "second": "s", "seconds": "s", "Seconds": "s", "msec": "ms",
              "minutes": "min", "µs": "us", "μs": "us", "hr": "h", "hours": "h",
              "micron": "um", "microns": "um", "inch": "in", "inches": "in", "Newton": "N", "Newtons": "N",
              "grams": "g", "gram": "g", "Gms": "g", "gr": "g", "gmf": "gf", "lbs": "lb", "pound": "lb",
              "percent": "%", "volt": "V", "Volt": "V", "volts": "V", "Volts": "V", "count": "counts",
              "Counts": "counts", "cts": "counts", "digits": "counts", "bits": "counts"}
#: The looser ways in which foreign headers state a unit: ``Fz, N``, ``Kraft / N``, ``Force_N``, ``Kraft in N``.
_LOOSE = (re.compile(r"^(?P<name>.*\S)\s*,\s*(?P<unit>\S+)$"), re.compile(r"^(?P<name>.*\S)\s*/\s*(?P<unit>\S+)$"),
          re.compile(r"^(?P<name>.*\S)_(?P<unit>[^_\s]+)$"), re.compile(r"^(?P<name>.*\S)\s+in\s+(?P<unit>\S+)$"))
#: SI unit -> unit in which people are shown a value, and that many of them in one SI unit; any other as it is.
_SHOWN = {"Pa": ("kPa", 1e-3), "1/Pa": ("1/MPa", 1e6), "m": ("mm", 1e3), "m2/s": ("mm²/s", 1e6), "m/N": ("mm/N", 1e3),
          "rad": ("deg", 180.0 / math.pi), "1": ("", 1.0)}
#: Longest header that is searched for a unit, characters; the time of the search grows faster than the length.
_LONGEST_HEADER = 300
_HEADER = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*$")


def get_si_factor_and_offset(unit: str, quantity: str | None = None) -> tuple[float, float]:
    """Return factor and offset that convert a value in a unit to SI.

    Args:
        unit: such as ``mm``, ``kPa``, ``degC``.
        quantity: ``length``, ``force``, ...; None: any.

    Raises:
        InputError: unknown unit, or a unit of another quantity.

    Examples:
        >>> get_si_factor_and_offset("mm")
        (0.001, 0.0)
        >>> factor, offset = get_si_factor_and_offset("degC")
        >>> 20.0 * factor + offset
        293.15
    """
    unit = find_known_unit_or_none(unit) or unit.strip()
    if unit not in UNITS:
        raise InputError(f"unknown unit {unit!r}{make_hint_with_similar_or_known_words(unit, UNITS)}")
    found, factor, offset = UNITS[unit]
    if quantity is not None and found != quantity:
        possible = ", ".join(name for name, entry in UNITS.items() if entry[0] == quantity)
        raise InputError(f"unit {unit!r} is a {found}, expected a {quantity} ({possible})")
    return factor, offset


def find_known_unit_or_none(text: str) -> str | None:
    """Return the name in `UNITS` of a unit in another spelling or in brackets; None for an unknown unit.

    Examples:
        >>> find_known_unit_or_none("(sec)")
        's'
    """
    text = text.strip()
    if text[:1] in ("[", "(") and text[-1:] in ("]", ")"):
        text = text[1:-1].strip()
    text = _SPELLINGS.get(text, text)
    return text if text in UNITS else None


def find_quantity_of_unit_or_none(unit: str | None) -> str | None:
    """Return the quantity of a unit, such as ``force``, or ``signal`` for volts and counts; None for an unknown unit.

    Examples:
        >>> find_quantity_of_unit_or_none("kPa"), find_quantity_of_unit_or_none("mV")
        ('stress', 'signal')
    """
    name = None if unit is None else find_known_unit_or_none(unit)
    return None if name is None else UNITS[name][0]


def get_display_unit_and_factor(unit: str) -> tuple[str, float]:
    """Return the unit in which values of an SI unit are displayed, and the factor from SI to it.

    Examples:
        >>> get_display_unit_and_factor("Pa")
        ('kPa', 0.001)
    """
    return _SHOWN.get(unit, (unit, 1.0))


def split_header_with_brackets(header: str) -> tuple[str, str | None]:
    """Split a header with the unit in brackets into name and unit; the unit is None without brackets.

    Examples:
        >>> split_header_with_brackets("Load (N)")
        ('Load', 'N')
    """
    match = _HEADER.match(header.strip()) if len(header) <= _LONGEST_HEADER else None
    if not match:
        return header.strip(), None
    return match["name"].strip(), match["unit"].strip()


def split_header_and_known_unit(header: str) -> tuple[str, str | None]:
    """Split a header of a testing machine without brackets, such as ``'Fz, gf'``, into name and unit; None: no unit.

    Only a known unit is split off: ``Run_2`` and ``Position (z)`` are names without a unit.

    Examples:
        >>> split_header_and_known_unit("Weg / mm")
        ('Weg', 'mm')
        >>> split_header_and_known_unit("Run_2")
        ('Run_2', None)
    """
    name, unit = split_header_with_brackets(header)
    if unit is not None:
        return (name, unit) if find_known_unit_or_none(unit) else (header.strip(), None)
    for pattern in _LOOSE if len(header) <= _LONGEST_HEADER else ():
        match = pattern.match(name)
        if match and find_known_unit_or_none(match["unit"]) not in (None, "1"):
            return match["name"].strip(), match["unit"]
    return name, None
