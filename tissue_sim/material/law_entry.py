"""Entries of material files for law, parameters and bulk response, of a material or a region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.laws import find_law
from tissue_sim.material.material import Bulk, Material
from tissue_sim.units import UNITS, get_si_factor_and_offset


class MaterialFileEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all entries of a file: unknown keys are errors, and default values are not written."""


class ParameterEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Parameter of a law; value and standard error have the same unit."""

    value: float
    unit: str
    standard_error: float | None = None


class BulkEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Bulk response: exactly one of the four keys; see `tissue_sim.Bulk`."""

    K_Pa: float | None = None
    D1_per_Pa: float | None = None
    bulk_ratio: float | None = None
    incompressible: bool | None = None

    def make_bulk(self) -> Bulk:
        """Return the bulk response.

        Raises:
            InputError: none, or several, of the four keys are given.
        """
        stated = {kind: value for kind, value in msgspec.structs.asdict(self).items() if value is not None}
        if len(stated) != 1 or self.incompressible is False:
            raise InputError("expected exactly one of K_Pa, D1_per_Pa, bulk_ratio, or incompressible: true",
                             field="bulk")
        (kind, value), = stated.items()
        return Bulk(kind, None if kind == "incompressible" else value)


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
