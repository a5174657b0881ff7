"""Entries of material files for law, bulk response, effects and provenance; see `tissue_sim.MaterialFile`.

The entry of a part of a material is derived from the declarations of the part (`tissue_sim.parameters`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import msgspec
import numpy as np

from tissue_sim.decode import decode_struct
from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.laws import find_law
from tissue_sim.material.effect import EFFECTS
from tissue_sim.material.force_scaling import Puncture
from tissue_sim.material.fractional_zener import FractionalRelaxation, FractionalZener
from tissue_sim.material.material import Bulk, Layer, Material
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import FORM, Poroelasticity, Prony, PronyTerm, RelaxationSeries
from tissue_sim.parameters import list_field_choices, list_field_declarations, make_from_file_values
from tissue_sim.units import UNITS, get_si_factor_and_offset

#: Lowest and highest value.
Range = tuple[float, float]


class MaterialFileEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all entries of a file: unknown keys are errors, and default values are not written."""


class ParameterEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Parameter of a law; value and standard error have the same unit."""

    value: float
    unit: str
    standard_error: float | None = None


class BulkEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Bulk response: exactly one of the keys; see `tissue_sim.Bulk`."""

    K_Pa: float | None = None
    D1_per_Pa: float | None = None
    bulk_ratio: float | None = None
    incompressible: bool | None = None
    of_law: bool | None = None

    def make_bulk(self, law: str) -> Bulk:
        """Return the bulk response of a material with the law of this name.

        Raises:
            InputError: none, or several, of the keys are given; or incompressible with a compressible law.
        """
        stated = {kind: value for kind, value in msgspec.structs.asdict(self).items() if value is not None}
        if len(stated) != 1 or self.incompressible is False or self.of_law is False:
            raise InputError("expected exactly one of K_Pa, D1_per_Pa, bulk_ratio, incompressible: true, or of_law: "
                             "true for a compressible law", field="bulk")
        if self.incompressible and find_law(law).is_compressible:
            raise InputError(f"must not be given for {law}, whose parameters state the volumetric response. Write "
                             "of_law: true", field="bulk.incompressible")
        (kind, value), = stated.items()
        return Bulk(kind, None if value is True else value)


def make_law_bulk_and_parameter_entries(material: Material, errors: Mapping[str, float]) -> dict[str, Any]:
    """Return the values of the keys ``law``, ``bulk`` and ``parameters`` of a file, in SI.

    The argument `errors` contains the standard errors by path, SI.
    """
    law, bulk = material.energy_law, material.bulk
    stated: dict[str, Any] = {bulk.kind: True if bulk.value is None else float(bulk.value)}
    return {"law": law.name, "bulk": BulkEntry(**stated),
            "parameters": {name: ParameterEntry(value=value, unit=law.units[name], standard_error=(
                float(errors[name]) if name in errors else None)) for name, value in material.parameters.items()}}


def convert_entries_to_si_with_factors(
        law: str, parameters: Mapping[str, ParameterEntry]) -> tuple[dict[str, ParameterEntry], dict[str, float]]:
    """Return the entries of the parameters of a law in SI, and the factor of the unit of each entry.

    Args:
        law: name of the law.
        parameters: entries of a file by name.

    Returns:
        Entries in SI by name; and by name the value in SI of one unit of the file.

    Raises:
        InputError: an unknown parameter, a unit of another quantity, or a negative standard error.
    """
    found = find_law(law)
    factors, in_SI = {}, {}
    for name, entry in parameters.items():
        if name not in found.units:
            raise InputError(
                f"law {law} has no parameter {name!r}{make_hint_with_similar_or_known_words(name, found.parameters)}",
                field=f"parameters.{name}")
        with located_and_converted_errors(field=f"parameters.{name}.unit"):
            factor, _ = get_si_factor_and_offset(entry.unit, UNITS[found.units[name]][0])
        error = entry.standard_error
        if error is not None and error < 0:
            raise InputError(f"must be a standard deviation of 0 or more; got {error:g}.",
                             field=f"parameters.{name}.standard_error")
        factors[name] = factor
        in_SI[name] = ParameterEntry(value=factor * entry.value, unit=found.units[name],
                                     standard_error=None if error is None else factor * error)
    return in_SI, factors


def get_parameter_values_by_name(parameters: Mapping[str, ParameterEntry]) -> dict[str, float]:
    """Return name -> value of the entries, which must be in SI already."""
    return {name: entry.value for name, entry in parameters.items()}


class CovarianceEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Covariance of the parameters in `order`; units are products of those of the parameters."""

    order: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class ValidRange(MaterialFileEntry, frozen=True, kw_only=True):
    """Ranges, (lowest, highest), of the data to which the parameters were fitted."""

    stretch: Range | None = None
    strain_rate_per_s: Range | None = None
    temperature_degC: Range | None = None


class StabilityEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Range of Drucker stability; see `tissue_sim.find_stability_range`."""

    stable_from: float
    stable_to: float
    stretch_range: Range
    text: str = ""


class SourceRecording(MaterialFileEntry, frozen=True, kw_only=True):
    """File and SHA-256 of a recording from which the parameters were determined."""

    file: str
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class Provenance(MaterialFileEntry, frozen=True, kw_only=True):
    """Origin of the parameters; `residual` such as ``{"RMSE_Pa": 12.0}``, `date` in ISO 8601."""

    recordings: tuple[SourceRecording, ...] = ()
    method: str | None = None
    software: str | None = None
    version: str | None = None
    date: str | None = None
    residual: dict[str, float] = {}
    settings: dict[str, Any] = {}


class ComponentEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Component of a material, such as a layer, in the units of the file; `standard_errors` by key, in these units."""

    #: Class of the component.
    noun: ClassVar[type]
    standard_errors: dict[str, float] = {}

    @classmethod
    def from_component(cls, part: Any, place: str, errors: Mapping[str, float]) -> ComponentEntry:
        """Make the entry of a component, in the units of the file.

        Args:
            part: part of a material.
            place: path of the part.
            errors: path of a parameter -> standard error, SI.
        """
        known = list_field_declarations(cls.noun).items()
        mine = {what.key: errors[f"{place}.{name}"] / what.factor for name, what in known
                if f"{place}.{name}" in errors}
        return cls(**{what.key: getattr(part, name) / what.factor for name, what in known},
                   **{name: getattr(part, name) for name in list_field_choices(cls.noun)}, standard_errors=mine)

    def make_component(self, field: str) -> Any:
        """Make the component of a material from the entry, in SI.

        Args:
            field: path of the part, for messages.

        Raises:
            InputError: an invalid value or standard error, with its path.
        """
        keys = [what.key for what in list_field_declarations(self.noun).values()]
        for key, error in self.standard_errors.items():
            if key not in keys:
                raise InputError(f"must be the key of a parameter: {', '.join(keys)}.",
                                 field=f"{field}.standard_errors.{key}")
            if error < 0:
                raise InputError(f"must be a standard deviation of 0 or more; got {error:g}.",
                                 field=f"{field}.standard_errors.{key}")
        return make_from_file_values(self.noun, {key: getattr(self, key) for key in keys}, field,
                                     **{name: getattr(self, name) for name in list_field_choices(self.noun)})


@cache
def make_entry_class(noun: type) -> type[ComponentEntry]:
    """Make the msgspec class of the file entry of a component: one key for each declared parameter and choice."""
    keys: list[tuple[str, Any] | tuple[str, Any, Any]] = [
        (name, Literal[words], words[0]) for name, words in list_field_choices(noun).items()]
    for entry in fields(noun):
        what = list_field_declarations(noun).get(entry.name)
        if what is not None:
            keys.append((what.key, float) if entry.default is MISSING else
                        (what.key, float, entry.default / what.factor))
    made = msgspec.defstruct(f"{noun.__name__}Entry", keys, bases=(ComponentEntry,), namespace={"noun": noun},
                             frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True)
    return cast(type[ComponentEntry], made)


if TYPE_CHECKING:  # type checkers do not accept a class from a function as a type
    LayerEntry = ComponentEntry
    PoroelasticityEntry = ComponentEntry
    PronyTermEntry = ComponentEntry
    PunctureEntry = ComponentEntry
    SofteningEntry = ComponentEntry
    FractionalZenerEntry = ComponentEntry
else:
    SofteningEntry, LayerEntry, PoroelasticityEntry, PunctureEntry, PronyTermEntry, FractionalZenerEntry = map(
        make_entry_class, (Softening, Layer, Poroelasticity, Puncture, PronyTerm, FractionalZener))


class ViscoelasticEntry(MaterialFileEntry, frozen=True, kw_only=True, omit_defaults=False):
    """Relaxation: either the `terms` of a Prony series or a fractional Zener model; the convention is always written.

    See `tissue_sim.material.viscoelasticity.Prony` and `tissue_sim.material.fractional_zener.FractionalRelaxation`.
    """

    terms: tuple[PronyTermEntry, ...] | msgspec.UnsetType = msgspec.UNSET
    fractional_zener: FractionalZenerEntry | msgspec.UnsetType = msgspec.UNSET
    moduli: Literal["instantaneous", "long_term"] = "instantaneous"
    form: Literal["isochoric_second_piola"] = FORM

    @classmethod
    def from_component(cls, prony: RelaxationSeries, place: str, errors: Mapping[str, float]) -> ViscoelasticEntry:
        """Make the entry of a relaxation; arguments as in `ComponentEntry.from_component`."""
        if isinstance(prony, FractionalRelaxation):
            return cls(moduli=prony.moduli, fractional_zener=FractionalZenerEntry.from_component(
                prony.fractional_zener, f"{place}.fractional_zener", errors))
        terms = (PronyTermEntry.from_component(term, f"{place}.terms[{i}]", errors) for i,
                 term in enumerate(prony.terms))
        return cls(terms=tuple(terms), moduli=prony.moduli)

    def make_component(self, field: str) -> RelaxationSeries:
        """Make the relaxation; errors as in `ComponentEntry.make_component`."""
        if isinstance(self.terms, tuple) == isinstance(self.fractional_zener, ComponentEntry):
            raise InputError("must have either terms or fractional_zener. Add or remove one of them", field=field)
        if not isinstance(self.terms, tuple):
            assert isinstance(self.fractional_zener, ComponentEntry)
            return FractionalRelaxation(self.fractional_zener.make_component(f"{field}.fractional_zener"), self.moduli)
        terms = tuple(term.make_component(f"{field}.terms[{i}]") for i, term in enumerate(self.terms))
        with located_and_converted_errors(field=field):
            return Prony(terms, self.moduli)


def make_component_entries(material: Material, errors: Mapping[str, float]) -> dict[str, Any]:
    """Return key in the file -> entry of every component of a material but law and bulk response; None: no component.

    Args:
        material: the material.
        errors: path -> standard error, SI.
    """
    def make_component_entry(part: Any, place: str) -> ComponentEntry:
        """Make the file entry of one component at a path."""
        return make_entry_class(part.__class__).from_component(part, place, errors)

    single = {key: None if (part := getattr(material, key)) is None else make_component_entry(part, key)
              for key in ("softening", "poroelasticity", "puncture")}
    prony = material.viscoelastic
    return {**single,
            "viscoelastic": None if prony is None else ViscoelasticEntry.from_component(prony, "viscoelastic", errors),
            "layers": tuple(make_component_entry(layer, f"layers[{i}]") for i, layer in enumerate(material.layers))
            or None,
            "effects": {name: msgspec.to_builtins(make_component_entry(effect, f"effects.{name}"))
                        for name, effect in material.effects.items()} or None,
            "regions": {name: RegionEntry.from_component(own, f"regions.{name}", errors)
                        for name, own in material.regions.items()} or None}


def make_material_arguments_from_entries(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments of `Material`, except law and bulk response, from the entries of a file.

    Errors are those of `ComponentEntry.make_component`.
    """
    single = {key: entry.make_component(key) for key, entry in entries.items()
              if entry is not None and key not in ("layers", "effects", "regions")}
    layers = tuple(layer.make_component(f"layers[{i}]") for i, layer in enumerate(entries["layers"] or ()))
    effects = {name: _decode_effect(name, content).make_component(f"effects.{name}")
               for name, content in (entries["effects"] or {}).items()}
    regions = {name: entry.make_component(f"regions.{name}") for name, entry in (entries["regions"] or {}).items()}
    return {**single, "layers": layers, "effects": effects, "regions": regions}


class RegionEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Entry of one region in a material file: law, parameters, bulk and parts of the region's material.

    The key of the entry in ``regions`` of the file names the region of the mesh; `name` is the name of the material.
    """

    name: str = ""
    law: str
    parameters: dict[str, ParameterEntry]
    bulk: BulkEntry
    viscoelastic: ViscoelasticEntry | None = None
    softening: SofteningEntry | None = None
    poroelasticity: PoroelasticityEntry | None = None
    density_kg_m3: float | None = None

    @classmethod
    def from_component(cls, material: Material, place: str, errors: Mapping[str, float]) -> RegionEntry:
        """Make the entry of a region's material; arguments as in `ComponentEntry.from_component`."""
        mine = {path.removeprefix(f"{place}."): error for path, error in errors.items()
                if path.startswith(f"{place}.")}
        parts = {key: entry for key, entry in make_component_entries(material, mine).items() if entry is not None}
        return cls(name=material.name, **make_law_bulk_and_parameter_entries(material, mine), **parts,
                   density_kg_m3=material.density)

    def convert_to_si_with_factors(self, field: str) -> tuple[RegionEntry, dict[str, float]]:
        """Return the entry in SI, and by path of the parameter the value in SI of one unit of the file.

        Errors are those of `convert_entries_to_si_with_factors`.
        """
        with located_and_converted_errors(field=field):
            parameters, factors = convert_entries_to_si_with_factors(self.law, self.parameters)
        return (msgspec.structs.replace(self, parameters=parameters),
                {f"{field}.{name}": factor for name, factor in factors.items()})

    def make_component(self, field: str) -> Material:
        """Make the material of an entry in SI; errors as in `ComponentEntry.make_component` and `Material`."""
        with located_and_converted_errors(field=field):
            parts = {key: entry.make_component(key) for key in ("viscoelastic", "softening", "poroelasticity")
                     if (entry := getattr(self, key)) is not None}
            return Material(self.law, get_parameter_values_by_name(self.parameters), self.bulk.make_bulk(self.law),
                            self.density_kg_m3, self.name,
                            **parts)


def _decode_effect(name: str, content: Any) -> ComponentEntry:
    """Decode the entry of an additional effect.

    Raises:
        InputError: no registered effect has the name, or the content is invalid.
    """
    if name not in EFFECTS:
        raise InputError(f"must be the name of a registered effect: {', '.join(EFFECTS) or 'none'}. Install or "
                         "register the package that defines it", field=f"effects.{name}")
    kind: type = EFFECTS[name]
    return decode_struct(content, make_entry_class(kind), f"effects.{name}")


def check_covariance(matrix: np.ndarray, m: int, field: str = "covariance.matrix") -> None:
    """Require that a matrix is a covariance of m numbers; returns nothing.

    Args:
        matrix: matrix to check.
        m: number of rows.
        field: field for messages.

    Raises:
        InputError: the matrix has another shape, is not finite, not symmetric, or not positive semi-definite.
    """
    if matrix.shape != (m, m):
        raise InputError(f"must have {m} rows of {m} numbers; got the shape {matrix.shape}.", field=field)
    if not np.isfinite(matrix).all():
        raise InputError("must be finite.", field=field)
    variances = np.diag(matrix)
    if (variances < 0).any():
        raise InputError(f"must have a diagonal of 0 or more; got {variances.min():g}.", field=field)
    # A fixed parameter has a row of zeros. Rounding errors of a fit are far below 1e-9 of a correlation.
    scale = np.sqrt(np.where(variances > 0, variances, 1.0))
    correlation = matrix / scale[:, None] / scale[None, :]
    if np.abs(correlation - correlation.T).max() > 1e-9:
        raise InputError("must be symmetric.", field=field)
    if np.linalg.eigvalsh(correlation).min() < -1e-9:
        raise InputError("must be positive semi-definite; some combination of the parameters has a negative variance.",
                         field=field)
