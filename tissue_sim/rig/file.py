"""Rig files: ``NAME.rig.json``, what a load frame and its sensor do, apart from any material."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgspec

from tissue_sim.atomic_write import write_text
from tissue_sim.decode import decode, read_json, require_writable
from tissue_sim.errors import InputError
from tissue_sim.rig.rig import Rig

VERSION = 1
SCHEMA = f"tissue_sim/rig/{VERSION}"
#: Field of `Rig` -> (key in the file, SI units in one unit of the file).
KEYS: dict[str, tuple[str, float]] = {
    "contact_offset": ("contact_offset_mm", 1e-3),
    "displacement_gain": ("displacement_gain", 1.0),
    "backlash": ("backlash_mm", 1e-3),
    "step_loss": ("step_loss_mm", 1e-3),
    "step_loss_depth": ("step_loss_depth_mm", 1e-3),
    "compliance": ("compliance_mm_per_N", 1e-3),
    "guide_friction": ("guide_friction_N", 1.0),
    "rate_damping": ("rate_damping_N_s_per_mm", 1e3),
    "latency": ("latency_s", 1.0),
    "sensor_gain": ("sensor_gain", 1.0),
    "zero_offset": ("zero_offset_N", 1.0),
    "sensor_drift": ("sensor_drift_N_per_s", 1.0),
    "sampling_rate": ("sampling_rate_Hz", 1.0),
    "force_noise": ("force_noise_N", 1.0),
    "noise_correlation_time": ("noise_correlation_time_s", 1.0),
    "force_resolution": ("force_resolution_N", 1.0),
    "displacement_resolution": ("displacement_resolution_mm", 1e-3),
}
_RigFile = msgspec.defstruct(
    "RigFile", [("schema", str), *((key, float | None, None) for key, _ in KEYS.values()), ("seed", int, 0)],
    frozen=True, kw_only=True, forbid_unknown_fields=True)


def load_rig(path: str | Path) -> Rig:
    """The rig in a file; a key that is absent or null leaves its effect out.

    Raises:
        InputError: damaged JSON (line), a newer schema, an unknown key (names the nearest), a value of the wrong type
            or out of its range; with the file and the key.
    """
    path = Path(path)
    try:
        return _decode(read_json(path, "a rig file (JSON)"))
    except InputError as error:
        raise error.located(file=path) from None


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig in one step, with the effects that it has, 15 digits kept.

    Raises:
        InputError: a number too large in the unit of the file, or a place that cannot be written.
    """
    absent = Rig()
    data: dict[str, str | float | int] = {"schema": SCHEMA}
    for name, (key, unit) in KEYS.items():
        if (value := getattr(rig, name)) != getattr(absent, name):
            data[key] = float(f"{value / unit:.15g}")
    if rig.seed:
        data["seed"] = int(rig.seed)
    try:
        require_writable(data)
    except InputError as error:
        raise error.located(file=path) from None
    write_text(path, json.dumps(data, indent=2) + "\n")


def _decode(data) -> Rig:
    if not isinstance(data, dict):
        raise InputError('expected an object { "schema": ... }, found something else')
    schema = data.get("schema")
    version = re.fullmatch(r"tissue_sim/rig/([1-9][0-9]{0,8})", schema) if isinstance(schema, str) else None
    if not version:
        found = "the schema is missing" if schema is None else f"{schema!r} is not a rig schema"
        raise InputError(f"{found}, expected {SCHEMA!r}", field="schema")
    if int(version[1]) > VERSION:
        raise InputError(f"{schema!r} was written by a newer version, expected {SCHEMA!r}; update tissue-sim",
                         field="schema")
    file = decode(data, _RigFile)
    require_writable(data)
    stated = {name: unit * getattr(file, key) for name, (key, unit) in KEYS.items() if getattr(file, key) is not None}
    try:
        return Rig(**stated, seed=file.seed)
    except InputError as error:
        name = error.field.removeprefix("rig.")
        raise InputError(error.problem, field=KEYS.get(name, (name,))[0]) from None
