"""A material: law, parameters, bulk response, and what time and loading history do to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.frozen_mapping import read_only
from tissue_sim.laws import Law, find_law
from tissue_sim.material.effect import ReducedEffect, TissueEffect
from tissue_sim.material.layer import Layer
from tissue_sim.material.poroelasticity import Poroelasticity
from tissue_sim.material.puncture import Puncture
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import MOST_TERMS, Prony
from tissue_sim.parameters import Declaration

#: K / mu0 inside which the finite elements are checked; 2.17 is a Poisson's ratio of 0.3.
BULK_RATIOS = (2.0, 1e6)
#: What the number of a bulk response is.
_BULK = {
    "K_Pa": Declaration("K", "Pa", (1.0, 1e12), key="K_Pa"),
    "D1_per_Pa": Declaration("D1", "1/Pa", (2e-12, 2.0), key="D1_per_Pa"),
    "bulk_ratio": Declaration("K/mu", "1", BULK_RATIOS, key="bulk_ratio"),
}
#: Exponents and other numbers of a law that have no unit may run so far in a fit.
EXPONENT_BOUND = 50.0


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

    def own_parameters(self) -> dict[str, tuple[Declaration, float]]:
        """The number of this response by its kind; see `tissue_sim.parameters`."""
        return {} if self.value is None else {self.kind: (_BULK[self.kind], float(self.value))}

    def with_own_parameters(self, values: Mapping[str, float]) -> Bulk:
        """With another number."""
        return Bulk(self.kind, values[self.kind])

    def modulus(self, mu0: float) -> float:
        """Bulk modulus in Pa for a material of initial shear modulus mu0; infinite for incompressible."""
        if self.value is None:
            return np.inf
        match self.kind:
            case "K_Pa":
                return self.value
            case "D1_per_Pa":
                return 2.0 / self.value
            case _:
                return self.value * mu0


@dataclass(frozen=True)
class Material:
    """A strain-energy law with its parameters, its bulk response, and what is lost with time and loading.

    Attributes:
        law: name in `tissue_sim.laws.LAWS`.
        parameters: name -> value, SI (Pa, or 1 for exponents); read-only after construction.
        bulk: volumetric response; it does not relax and does not soften.
        density: kg/m3, or None where nobody said.
        name: for people.
        viscoelastic: Prony series of the isochoric stress, which also says whether `parameters` are instantaneous or
            long-term.
        softening: on first load.
        layers: from the top face down.
        regions: name of a region of the specimen's mesh -> what is there instead; only a solid in space has any.
        poroelasticity: drainage, with a time of each test's own.
        puncture: under a needle.
        effects: what was added beside these, by name; see `tissue_sim.material.effect`. A sequence of effects is
            taken, too.

    Raises:
        InputError: unknown law or parameter, parameters whose shear modulus at rest is not positive, or relaxing terms
            and drainage that together are too many or leave nothing.
    """

    law: str
    parameters: Mapping[str, float]
    bulk: Bulk = field(default_factory=Bulk)
    density: float | None = None
    name: str = ""
    viscoelastic: Prony | None = None
    softening: Softening | None = None
    layers: tuple[Layer, ...] = ()
    poroelasticity: Poroelasticity | None = None
    puncture: Puncture | None = None
    effects: Mapping[str, TissueEffect] = field(default_factory=dict)
    regions: Mapping[str, Material] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "regions", read_only(dict(self.regions)))
        for name, own in self.regions.items():
            if not name or set(name) & set(".[]"):
                raise InputError(f"{name!r} cannot be the name of a region: it is part of the paths of its parameters; "
                                 "give it one without dots and brackets, in the mesh, too", field="regions")
            if own.layers or own.regions or own.effects or own.puncture is not None:
                raise InputError("a region has no layers, regions, effects or puncture of its own; leave them out",
                                 field=f"regions.{name}")
        object.__setattr__(self, "effects", read_only(_by_name(self.effects)))
        object.__setattr__(self, "parameters", read_only(self.energy_law.as_mapping(self.parameters)))
        object.__setattr__(self, "layers", tuple(self.layers))
        if not self.mu0 > 0:
            raise InputError(f"these parameters give a shear modulus of {self.mu0:g} Pa at rest; it must be positive",
                             field="parameters")
        if self.density is not None and not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"{self.density} is not a positive density", field="density_kg_m3")
        if self._drained > 0:
            if self.viscoelastic is not None and len(self.viscoelastic.terms) == MOST_TERMS:
                raise InputError(f"drainage takes one of the {MOST_TERMS} relaxing terms that a material may have; "
                                 f"give {MOST_TERMS - 1} viscoelastic ones at most", field="poroelasticity")
            if not self.mu_long_term > 0:
                raise InputError("phi and the g of all viscoelastic terms add up to 1 or more; they must stay below 1, "
                                 "or nothing carries a constant load", field="poroelasticity.phi")

    def own_parameters(self) -> dict[str, tuple[Declaration, float]]:
        """Those of the law, by name; see `tissue_sim.parameters`."""
        return {name: (law_declaration(self.energy_law, name), value) for name, value in self.parameters.items()}

    def with_own_parameters(self, values: Mapping[str, float], **changes: Any) -> Material:
        """With other parameters of the law, and other fields."""
        return replace(self, parameters={**self.parameters, **values}, **changes)

    @property
    def ages(self) -> bool:
        """Whether its force depends on time."""
        return (self.viscoelastic is not None or self.poroelasticity is not None
                or any(effect.ages for effect in self.effects.values())
                or any(own.ages for own in self.regions.values()))

    @property
    def remembers(self) -> bool:
        """Whether its force depends on how the tool came to where it is."""
        return (self.ages or self.softening is not None
                or any(effect.remembers for effect in self.effects.values())
                or any(own.remembers for own in self.regions.values()))

    def reduced_effects(self, *, plate: bool) -> tuple[ReducedEffect, ...]:
        """The effects in reduced form that act under a plate, or else under a needle."""
        return tuple(part for part in (self.puncture, *self.effects.values())
                     if isinstance(part, ReducedEffect) and (part.under_plates or not plate))

    @property
    def energy_law(self) -> Law:
        return find_law(self.law)

    @property
    def values(self) -> np.ndarray:
        """Parameters in the order of the law, shape (m,)."""
        return self.energy_law.as_array(self.parameters)

    @property
    def instantaneous_factor(self) -> float:
        """Instantaneous stress over that of the law with `parameters`; 1 unless these are long-term."""
        return 1.0 if self.viscoelastic is None else self.viscoelastic.instantaneous_factor

    @cached_property
    def mu0(self) -> float:
        """Initial shear modulus in instantaneous loading, Pa."""
        return self.instantaneous_factor * self.energy_law.mu0(self.parameters)

    @property
    def mu_long_term(self) -> float:
        """Initial shear modulus in very slow loading, Pa: all terms relaxed, pores drained."""
        relaxing = 0.0 if self.viscoelastic is None else self.viscoelastic.relaxing
        return self.mu0 * (1.0 - relaxing - self._drained)

    @property
    def E0(self) -> float:
        """Initial Young's modulus in instantaneous loading, Pa: 9 K mu0 / (3 K + mu0); 3 mu0 if incompressible."""
        return self._young(self.mu0)

    @property
    def E_long_term(self) -> float:
        """Initial Young's modulus in very slow loading, Pa; the bulk modulus does not relax."""
        return self._young(self.mu_long_term)

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus K, Pa; infinite for an incompressible material. `bulk_ratio` is that to `mu0`."""
        return self.bulk.modulus(self.mu0)

    def relaxation(self, contact_radius: float | None) -> Prony | None:
        """All that relaxes in a test with this contact radius (m): viscoelastic terms, then drainage.

        Returns:
            A series of instantaneous moduli, or None where nothing relaxes.

        Raises:
            InputError: drainage and no radius, or one that is not positive and finite.
        """
        terms = () if self.viscoelastic is None else self.viscoelastic.terms
        if self.poroelasticity is not None and self.poroelasticity.phi > 0:
            terms = (*terms, self.poroelasticity.term(contact_radius))
        return Prony(terms) if terms else None

    @property
    def _drained(self) -> float:
        return 0.0 if self.poroelasticity is None else self.poroelasticity.phi

    def _young(self, mu: float) -> float:
        K = self.bulk_modulus
        return 3.0 * mu if np.isinf(K) else 9.0 * K * mu / (3.0 * K + mu)


def bulk_declaration(kind: str) -> Declaration | None:
    """What the number of a kind of bulk response is; None where there is no such kind."""
    return _BULK.get(kind)


def law_declaration(law: Law, name: str) -> Declaration:
    """What a parameter of a law is."""
    unit = law.units[name]
    reach = EXPONENT_BOUND if unit == "1" else np.inf
    return Declaration(name, unit, (-reach, reach), key=name)


def _by_name(effects: Mapping[str, TissueEffect] | Iterable[TissueEffect]) -> dict[str, TissueEffect]:
    """Effects by their names.

    Raises:
        InputError: two of one name, or something that is no effect.
    """
    given = list(effects.values() if isinstance(effects, Mapping) else effects)
    by_name: dict[str, TissueEffect] = {}
    for effect in given:
        if not isinstance(effect, TissueEffect):
            raise InputError(f"{type(effect).__name__} is no effect of a tissue; derive it from "
                             "tissue_sim.TissueEffect", field="effects")
        if effect.name in by_name:
            raise InputError(f"{effect.name!r} stands there twice; a material has an effect once", field="effects")
        by_name[effect.name] = effect
    return by_name
