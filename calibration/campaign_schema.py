"""The campaign file as it stands on disk: every key, its type, and errors that name the key."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Literal

import msgspec

from tissue_sim.errors import InputError, nearest

KINDS = ("lubricated_compression", "uniaxial_tension", "simple_shear", "bonded_compression", "friction_compression",
         "needle_indentation")
Pair = tuple[float, float]


class SpecimenTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[[specimen]]``."""

    name: str | None = None
    shape: Literal["cylinder", "prism"] = "cylinder"
    radius_mm: float | None = None
    area_mm2: float | None = None
    height_mm: float
    gravity: bool = False
    height_is: Literal["moulded", "placed"] = "moulded"
    density_kg_m3: float | None = None


class ColumnTable(msgspec.Struct, frozen=True, kw_only=True):
    """A column of a foreign file, spelt out."""

    name: str
    unit: str | None = None
    sign: Literal[1, -1] = 1


class TestTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[[test]]``."""

    name: str | None = None
    specimen: str | None = None
    kind: Literal[KINDS]
    recordings: list[str] = []
    format: str = "native"
    columns: dict[str, str | ColumnTable] | None = None
    skip_lines: int | None = None
    tool: str = "plate"
    tool_radius_mm: float | None = None
    edge_radius_mm: float | None = None
    half_angle_deg: float | None = None
    friction: str | float | None = None
    friction_base: str | float | None = None
    friction_wall: float | None = None
    speed_mm_s: float | None = None
    protocol: str | None = None
    max_strain: float | None = None
    hold_out: bool = False
    rig: str | None = None


class FitTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[fit]``."""

    method: Literal["analytical", "inverse_fem"] = "analytical"
    laws: list[str]
    bulk_ratio: float | None = None
    offset: Literal["none", "fit"] = "none"
    offset_bounds_mm: float = 0.5
    offset_prior_mm: float | None = None
    zero_bounds_N: float | None = None
    zero_prior_N: float | None = None
    strain_points: int | None = None
    start: dict[str, float] = {}
    fixed: dict[str, float] = {}
    prior: dict[str, Pair] = {}
    bounds: dict[str, Pair] = {}


class NoiseTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[noise]``."""

    force_N: float | Literal["estimate"] = "estimate"
    nominal_stress_Pa: float | Literal["estimate"] = "estimate"
    contact_jitter_mm: float | Literal["estimate"] | None = None
    zero_jitter_N: float | Literal["estimate"] | None = None


class CampaignTable(msgspec.Struct, frozen=True, kw_only=True):
    """The whole file."""

    specimen: list[SpecimenTable] = []
    test: list[TestTable]
    fit: FitTable
    noise: NoiseTable = NoiseTable()


_TABLES = {"specimen": SpecimenTable, "test": TestTable, "fit": FitTable, "noise": NoiseTable}


def decode_campaign(path: Path) -> tuple[CampaignTable, bytes]:
    """The file's tables with types checked, and its bytes.

    Raises:
        InputError: missing or unreadable file, not TOML (line), unknown key (names the nearest), missing key, wrong
            type.
    """
    try:
        data = path.read_bytes()
        content = tomllib.loads(data.decode("utf-8"))
    except FileNotFoundError:
        raise InputError("no such file; give the path of a campaign file (TOML)", file=path) from None
    except IsADirectoryError:
        raise InputError("is a folder; give the path of a campaign file (TOML)", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start + 1} is not UTF-8; save the campaign as UTF-8 text", file=path) from None
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        text = re.sub(r"\s*\(at .*\)$", "", str(error))
        where = f" at column {place[2]}" if place else ""
        raise InputError(f"this is not valid TOML: {text}{where}", file=path,
                         line=int(place[1]) if place else None) from None
    _check_keys(content, path)
    try:
        return msgspec.convert(content, CampaignTable), data
    except msgspec.ValidationError as error:
        raise _as_input_error(str(error), content, path) from None


def _check_keys(content: dict[str, Any], path: Path) -> None:
    """Unknown keys, before types: the nearest known key is the better answer to a typing slip."""
    for key, value in content.items():
        if key not in _TABLES:
            raise InputError(f"unknown key{nearest(key, _TABLES)}", file=path, field=key)
        known = _TABLES[key].__struct_fields__
        is_list = key in ("specimen", "test")
        if is_list != isinstance(value, list):
            raise InputError(f"expected {'a list of tables, written [[' if is_list else 'one table, written ['}"
                             f"{key}{']]' if is_list else ']'}", file=path, field=key)
        for i, table in enumerate(value if is_list else [value]):
            place = f"{key}[{i}]" if is_list else key
            if not isinstance(table, dict):
                raise InputError(f"expected a table, written {'[[' if is_list else '['}{key}{']]' if is_list else ']'}",
                                 file=path, field=place)
            for name in table:
                if name not in known:
                    raise InputError(f"unknown key{nearest(name, known)}", file=path, field=f"{place}.{name}")
            _check_columns(table.get("columns"), f"{place}.columns", path)


def _check_columns(columns: Any, place: str, path: Path) -> None:
    """Keys of the columns that are spelt out."""
    for channel, column in columns.items() if isinstance(columns, dict) else ():
        known = ColumnTable.__struct_fields__
        for name in column if isinstance(column, dict) else ():
            if name not in known:
                raise InputError(f"unknown key{nearest(name, known)}", file=path, field=f"{place}.{channel}.{name}")


def _as_input_error(message: str, content: dict[str, Any], path: Path) -> InputError:
    """msgspec's message as one sentence with the dotted field."""
    text, _, place = message.partition(" - at `")
    field = re.sub(r"^\$\.?", "", place.rstrip("`")) or None
    missing = re.match(r"Object missing required field `(.*)`", text)
    if missing:
        return InputError("this key is needed and missing", file=path,
                          field=f"{field}.{missing[1]}" if field else missing[1])
    found = re.match(r"Invalid enum value '(.*)'", text)
    if found:
        key = field.rsplit(".", 1)[-1] if field else ""
        choices = {"kind": KINDS, "shape": ("cylinder", "prism"), "method": ("analytical", "inverse_fem"),
                   "offset": ("none", "fit"), "height_is": ("moulded", "placed")}.get(key, ("estimate",))
        return InputError(f"unknown value {found[1]!r}{nearest(found[1], choices)}", file=path, field=field)
    text = text.replace("Expected", "expected").replace("`", "")
    return InputError(f"{text[0].lower()}{text[1:]}", file=path, field=field)
