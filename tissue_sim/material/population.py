"""Statistics of the measured specimens in a material file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tissue_sim.decode import convert_to_json_types, decode_struct
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.material.schema import MaterialFileEntry, Range, check_covariance
from tissue_sim.parameters import Parameter

_LISTS = ("mean", "spread", "mean_interval95", "spread_interval95")


class PopulationEntry(MaterialFileEntry, frozen=True, kw_only=True):
    """Statistics of the specimens whose mean is the material, for its parameters in `order`.

    One number for each parameter, in the units of the file: `mean`, `spread` (standard deviation between specimens),
    their 95 % intervals, the covariance `between_specimens`, and the values of each measured specimen in `specimens`.
    `left_out` contains the reason for each specimen that was not used.
    """

    order: tuple[str, ...]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    between_specimens: tuple[tuple[float, ...], ...]
    specimens: dict[str, tuple[float, ...]]
    left_out: dict[str, str] = {}
    mean_interval95: tuple[Range, ...] | None = None
    spread_interval95: tuple[Range, ...] | None = None

    def with_renamed_and_scaled_parameters(self, order: Sequence[str], factors: Sequence[float]) -> PopulationEntry:
        """Return a copy of the entry with the names `order`, and with each parameter's values times its factor."""
        sizes = np.asarray(factors)
        lists = {key: None if getattr(self, key) is None else (np.transpose(getattr(self, key)) * sizes).T.tolist()
                 for key in _LISTS}
        return decode_struct(convert_to_json_types({
            "order": list(order), **{key: value for key, value in lists.items() if value is not None},
            "between_specimens": (np.outer(sizes, sizes) * np.array(self.between_specimens)).tolist(),
            "specimens": {name: (sizes * values).tolist() for name, values in self.specimens.items()},
            "left_out": self.left_out}),
            PopulationEntry, "population")


def make_population_entry_from_si_fields(stated: Mapping[str, Any], known: Mapping[str, Parameter]) -> PopulationEntry:
    """Check the stated fields of a population and convert them to an entry in the units and names of the file.

    Args:
        stated: fields of `PopulationEntry`, in SI, with the parameters by path.
        known: path -> parameter of the material.

    Raises:
        InputError: a parameter that the material does not have, or a wrong shape; with the field.
    """
    entry = decode_struct(convert_to_json_types(stated), PopulationEntry, "population")
    _check_population_entry(entry, known)
    return entry.with_renamed_and_scaled_parameters([known[name].path_in_file for name in entry.order],
                                                    [1.0 / known[name].declaration.factor for name in entry.order])


def make_checked_population_entry_in_si(entry: PopulationEntry, known: Mapping[str, float]) -> PopulationEntry:
    """Check an entry of a file, and return a copy in SI.

    Args:
        entry: entry of a file.
        known: name of a parameter in the file -> factor of its unit.

    Raises:
        InputError: an unknown parameter, a wrong shape, or a matrix that is not a covariance.
    """
    _check_population_entry(entry, known)
    return entry.with_renamed_and_scaled_parameters(entry.order, [known[name] for name in entry.order])


def _check_population_entry(entry: PopulationEntry, known: Mapping[str, Any]) -> None:
    """Require known parameters, one number for each of them in every row, disjoint specimens, and a covariance."""
    for name in entry.order:
        if name not in known:
            raise InputError(
                f"this material has no parameter {name!r}{make_hint_with_similar_or_known_words(name, known)}",
                field="population.order")
    rows: dict[str, Any] = {key: getattr(entry, key) for key in _LISTS if getattr(entry, key) is not None}
    rows |= {f"specimens.{name}": values for name, values in entry.specimens.items()}
    for key, values in (*rows.items(), *((f"between_specimens[{i}]", row)
                                         for i, row in enumerate(entry.between_specimens))):
        if len(values) != len(entry.order):
            raise InputError(f"must have {len(entry.order)} entries, one for each parameter in order; got "
                             f"{len(values)}.",
                             field=f"population.{key}")
    for name in entry.left_out:
        if name in entry.specimens:
            raise InputError("must not be among the specimens too; remove one of them.",
                             field=f"population.left_out.{name}")
    check_covariance(np.array(entry.between_specimens), len(entry.order), "population.between_specimens")
