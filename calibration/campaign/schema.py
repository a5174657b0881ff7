"""The campaign file as it stands on disk: every key, its type, and errors that name the key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from types import GenericAlias
from typing import Any, Literal, cast

import msgspec

from tissue_sim.decode import decode, read_toml
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import tool_sizes
from tissue_sim.files import read_bytes
from tissue_sim.specimen import SPECIMENS, specimen_sizes, specimen_texts

#: A body of any cross-section, of which homogeneous tests need no more than its area.
PRISM = "prism"
Pair = tuple[float, float]
#: JSON's words in TOML.
_WORDS = {"object": "a table, written [name] or { ... }", "array": "a list, written [...]"}
_PLACE_IN_TEST = re.compile(r"^test\[(?P<number>\d+)\]\.(?P<key>\w+)(?P<rest>.*)$")
#: What the tables of ``[fit]`` hold for each parameter.
BY_PARAMETER = {"start": "a number", "fixed": "a number", "prior": "[mean, standard deviation]",
                 "bounds": "[low, high]"}


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How every table is read: unknown keys are errors."""


class SpecimenTable(_Table, frozen=True, kw_only=True):
    """``[[specimen]]``, but for what its shape states, see `campaign_table`."""

    name: str | None = None
    shape: str = "cylinder"
    area_mm2: float | None = None
    gravity: bool = False
    height_is: Literal["moulded", "placed"] = "moulded"
    density_kg_m3: float | None = None

    @property
    def sizes(self) -> dict[str, float]:
        """Key of `tissue_sim.specimen.specimen_sizes` -> value, of those that are stated."""
        return {key: value for key in specimen_sizes() if (value := getattr(self, key)) is not None}

    @property
    def texts(self) -> dict[str, str]:
        """Key of `tissue_sim.specimen.specimen_texts` -> value, of those that are stated."""
        return {key: value for key in specimen_texts() if (value := getattr(self, key)) is not None}


class TestTable(_Table, frozen=True, kw_only=True):
    """``[[test]]``, but for the sizes of its tool, see `campaign_table`."""

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
    hold_out: bool = False
    contact: Literal["recorded", "find"] | float = "recorded"
    failure: Literal["cut", "keep", "refuse"] = "cut"
    control: Literal["find", "displacement", "force"] = "find"
    leave_out: Literal["find"] | list[int] | dict[str, list[int]] = "find"
    rig: str | None = None

    @property
    def tool_sizes(self) -> dict[str, float]:
        """Key of `tissue_sim.experiment.tools.tool.tool_sizes` -> value, of those that are stated."""
        return {key: value for key in tool_sizes() if (value := getattr(self, key)) is not None}


class FitTable(_Table, frozen=True, kw_only=True):
    """``[fit]``."""

    method: Literal["analytical", "inverse_fem"] = "analytical"
    laws: list[str]
    bulk_ratio: float | None = None
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
    """``[noise]``."""

    force_N: float | Literal["estimate"] = "estimate"
    nominal_stress_Pa: float | Literal["estimate"] = "estimate"
    correlation_time_s: float | Literal["estimate"] | None = None
    contact_jitter_mm: float | Literal["estimate"] | None = None
    zero_jitter_N: float | Literal["estimate"] | None = None


class CampaignTable(_Table, frozen=True, kw_only=True):
    """The whole file.

    Attributes:
        questions: of an import that the user has not decided yet; the campaign is refused until there is none.
    """

    specimen: list[SpecimenTable] = []
    test: list[TestTable]
    fit: FitTable
    noise: NoiseTable = NoiseTable()
    questions: list[str] = []


def campaign_table() -> type[CampaignTable]:
    """The whole file, with the kinds of test, the shapes of specimens and the sizes of both that there are now, those
    of packages included."""
    how: dict[str, Any] = {"frozen": True, "forbid_unknown_fields": True, "kw_only": True}
    sizes = [(key, float | None, None) for key in tool_sizes()]
    test = msgspec.defstruct("TestTable", [("kind", Literal[tuple(KINDS)]), *sizes], bases=(TestTable,), **how)
    shapes = [("shape", Literal[(*SPECIMENS, PRISM)], "cylinder"),
              *((key, float | None, None) for key in specimen_sizes()),
              *((key, str | None, None) for key in specimen_texts())]
    specimen = msgspec.defstruct("SpecimenTable", shapes, bases=(SpecimenTable,), **how)
    tests: Any = GenericAlias(list, (test,))
    specimens: Any = GenericAlias(list, (specimen,))
    table = msgspec.defstruct("CampaignTable", [("test", tests), ("specimen", specimens, [])], bases=(CampaignTable,),
                              **how)
    return cast(type[CampaignTable], table)


@dataclass(frozen=True)
class Defaults:
    """``[defaults]``: keys that every ``[[test]]`` has that does not state them itself.

    Attributes:
        keys: that it states.
        own: of each test, the keys that it states itself.
    """

    keys: frozenset[str]
    own: tuple[frozenset[str], ...]

    def located(self, error: InputError, path: Path) -> InputError:
        """The error with the file and, where a default is at fault, with its place there: ``defaults.columns``."""
        match = _PLACE_IN_TEST.match(error.field or "")
        place = error.field
        if match and match["key"] in self.keys and match["key"] not in self.own[int(match["number"])]:
            place = f"defaults.{match['key']}{match['rest']}"
        return InputError(error.problem, file=error.file if error.file is not None else path, line=error.line,
                          field=place)


def _take_defaults(content: dict[str, Any], path: Path) -> Defaults:
    """Move ``[defaults]`` into the tests of `content`. A test that states a format does without default columns, and
    one that states columns without a default format."""
    defaults = content.pop("defaults", {})
    if not isinstance(defaults, dict):
        raise InputError("expected a table, written [defaults]", file=path, field="defaults")
    tests = [test for test in content.get("test", []) if isinstance(test, dict)]
    own = tuple(frozenset(test) for test in tests)
    for test in tests:
        instead = {"format": "columns", "columns": "format"}
        left = {instead[key] for key in instead if key in test}
        test.update({key: value for key, value in defaults.items() if key not in test and key not in left})
    return Defaults(frozenset(defaults), own)


def decode_campaign(path: Path) -> tuple[CampaignTable, bytes, Defaults]:
    """The file's tables with types checked, its bytes, and what its tests have from ``[defaults]``.

    Raises:
        InputError: missing or unreadable file, not TOML (line), unknown key (names the nearest), missing key, wrong
            type.
    """
    content = read_toml(path, "a campaign (TOML)")
    for key in ("specimen", "test"):
        if not isinstance(content.get(key, []), list):
            raise InputError(f"expected a list of tables, written [[{key}]]", file=path, field=key)
    defaults = _take_defaults(content, path)
    try:
        _check_by_parameter(content.get("fit"))
        return decode(content, campaign_table(), words=_WORDS), read_bytes(path, "a campaign (TOML)"), defaults
    except InputError as error:
        # TOML has no null: what may be left out is not written.
        problem = error.problem.replace(" or null", "")
        raise defaults.located(InputError(problem, field=error.field), path) from None


def _check_by_parameter(fit: Any) -> None:
    """Types in the tables whose keys are parameters, which the decoder does not name."""
    for key, expected in BY_PARAMETER.items():
        table = fit.get(key) if isinstance(fit, dict) else None
        for name, value in table.items() if isinstance(table, dict) else ():
            numbers = value if expected.startswith("[") else [value]
            length = 2 if expected.startswith("[") else 1
            if not (isinstance(numbers, list) and len(numbers) == length
                    and all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)):
                raise InputError(f"expected {expected}, got {value!r}", field=f"fit.{key}.{name}")
