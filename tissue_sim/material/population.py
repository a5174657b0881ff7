"""What a material file says of the specimens that the material stands for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tissue_sim.decode import as_json_types, decode
from tissue_sim.errors import InputError, nearest
from tissue_sim.material.schema import Entry, Range, check_covariance
from tissue_sim.parameters import Parameter

_LISTS = ("mean", "spread", "mean_interval95", "spread_interval95")


class PopulationEntry(Entry, frozen=True, kw_only=True):
    """The specimens that the material stands for: its parameters in `order` are their mean.

    In the units of the file, one entry for each parameter: `mean`, `spread` (standard deviation between specimens),
    their 95 % intervals, `between_specimens` (covariance), and the values of each of the measured `specimens` that went
    in; `left_out` says why others did not.
    """

    order: tuple[str, ...]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    between_specimens: tuple[tuple[float, ...], ...]
    specimens: dict[str, tuple[float, ...]]
    left_out: dict[str, str] = {}
    mean_interval95: tuple[Range, ...] | None = None
    spread_interval95: tuple[Range, ...] | None = None

    def scaled(self, order: Sequence[str], factors: Sequence[float]) -> PopulationEntry:
        """The same under other names of the parameters and in other units."""
        sizes = np.asarray(factors)
        lists = {key: None if getattr(self, key) is None else (np.transpose(getattr(self, key)) * sizes).T.tolist()
                 for key in _LISTS}
        return decode(as_json_types({
            "order": list(order), **{key: value for key, value in lists.items() if value is not None},
            "between_specimens": (np.outer(sizes, sizes) * np.array(self.between_specimens)).tolist(),
            "specimens": {name: (sizes * values).tolist() for name, values in self.specimens.items()},
            "left_out": self.left_out}),
            PopulationEntry, "population")


def population_entry(stated: Mapping[str, Any], known: Mapping[str, Parameter]) -> PopulationEntry:
    """The entry of a population.

    Args:
        stated: what `PopulationEntry` holds, in SI, with the parameters by path. known: path -> parameter.

    Raises:
        InputError: a parameter that the material does not have, or another shape; with the field.
    """
    entry = decode(as_json_types(stated), PopulationEntry, "population")
    _check(entry, known)
    return entry.scaled([known[name].file_path for name in entry.order],
                        [1.0 / known[name].declaration.factor for name in entry.order])


def checked_population(entry: PopulationEntry, known: Mapping[str, float]) -> PopulationEntry:
    """The entry in SI as far as a file states units, with everything checked that types do not say.

    Args:
        known: name of a parameter in the file -> factor of its unit.
    """
    _check(entry, known)
    return entry.scaled(entry.order, [known[name] for name in entry.order])


def _check(entry: PopulationEntry, known: Mapping[str, Any]) -> None:
    for name in entry.order:
        if name not in known:
            raise InputError(f"this material has no parameter {name!r}{nearest(name, known)}", field="population.order")
    rows: dict[str, Any] = {key: getattr(entry, key) for key in _LISTS if getattr(entry, key) is not None}
    rows |= {f"specimens.{name}": values for name, values in entry.specimens.items()}
    for key, values in (*rows.items(), *((f"between_specimens[{i}]", row)
                                         for i, row in enumerate(entry.between_specimens))):
        if len(values) != len(entry.order):
            raise InputError(f"{len(values)} entries for the {len(entry.order)} parameters in order",
                             field=f"population.{key}")
    for name in entry.left_out:
        if name in entry.specimens:
            raise InputError("is among the specimens too; keep it in one of them", field=f"population.left_out.{name}")
    check_covariance(np.array(entry.between_specimens), len(entry.order), "population.between_specimens")
