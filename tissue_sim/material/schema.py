"""What stands in a material file, part by part; see `tissue_sim.MaterialFile`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from tissue_sim.errors import InputError
from tissue_sim.material.layer import Layer
from tissue_sim.material.material import Material
from tissue_sim.material.puncture import Puncture
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import FORM, Poroelasticity, Prony, PronyTerm

Range = tuple[float, float]


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """How every part of the file is read: unknown keys are errors, absent ones are not written."""


class ParameterEntry(Part, kw_only=True):
    """A parameter; value and standard error share the unit."""

    value: float
    unit: str
    standard_error: float | None = None


class CovarianceEntry(Part, kw_only=True):
    """Covariance of the parameters in `order`, in the product of their units."""

    order: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class BulkEntry(Part, kw_only=True):
    """Exactly one of the four; see `tissue_sim.Bulk`."""

    K_Pa: float | None = None
    D1_per_Pa: float | None = None
    bulk_ratio: float | None = None
    incompressible: bool | None = None


class ValidRange(Part, kw_only=True):
    """(lowest, highest) of what the parameters were fitted to."""

    stretch: Range | None = None
    strain_rate_per_s: Range | None = None
    temperature_degC: Range | None = None


class StabilityEntry(Part, kw_only=True):
    """Drucker stability; see `tissue_sim.check_stability`."""

    stable_from: float
    stable_to: float
    stretch_range: Range
    text: str = ""


class SourceRecording(Part, kw_only=True):
    """A recording that the parameters come from."""

    file: str
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class Provenance(Part, kw_only=True):
    """Where the parameters come from; `residual` such as ``{"RMSE_Pa": 12.0}``, `date` in ISO 8601."""

    recordings: tuple[SourceRecording, ...] = ()
    method: str | None = None
    software: str | None = None
    version: str | None = None
    date: str | None = None
    residual: dict[str, float] = {}
    settings: dict[str, Any] = {}


class EffectEntry(Part, kw_only=True):
    """A frozen part of `Material` in the units of the file; `standard_errors` by the file's keys and in its units."""

    #: Class that it stands for, and for each key of the file the attribute and the factor to SI.
    noun: ClassVar[type]
    attributes: ClassVar[Mapping[str, tuple[str, float]]]
    standard_errors: dict[str, float] = {}

    @classmethod
    def of(cls, noun, place: str, errors: Mapping[str, float]):
        """The entry of a part of a material, None of None; `errors` are looked up by ``place.key``."""
        if noun is None:
            return None
        mine = {key: float(errors[f"{place}.{key}"]) for key in cls.attributes if f"{place}.{key}" in errors}
        return cls(**{key: getattr(noun, name) / factor for key, (name, factor) in cls.attributes.items()},
                   standard_errors=mine)

    def build(self, field: str):
        """The part of a material.

        Raises:
            InputError: a value that the part refuses, or a bad standard error, with the path below `field`.
        """
        for key, error in self.standard_errors.items():
            if key not in self.attributes:
                raise InputError(f"names no parameter beside it; known: {', '.join(self.attributes)}",
                                 field=f"{field}.standard_errors.{key}")
            if error < 0:
                raise InputError(f"{error:g} is negative; give a standard deviation",
                                 field=f"{field}.standard_errors.{key}")
        keys = {name: key for key, (name, _) in self.attributes.items()}
        try:
            return self.noun(**{name: factor * getattr(self, key) for key, (name, factor) in self.attributes.items()})
        except InputError as refused:
            raise InputError(refused.problem, field=f"{field}.{keys[refused.field]}") from None


class PronyTermEntry(EffectEntry, kw_only=True):
    """See `tissue_sim.material.viscoelasticity.PronyTerm`."""

    noun = PronyTerm
    attributes = {"g": ("g", 1.0), "tau_s": ("tau", 1.0)}
    g: float
    tau_s: float


class ViscoelasticEntry(Part, kw_only=True, omit_defaults=False):
    """See `tissue_sim.material.viscoelasticity.Prony`; the convention is always written."""

    terms: tuple[PronyTermEntry, ...]
    moduli: Literal["instantaneous", "long_term"] = "instantaneous"
    form: Literal["isochoric_second_piola"] = FORM

    @classmethod
    def of(cls, prony: Prony | None, place: str, errors: Mapping[str, float]) -> ViscoelasticEntry | None:
        """The entry of a Prony series, None of None; `errors` as in `EffectEntry.of`."""
        if prony is None:
            return None
        terms = (PronyTermEntry.of(term, f"{place}.terms[{i}]", errors) for i, term in enumerate(prony.terms))
        return cls(terms=tuple(terms), moduli=prony.moduli)

    def build(self, field: str) -> Prony:
        """The Prony series; errors as `EffectEntry.build`."""
        terms = tuple(term.build(f"{field}.terms[{i}]") for i, term in enumerate(self.terms))
        try:
            return Prony(terms, self.moduli)
        except InputError as refused:
            raise refused.located(field=field) from None


class SofteningEntry(EffectEntry, kw_only=True):
    """See `tissue_sim.material.softening.Softening`."""

    noun = Softening
    attributes = {"loss": ("loss", 1.0), "modulus_Pa": ("modulus", 1.0), "share": ("share", 1.0)}
    loss: float
    modulus_Pa: float = 0.0
    share: float = 1.0


class LayerEntry(EffectEntry, kw_only=True):
    """See `tissue_sim.material.layer.Layer`."""

    noun = Layer
    attributes = {"thickness_mm": ("thickness", 1e-3), "modulus_ratio": ("ratio", 1.0)}
    thickness_mm: float
    modulus_ratio: float


class PoroelasticityEntry(EffectEntry, kw_only=True):
    """See `tissue_sim.material.viscoelasticity.Poroelasticity`."""

    noun = Poroelasticity
    attributes = {"phi": ("phi", 1.0), "diffusivity_mm2_per_s": ("diffusivity", 1e-6)}
    phi: float
    diffusivity_mm2_per_s: float


class PunctureEntry(EffectEntry, kw_only=True):
    """See `tissue_sim.material.puncture.Puncture`."""

    noun = Puncture
    attributes = {"depth_mm": ("depth", 1e-3), "drop": ("drop", 1.0)}
    depth_mm: float
    drop: float


def entries_of(material: Material, errors: Mapping[str, float]) -> dict[str, Any]:
    """Key of the file -> entry of everything that the material has beside its law and its bulk response.

    Args:
        material: the material.
        errors: standard errors by paths as in `effect_parameters`, in the units of the file.
    """
    layers = tuple(LayerEntry.of(layer, f"layers[{i}]", errors) for i, layer in enumerate(material.layers))
    return {"viscoelastic": ViscoelasticEntry.of(material.viscoelastic, "viscoelastic", errors),
            "softening": SofteningEntry.of(material.softening, "softening", errors),
            "layers": layers or None,
            "poroelasticity": PoroelasticityEntry.of(material.poroelasticity, "poroelasticity", errors),
            "puncture": PunctureEntry.of(material.puncture, "puncture", errors)}


def build_effects(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of `Material` from what `entries_of` made; errors as `EffectEntry.build`."""
    built = {key: entry.build(key) for key, entry in entries.items() if entry is not None and key != "layers"}
    return {**built, "layers": tuple(layer.build(f"layers[{i}]") for i, layer in enumerate(entries["layers"] or ()))}


def effect_parameters(entries: Mapping[str, Any]) -> dict[str, tuple[float, float | None]]:
    """Dotted path, such as ``viscoelastic.terms[0].tau_s``, -> value and standard error in the units of the file."""
    found = {}
    for place, entry in _places(entries):
        for key in entry.attributes:
            found[f"{place}.{key}"] = (getattr(entry, key), entry.standard_errors.get(key))
    return found


def _places(entries: Mapping[str, Any]) -> Iterator[tuple[str, EffectEntry]]:
    for key, entry in entries.items():
        several = entry.terms if isinstance(entry, ViscoelasticEntry) else entry
        if isinstance(several, tuple):
            name = f"{key}.terms" if several is not entry else key
            yield from ((f"{name}[{i}]", item) for i, item in enumerate(several))
        elif entry is not None:
            yield key, entry
