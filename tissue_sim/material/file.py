"""Material files, ``NAME.material.json``: output of a calibration and input of the simulator.

A file may contain the statistics of the measured specimens (`PopulationEntry`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tissue_sim.decode import (
    convert_to_json_types,
    decode_struct,
    read_json_value,
    require_schema_kind_and_max_version,
    require_valid_json_values,
)
from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.files import write_text
from tissue_sim.laws import Law, find_law, find_stability_range
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.schema import (
    BulkEntry,
    CovarianceEntry,
    LayerEntry,
    MaterialFileEntry,
    ParameterEntry,
    PoroelasticityEntry,
    Provenance,
    PunctureEntry,
    Range,
    RegionEntry,
    SofteningEntry,
    StabilityEntry,
    ValidRange,
    ViscoelasticEntry,
    check_covariance,
    convert_entries_to_si_with_factors,
    get_parameter_values_by_name,
    make_component_entries,
    make_law_bulk_and_parameter_entries,
    make_material_arguments_from_entries,
)
from tissue_sim.parameters import Parameter, parameters, split_path_into_names_and_indices
from tissue_sim.public_names import with_old_names
from tissue_sim.version import __version__

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


#: Version of the format; files of version 1 (law and bulk response only) are valid files of version 2.
VERSION = 2
#: Value of the key ``schema``.
SCHEMA = f"tissue_sim/material/{VERSION}"
#: Keys of the parts of a material besides law, parameters and bulk response.
EFFECTS = ("viscoelastic", "softening", "layers", "poroelasticity", "puncture", "effects", "regions")


@with_old_names(covariance_SI="paths_and_covariance_SI")
class MaterialFile(MaterialFileEntry, frozen=True, kw_only=True):
    """Material with uncertainty, population statistics and provenance.

    Files may state stresses in Pa, kPa or MPa. In a `MaterialFile` that was read, or made by `of`, the parameters of
    the law are in SI; other parts keep the units that their keys name.
    """

    schema: str
    name: str = ""
    law: str
    parameters: dict[str, ParameterEntry]
    covariance: CovarianceEntry | None = None
    bulk: BulkEntry
    viscoelastic: ViscoelasticEntry | None = None
    softening: SofteningEntry | None = None
    layers: tuple[LayerEntry, ...] | None = None
    poroelasticity: PoroelasticityEntry | None = None
    puncture: PunctureEntry | None = None
    effects: dict[str, dict[str, Any]] | None = None
    regions: dict[str, RegionEntry] | None = None
    population: PopulationEntry | None = None
    density_kg_m3: float | None = None
    valid_range: ValidRange | None = None
    stability: StabilityEntry | None = None
    provenance: Provenance | None = None

    @classmethod
    def of(cls, material: Material, *, standard_errors: Mapping[str, float] | None = None, covariance=None,
           others: Sequence[str] = (), population: Mapping[str, Any] | None = None,
           valid_range: ValidRange | Mapping[str, Any] | None = None,
           provenance: Provenance | Mapping[str, Any] | None = None) -> MaterialFile:
        """Make the checked content of a file from a material, and compute the range of stability of its law.

        Args:
            material: the material.
            standard_errors: path -> standard error, SI, with paths as in `tissue_sim.parameters`: ``C10``,
                ``viscoelastic.terms[0].tau``. None: from the covariance.
            covariance: covariance of the law's parameters in their order, then of `others`, SI, shape (m, m).
            others: paths of the parameters that follow those of the law in the covariance.
            population: fields of `PopulationEntry`, in SI and by path.
            valid_range: for example ``{"stretch": [0.8, 1.0]}``.
            provenance: fields of `Provenance`; software, version and date are added if they are missing.

        Raises:
            InputError: an invalid value, with its dotted path.

        Examples:
            >>> from tissue_sim import Material
            >>> file = MaterialFile.of(Material("neo_hooke", {"C10": 1000.0}), standard_errors={"C10": 20.0})
            >>> file.standard_errors
            {'C10': 20.0}
        """
        law, known = material.energy_law, _get_parameters_except_bulk_by_path(material)
        errors = {name: float(error) for name, error in (standard_errors or {}).items()}
        for name in (*errors, *others):
            if name not in known:
                field = f"standard_errors.{name}" if name in errors else "covariance.order"
                raise InputError(
                    f"this material has no parameter {name!r}{make_hint_with_similar_or_known_words(name, known)}",
                    field=field)
        stated = None
        if covariance is not None:
            matrix = np.asarray(covariance, dtype=float)
            order = (*law.parameters, *others)
            check_covariance(matrix, len(order))
            errors = errors or dict(zip(order, np.sqrt(np.diag(matrix)).tolist(), strict=True))
            factors = np.array([known[name].declaration.factor for name in order])
            stated = CovarianceEntry(order=tuple(known[name].path_in_file for name in order),
                                     matrix=_convert_matrix_to_tuples(matrix / np.outer(factors, factors)))
        stability = find_stability_range(law, material.values)
        specimens = None if population is None else make_population_entry_from_si_fields(population, known)
        given = convert_to_json_types(provenance or {})
        history = {"software": "tissue-sim", "version": __version__,
                   "date": datetime.now(UTC).isoformat(timespec="seconds"), **given}
        return check_and_convert_material_file_to_si(cls(
            schema=SCHEMA, name=material.name, **make_law_bulk_and_parameter_entries(material, errors),
            covariance=stated, population=specimens, **make_component_entries(material, errors),
            density_kg_m3=material.density,
            valid_range=decode_struct(convert_to_json_types(valid_range), ValidRange | None, "valid_range"),
            stability=StabilityEntry(stable_from=stability.stable_from, stable_to=stability.stable_to,
                                     stretch_range=stability.stretch_range, text=stability.describe()),
            provenance=decode_struct(history, Provenance, "provenance")))

    @property
    def material(self) -> Material:
        """Material that the file describes; the file must be read or checked, so that its parameters are in SI."""
        return Material(self.law, get_parameter_values_by_name(self.parameters), self.bulk.make_bulk(self.law),
                        self.density_kg_m3, self.name,
                        **make_material_arguments_from_entries(self._component_entries_by_key))

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors that the file states, SI, by path of the parameter; the file must be read or checked."""
        stated, content = {}, msgspec.to_builtins(self)
        for path, each in _get_parameters_except_bulk_by_path(self.material).items():
            *place, key = split_path_into_names_and_indices(each.path_in_file)
            entry = reduce(getitem, place, content)
            own = entry.get("parameters", {})
            error = own[key].get("standard_error") if key in own else entry.get("standard_errors", {}).get(key)
            if error is not None:
                stated[path] = each.declaration.factor * error
        return stated

    @property
    def paths_and_covariance_SI(self) -> tuple[tuple[str, ...], np.ndarray] | None:
        """Paths of m parameters, and their covariance, SI, shape (m, m); None if the file states no covariance."""
        if self.covariance is None:
            return None
        known = {each.path_in_file: each for each in _get_parameters_except_bulk_by_path(self.material).values()}
        stated = [known[name] for name in self.covariance.order]
        factors = np.array([each.declaration.factor for each in stated])
        return tuple(each.path for each in stated), np.outer(factors, factors) * np.array(self.covariance.matrix)

    @property
    def _component_entries_by_key(self) -> dict[str, Any]:
        """Entries of the material's components by key, in the units of the file; None for components it lacks."""
        return {key: getattr(self, key) for key in EFFECTS}


def load_material(path: str | Path) -> Material:
    """Read a material file and return its `Material`; errors as in `read_material_file`."""
    return read_material_file(path).material


def read_material_file(path: str | Path) -> MaterialFile:
    """Read and check a material file; the result is in SI.

    Raises:
        InputError: damaged JSON (line), a newer schema, an unknown or missing key, a wrong type, unit, covariance or
            range; with the file and the dotted path of the field.
    """
    path = Path(path)
    data = read_json_value(path, "a material file (JSON)")
    with located_and_converted_errors(file=path):
        return make_material_file_from_json_data(data)


def write_material_file(material_file: MaterialFile, path: str | Path) -> None:
    """Check a material file and write it atomically, indented and with every digit.

    Raises:
        InputError: an invalid value, or a path that cannot be written; nothing is written then.

    Examples:
        >>> from tissue_sim import Material
        >>> gel = Material("neo_hooke", {"C10": 1000.0})
        >>> write_material_file(MaterialFile.of(gel), "gel.material.json")
        >>> load_material("gel.material.json") == gel
        True
    """
    with located_and_converted_errors(file=path):
        data = convert_material_file_to_json_data(material_file)
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)
    # Lists of numbers on one line: a line break inside brackets is never part of a JSON string.
    text = re.sub(r"\[\n([^\[\]{}\"]*)\n\s*\]", lambda match: f"[{' '.join(match[1].split())}]", text)
    write_text(path, text + "\n")


def convert_material_file_to_json_data(material_file: MaterialFile) -> dict[str, Any]:
    """Check a material file and return it as JSON data, the inverse of `make_material_file_from_json_data`."""
    return msgspec.to_builtins(check_and_convert_material_file_to_si(material_file))


def make_material_file_from_json_data(data: Any) -> MaterialFile:
    """Check the decoded JSON of a material file and return it as a `MaterialFile` in SI; see `read_material_file`."""
    require_schema_kind_and_max_version(data, "material", VERSION)
    _require_decodable_map_values(data, "parameters", ParameterEntry)
    regions = data.get("regions")
    if isinstance(regions, dict):
        for name, entry in regions.items():
            with located_and_converted_errors(field=f"regions.{name}"):
                if isinstance(entry, dict):
                    _require_decodable_map_values(entry, "parameters", ParameterEntry)
                decode_struct(entry, RegionEntry)
    return check_and_convert_material_file_to_si(decode_struct(data, MaterialFile, ""))


def _require_decodable_map_values(data: dict[str, Any], key: str, kind: type[MaterialFileEntry]) -> None:
    """Require that each value of the map `data[key]` can be decoded; an error names the key of the value."""
    entries = data.get(key)
    if isinstance(entries, dict):
        for name, entry in entries.items():
            decode_struct(entry, kind, f"{key}.{name}")


def check_and_convert_material_file_to_si(file: MaterialFile) -> MaterialFile:
    """Check a material file and return it with the parameters of its laws, covariance and population in SI.

    Raises:
        InputError: an invalid value, with the dotted path of the field.
    """
    content = msgspec.to_builtins(file)
    require_schema_kind_and_max_version(content, "material", VERSION)
    require_valid_json_values(content)
    law = find_law(file.law)
    parameters, factors = convert_entries_to_si_with_factors(law.name, file.parameters)
    regions = {}
    for name, region in (file.regions or {}).items():
        regions[name], more = region.convert_to_si_with_factors(f"regions.{name}")
        factors |= more
    _ = file.bulk.make_bulk(law.name)
    _require_ordered_valid_ranges(file)
    if file.provenance is not None and file.provenance.date is not None:
        try:
            datetime.fromisoformat(file.provenance.date)
        except ValueError:
            raise InputError(f"{file.provenance.date!r} is not an ISO 8601 date such as 2026-01-31T12:00:00+00:00",
                             field="provenance.date") from None
    file = msgspec.structs.replace(file, schema=SCHEMA, parameters=parameters, regions=regions or None)
    _ = file.material  # checks missing parameters, shear modulus, bulk response and density
    if file.covariance is not None:
        order = file.covariance.order
        _check_parameter_order(order, law, [each.path_in_file
                                            for each in _get_parameters_except_bulk_by_path(file.material).values()])
        scale = np.array([factors.get(name, 1.0) for name in order])
        if (lengths := [len(row) for row in file.covariance.matrix]) != [len(order)] * len(order):
            raise InputError(f"must have {len(order)} rows of {len(order)} numbers; got rows of {lengths}.",
                             field="covariance.matrix")
        matrix = np.outer(scale, scale) * np.array(file.covariance.matrix, dtype=float)
        check_covariance(matrix, len(order))
        file = msgspec.structs.replace(file, covariance=CovarianceEntry(order=order,
                                                                        matrix=_convert_matrix_to_tuples(matrix)))
    if file.population is not None:
        known = {each.path_in_file: factors.get(each.path_in_file, 1.0)
                 for each in _get_parameters_except_bulk_by_path(file.material).values()}
        file = msgspec.structs.replace(file, population=make_checked_population_entry_in_si(file.population, known))
    require_valid_json_values(msgspec.to_builtins(file))  # a number near 1e308 MPa overflows in Pa
    return file


def _get_parameters_except_bulk_by_path(material: Material) -> dict[str, Parameter]:
    """Return path -> parameter for all parameters except the bulk response, whose uncertainty a file cannot state."""
    return {path: each for path, each in parameters(material).items() if each.part is not Bulk}


def _check_parameter_order(order: Sequence[str], law: Law, known: Sequence[str]) -> None:
    """Require that a covariance lists the law's parameters first, in their order, then other known ones, each once."""
    m = len(law.parameters)
    if tuple(order[:m]) != law.parameters or len(set(order)) != len(order):
        raise InputError(f"must be the parameters of {law.name} in its order, {', '.join(law.parameters)}, then "
                         f"others, each once; got {', '.join(order)}.", field="covariance.order")
    for name in order[m:]:
        if name not in known:
            raise InputError(
                f"this material has no parameter {name!r}{make_hint_with_similar_or_known_words(name, known)}",
                field="covariance.order")


def _convert_matrix_to_tuples(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return the rows of a matrix as tuples of floats."""
    return tuple(map(tuple, matrix.tolist()))


def _require_ordered_valid_ranges(file: MaterialFile) -> None:
    """Require lowest <= highest in the valid ranges and in the range of stability, and stretches above 0."""
    ranges = {f"valid_range.{name}": value for name, value in
              (msgspec.structs.asdict(file.valid_range) if file.valid_range else {}).items() if value is not None}
    if file.stability:
        ranges["stability.stretch_range"] = file.stability.stretch_range
    for field, (low, high) in ranges.items():
        if low > high:
            raise InputError(f"must be [lowest, highest]; got {low:g} to {high:g}.", field=field)
        if "stretch" in field and low <= 0:
            raise InputError(f"must be above 0 (1 is undeformed); got {low:g}.", field=field)
