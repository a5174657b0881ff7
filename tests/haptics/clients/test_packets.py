"""Golden packets of haptics/clients/packets: the protocol page, Python, C and C# agree to the last bit."""

import json
import math
import re
import struct

import pytest
from client_drivers import PARAMETERS, Driver, build_driver, to_hex

from haptics.clients import get_source_folder
from haptics.server.steps import StepService
from haptics.server.wire import (
    OtherVersionError,
    Reply,
    Request,
    Status,
    WireError,
    decode_reply,
    decode_request_without_pose_check,
    encode_reply,
    encode_request,
)
from tissue_sim.tool_force import ForceStatus, ToolForce

FOLDER = get_source_folder() / "packets"
PACKETS = json.loads((FOLDER / "packets.json").read_text(encoding="utf-8"))["packets"]
CODES = {"uint16": "H", "uint32": "I", "uint64": "Q", "float64": "d"}
#: Bits of the quiet NaN that Python and C write.
NAN = bytes.fromhex("7ff8000000000000")


def packets(kind):
    return [pytest.param(packet, id=packet["file"]) for packet in PACKETS if packet["kind"] == kind]


def read(packet):
    raw = (FOLDER / packet["file"]).read_bytes()
    assert len(raw) == packet["size"]
    return raw


def flat(value):
    return [number for each in value for number in flat(each)] if isinstance(value, list | tuple) else [value]


def number(value):
    """A number of `packets.json`, whose integers of 64 bits and special values are strings."""
    if isinstance(value, list):
        return tuple(map(number, value))
    return value if not isinstance(value, str) else int(value) if value.isdigit() else float(value)


def fields(packet):
    return {name: number(value) for name, value in packet["fields"].items() if name not in ("magic", "reserved")}


def bits(values):
    return [NAN if isinstance(value, float) and math.isnan(value) else
            struct.pack(">d", value) if isinstance(value, float) else value for value in values]


@pytest.fixture(scope="module", params=PARAMETERS)
def driver(request, root, tmp_path_factory):
    with Driver(build_driver(root, request.param, tmp_path_factory.mktemp(request.param))) as driver:
        yield driver


def test_the_folder_has_the_packets_that_its_index_describes():
    assert sorted(path.name for path in FOLDER.glob("*.bin")) == sorted(packet["file"] for packet in PACKETS)
    replies = [fields(packet) for packet in PACKETS if packet["kind"] == "reply"]
    assert {reply["status"] for reply in replies} >= set(map(int, Status))
    assert {reply["version"] for reply in replies} == {2, 3}
    assert {reply["flags"] for reply in replies} >= {0, 1, 2, 4, 8}


@pytest.mark.parametrize("packet", [*packets("request"), *packets("reply")])
def test_a_packet_has_the_layout_of_the_protocol_page(root, packet):
    """Unpacked with the offsets of docs/wire_protocol.md alone."""
    rows = re.findall(r"^\| (\d+) \| (\w+)(?: x (\d+))? \| (\w+) \|",
                      (root / "docs" / "wire_protocol.md").read_text(encoding="utf-8"), re.MULTILINE)
    second = [k for k, row in enumerate(rows) if row[0] == "0"][1]
    raw, expected = read(packet), packet["fields"]
    checked = 0
    for at, kind, count, name in rows[:second] if packet["kind"] == "request" else rows[second:]:
        if name not in expected:
            continue
        checked += 1
        if kind == "char":
            assert raw[int(at):int(at) + 4].decode("ascii") == expected[name]
        else:
            found = struct.unpack_from(f"<{count or 1}{CODES[kind]}", raw, int(at))
            assert bits(found) == bits(map(number, flat(expected[name]))), name
    assert checked == len(expected)


@pytest.mark.parametrize("packet", packets("request"))
def test_python_encodes_the_request(packet):
    assert encode_request(Request(**fields(packet))) == read(packet)
    decoded = decode_request_without_pose_check(read(packet))
    assert encode_request(decoded) == read(packet)


@pytest.mark.parametrize("packet", packets("reply"))
def test_python_decodes_the_reply(packet):
    decoded, expected = decode_reply(read(packet)), fields(packet)
    if "force_error" in expected and math.isnan(expected["force_error"]):
        expected["force_error"] = None
    assert {name: getattr(decoded, name) for name in expected} == expected
    assert encode_reply(Reply(**expected)) == encode_reply(decoded) == read(packet)


@pytest.mark.parametrize("packet", packets("refused"))
def test_python_refuses_the_packet(packet):
    decode = decode_reply if packet["reader"] == "client" else decode_request_without_pose_check
    with pytest.raises(WireError) as caught:
        decode(read(packet))
    assert isinstance(caught.value, OtherVersionError) == (packet["result"] == "other_version")
    if packet["result"] == "other_version":
        assert caught.value.version == packet["version"]


@pytest.mark.parametrize("name", ["request_nan_position.bin", "request_infinite_time.bin"])
def test_the_server_refuses_numbers_that_are_not_finite(name):
    class Spring:
        def step(self, pose, dt):
            return ToolForce.from_axial_force(800.0 * pose.depth, 800.0, ForceStatus.CONVERGED)

        def reset(self):
            pass

    service, address = StepService(Spring()), ("127.0.0.1", 1)
    replies = []
    for file in ("request_step.bin", name):
        assert service.receive((FOLDER / file).read_bytes(), address, 0.0) is None
        replies.append(decode_reply(service.step(0.0)[0]))
    assert [reply.status for reply in replies] == [Status.CONVERGED, Status.REFUSED]
    assert replies[1].force == replies[0].force == (0.0, 0.0, 4.0)


@pytest.mark.parametrize("packet", packets("request"))
def test_client_encodes_the_request(driver, packet):
    values = fields(packet)
    words = driver.ask("encode", values["version"], values["kind"], values["sequence"], to_hex(values["time"]),
                       values["session"], to_hex(*values["position"]), to_hex(*values["orientation"]), values["flags"])
    assert words == [read(packet).hex()]


@pytest.mark.parametrize("packet", packets("reply"))
def test_client_decodes_the_reply(driver, packet):
    reply = decode_reply(read(packet))
    error = 0.0 if reply.version == 2 else math.nan if reply.force_error is None else reply.force_error
    expected = [str(word) for word in (
        "ok", reply.version, reply.status, reply.sequence, to_hex(reply.time), reply.session,
        *map(to_hex, (*reply.force, *reply.torque, *flat(reply.stiffness), *flat(reply.step_stiffness), reply.age,
                      reply.compute_time, reply.residual, reply.dt)),
        reply.iterations, reply.flags, reply.malformed, reply.stale, reply.skipped, reply.turned_away,
        *map(to_hex, (reply.stiffness_age, error, reply.error_age, reply.least_tool_mass)),
        "".join(str(int(bool(flag))) for flag in (
            reply.flags & 1, reply.flags & 2, reply.flags & 4, reply.version == 2 or reply.is_on_axis,
            reply.version > 2 and reply.force_error is not None)))]
    assert driver.ask("decode", read(packet).hex()) == expected


@pytest.mark.parametrize("packet", [packet for packet in packets("refused") if packet.values[0]["reader"] == "client"])
def test_client_refuses_the_packet(driver, packet):
    expected = [packet["result"]] + ([str(packet["version"])] if "version" in packet else [])
    assert driver.ask("decode", read(packet).hex() or "-") == expected
