"""Consistent unit systems of finite-element input files, which state no units themselves."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words


@dataclass(frozen=True)
class UnitSystem:
    """Consistent unit system: lengths, forces and times, from which all other units follow.

    The time is the second in all systems.

    Attributes:
        name: name on the command line, such as ``"mm-N-MPa"``.
        length: one unit of length, m.
        force: one unit of force, N.
        mass_name: name of the unit of mass that makes the system consistent.
        stress_name: name of the unit of stress.

    Examples:
        >>> find_unit_system("mm-N-MPa").stress
        1000000.0
    """

    name: str
    length: float
    force: float
    mass_name: str
    stress_name: str

    def describe(self) -> str:
        """Return the units as a sentence for a comment: ``Units (mm-N-MPa): mm, N, s, stress MPa, density t/mm3.``."""
        length, force = ("m", "N") if self.name == SI.name else self.name.split("-")[:2]
        return (f"Units ({self.name}): {length}, {force}, s, stress {self.stress_name}, density "
                f"{self.mass_name}/{length}3.")

    @property
    def stress(self) -> float:
        """One unit of stress, Pa."""
        return self.force / self.length**2

    @property
    def mass(self) -> float:
        """One unit of mass, kg: force s^2 / length."""
        return self.force / self.length

    @property
    def density(self) -> float:
        """One unit of density, kg/m3: force s^2 / length^4."""
        return self.force / self.length**4


#: International system: m, N, kg, Pa.
SI = UnitSystem("SI", 1.0, 1.0, "kg", "Pa")
#: Name -> unit system.
UNIT_SYSTEMS = {system.name: system for system in (
    SI, UnitSystem("mm-N-MPa", 1e-3, 1.0, "t", "MPa"), UnitSystem("mm-mN-kPa", 1e-3, 1e-3, "kg", "kPa"))}


def find_unit_system(name: str, field: str = "--units") -> UnitSystem:
    """Return the unit system of a name.

    Args:
        name: key of `UNIT_SYSTEMS`.
        field: field of the name, for the message.

    Raises:
        InputError: unknown name.
    """
    if name not in UNIT_SYSTEMS:
        raise InputError(f"unknown unit system {name!r}{make_hint_with_similar_or_known_words(name, UNIT_SYSTEMS)}",
                         field=field)
    return UNIT_SYSTEMS[name]
