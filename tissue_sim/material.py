"""A material: law, parameters, bulk response."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.laws import Law, find_law

#: K / mu0 inside which the finite elements are checked.
BULK_RATIOS = (10.0, 1e6)


def incompressible_ratio(radius: float, height: float) -> float:
    """K / mu0 that the finite elements use for a cylinder of a material stated as incompressible.

    Compressibility costs force in proportion to (radius / height)^2 mu0 / K. With this ratio bonded compression loses
    1e-5 at radius 40 and height 70 mm; flat specimens get the highest ratio that is checked, and lose 5e-5 at five
    times as wide as high, 3e-4 at ten times.
    """
    return min(BULK_RATIOS[1], 1e5 * max(1.0, 3.0 * (radius / height) ** 2))


@dataclass(frozen=True)
class Bulk:
    """Volumetric response U(J) = K/2 (J - 1)^2, stated in one of four ways.

    Attributes:
        kind: ``"K_Pa"``, ``"D1_per_Pa"`` (K = 2/D1), ``"bulk_ratio"`` (K/mu0) or ``"incompressible"``.
        value: the number that goes with it; None for incompressible.
    """

    kind: str = "incompressible"
    value: float | None = None

    def __post_init__(self):
        if self.kind not in ("K_Pa", "D1_per_Pa", "bulk_ratio", "incompressible"):
            raise InputError(f"unknown bulk response {self.kind!r}; known: K_Pa, D1_per_Pa, bulk_ratio, incompressible",
                             field="bulk")
        if self.kind == "incompressible":
            if self.value is not None:
                raise InputError("an incompressible material takes no bulk value", field="bulk.incompressible")
        elif self.value is None or not np.isfinite(self.value) or self.value <= 0:
            raise InputError(f"{self.value} is not a positive number", field=f"bulk.{self.kind}")

    def modulus(self, mu0: float) -> float:
        """Bulk modulus in Pa for a material of initial shear modulus mu0; infinite for incompressible."""
        match self.kind:
            case "K_Pa":
                return self.value
            case "D1_per_Pa":
                return 2.0 / self.value
            case "bulk_ratio":
                return self.value * mu0
            case _:
                return np.inf


@dataclass(frozen=True)
class Material:
    """A strain-energy law with its parameters and its bulk response.

    Attributes:
        law: name in `tissue_sim.laws.LAWS`.
        parameters: name -> value, SI (Pa, or 1 for exponents); read-only after construction.
        bulk: volumetric response.
        density: kg/m3, or None where nobody said.
        name: for people.

    Raises:
        InputError: unknown law or parameter, or parameters whose shear modulus at rest is not positive.
    """

    law: str
    parameters: Mapping[str, float]
    bulk: Bulk = field(default_factory=Bulk)
    density: float | None = None
    name: str = ""

    def __post_init__(self):
        object.__setattr__(self, "parameters", MappingProxyType(self.energy_law.as_mapping(self.parameters)))
        if not self.mu0 > 0:
            raise InputError(f"these parameters give a shear modulus of {self.mu0:g} Pa at rest; it must be positive",
                             field="parameters")
        if self.density is not None and not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"{self.density} is not a positive density", field="density_kg_m3")

    @property
    def energy_law(self) -> Law:
        return find_law(self.law)

    @property
    def values(self) -> np.ndarray:
        """Parameters in the order of the law, shape (m,)."""
        return self.energy_law.as_array(self.parameters)

    @property
    def mu0(self) -> float:
        """Initial shear modulus, Pa."""
        return self.energy_law.mu0(self.parameters)

    @property
    def E0(self) -> float:
        """Initial Young's modulus, Pa: 9 K mu0 / (3 K + mu0), which is 3 mu0 for an incompressible material."""
        K = self.bulk_modulus
        return 3.0 * self.mu0 if np.isinf(K) else 9.0 * K * self.mu0 / (3.0 * K + self.mu0)

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus K, Pa; infinite for an incompressible material."""
        return self.bulk.modulus(self.mu0)
