"""Schema of a campaign file: keys, types, errors that name the key, and the files that a campaign names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import GenericAlias
from typing import Any, Literal, cast

import msgspec

from tissue_sim.decode import decode_struct, read_toml_dict
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import interpret_shape_or_profile_path, list_all_tool_sizes_by_key
from tissue_sim.files import read_bytes
from tissue_sim.material.softening import SofteningForm
from tissue_sim.specimen import SPECIMENS, specimen_sizes, specimen_texts


def resolve_path_to_text(path: Path) -> str:
    """Return the absolute path of a file as text, with symbolic links resolved."""
    return str(path.resolve())


def replace_mesh_profile_and_rig_paths(content: Mapping[str, Any], folder: Path,
                                       name: Callable[[Path], str]) -> dict[str, Any]:
    """Return the content of a campaign with other paths of its specimen meshes, tool profiles and rigs.

    Files on disk are not changed.

    Args:
        content: parsed content of the campaign file.
        folder: folder of the campaign file.
        name: returns the new path, as text, of the file with a given path.
    """
    of_specimens = {key for kind in SPECIMENS.values() for key in kind.paths}

    def replace_profile_or_rig_path(key: str, value: Any) -> Any:
        """Return the value of a key of ``[[test]]`` with the new path if the value names a file."""
        path = folder / value if key == "rig" else interpret_shape_or_profile_path(value, folder)[1] if key == "tool" \
            else None
        return value if path is None else name(path)

    renamed = dict(content)
    if "specimen" in content:
        renamed["specimen"] = [{key: name(folder / value) if key in of_specimens else value
                                for key, value in table.items()} for table in content["specimen"]]
    if "defaults" in content:
        renamed["defaults"] = {key: replace_profile_or_rig_path(key, value) for key,
                               value in content["defaults"].items()}
    renamed["test"] = [{key: replace_profile_or_rig_path(key, value) for key, value in table.items()}
                       for table in content["test"]]
    return renamed


def list_mesh_profile_and_rig_paths(content: Mapping[str, Any], folder: Path) -> list[Path]:
    """Return the paths of meshes, tool profiles and rigs that a campaign names.

    See `replace_mesh_profile_and_rig_paths`.
    """
    found: list[Path] = []

    def collect_path(path: Path) -> str:
        """Append a path to `found` and return the path unchanged."""
        found.append(path)
        return str(path)

    replace_mesh_profile_and_rig_paths(content, folder, collect_path)
    return found


#: Shape of a body with an arbitrary constant cross-section, of which homogeneous tests use the area only.
PRISM = "prism"
#: Two numbers.
Pair = tuple[float, float]
#: JSON type -> description in TOML terms for messages.
_WORDS = {"object": "a table, written [name] or { ... }", "array": "a list, written [...]"}
#: Dotted field of a key in a test table.
_FIELD_IN_TEST = re.compile(r"^test\[(?P<number>\d+)\]\.(?P<key>\w+)(?P<rest>.*)$")
#: Tables of ``[fit]`` with one entry per parameter -> form of an entry.
BY_PARAMETER = {"start": "a number", "fixed": "a number", "prior": "[mean, standard deviation]",
                "bounds": "[low, high]"}


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the tables of a campaign file; the decoder rejects unknown keys."""


class SpecimenTable(_Table, frozen=True, kw_only=True):
    """Table ``[[specimen]]`` without the keys of shapes; `build_campaign_table_type_with_plugin_keys` adds these."""

    name: str | None = None
    shape: str = "cylinder"
    area_mm2: float | None = None
    gravity: bool = False
    height_is: Literal["moulded", "placed"] = "moulded"
    density_kg_m3: float | None = None

    @property
    def stated_sizes_in_file_units(self) -> dict[str, float]:
        """Stated sizes by their keys, see `tissue_sim.specimen.specimen_sizes`."""
        return {key: value for key in specimen_sizes() if (value := getattr(self, key)) is not None}

    @property
    def stated_text_values(self) -> dict[str, str]:
        """Stated texts by their keys, see `tissue_sim.specimen.specimen_texts`."""
        return {key: value for key in specimen_texts() if (value := getattr(self, key)) is not None}


class TestTable(_Table, frozen=True, kw_only=True):
    """Table ``[[test]]`` without the sizes of tools, which `build_campaign_table_type_with_plugin_keys` adds."""

    name: str | None = None
    specimen: str | None = None
    kind: str
    recordings: list[str] = []
    format: str = "native"
    columns: dict[str, Any] | None = None
    skip_lines: int | None = None
    delimiter: str | None = None
    sheet: str | int | list[str | int] | None = None
    curve: int | list[int] | None = None
    decimal: str | None = None
    tool: str | None = None
    friction: str | float | None = None
    friction_base: str | float | None = None
    friction_wall: str | float | None = None
    contact_laws: dict[str, dict[str, float]] | None = None
    tilt_mm: float | None = None
    offset_mm: float | None = None
    tilt_deg: float | None = None
    solver: str | None = None
    slip: float | None = None
    speed_mm_s: float | None = None
    protocol: str | None = None
    max_strain: float | None = None
    pre_strain: float | None = None
    hold_out: bool = False
    contact: Literal["recorded", "find"] | float = "recorded"
    failure: Literal["cut", "keep", "refuse"] = "cut"
    control: Literal["find", "displacement", "force"] = "find"
    leave_out: Literal["find"] | list[int] | dict[str, list[int]] = "find"
    rig: str | None = None

    @property
    def stated_tool_sizes_in_file_units(self) -> dict[str, float]:
        """Stated sizes of the tool by their keys, see `tissue_sim.experiment.tools.tool.list_all_tool_sizes_by_key`."""
        return {key: value for key in list_all_tool_sizes_by_key() if (value := getattr(self, key)) is not None}


class FitTable(_Table, frozen=True, kw_only=True):
    """Keys of the table ``[fit]`` in the units of the file; see `calibration.campaign.campaign.FitSettings`."""

    method: Literal["analytical", "inverse_fem"] = "analytical"
    laws: list[str]
    bulk_ratio: float | None = None
    softening_form: SofteningForm = "tanh"
    stable: bool | Pair = False
    offset: Literal["none", "fit"] = "none"
    offset_bounds_mm: float | None = None
    offset_prior_mm: float | None = None
    zero_bounds_N: float | None = None
    zero_prior_N: float | None = None
    strain_points: int | None = None
    starts: int | None = None
    start: dict[str, float] = {}
    fixed: dict[str, float] = {}
    prior: dict[str, Pair] = {}
    bounds: dict[str, Pair] = {}
    scope: dict[str, str | list[str]] = {}


class NoiseTable(_Table, frozen=True, kw_only=True):
    """Keys of the table ``[noise]`` in the units of the file; see `calibration.campaign.campaign.Noise`."""

    force_N: float | Literal["estimate"] = "estimate"
    nominal_stress_Pa: float | Literal["estimate"] = "estimate"
    modulus_relative: float | Literal["estimate"] = "estimate"
    displacement_mm: float | Literal["estimate"] = "estimate"
    correlation_time_s: float | Literal["estimate"] | None = None
    contact_jitter_mm: float | Literal["estimate"] | None = None
    zero_jitter_N: float | Literal["estimate"] | None = None


class CampaignTable(_Table, frozen=True, kw_only=True):
    """Tables of a campaign file.

    Attributes:
        specimen: tables ``[[specimen]]``.
        test: tables ``[[test]]``.
        fit: table ``[fit]``.
        noise: table ``[noise]``.
        questions: open questions of an import; a campaign with open questions is rejected.
    """

    specimen: list[SpecimenTable] = []
    test: list[TestTable]
    fit: FitTable
    noise: NoiseTable = NoiseTable()
    questions: list[str] = []


def build_campaign_table_type_with_plugin_keys() -> type[CampaignTable]:
    """Make the class of a campaign file, whose keys include the kinds, shapes and sizes that plug-ins register."""
    options: dict[str, Any] = {"frozen": True, "forbid_unknown_fields": True, "kw_only": True}
    sizes = [(key, float | None, None) for key in list_all_tool_sizes_by_key()]
    test = msgspec.defstruct("TestTable", [("kind", Literal[tuple(KINDS)]), *sizes], bases=(TestTable,), **options)
    shapes = [("shape", Literal[(*SPECIMENS, PRISM)], "cylinder"),
              *((key, float | None, None) for key in specimen_sizes()),
              *((key, str | None, None) for key in specimen_texts())]
    specimen = msgspec.defstruct("SpecimenTable", shapes, bases=(SpecimenTable,), **options)
    tests: Any = GenericAlias(list, (test,))
    specimens: Any = GenericAlias(list, (specimen,))
    table = msgspec.defstruct("CampaignTable", [("test", tests), ("specimen", specimens, [])], bases=(CampaignTable,),
                              **options)
    return cast(type[CampaignTable], table)


@dataclass(frozen=True)
class DefaultedTestKeys:
    """Keys of the table ``[defaults]``, which apply to all tests that do not state them.

    Attributes:
        keys: keys in ``[defaults]``.
        own: for each test, the keys that the test itself states.
    """

    keys: frozenset[str]
    own: tuple[frozenset[str], ...]

    def make_error_with_file_and_field(self, error: InputError, path: Path) -> InputError:
        """Return the error with the campaign file, and with the field ``defaults.KEY`` if a default caused the error.

        An error in ``test[2].speed_mm_s`` becomes ``defaults.speed_mm_s`` if test 2 does not state this key itself.
        """
        match = _FIELD_IN_TEST.match(error.field or "")
        field = error.field
        if match and match["key"] in self.keys and match["key"] not in self.own[int(match["number"])]:
            field = f"defaults.{match['key']}{match['rest']}"
        return InputError(error.problem, file=error.file if error.file is not None else path, line=error.line,
                          field=field)


def _move_defaults_into_test_tables_in_place(content: dict[str, Any], path: Path) -> DefaultedTestKeys:
    """Copy the keys of ``[defaults]`` into the tests of `content` and remove the table.

    Default columns do not apply to a test that states a format, and a default format does not apply to a test that
    states columns.
    """
    defaults = content.pop("defaults", {})
    if not isinstance(defaults, dict):
        raise InputError(f"defaults must be a table; got {type(defaults).__name__}. Write [defaults].", file=path,
                         field="defaults")
    tests = [test for test in content.get("test", []) if isinstance(test, dict)]
    own = tuple(frozenset(test) for test in tests)
    for test in tests:
        excludes = {"format": "columns", "columns": "format"}
        skipped = {excludes[key] for key in excludes if key in test}
        test.update({key: value for key, value in defaults.items() if key not in test and key not in skipped})
    return DefaultedTestKeys(frozenset(defaults), own)


def decode_campaign_tables_bytes_and_defaults(path: Path) -> tuple[CampaignTable, bytes, DefaultedTestKeys]:
    """Read a campaign file and check the types of all keys.

    Returns:
        The tables, the bytes of the file, and the applied defaults.

    Raises:
        InputError: missing or unreadable file, invalid TOML (with the line), unknown key (with the most similar known
            key), missing key, or wrong type.
    """
    content = read_toml_dict(path, "a campaign (TOML)")
    for key in ("specimen", "test"):
        if not isinstance(content.get(key, []), list):
            raise InputError(f"{key} must be a list of tables; got {type(content[key]).__name__}. Write [[{key}]].",
                             file=path, field=key)
    defaults = _move_defaults_into_test_tables_in_place(content, path)
    try:
        _check_types_of_parameter_values(content.get("fit"))
        return decode_struct(content, build_campaign_table_type_with_plugin_keys(),
                             words=_WORDS), read_bytes(path, "a campaign (TOML)"), defaults
    except InputError as error:
        # TOML has no null; optional keys are left out.
        problem = error.problem.replace(" or null", "")
        raise defaults.make_error_with_file_and_field(InputError(problem, field=error.field), path) from None


def _check_types_of_parameter_values(fit: Any) -> None:
    """Raise an `InputError` for wrong types of values in ``fit.start``, ``fit.fixed``, ``fit.prior``, ``fit.bounds``.

    Their keys are parameters, which the decoder does not name in its errors.
    """
    for key, expected in BY_PARAMETER.items():
        table = fit.get(key) if isinstance(fit, dict) else None
        for name, value in table.items() if isinstance(table, dict) else ():
            numbers = value if expected.startswith("[") else [value]
            length = 2 if expected.startswith("[") else 1
            if not (isinstance(numbers, list) and len(numbers) == length
                    and all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)):
                raise InputError(f"{name} must be {expected}; got {value!r}. Correct the value.",
                                 field=f"fit.{key}.{name}")
