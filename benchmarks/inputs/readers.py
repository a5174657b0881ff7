"""Readers of untrusted input, each with a valid sample: recordings, settings, devices, and the wire protocol."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import calibration
import tissue_sim as ts
from benchmarks.inputs import sample_files
from calibration.campaign.campaign import load_campaign
from haptics.devices.contracts import DeviceError
from haptics.devices.settings import (
    parse_number_settings,
    parse_word_settings_and_remaining_text,
    split_address_and_settings_text,
)
from haptics.loop.ring import RingReader, RingWriter
from haptics.protocols import ati_serial, grbl, haply, rdt
from haptics.protocols.ati_calibration import parse_ati_calibration
from haptics.server import wire
from haptics.server.commands import ConfigurationCommands
from scenes.commands.record.protocol_file import read_protocol_file
from scenes.viewer.material_files import read_uploaded_material
from tissue_sim.experiment.protocol_text import parse_protocol

#: How an input is refused: files in one sentence, packets and lines of devices by the errors that their callers know.
REFUSALS = (ts.InputError, wire.WireError, DeviceError)
Reader = Callable[[bytes], Any]

CAMPAIGN = """[defaults]
kind = "needle_indentation"
tool = "flat"
tool_radius_mm = 8.0
edge_radius_mm = 1.0
[[specimen]]
name = "gel"
radius_mm = 40.0
height_mm = 70.0
[[test]]
name = "first"
recordings = ["run_*.csv"]
friction = 0.3
friction_wall = "stick"
contact = 0.01
[[test]]
name = "second"
recordings = ["run_1.csv"]
friction = "bonded"
hold_out = true
[fit]
method = "inverse_fem"
laws = ["neo_hooke", "reduced_polynomial_2"]
bulk_ratio = 100.0
offset = "fit"
bounds = { C10 = [100.0, 5000.0] }
start = { C10 = 1000.0 }
[noise]
force_N = 0.01
contact_jitter_mm = 0.03
"""
PROTOCOL = """[[specimen]]
name = "phantom"
radius_mm = 40.0
height_mm = 70.0
[[test]]
name = "plates"
kind = "lubricated_compression"
protocol = "repeat 3 (ramp 4mm @8mm/s; unload); hold 2s"
[limits]
force_N = 20.0
lowest_mm = -6.0
highest_mm = 12.0
speed_mm_s = 10.0
duration_s = 600.0
stiffness_N_per_mm = 2.0
force_margin_N = 1e3
[record]
replicates = 2
contact_force_N = 0.1
temperature_degC = 21.5
"""
STEPS = "approach 2mm; repeat 3 (ramp 10mm @0.248mm/s; unload); hold 60s; ramp 5 mm @ 1 mm/min"
CALIBRATION = ('<?xml version="1.0" encoding="utf-8"?>\n<FTSensor Serial="FT1" BodyStyle="Mini40" Family="DAQ" '
               'NumGages="6" CalFileVersion="1.1">\n<Calibration PartNumber="SI-40-2" CalDate="1/2/2003" '
               'ForceUnits="N" TorqueUnits="N-m" DistUnits="m" OutputRange="20" OutputBipolar="True">\n'
               '<BasicTransform Dx="3" Dy="20" Dz="100"/>\n'
               + "".join(f'<Axis Name="{axis}" values="1 2 3 4 5 6" max="40" scale="2.5"/>\n'
                         for axis in ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")) + "</Calibration>\n</FTSensor>\n")
STATE = json.dumps({"session_id": 7, "inverse3": [{
    "device_id": "04BA", "config": {"handedness": "right"}, "status": {"power_supply": True},
    "state": {"cursor_position": {"x": 0.1, "y": -0.02, "z": 0.3}, "cursor_velocity": {"x": 0, "y": 0.5, "z": 0}}}],
    "verse_grip": [{"device_id": "1", "state": {"orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}}]})


class _Tissue:
    """Test double of a tissue with the methods that commands call."""

    def set_parameters(self, **values: float) -> None:
        if not all(0 < value < 1e9 for value in values.values()):
            raise ts.InputError("is not a stiffness", field="C10")

    def save(self) -> object:
        return ()

    def restore(self, state: object) -> None:
        pass

    def reset(self) -> None:
        pass


class _Service:
    """Test double of the step service, with the methods that commands call."""

    def __init__(self) -> None:
        self.tissue, self.owner, self.counters = _Tissue(), None, {}

    def clear_last_step_record(self) -> None:
        pass

    def log(self, sentence: str) -> None:
        pass


def names() -> list[str]:
    """Return the names of all readers."""
    sample_files.short_curves()
    return [*sample_files.recordings(), *(f"import of {name}" for name in sample_files.IMPORTED), *_SETTINGS, *_DEVICES,
            *_WIRE]


_SETTINGS = ("sidecar", "material", "upload of a material", "rig", "profile", "campaign", "protocol file",
             "protocol text")
_DEVICES = ("ati calibration", "device settings", "haply state", "grbl line", "ati record", "rdt records",
            "rdt settings")
_WIRE = ("request", "reply", "command line", "ring")


def readers(folder: Path) -> dict[str, tuple[bytes, Reader]]:
    """Return for each reader a valid sample and a function of its bytes; files are written into `folder`."""
    sample_files.short_curves()
    every: dict[str, tuple[bytes, Reader]] = {}
    for name, (file, content, options) in sample_files.recordings().items():
        every[name] = content, _of_file(folder / file,
                                        lambda path, options=options: ts.read_recordings(path, **options))
        if name in sample_files.IMPORTED:
            wishes = calibration.ImportOptions(specimen={"radius_mm": 10.0, "height_mm": 12.0})
            every[f"import of {name}"] = content, _of_file(
                folder / file, lambda path, wishes=wishes: calibration.import_files([path], wishes=wishes))
    return every | _of_settings(folder) | _of_devices() | _of_the_wire(folder)


def _of_file(path: Path, read: Callable[[Path], Any]) -> Reader:
    def of_bytes(content: bytes) -> Any:
        path.write_bytes(content)
        return read(path)

    return of_bytes


def _text(read: Callable[[str], Any]) -> Reader:
    return lambda content: read(content.decode("utf-8", "surrogateescape"))


def _found(what: Any) -> Any:
    """Read one line of a device; drivers refuse a line by returning None."""
    if what is None:
        raise ts.InputError("is none")
    return what


def _of_settings(folder: Path) -> dict[str, tuple[bytes, Reader]]:
    table = "time [s],displacement [mm],force [N]\n" + "".join(f"{i},{i},{i}\n" for i in range(9))
    for name in ("run_1.csv", "run_2.csv", "sided.csv"):
        (folder / name).write_text(table, encoding="utf-8")
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.3, 1.0), ts.PronyTerm(0.2, 10.0))))
    ts.write_material_file(ts.MaterialFile.of(material), folder / "gel.material.json")
    ts.write_rig(ts.Rig(compliance=2e-5, sensor_gain=0.01, force_noise=0.02), folder / "frame.rig.json")
    sound = {name: (folder / name).read_bytes() for name in ("gel.material.json", "frame.rig.json")}
    sidecar = json.dumps({"name": "run", "specimen": {"shape": "cylinder", "radius_mm": 40.0}, "tags": ["a", 1, None]})
    return {
        "sidecar": (sidecar.encode(), _of_file(folder / "sided.json",
                                               lambda path: ts.read_recording(path.with_suffix(".csv")))),
        "material": (sound["gel.material.json"], _of_file(folder / "gel.material.json", ts.load_material)),
        "upload of a material": (sound["gel.material.json"],
                                 lambda content: read_uploaded_material("gel.material.json", content)),
        "rig": (sound["frame.rig.json"], _of_file(folder / "frame.rig.json", ts.load_rig)),
        "profile": (b"r [mm],z [mm]\n0,0\n4,1\n8,4\n8.5,9\n", _of_file(
            folder / "tool.csv", lambda path: ts.Tool("profile", profile_file=path))),
        "campaign": (CAMPAIGN.encode(), _of_file(folder / "study.toml", load_campaign)),
        "protocol file": (PROTOCOL.encode(), _of_file(folder / "protocol.toml", read_protocol_file)),
        "protocol text": (STEPS.encode(), _text(parse_protocol)),
    }


def _of_devices() -> dict[str, tuple[bytes, Reader]]:
    def settings(text: str) -> Any:
        _, rest = split_address_and_settings_text(text, "the port", "/dev/ttyUSB0,baud=9600")
        words, rest = parse_word_settings_and_remaining_text(rest, volts=("",), mode=("ascii", "binary"))
        return words, parse_number_settings(rest, rate_hz=1000.0, count=3)

    def haply_state(text: str) -> Any:
        try:
            return _found(haply.find_device_state_in_message(text))
        except ValueError as error:  # which its driver expects
            raise ts.InputError(str(error)) from None

    def grbl_line(text: str) -> Any:
        return _found(grbl.parse_report_or_none(text) or grbl.parse_setting_or_none(text)
                      or grbl.parse_answer_kind_and_number_or_none(text)
                      or grbl.parse_version_and_date_or_none(text) or grbl.parse_banner_version_or_none(text)
                      or grbl.parse_jog_or_none(text))

    def records(content: bytes) -> Any:
        return _found(rdt.unpack_records_or_none(content) or rdt.unpack_request_or_none(content))

    def serial(content: bytes) -> Any:
        return _found(ati_serial.decode_ascii_record_or_none(content)
                      or ati_serial.decode_binary_record_or_none(content))

    return {
        "ati calibration": (CALIBRATION.encode(), lambda content: parse_ati_calibration(content, "FT1.cal")),
        "device settings": (b"/dev/ttyUSB0,mode=binary,rate_hz=500,count=7", _text(settings)),
        "haply state": (STATE.encode(), _text(haply_state)),
        "grbl line": (b"<Hold:1|MPos:0.000,1.500,-3.250|FS:500,0|Ov:100,100,100|A:S>", _text(grbl_line)),
        "ati record": (ati_serial.encode_ascii_record_without_ending(ati_serial.AtiSerialRecord(0, (1, 2, 3, 4, 5, 6))),
                       serial),
        "rdt settings": (rdt.encode_settings_page(rdt.BoxSettings(1e6, 1e6, rate=7000.0, product="Net")),
                         rdt.parse_settings_page),
        "rdt records": (struct.pack("!3I6i", 1, 2, 0, 100, -200, 300, 4, 5, 6), records),
    }


def _of_the_wire(folder: Path) -> dict[str, tuple[bytes, Reader]]:
    commands = ConfigurationCommands(_Service(), {"scene": "needle"}, {"C10": 1500.0})  # type: ignore[arg-type]
    commands_sample = json.dumps({"command": "set_parameters", "parameters": {"C10": 1500.0}}).encode()

    def command(line: bytes) -> None:
        try:
            answer = b"".join(commands.execute(line))
        except ConnectionAbortedError:
            raise ts.InputError("a browser") from None
        said = json.loads(answer)
        if not answer.endswith(b"\n") or answer.count(b"\n") != 1:
            raise AssertionError(f"not one line: {answer!r}")
        if "error" in said:
            raise ts.InputError(said["error"])

    path = folder / "loop.ring"
    with RingWriter(path, 8) as writer:
        writer.write(b"\0" * writer.size)
        ring = path.read_bytes()

    def read_ring(content: bytes) -> Any:
        path.write_bytes(content)
        with RingReader(path) as reader:
            return reader.latest(), reader.read_ticks_after(0).records.size, reader.written_count, reader.ended

    return {
        "request": (wire.encode_request(wire.Request(3, 0.5, (0.0, 0.0, -0.01))),
                    wire.decode_request_without_pose_check),
        "reply": (wire.encode_reply(wire.Reply(0, 3, 0.5, force=(0.0, 0.0, 1.0))), wire.decode_reply),
        "request of version 2": (wire.encode_request(wire.Request(3, 0.5, (0.0, 0.0, -0.01), version=2)),
                                 wire.decode_request_without_pose_check),
        "reply of version 2": (wire.encode_reply(wire.Reply(0, 3, 0.5, force=(0.0, 0.0, 1.0), version=2)),
                               wire.decode_reply),
        "command line": (commands_sample, command),
        "ring": (ring, read_ring),
    }
