"""A law with its numbers and a bulk response, as they stand in a material file: of the material, and of each region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from tissue_sim.errors import InputError, located, nearest
from tissue_sim.laws import find_law
from tissue_sim.material.material import Bulk, Material
from tissue_sim.units import UNITS, to_si


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """How every part of the file is read: unknown keys are errors, absent ones are not written."""


class ParameterEntry(Entry, frozen=True, kw_only=True):
    """A parameter; value and standard error share the unit."""

    value: float
    unit: str
    standard_error: float | None = None


class BulkEntry(Entry, frozen=True, kw_only=True):
    """Exactly one of the four; see `tissue_sim.Bulk`."""

    K_Pa: float | None = None
    D1_per_Pa: float | None = None
    bulk_ratio: float | None = None
    incompressible: bool | None = None

    @property
    def part(self) -> Bulk:
        """The bulk response.

        Raises:
            InputError: none of the four, or several.
        """
        stated = {kind: value for kind, value in msgspec.structs.asdict(self).items() if value is not None}
        if len(stated) != 1 or self.incompressible is False:
            raise InputError("expected exactly one of K_Pa, D1_per_Pa, bulk_ratio, or incompressible: true",
                             field="bulk")
        (kind, value), = stated.items()
        return Bulk(kind, None if kind == "incompressible" else value)


def law_entries(material: Material, errors: Mapping[str, float]) -> dict[str, Any]:
    """Key of the file -> entry of law, parameters and bulk response; `errors`: path -> standard error, SI."""
    law, bulk = material.energy_law, material.bulk
    stated: dict[str, Any] = {bulk.kind: True if bulk.value is None else float(bulk.value)}
    return {"law": law.name, "bulk": BulkEntry(**stated),
            "parameters": {name: ParameterEntry(value=value, unit=law.units[name], standard_error=(
                float(errors[name]) if name in errors else None)) for name, value in material.parameters.items()}}


def parameters_in_SI(law: str, parameters: Mapping[str, ParameterEntry]) -> tuple[
        dict[str, ParameterEntry], dict[str, float]]:
    """The parameters of a law in SI, and the factors of their units.

    Raises:
        InputError: no parameter of the law, a unit that is none of it, or a negative standard error.
    """
    found = find_law(law)
    factors, in_SI = {}, {}
    for name, entry in parameters.items():
        if name not in found.units:
            raise InputError(f"law {law} has no parameter {name!r}{nearest(name, found.parameters)}",
                             field=f"parameters.{name}")
        with located(field=f"parameters.{name}.unit"):
            factor, _ = to_si(entry.unit, UNITS[found.units[name]][0])
        error = entry.standard_error
        if error is not None and error < 0:
            raise InputError(f"{error:g} is negative; give a standard deviation",
                             field=f"parameters.{name}.standard_error")
        factors[name] = factor
        in_SI[name] = ParameterEntry(value=factor * entry.value, unit=found.units[name],
                                     standard_error=None if error is None else factor * error)
    return in_SI, factors


def values_of(parameters: Mapping[str, ParameterEntry]) -> dict[str, float]:
    """Name -> value of parameters that are in SI."""
    return {name: entry.value for name, entry in parameters.items()}
