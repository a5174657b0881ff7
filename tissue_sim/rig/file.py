"""Rig files, ``NAME.rig.json``: effects of a load frame and its sensor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from tissue_sim.decode import (
    decode_struct,
    read_json_value,
    require_schema_kind_and_max_version,
    require_valid_json_values,
)
from tissue_sim.errors import located_and_converted_errors
from tissue_sim.files import write_text
from tissue_sim.parameters import convert_to_file_values, list_field_declarations, make_from_file_values
from tissue_sim.rig.fault import FAULTS
from tissue_sim.rig.rig import Rig

#: Version of the format.
VERSION = 1
#: Value of the key ``schema``.
SCHEMA = f"tissue_sim/rig/{VERSION}"
_KEYS = [what.key for what in list_field_declarations(Rig).values()]
_RigFile = msgspec.defstruct(
    "RigFile", [("schema", str), *((key, float | None, None) for key in _KEYS), ("seed", int, 0),
                ("faults", dict[str, dict[str, float]] | None, None)],
    frozen=True, kw_only=True, forbid_unknown_fields=True)


def load_rig(path: str | Path) -> Rig:
    """Read the rig of a file; a key that is absent or null means that the effect is absent.

    Raises:
        InputError: damaged JSON (line), a newer schema, an unknown key (names the nearest), a value of the wrong type
            or out of its range; with the file and the key.
    """
    path = Path(path)
    with located_and_converted_errors(file=path):
        return _decode_rig(read_json_value(path, "a rig file (JSON)"))


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig atomically, with the effects that it has and 15 digits.

    Raises:
        InputError: a number overflows in the unit of the file, or the path cannot be written.

    Examples:
        >>> bench = Rig(compliance=1e-5)
        >>> write_rig(bench, "bench.rig.json")
        >>> load_rig("bench.rig.json") == bench
        True
    """
    absent = convert_to_file_values(Rig())
    data: dict[str, Any] = {"schema": SCHEMA}
    data |= {key: value for key, value in convert_to_file_values(rig).items() if value != absent.get(key)}
    if rig.seed:
        data["seed"] = int(rig.seed)
    if rig.faults:
        data["faults"] = {name: convert_to_file_values(fault) for name, fault in rig.faults.items()}
    with located_and_converted_errors(file=path):
        require_valid_json_values(data)
    write_text(path, json.dumps(data, indent=2) + "\n")


def _decode_rig(data) -> Rig:
    """Return the rig in the decoded JSON data of a rig file; InputError for an invalid schema, key or value."""
    require_schema_kind_and_max_version(data, "rig", VERSION)
    file = decode_struct(data, _RigFile)
    require_valid_json_values(data)
    stated = {key: number for key in _KEYS if (number := getattr(file, key)) is not None}
    faults = {name: make_from_file_values(FAULTS.find(name, f"faults.{name}"), content, f"faults.{name}")
              for name, content in (file.faults or {}).items()}
    return make_from_file_values(Rig, stated, "", seed=file.seed, faults=faults)
