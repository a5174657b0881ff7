"""Material: law, parameters, bulk response, layers, and effects of time and loading history.

The parts of a material besides its law have declarations by path, and materials are made from numbers by path.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.laws import LAWS, Law, find_law
from tissue_sim.material.effect import EFFECTS, ForceScalingEffect, TissueEffect
from tissue_sim.material.force_scaling import Puncture
from tissue_sim.material.fractional_zener import FractionalRelaxation, FractionalZener
from tissue_sim.material.softening import Softening, SofteningForm
from tissue_sim.material.viscoelasticity import MOST_TERMS, Poroelasticity, Prony, PronyTerm, RelaxationSeries
from tissue_sim.parameters import (
    Declaration,
    list_field_declarations,
    parameter,
    parameters,
    split_path_into_names_and_indices,
    with_values,
)
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.settings import make_shallow_read_only_copy


@dataclass(frozen=True)
class Layer:
    """Layer of the specimen, counted from its top face downwards; the material itself is below the last layer.

    Attributes:
        thickness: m, in the same state as the specimen's height: undeformed, or settled under its weight.
        ratio: factor on every modulus of the material, bulk included; 1 is absent.
    """

    thickness: float = parameter("h", "m", key="thickness_mm", factor=1e-3, bounds=(1e-6, 1.0), shapes_mesh=True)
    ratio: float = parameter("k", "1", key="modulus_ratio", bounds=(1e-3, 1e3), absent=1.0)

    def __post_init__(self):
        if not 0 < self.thickness < np.inf:
            raise InputError(f"must be positive and finite; got {self.thickness:g} m.", field="thickness")
        if not 0 < self.ratio < np.inf:
            raise InputError(f"must be a positive finite factor on the moduli of the material below; got "
                             f"{self.ratio:g}.", field="ratio")


#: Range of K / mu0 for which the finite elements are verified, 1; 2.17 is a Poisson's ratio of 0.3.
BULK_RATIOS = (2.0, 1e6)
#: Largest K / mu0 of a compressible law in the finite elements, 1: a Poisson's ratio of 0.45. Displacement elements
#: become too stiff above it.
LARGEST_BULK_RATIO_OF_COMPRESSIBLE_LAW = 10.0
#: Kind of bulk response -> declaration of its number.
_BULK = {
    "K_Pa": Declaration("K", "Pa", (1.0, 1e12), key="K_Pa"),
    "D1_per_Pa": Declaration("D1", "1/Pa", (2e-12, 2.0), key="D1_per_Pa"),
    "bulk_ratio": Declaration("K/mu", "1", BULK_RATIOS, key="bulk_ratio"),
}
#: Kind of bulk response without a number -> the material that has it.
_BULK_WITHOUT_NUMBER = {"incompressible": "an incompressible material", "of_law": "a compressible law"}
#: Longest relaxation times after which tissue without a tool has forgotten its path, 1: 0.7 % of the stress remains.
MEMORY_TIMES = 5.0
#: Largest absolute value, in a fit, of an exponent or another parameter without unit for which the law has no bounds.
EXPONENT_BOUND = 50.0


def compute_finite_bulk_to_shear_ratio(radius: float, height: float) -> float:
    """Return the finite ratio K / mu0 that replaces infinity for a cylinder of an incompressible material.

    Compressibility reduces the force in proportion to (radius / height)^2 mu0 / K. With this ratio bonded compression
    loses 1e-5 of its force at radius 40 and height 70 mm. Flat specimens get the highest verified ratio; the loss is
    5e-5 if they are five times as wide as high, 3e-4 if ten times.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
    """
    return min(BULK_RATIOS[1], 1e5 * max(1.0, 3.0 * (radius / height) ** 2))


@dataclass(frozen=True)
class Bulk:
    """Volumetric response U(J) = K/2 (J - 1)^2, stated in one of four ways, or that of the law itself.

    Attributes:
        kind: ``"K_Pa"``, ``"D1_per_Pa"`` (K = 2/D1), ``"bulk_ratio"`` (K/mu0), ``"incompressible"``, or ``"of_law"``
            for a compressible law, see `tissue_sim.laws.CompressibleLaw`.
        value: number in the unit of its kind; None for incompressible and of_law.
    """

    kind: str = "incompressible"
    value: float | None = None

    def __post_init__(self):
        if self.kind not in (*_BULK, *_BULK_WITHOUT_NUMBER):
            raise InputError(f"unknown bulk response {self.kind!r}; known: "
                             f"{', '.join((*_BULK, *_BULK_WITHOUT_NUMBER))}", field="bulk")
        if self.kind in _BULK_WITHOUT_NUMBER:
            if self.value is not None:
                raise InputError(f"must not be given for {_BULK_WITHOUT_NUMBER[self.kind]}; got {self.value}.",
                                 field=f"bulk.{self.kind}")
        elif self.value is None or not np.isfinite(self.value) or self.value <= 0:
            raise InputError(f"must be positive and finite; got {self.value}.", field=f"bulk.{self.kind}")

    def non_field_parameters(self) -> dict[str, tuple[Declaration, float]]:
        """Return kind -> (declaration, number) of this response; empty for a response without a number."""
        return {} if self.value is None else {self.kind: (_BULK[self.kind], float(self.value))}

    def with_non_field_parameters(self, values: Mapping[str, float]) -> Bulk:
        """Return a response of the same kind with another number, `values[kind]`."""
        return Bulk(self.kind, values[self.kind])

    @property
    def verified_ratios(self) -> tuple[float, float]:
        """Range of a finite K / mu0 for which the finite elements are verified, 1."""
        return (0.0, LARGEST_BULK_RATIO_OF_COMPRESSIBLE_LAW) if self.kind == "of_law" else BULK_RATIOS

    def modulus(self, mu0: float) -> float:
        """Return the bulk modulus K, Pa, for an initial shear modulus mu0, Pa; infinite without a number."""
        if self.value is None:
            return np.inf
        match self.kind:
            case "K_Pa":
                return self.value
            case "D1_per_Pa":
                return 2.0 / self.value
            case _:
                return self.value * mu0


@with_old_names(ages="is_time_dependent", remembers="is_history_dependent", relaxation="make_prony_series",
                list_acting_reduced_effects="list_acting_force_scaling_effects")
@dataclass(frozen=True)
class Material:
    """Strain-energy law with its parameters, bulk response, and effects of time, loading and depth.

    Attributes:
        law: name in `tissue_sim.laws.LAWS`; an alias is replaced by the name.
        parameters: name -> value, SI (Pa, or 1 for exponents); read-only after construction.
        bulk: volumetric response; it neither relaxes nor softens. Kind ``"of_law"`` for a compressible law, always.
        density: kg/m3; None if unknown.
        name: name in reports.
        viscoelastic: `Prony` series or `FractionalRelaxation` of the isochoric stress; its `moduli` state whether
            `parameters` are instantaneous or long-term.
        softening: Mullins effect.
        layers: layers from the top face downwards.
        regions: name of a region of the specimen's mesh -> material of that region; three-dimensional solvers only.
        poroelasticity: drainage, whose relaxation time depends on the contact radius of a test.
        puncture: drop of the force of a needle.
        effects: additional effects by name; see `tissue_sim.material.effect`. A sequence of effects is accepted.

    Raises:
        InputError: unknown law or parameter, parameters whose initial shear modulus is not positive, too many relaxing
            terms (drainage included), relaxing fractions whose sum is 1 or more, or a compressible law with a bulk
            response, relaxation, softening, drainage or effects at material points.

    Examples:
        >>> gel = Material("neo_hooke", {"C10": 1000.0}, Bulk("bulk_ratio", 1e3))
        >>> gel.mu0, gel.bulk_modulus
        (2000.0, 2000000.0)
    """

    law: str
    parameters: Mapping[str, float]
    bulk: Bulk = field(default_factory=Bulk)
    density: float | None = None
    name: str = ""
    viscoelastic: RelaxationSeries | None = None
    softening: Softening | None = None
    layers: tuple[Layer, ...] = ()
    poroelasticity: Poroelasticity | None = None
    puncture: Puncture | None = None
    effects: Mapping[str, TissueEffect] = field(default_factory=dict)
    regions: Mapping[str, Material] = field(default_factory=dict)
    instantaneous_factor = OldName("instantaneous_over_law_modulus_ratio")
    reduced_effects = OldName("list_acting_force_scaling_effects")

    def __post_init__(self):
        object.__setattr__(self, "law", LAWS.get_name_of_alias(self.law))
        object.__setattr__(self, "regions", make_shallow_read_only_copy(dict(self.regions)))
        for name, own in self.regions.items():
            if not name or set(name) & set(".[]"):
                raise InputError(f"the name of a region must not be empty or contain dots or brackets, which separate "
                                 f"the paths of parameters; got {name!r}. Rename the region in the mesh as well",
                                 field="regions")
            if own.layers or own.regions or own.effects or own.puncture is not None:
                raise InputError("a region has no layers, regions, effects or puncture; leave them out",
                                 field=f"regions.{name}")
        object.__setattr__(self, "effects", make_shallow_read_only_copy(_index_effects_by_name(self.effects)))
        object.__setattr__(self, "parameters",
                           make_shallow_read_only_copy(self.energy_law.convert_parameters_to_mapping(self.parameters)))
        self.energy_law.require_values_within_bounds(self.parameters)
        object.__setattr__(self, "layers", tuple(self.layers))
        self._require_parts_of_compressible_law()
        if not self.mu0 > 0:
            raise InputError(f"must give a positive shear modulus at rest; got {self.mu0:g} Pa.",
                             field="parameters")
        if self.density is not None and not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"must be positive and finite; got {self.density}.", field="density_kg_m3")
        if self._fraction_lost_by_drainage > 0:
            if self.viscoelastic is not None and len(self.viscoelastic.terms) == MOST_TERMS:
                raise InputError(f"drainage is one of the at most {MOST_TERMS} relaxing terms of a material; give at "
                                 f"most {MOST_TERMS - 1} viscoelastic terms", field="poroelasticity")
            if not self.mu_long_term > 0:
                raise InputError("the sum of phi and the g of all viscoelastic terms must be below 1, or no stress "
                                 "remains under constant strain", field="poroelasticity.phi")

    def _require_parts_of_compressible_law(self) -> None:
        """Set the bulk response of a compressible law; raise an `InputError` for parts that such a law excludes."""
        law = self.energy_law
        if not law.is_compressible:
            if self.bulk.kind == "of_law":
                raise InputError(f"must be stated for {law.name}, which has no volumetric response; got 'of_law'. "
                                 "State bulk_ratio, K_Pa, D1_per_Pa or incompressible", field="bulk")
            return
        if self.bulk.value is not None:
            raise InputError(f"must not be given for {law.name}, whose parameters state the volumetric response; got "
                             f"{self.bulk.kind} = {self.bulk.value:g}. Remove it", field=f"bulk.{self.bulk.kind}")
        object.__setattr__(self, "bulk", Bulk("of_law"))
        acting = [effect.name for effect in self.effects.values() if not isinstance(effect, ForceScalingEffect)]
        for part in ("viscoelastic", "softening", "poroelasticity", *(f"effects.{name}" for name in acting)):
            if part.startswith("effects.") or getattr(self, part) is not None:
                raise InputError(f"must not be given for {law.name}: relaxation, softening, drainage and effects act "
                                 "on the isochoric stress, which a compressible law does not separate. Remove it, or "
                                 "use a law with a bulk response", field=part)
        if not law.K0(self.parameters) > 0:
            raise InputError(f"must give a positive bulk modulus at rest; got {law.K0(self.parameters):g} Pa.",
                             field="parameters")

    def non_field_parameters(self) -> dict[str, tuple[Declaration, float]]:
        """Return name -> (declaration, value in SI) of the law's parameters."""
        return {name: (get_law_parameter_declaration(self.energy_law, name), value) for name,
                value in self.parameters.items()}

    def with_non_field_parameters(self, values: Mapping[str, float], **changes: Any) -> Material:
        """Return the material with other parameters of the law, and other fields."""
        return replace(self, parameters={**self.parameters, **values}, **changes)

    @property
    def is_time_dependent(self) -> bool:
        """Whether the force depends on time, by relaxation, drainage, an effect or a region."""
        return (self.viscoelastic is not None or self.poroelasticity is not None
                or any(effect.is_time_dependent for effect in self.effects.values())
                or any(own.is_time_dependent for own in self.regions.values()))

    @property
    def is_history_dependent(self) -> bool:
        """Whether the force depends on the previous path of the tool, by time dependence, softening or an effect."""
        return (self.is_time_dependent or self.softening is not None
                or any(effect.is_history_dependent for effect in self.effects.values())
                or any(own.is_history_dependent for own in self.regions.values()))

    def list_acting_force_scaling_effects(self, *, plate: bool) -> tuple[ForceScalingEffect, ...]:
        """Return the effects in reduced form, puncture included, that act under a plate (needle if not `plate`)."""
        return tuple(part for part in (self.puncture, *self.effects.values())
                     if isinstance(part, ForceScalingEffect) and (part.under_plates or not plate))

    @property
    def energy_law(self) -> Law:
        """The `Law` of the strain energy."""
        return find_law(self.law)

    @property
    def values(self) -> np.ndarray:
        """Parameters in the order of the law, SI, shape (m,)."""
        return self.energy_law.convert_parameters_to_array(self.parameters)

    @property
    def instantaneous_over_law_modulus_ratio(self) -> float:
        """Ratio of the instantaneous stress to the stress of the law: 1, or more if `parameters` are long-term."""
        return 1.0 if self.viscoelastic is None else self.viscoelastic.instantaneous_over_law_modulus_ratio

    @cached_property
    def mu0(self) -> float:
        """Initial shear modulus in instantaneous loading, Pa."""
        return self.instantaneous_over_law_modulus_ratio * self.energy_law.mu0(self.parameters)

    @property
    def mu_long_term(self) -> float:
        """Initial shear modulus in very slow loading, Pa: all terms relaxed, pores drained; mu0 (1 - sum g - phi)."""
        relaxing = 0.0 if self.viscoelastic is None else self.viscoelastic.relaxing_fraction
        return self.mu0 * (1.0 - relaxing - self._fraction_lost_by_drainage)

    @property
    def E0(self) -> float:
        """Initial Young's modulus in instantaneous loading, Pa: 9 K mu0 / (3 K + mu0); 3 mu0 if incompressible."""
        return self._young_modulus(self.mu0)

    @property
    def E_long_term(self) -> float:
        """Initial Young's modulus in very slow loading, Pa; the bulk modulus does not relax."""
        return self._young_modulus(self.mu_long_term)

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus K, Pa; infinite for an incompressible material."""
        return self.energy_law.K0(self.parameters) if self.bulk.kind == "of_law" else self.bulk.modulus(self.mu0)

    @property
    def is_bulk_ratio_verified(self) -> bool:
        """Whether the finite elements are verified for K / mu0; they replace an infinite one by a finite one."""
        low, high = self.bulk.verified_ratios
        return self.bulk.kind == "incompressible" or low <= self.bulk_modulus / self.mu0 <= high

    def require_verified_bulk_ratio(self) -> None:
        """Raise an `InputError` if the finite elements are not verified for K / mu0."""
        if self.is_bulk_ratio_verified:
            return
        (low, high), ratio = self.bulk.verified_ratios, self.bulk_modulus / self.mu0
        if self.bulk.kind == "of_law":
            raise InputError(f"must give K/mu0 of at most {high:g} with {self.law} in displacement elements; "
                             f"got {ratio:.4g}. Use a law with a bulk response", field="parameters")
        raise InputError(f"K/mu0 must be {low:g} to {high:g}, for which the finite elements are verified; got "
                         f"{ratio:.4g}. State another bulk response", field="bulk")

    def compute_memory_time(self, contact_radius: float | None) -> float:
        """Return the time after which unloaded tissue has relaxed, s: `MEMORY_TIMES` relaxation times.

        Args:
            contact_radius: contact radius of the test, m, for the time of drainage.

        Returns:
            0 for elastic tissue; infinite with softening and other effects that do not recover.
        """
        if self.softening is not None or any(effect.is_history_dependent for effect in self.effects.values()):
            return math.inf
        prony = self.make_prony_series(contact_radius)
        longest = max((term.tau for term in prony.terms), default=0.0) if prony is not None else 0.0
        return max([MEMORY_TIMES * longest,
                    *(own.compute_memory_time(contact_radius) for own in self.regions.values())])

    def make_prony_series(self, contact_radius: float | None) -> Prony | None:
        """Return the Prony series of all relaxing terms in a test: viscoelastic terms, then drainage.

        Args:
            contact_radius: contact radius of the test, m.

        Returns:
            A series of instantaneous moduli; None if nothing relaxes.

        Raises:
            InputError: the material drains, and the radius is None, not positive or not finite.
        """
        terms = () if self.viscoelastic is None else self.viscoelastic.terms
        if self.poroelasticity is not None and self.poroelasticity.phi > 0:
            terms = (*terms, self.poroelasticity.make_prony_term(contact_radius))
        return Prony(terms) if terms else None

    @property
    def _fraction_lost_by_drainage(self) -> float:
        """Fraction of the instantaneous stiffness that is lost by drainage; 0 without poroelasticity."""
        return 0.0 if self.poroelasticity is None else self.poroelasticity.phi

    def _young_modulus(self, mu: float) -> float:
        """Return Young's modulus, Pa, for a shear modulus mu, Pa, and the bulk modulus of this material."""
        K = self.bulk_modulus
        return 3.0 * mu if np.isinf(K) else 9.0 * K * mu / (3.0 * K + mu)


def find_bulk_declaration_or_none(kind: str) -> Declaration | None:
    """Return the declaration of the number of a kind of bulk response; None for ``incompressible``."""
    return _BULK.get(kind)


def get_law_parameter_declaration(law: Law, name: str) -> Declaration:
    """Return the declaration (symbol, unit, bounds) of a parameter of a law."""
    unit = law.units[name]
    reach = EXPONENT_BOUND if unit == "1" else np.inf
    return Declaration(name, unit, law.parameter_bounds.get(name, (-reach, reach)), key=name)


def _index_effects_by_name(effects: Mapping[str, TissueEffect] | Iterable[TissueEffect]) -> dict[str, TissueEffect]:
    """Return name -> effect for effects given as a sequence or a mapping.

    Raises:
        InputError: two effects of one name, or an object that is not a `TissueEffect`.
    """
    given = list(effects.values() if isinstance(effects, Mapping) else effects)
    by_name: dict[str, TissueEffect] = {}
    for effect in given:
        if not isinstance(effect, TissueEffect):
            raise InputError(f"must be effects derived from tissue_sim.TissueEffect; got {type(effect).__name__}.",
                             field="effects")
        if effect.name in by_name:
            raise InputError(f"must contain each effect once; got {effect.name!r} twice.", field="effects")
        by_name[effect.name] = effect
    return by_name


#: Path -> class of the parts that a material has at most once.
SINGLE: dict[str, type] = {"softening": Softening, "poroelasticity": Poroelasticity, "puncture": Puncture,
                           "viscoelastic.fractional_zener": FractionalZener}
#: Message for two kinds of relaxation in one material.
_PRONY_OR_FRACTIONAL = "must not have both Prony terms and a fractional Zener model. Remove one of them"
#: Path -> class of the parts that a material may have several of.
SEVERAL: dict[str, type] = {"viscoelastic.terms": PronyTerm, "layers": Layer}
#: Path of a parameter of a region's law: name of the region, name of the parameter.
_OF_REGION = re.compile(r"regions\.([^.\[\]]+)\.([^.\[\]]+)")
#: Path of one of several parts: path of the list, index.
_NUMBERED = re.compile(r"(.*)\[(?:0|[1-9]\d*)\]")
#: Paths among which messages name the nearest to an unknown path.
_EXAMPLES = (*(f"{place}[0].{name}" for place, kind in SEVERAL.items() for name in list_field_declarations(kind)),
             *(f"{place}.{name}" for place, kind in SINGLE.items() for name in list_field_declarations(kind)),
             "bulk.bulk_ratio")


def find_parameter_path_and_declaration(path: str) -> tuple[str, Declaration]:
    """Return the full path and the declaration of a parameter that a material may have besides its law's parameters.

    Args:
        path: path of the attribute, or as in files: ``viscoelastic.terms[0].tau`` or ``...tau_s``; for a region a
            parameter of its law, ``regions.tumour.C10``.

    Returns:
        The path of the attribute, and the declaration.

    Raises:
        InputError: no material has such a parameter; the message names the nearest.
    """
    if (of_region := _OF_REGION.fullmatch(path)) is not None:
        return path, _find_declaration_in_any_law(of_region[2], path)
    place, _, last = path.rpartition(".")
    if place == "bulk" and (found := find_bulk_declaration_or_none(last)) is not None:
        return path, found
    kind = _find_component_class_or_none(place)
    for name, found in (list_field_declarations(kind) if kind else {}).items():
        if last in (name, found.key):
            return f"{place}.{name}", found
    raise InputError(f"no material has a parameter {path!r}{make_hint_with_similar_or_known_words(path, _EXAMPLES)}",
                     field=path)


def find_region_name_or_none(path: str) -> str | None:
    """Return the name of the mesh region whose parameter a path names; None for other paths."""
    found = _OF_REGION.fullmatch(path)
    return None if found is None else found[1]


def make_material_from_numbers(law: str, parameters: Mapping[str, float], others: Mapping[str, float],
                               bulk: Bulk | None = None,
                               **options: Any) -> Material:
    """Make a material from a law and numbers by path.

    Args:
        law: name of the law.
        parameters: parameters of the law, SI.
        others: path -> value, SI, of all other parameters; a part needs all of its numbers. The law of a region is the
            one with exactly the given parameters; its bulk response is that of the material.
        bulk: bulk response, if no path states it; None: incompressible.
        options: other fields of `Material`: density, name.

    Raises:
        InputError: a part lacks a number, or a number is invalid; with its path.
    """
    response = bulk or Bulk()
    terms: dict[str, dict[int, dict[str, float]]] = {place: {} for place in SEVERAL}
    single: dict[str, dict[str, float]] = {}
    effects: dict[str, dict[str, float]] = {}
    regions: dict[str, dict[str, float]] = {}
    for path, value in others.items():
        *place, last = split_path_into_names_and_indices(find_parameter_path_and_declaration(path)[0])
        match place:
            case ["bulk"]:
                response = Bulk(str(last), value)
            case ["regions", name]:
                regions.setdefault(str(name), {})[str(last)] = value
            case ["effects", name]:
                effects.setdefault(str(name), {})[str(last)] = value
            case [*outer, int(index)]:
                terms[".".join(map(str, outer))].setdefault(index, {})[str(last)] = value
            case _:
                single.setdefault(".".join(map(str, place)), {})[str(last)] = value
    parts: dict[str, Any] = {place: _make_component(SINGLE[place], place, numbers) for place, numbers in single.items()}
    prony = tuple(_make_components_in_index_order(terms, "viscoelastic.terms"))
    if fractional := parts.pop("viscoelastic.fractional_zener", None):
        if prony:
            raise InputError(_PRONY_OR_FRACTIONAL, field="viscoelastic")
        parts["viscoelastic"] = FractionalRelaxation(fractional)
    if prony:
        with located_and_converted_errors(field="viscoelastic"):
            parts["viscoelastic"] = Prony(prony)
    added = {name: _make_component(EFFECTS[name], f"effects.{name}", numbers) for name, numbers in effects.items()}
    return Material(law, parameters, response, layers=tuple(_make_components_in_index_order(terms, "layers")),
                    effects=added, regions={name: _make_region_material_by_parameter_names(name, numbers, response)
                                            for name, numbers in regions.items()}, **parts, **options)


def with_softening_form(material: Material, form: SofteningForm) -> Material:
    """Return a copy of a material whose softening has the form ``"tanh"`` or ``"erf"``; unchanged without softening."""
    soft = material.softening
    return material if soft is None else replace(material, softening=replace(soft, form=form))


def with_changed_or_added_parameters(material: Material, values: Mapping[str, float]) -> Material:
    """Return a copy of a material with changed parameters; components that the material lacks are added.

    Args:
        material: material to change.
        values: path -> value, SI; a new part needs all of its numbers.

    Raises:
        InputError: no material has the path, a part lacks a number, or a number is invalid.
    """
    known = parameters(material)
    new = {path: value for path, value in values.items() if path not in known}
    material = with_values(material, {path: value for path, value in values.items() if path in known})
    if not new:
        return material
    several: dict[str, tuple] = {"viscoelastic.terms": getattr(material.viscoelastic, "terms", ()),
                                 "layers": material.layers}

    def renumber_path_after_existing_terms(path: str) -> str:
        """Return a path of a new component with its index counted from the end of the present components."""
        place, _, last = find_parameter_path_and_declaration(path)[0].rpartition(".")
        if (numbered := _NUMBERED.fullmatch(place)) is None:
            return path
        return f"{numbered[1]}[{int(place[len(numbered[1]) + 1:-1]) - len(several[numbered[1]])}].{last}"

    made = make_material_from_numbers("neo_hooke", {"C10": 1.0},
                                      {renumber_path_after_existing_terms(path): value for path, value in new.items()},
                                      None if material.bulk.kind == "of_law" else material.bulk)
    changes: dict[str, Any] = {name: part for name in SINGLE if (part := getattr(made, name, None)) is not None}
    if made.viscoelastic is not None:
        series = material.viscoelastic or made.viscoelastic
        if made.viscoelastic is not series:
            if not (isinstance(series, Prony) and isinstance(made.viscoelastic, Prony)):
                raise InputError(_PRONY_OR_FRACTIONAL, field="viscoelastic")
            series = replace(series, terms=(*series.terms, *made.viscoelastic.terms))
        changes["viscoelastic"] = series
    if any(path.startswith("bulk.") for path in new):
        changes["bulk"] = made.bulk
    return replace(material, layers=(*material.layers, *made.layers), effects={**material.effects, **made.effects},
                   regions={**material.regions, **made.regions}, **changes)


def _find_component_class_or_none(place: str) -> type | None:
    """Return the class of the component at a path, such as ``layers[0]``; None if no component has the path."""
    numbered = _NUMBERED.fullmatch(place)
    if numbered:
        return SEVERAL.get(numbered[1])
    if place.startswith("effects."):
        return EFFECTS.get(place.removeprefix("effects."))
    return SINGLE.get(place)


def _find_declaration_in_any_law(name: str, path: str) -> Declaration:
    """Return the declaration of a parameter that at least one registered law has."""
    for law in LAWS.values():
        if name in law.parameters:
            return get_law_parameter_declaration(law, name)
    known = dict.fromkeys(each for law in LAWS.values() for each in law.parameters)
    raise InputError(f"no law has a parameter {name!r}{make_hint_with_similar_or_known_words(name, known)}", field=path)


def _make_region_material_by_parameter_names(name: str, numbers: Mapping[str, float], bulk: Bulk) -> Material:
    """Make the material of a region from its numbers; its law is the registered one with exactly these parameters."""
    law = next((name for name, law in LAWS.items() if set(law.parameters) == set(numbers)), None)
    if law is None:
        raise InputError(f"no law has the parameters {', '.join(numbers)} and no others; give all of one law",
                         field=f"regions.{name}")
    try:
        return Material(law, numbers, bulk)
    except InputError as refused:
        raise InputError(refused.problem, field=f"regions.{name}.{refused.field}") from None


def _make_components_in_index_order(terms: Mapping[str, Mapping[int, Mapping[str, float]]],
                                    place: str) -> Iterator[Any]:
    """Yield the components of a list in the order of their indices, which must be 0, 1, ... without gaps."""
    numbered = terms[place]
    if sorted(numbered) != list(range(len(numbered))):
        raise InputError(f"must be numbered from 0 without gaps, as {place}[0], {place}[1].", field=place)
    return (_make_component(SEVERAL[place], f"{place}[{index}]", numbered[index]) for index in range(len(numbered)))


def _make_component(kind: type, place: str, numbers: Mapping[str, float]) -> Any:
    """Make a component of a class from its numbers; errors name the path of the number."""
    try:
        return kind(**numbers)
    except InputError as refused:
        raise InputError(refused.problem, field=f"{place}.{refused.field}") from None
    except TypeError:
        missing = next((name for name in list_field_declarations(kind) if name not in numbers), None)
        if missing is None:
            raise
        raise InputError("is missing; add it", field=f"{place}.{missing}") from None
