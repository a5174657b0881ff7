"""PROTOCOL.toml: a campaign whose tests have a motion instead of recordings, the devices, and the limits."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from calibration.campaign.campaign import Campaign, load_campaign
from calibration.campaign.named_files import files_named, with_files_named
from calibration.campaign.schema import PRISM
from calibration.report.additions import to_toml
from haptics.recorder.lag import measure_lag
from haptics.recorder.plan import Plan
from haptics.safety.motion_guard import DEFAULT_SENSOR_SILENCE, MotionLimits
from tissue_sim.decode import decode, read_toml
from tissue_sim.errors import InputError, located
from tissue_sim.experiment.protocol_text import parse_protocol
from tissue_sim.experiment.segments import legs
from tissue_sim.files import read_text
from tissue_sim.recording.file import read_recording
from tissue_sim.specimen import Specimen

#: Tables that a campaign does not have.
OWN_TABLES = ("devices", "virtual", "limits", "record")
#: m/s, until a protocol names one: the study's.
_EXPECTED = "a protocol (TOML)"
_SPEED = 0.248e-3


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How every table is read: unknown keys are errors."""


class DevicesTable(_Table, frozen=True, kw_only=True):
    """``[devices]``: as `haptics.devices.back_ends` names them."""

    sensor: str = "virtual:"
    stage: str = "virtual:"


class VirtualTable(_Table, frozen=True, kw_only=True):
    """``[virtual]``: the specimen on a virtual bench, and what stands between it and the numbers."""

    material: str | None = None
    rig: str | None = None
    surface_mm: float = 2.0
    rate_Hz: float = 200.0
    resolution_N: float = 0.02
    range_N: float = 120.0
    encoder: bool = True
    faults: str = ""
    remembers: bool = False


class LimitsTable(_Table, frozen=True, kw_only=True):
    """``[limits]``."""

    force_N: float
    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    duration_s: float
    stiffness_N_per_mm: float
    force_margin_N: float
    sensor_silence_s: float = DEFAULT_SENSOR_SILENCE
    tare_N: float = 10.0
    on_stop: Literal["stand", "retract"] = "stand"


class RecordTable(_Table, frozen=True, kw_only=True):
    """``[record]``."""

    replicates: int = 3
    contact: Literal["auto", "force", "here"] = "auto"
    touch: Literal["each", "once"] = "each"
    contact_force_N: float = 0.1
    approach_speed_mm_s: float = 1.0
    retract_mm: float = 1.0
    preconditioning: int = 0
    rest_s: float = 0.0
    sign: int = 1
    axis: str = "Fz"
    lag_from: str | None = None
    lubricant: str | None = None
    temperature_degC: float | None = None
    operator: str | None = None
    notes: str | None = None


class _OwnTables(_Table, frozen=True, kw_only=True):
    devices: DevicesTable = DevicesTable()
    virtual: VirtualTable = VirtualTable()
    limits: LimitsTable
    record: RecordTable = RecordTable()


@dataclass(frozen=True)
class ProtocolFile:
    """A protocol, read and checked.

    Attributes:
        path: of it. digest: SHA-256 of its bytes.
        campaign: its tests, with a protocol each and no recordings.
        plans: one a test, by name.
        limits, devices, virtual, record: its tables.
        content: the whole file.
    """

    path: Path
    digest: str
    campaign: Campaign
    plans: Mapping[str, Plan]
    limits: MotionLimits
    devices: DevicesTable
    virtual: VirtualTable
    record: RecordTable
    content: Mapping[str, Any]

    @property
    def files(self) -> list[Path]:
        """Meshes, profiles and rigs that its tests depend on."""
        return files_named(self.content, self.path.parent)

    def campaign_text(self, recordings: Mapping[str, list[str]], file_name: Callable[[Path], str]) -> str:
        """The campaign of what was recorded, for ``tissue-sim calibrate``; tests without recordings are left out.

        Args:
            recordings: of each test. file_name: gives a mesh, profile or rig, by its path, its name in the campaign.
        """
        content = {key: value for key, value in self.content.items() if key not in OWN_TABLES}
        tests = []
        for entry, name in zip(content["test"], self.plans, strict=True):
            if recordings.get(name):
                entry = {key: value for key, value in entry.items() if key != "protocol"}
                tests.append({**entry, "name": name, "recordings": recordings[name]})
        defaults = {key: value for key, value in content.get("defaults", {}).items() if key != "protocol"}
        content = {**content, "test": tests, **({"defaults": defaults} if defaults else {})}
        content = with_files_named(content, self.path.parent, file_name)
        return f"# Recorded by {self.path.name}.\n{to_toml(content)}"


def read_protocol_file(path: Path) -> ProtocolFile:
    """Read and check a protocol.

    Raises:
        InputError: anything wrong with it, with the file and the dotted field.
    """
    content, text = read_toml(path, _EXPECTED), read_text(path, _EXPECTED)
    own = {key: content[key] for key in OWN_TABLES if key in content}
    with located(file=path):
        if "limits" not in own:
            raise InputError("a motor needs limits; give force_N, lowest_mm, highest_mm, speed_mm_s, duration_s, "
                             "stiffness_N_per_mm and force_margin_N", field="limits")
        tables = decode(own, _OwnTables)
        campaign = _campaign(path, content)
        lag = _lag(tables.record, path.parent)
        plans = {test.name: _plan(test, tables.record, lag, number, content,
                                  prism=test.specimen is not None and test.specimen.name in campaign.prisms)
                 for number, test in enumerate(campaign.tests)}
        protocol = ProtocolFile(path, hashlib.sha256(text.encode()).hexdigest(), campaign, plans,
                                _limits(tables.limits), tables.devices, tables.virtual, tables.record, content)
        if "fit" in content:
            _check_calibrates(protocol)
        return protocol


def _check_calibrates(protocol: ProtocolFile) -> None:
    """Read the campaign that the recordings will be in, as ``tissue-sim calibrate`` will.

    Raises:
        InputError: what that refuses, before anything was measured for it.
    """
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        recordings = {name: [f"{number}.csv"] for number, name in enumerate(protocol.plans)}
        for name, in recordings.values():
            Path(folder, name).touch()
        path = Path(folder, "campaign.toml")
        path.write_text(protocol.campaign_text(recordings, lambda file: str(file.resolve())), encoding="utf-8")
        try:
            load_campaign(path)
        except InputError as error:
            raise InputError(f"{error.problem} (calibrate would refuse what is recorded with it)",
                             field=error.field) from None


def _campaign(path: Path, content: Mapping[str, Any]) -> Campaign:
    """The tests, read as those of a planned campaign; what is to be fitted plays no part."""
    for number, entry in enumerate(content.get("test", [])):
        if isinstance(entry, dict) and "recordings" in entry:
            raise InputError("is what will be recorded; give a protocol instead, such as 'ramp 10mm @0.248mm/s; "
                             "hold 60s; unload'", field=f"test[{number}].recordings")
        if isinstance(entry, dict) and "protocol" not in {**content.get("defaults", {}), **entry}:
            raise InputError("there is no motion to record; give protocol = 'ramp 10mm @0.248mm/s; hold 60s; unload'",
                             field=f"test[{number}].protocol")
    planned = {key: value for key, value in content.items() if key not in (*OWN_TABLES, "fit", "noise")}
    planned["fit"] = {"method": "inverse_fem", "laws": ["neo_hooke"]}
    # Beside the file, for the files that it names.
    with tempfile.NamedTemporaryFile("w", suffix=".toml", prefix=f".{path.stem}_", dir=path.parent, encoding="utf-8",
                                     delete=False) as file:
        file.write(to_toml(planned))
    try:
        return load_campaign(file.name, planned=True)
    except InputError as error:
        raise InputError(error.problem, field=error.field) from None
    finally:
        Path(file.name).unlink(missing_ok=True)


def _lag(record: RecordTable, folder: Path) -> dict[str, Any] | None:
    """What a recording on something stiff says of the sensor's lag."""
    if record.lag_from is None:
        return None
    found = measure_lag(read_recording(folder / record.lag_from))
    return {"value_s": found.value, "interval95_s": list(found.interval), "from": record.lag_from}


def _plan(test: Any, record: RecordTable, lag: dict[str, Any] | None, number: int,
          content: Mapping[str, Any], *, prism: bool) -> Plan:
    if test.experiment is None:
        raise InputError(f"a {test.kind.name} is not done with a tool that is pushed in; leave the test out",
                         field=f"{test.place}.kind")
    entry = {**content.get("defaults", {}), **content["test"][number]}
    about = {"specimen": None if test.specimen is None else _about(test.specimen, prism=prism),
             "kind": test.kind.name, "tool": entry.get("tool", "plate"), "tool_radius_mm": entry.get("tool_radius_mm"),
             "friction": entry.get("friction"), "lubricant": record.lubricant,
             "temperature_degC": record.temperature_degC, "operator": record.operator, "notes": record.notes}
    # A plate that is glued to the specimen touches from the beginning.
    glued = test.experiment.tool.is_plate and test.experiment.friction == "bonded"
    contact = record.contact if record.contact != "auto" else "here" if glued else "force"
    return Plan(test.name, tuple(legs(parse_protocol(test.protocol), _SPEED)), record.replicates, contact,
                record.touch, record.contact_force_N, record.approach_speed_mm_s * 1e-3, record.retract_mm * 1e-3,
                record.preconditioning, record.rest_s, record.sign, record.axis, lag,
                {key: value for key, value in about.items() if value is not None})


def _about(specimen: Specimen, *, prism: bool) -> dict[str, Any]:
    """What recordings say of it; of a prism no more than is known."""
    if prism:
        return {"name": specimen.name, "shape": PRISM, "area_mm2": 1e6 * specimen.area,
                "height_mm": specimen.sizes["height_mm"]}
    return {"name": specimen.name, "shape": specimen.shape, **specimen.stated}


def _limits(table: LimitsTable) -> MotionLimits:
    return MotionLimits(table.force_N, table.lowest_mm * 1e-3, table.highest_mm * 1e-3, table.speed_mm_s * 1e-3,
                        table.duration_s, table.stiffness_N_per_mm * 1e3, table.force_margin_N, table.sensor_silence_s,
                        table.tare_N, table.on_stop == "retract")
