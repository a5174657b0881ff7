"""Protocol file of `tissue-sim record`: a campaign with motions instead of recordings, devices and limits."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from calibration.campaign.campaign import Campaign, load_campaign
from calibration.campaign.schema import PRISM, list_mesh_profile_and_rig_paths, replace_mesh_profile_and_rig_paths
from haptics.recorder.lag import estimate_force_lag
from haptics.recorder.plan import BenchTestPlan
from haptics.safety.force_control import ForceControlLimits
from haptics.safety.motion_guard import DEFAULT_SENSOR_SILENCE, MotionLimits
from tissue_sim.decode import decode_struct, format_toml, read_toml_dict
from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.protocol import STUDY_SPEED
from tissue_sim.experiment.protocol_legs import iterate_motion_legs
from tissue_sim.experiment.protocol_text import parse_protocol
from tissue_sim.files import read_text
from tissue_sim.recording.file import read_recording
from tissue_sim.specimen import Specimen

#: Tables of a protocol file that a campaign file does not have.
PROTOCOL_TABLES = ("devices", "virtual", "limits", "force_control", "record")
#: Description of the file for error messages.
_EXPECTED = "a protocol (TOML)"


class _ProtocolTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base class of the tables; unknown keys are errors."""


class DevicesTable(_ProtocolTable, frozen=True, kw_only=True):
    """Table ``[devices]``: force sensor and stage of the run.

    Attributes:
        sensor: force sensor, ``NAME:SETTINGS`` of `haptics.devices.back_ends.FORCE_SENSORS`.
        stage: stage, ``NAME:SETTINGS`` of `haptics.devices.back_ends.STAGES`.
    """

    sensor: str = "virtual:"
    stage: str = "virtual:"


class VirtualTable(_ProtocolTable, frozen=True, kw_only=True):
    """Table ``[virtual]``: specimen, rig and devices of the virtual rig.

    Attributes:
        material: material file of the specimen; None is the silicone of the reference study.
        rig: rig file with compliance, noise and sensor errors; None is an ideal rig.
        surface_mm: position of the stage at which the tool touches the specimen, mm.
        rate_Hz: sampling rate of the sensor, Hz.
        resolution_N: resolution of the sensor, N.
        range_N: range of the sensor, N; beyond it the sensor saturates.
        encoder: whether the stage measures its position.
        faults: faults of the devices, ``NAME=NUMBER,...``.
        remembers: whether the specimen has a memory (relaxation, softening); it is then simulated during the run.
    """

    material: str | None = None
    rig: str | None = None
    surface_mm: float = 2.0
    rate_Hz: float = 200.0
    resolution_N: float = 0.02
    range_N: float = 120.0
    encoder: bool = True
    faults: str = ""
    remembers: bool = False


class LimitsTable(_ProtocolTable, frozen=True, kw_only=True):
    """Table ``[limits]``: limits of the motion; a run stops beyond them.

    Attributes:
        force_N: largest force, N.
        lowest_mm: lowest position of the stage, mm.
        highest_mm: highest position of the stage, mm.
        speed_mm_s: largest speed, mm/s.
        duration_s: longest duration of the run, s.
        stiffness_N_per_mm: largest expected stiffness of the specimen, N/mm; with `force_margin_N` it limits the speed.
        force_margin_N: increase of the force that is allowed while the stage stops, N.
        sensor_silence_s: longest time without a reading, s.
        tare_N: largest reading of the sensor before it is zeroed for the first time, N.
        on_stop: "stand": the tool stays where it is; "retract": the tool moves back.
    """

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


class ForceControlTable(_ProtocolTable, frozen=True, kw_only=True):
    """Table ``[force_control]``: limits of a motion with a prescribed force; a protocol without forces needs none.

    Attributes:
        depth_mm: largest depth below the contact point, mm.
        speed_mm_s: largest speed of the stage, mm/s.
        force_error_N: largest difference to the prescribed force, N, for longer than half a second.
    """

    depth_mm: float
    speed_mm_s: float
    force_error_N: float


class RecordTable(_ProtocolTable, frozen=True, kw_only=True):
    """Table ``[record]``: procedure and metadata of the recordings.

    Attributes:
        replicates: recordings of each test.
        contact: "force": find contact by the force; "here": the tool is in contact at the start; "auto": "here" for a
            plate that is bonded to the specimen, otherwise "force".
        touch: find contact before "each" recording or "once".
        contact_force_N: force at which contact is detected, N.
        approach_speed_mm_s: speed of the approach, mm/s.
        retract_mm: distance of the tool from the specimen between recordings, mm.
        preconditioning: number of motions without recording before the first recording.
        rest_s: pause between two motions, s.
        sign: 1, or -1 if the reading of the sensor decreases in compression.
        axis: channel of the sensor that is recorded as force.
        lag_from: recording on a stiff object, from which the lag of the sensor is measured.
        lubricant: metadata of the recordings.
        temperature_degC: metadata of the recordings, degrees Celsius.
        operator: metadata of the recordings.
        notes: metadata of the recordings.
    """

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


class _ProtocolOnlyTables(_ProtocolTable, frozen=True, kw_only=True):
    """All tables of `PROTOCOL_TABLES`."""

    devices: DevicesTable = DevicesTable()
    virtual: VirtualTable = VirtualTable()
    limits: LimitsTable
    force_control: ForceControlTable | None = None
    record: RecordTable = RecordTable()


@dataclass(frozen=True)
class ProtocolFile:
    """Contents of a valid protocol file.

    Attributes:
        path: path of the file.
        digest: SHA-256 of its text.
        campaign: tests of the file, with protocols and without recordings.
        plans: plan of each test by its name.
        limits: limits of the motion.
        devices: table ``[devices]``.
        virtual: table ``[virtual]``.
        record: table ``[record]``.
        content: whole content of the file.
    """

    path: Path
    digest: str
    campaign: Campaign
    plans: Mapping[str, BenchTestPlan]
    limits: MotionLimits
    devices: DevicesTable
    virtual: VirtualTable
    record: RecordTable
    content: Mapping[str, Any]

    @property
    def mesh_profile_and_rig_files(self) -> list[Path]:
        """Files of meshes, tool profiles and rigs that the tests use."""
        return list_mesh_profile_and_rig_paths(self.content, self.path.parent)

    def make_campaign_text(self, recordings: Mapping[str, list[str]], file_name: Callable[[Path], str]) -> str:
        """Return the campaign file (TOML) of the recordings; tests without recordings are left out.

        Args:
            recordings: file names of the recordings of each test.
            file_name: function that maps the path of a mesh, profile or rig to its name in the campaign.
        """
        content = {key: value for key, value in self.content.items() if key not in PROTOCOL_TABLES}
        tests = []
        for entry, name in zip(content["test"], self.plans, strict=True):
            if recordings.get(name):
                entry = {key: value for key, value in entry.items() if key != "protocol"}
                control = {"control": "force"} if self.plans[name].uses_force_control else {}
                tests.append({**entry, "name": name, "recordings": recordings[name], **control})
        defaults = {key: value for key, value in content.get("defaults", {}).items() if key != "protocol"}
        content = {**content, "test": tests, **({"defaults": defaults} if defaults else {})}
        content = replace_mesh_profile_and_rig_paths(content, self.path.parent, file_name)
        return f"# Recorded by {self.path.name}.\n{format_toml(content)}"


def read_protocol_file(path: Path) -> ProtocolFile:
    """Read and check a protocol file.

    Raises:
        InputError: invalid content; the error has the file and the dotted field.
    """
    content, text = read_toml_dict(path, _EXPECTED), read_text(path, _EXPECTED)
    tables_content = {key: content[key] for key in PROTOCOL_TABLES if key in content}
    with located_and_converted_errors(file=path):
        if "limits" not in tables_content:
            raise InputError("is required, because a motor moves. Give force_N, lowest_mm, highest_mm, speed_mm_s, "
                             "duration_s, stiffness_N_per_mm and force_margin_N", field="limits")
        tables = decode_struct(tables_content, _ProtocolOnlyTables)
        campaign = _read_protocol_tests_as_campaign(path, content)
        lag = _compute_lag_from_recording_or_none(tables.record, path.parent)
        table = tables.force_control
        control = None if table is None else ForceControlLimits(table.depth_mm * 1e-3, table.speed_mm_s * 1e-3,
                                                                table.force_error_N)
        plans = {test.name: _make_test_plan(test, tables.record, lag, control, number, content,
                                            prism=test.specimen is not None and test.specimen.name in campaign.prisms)
                 for number, test in enumerate(campaign.tests)}
        protocol = ProtocolFile(path, hashlib.sha256(text.encode()).hexdigest(), campaign, plans,
                                _convert_limits_to_si(tables.limits), tables.devices, tables.virtual, tables.record,
                                content)
        if "fit" in content:
            _check_future_campaign(protocol)
        return protocol


def _check_future_campaign(protocol: ProtocolFile) -> None:
    """Check that ``tissue-sim calibrate`` will accept the campaign of the recordings, before anything is measured.

    Raises:
        InputError: an error of the campaign.
    """
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        recordings = {name: [f"{number}.csv"] for number, name in enumerate(protocol.plans)}
        for name, in recordings.values():
            Path(folder, name).touch()
        path = Path(folder, "campaign.toml")
        path.write_text(protocol.make_campaign_text(recordings, lambda file: str(file.resolve())), encoding="utf-8")
        try:
            load_campaign(path)
        except InputError as error:
            raise InputError(f"{error.problem} (calibrate would not accept the recordings)",
                             field=error.field) from None


def _read_protocol_tests_as_campaign(path: Path, content: Mapping[str, Any]) -> Campaign:
    """Read the tests as a planned campaign; the tables ``[fit]`` and ``[noise]`` are ignored.

    Raises:
        InputError: a test without protocol or with recordings, or another error of the campaign.
    """
    for number, entry in enumerate(content.get("test", [])):
        if isinstance(entry, dict) and "recordings" in entry:
            raise InputError("must not be given in a protocol file, because `record` makes the recordings. Give a "
                             "protocol instead, such as 'ramp 10mm @0.248mm/s; hold 60s; unload'",
                             field=f"test[{number}].recordings")
        if isinstance(entry, dict) and "protocol" not in {**content.get("defaults", {}), **entry}:
            raise InputError("is required. Give a motion such as 'ramp 10mm @0.248mm/s; hold 60s; unload'",
                             field=f"test[{number}].protocol")
    planned = {key: value for key, value in content.items() if key not in (*PROTOCOL_TABLES, "fit", "noise")}
    # Nothing is fitted; the ratio is required in confined compression.
    planned["fit"] = {"method": "inverse_fem", "laws": ["neo_hooke"], "bulk_ratio": 1000.0}
    # The temporary file is in the folder of the protocol file, because the paths in it are relative to that folder.
    with tempfile.NamedTemporaryFile("w", suffix=".toml", prefix=f".{path.stem}_", dir=path.parent, encoding="utf-8",
                                     delete=False) as file:
        file.write(format_toml(planned))
    try:
        return load_campaign(file.name, planned=True)
    except InputError as error:
        raise InputError(error.problem, field=error.field) from None
    finally:
        Path(file.name).unlink(missing_ok=True)


def _compute_lag_from_recording_or_none(record: RecordTable, folder: Path) -> dict[str, Any] | None:
    """Return the lag of the sensor with its 95 % interval, measured in the recording ``lag_from``; None without one."""
    if record.lag_from is None:
        return None
    found = estimate_force_lag(read_recording(folder / record.lag_from))
    return {"value_s": found.value, "interval95_s": list(found.interval), "from": record.lag_from}


def _make_test_plan(test: Any, record: RecordTable, lag: dict[str, Any] | None, control: ForceControlLimits | None,
                    number: int,
                    content: Mapping[str, Any], *, prism: bool) -> BenchTestPlan:
    """Return the plan of a test: its motion, replicates, search for contact and metadata.

    Args:
        test: test of the campaign.
        record: table ``[record]``.
        lag: lag of the sensor with its 95 % interval, from `_compute_lag_from_recording_or_none`; None: not measured.
        control: limits of the control of the force; None: not stated.
        number: index of the test.
        content: whole content of the file.
        prism: whether the specimen is a prism of known cross-section only.

    Raises:
        InputError: a kind of test without a tool.
    """
    if test.experiment is None:
        raise InputError(f"tests of kind {test.kind.name} have no tool and cannot be recorded. Leave the test out",
                         field=f"{test.place}.kind")
    entry = {**content.get("defaults", {}), **content["test"][number]}
    about = {"specimen": None if test.specimen is None else _make_specimen_metadata(test.specimen, prism=prism),
             "kind": test.kind.name, "tool": entry.get("tool", "plate"), "tool_radius_mm": entry.get("tool_radius_mm"),
             "friction": entry.get("friction"), "lubricant": record.lubricant,
             "temperature_degC": record.temperature_degC, "operator": record.operator, "notes": record.notes}
    # A plate that is bonded to the specimen is in contact from the start.
    bonded = test.experiment.tool.is_plate and test.experiment.friction == "bonded"
    contact = record.contact if record.contact != "auto" else "here" if bonded else "force"
    legs = tuple(iterate_motion_legs(parse_protocol(test.protocol), STUDY_SPEED, allows_force=True))
    return BenchTestPlan(test.name, legs, record.replicates,
                         contact, record.touch, record.contact_force_N, record.approach_speed_mm_s * 1e-3,
                         record.retract_mm * 1e-3, record.preconditioning, record.rest_s, record.sign, record.axis,
                         lag, {key: value for key, value in about.items() if value is not None}, control)


def _make_specimen_metadata(specimen: Specimen, *, prism: bool) -> dict[str, Any]:
    """Return the metadata of a specimen for its recordings; of a prism only cross-section and height are known."""
    if prism:
        return {"name": specimen.name, "shape": PRISM, "area_mm2": 1e6 * specimen.area,
                "height_mm": specimen.sizes["height_mm"]}
    return {"name": specimen.name, "shape": specimen.shape, **specimen.values_by_file_key}


def _convert_limits_to_si(table: LimitsTable) -> MotionLimits:
    """Convert the table ``[limits]`` to SI units."""
    return MotionLimits(table.force_N, table.lowest_mm * 1e-3, table.highest_mm * 1e-3, table.speed_mm_s * 1e-3,
                        table.duration_s, table.stiffness_N_per_mm * 1e3, table.force_margin_N, table.sensor_silence_s,
                        table.tare_N, table.on_stop == "retract")
