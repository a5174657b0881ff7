"""Wire protocol: bytes as documented in docs/wire_protocol.md, and encoding followed by decoding."""

import math
import re
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.server.wire import (
    REPLY_SIZE,
    REPLY_SIZES,
    REQUEST_SIZE,
    VERSION,
    VERSIONS,
    OtherVersionError,
    Reply,
    ReplyFlags,
    Request,
    RequestFlags,
    RequestKind,
    Status,
    WireError,
    decode_reply,
    decode_request_without_pose_check,
    encode_reply,
    encode_request,
)
from tissue_sim.tool_force import ForceStatus

U16 = st.integers(0, 2**16 - 1)
U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
REAL = st.floats(allow_nan=False)
VECTOR = st.tuples(REAL, REAL, REAL)
REQUESTS = st.builds(Request, U64, REAL, VECTOR, st.tuples(REAL, REAL, REAL, REAL), U64, st.sampled_from([1, 2]),
                     st.sampled_from([0, 1]), st.sampled_from(VERSIONS))
MATRIX = st.tuples(*[st.tuples(*[REAL] * 6)] * 6)
OLD = (U16, U64, REAL, U64, VECTOR, VECTOR, MATRIX, MATRIX, REAL, REAL, REAL, REAL, U32, U32, U64, U64, U64, U64)
REPLIES = (st.builds(Reply, *OLD, *map(st.just, (2, 0.0, None, 0.0, 0.0)))
           | st.builds(Reply, *OLD, st.just(3), REAL, st.none() | REAL, REAL, REAL))

#: Written by hand from the table of the page: IEEE 754 numbers 1, 2, 0.5, -0.25 ..., little-endian.
ZERO = bytes(8)
ONE = bytes.fromhex("000000000000f03f")
TWO = bytes.fromhex("0000000000000040")
HALF = bytes.fromhex("000000000000e03f")
MINUS_QUARTER = bytes.fromhex("000000000000d0bf")
GOLDEN_REQUESTS = {version: b"TSRQ" + bytes((version, 0)) + bytes.fromhex("0100" "0807060504030201") + HALF
                   + bytes.fromhex("1122334455667788") + ONE + TWO + MINUS_QUARTER
                   + ONE + ZERO + ZERO + ZERO + bytes.fromhex("01000000" "00000000") for version in (2, 3)}
GOLDEN_REQUEST = GOLDEN_REQUESTS[3]


@pytest.mark.parametrize("version", [2, 3])
def test_a_request_has_the_documented_bytes(version):
    request = Request(0x0102030405060708, 0.5, (1.0, 2.0, -0.25), session=0x8877665544332211,
                      flags=RequestFlags.RESET, version=version)
    assert encode_request(request) == GOLDEN_REQUESTS[version]
    assert decode_request_without_pose_check(GOLDEN_REQUESTS[version]) == request
    assert len(GOLDEN_REQUEST) == REQUEST_SIZE == 96


def test_a_goodbye_has_its_own_kind():
    assert encode_request(Request(0, 0.0, kind=RequestKind.GOODBYE))[6:8] == b"\x02\x00"


@pytest.mark.parametrize("version", [2, 3])
def test_a_reply_has_the_documented_bytes(version):
    stiffness = [[0.0] * 6 for _ in range(6)]
    stiffness[2][2], stiffness[5][0] = 2.0, 1.0
    within = [[0.0] * 6 for _ in range(6)]
    within[0][1] = 0.5
    reply = Reply(Status.LATE, 7, 1.0, 9, (0.0, 0.0, 2.0), (0.5, 0.0, 0.0), tuple(map(tuple, stiffness)),
                  tuple(map(tuple, within)), age=0.5, compute_time=1.0, residual=2.0, dt=-0.25, iterations=3, flags=1,
                  malformed=4, stale=5, skipped=6, turned_away=258, version=version)
    golden = (b"TSRP" + bytes((version, 0)) + bytes.fromhex("0100" "0700000000000000") + ONE
              + bytes.fromhex("0900000000000000")                    # session, from byte 24
              + ZERO + ZERO + TWO                                    # force, from byte 32
              + HALF + ZERO + ZERO                                   # torque, from byte 56
              + ZERO * 14 + TWO + ZERO * 15 + ONE + ZERO * 5         # stiffness by rows, from byte 80
              + ZERO + HALF + ZERO * 34                              # within the step, from byte 368
              + HALF + ONE + TWO + MINUS_QUARTER                     # from byte 656
              + bytes.fromhex("03000000" "01000000")                 # from byte 688
              + bytes.fromhex("0400000000000000" "0500000000000000" "0600000000000000" "0201000000000000"))
    if version == 3:
        reply = reply._replace(stiffness_age=0.5, force_error=2.0, error_age=1.0, least_tool_mass=0.5)
        golden += HALF + TWO + ONE + HALF                              # from byte 728
    assert encode_reply(reply) == golden
    assert decode_reply(golden) == reply
    assert len(golden) == REPLY_SIZES[version] == {2: 728, 3: 760}[version]


def test_an_unknown_error_is_encoded_as_nan_and_flags_are_encoded():
    unknown = Reply(Status.CONVERGED, 1, 0.0, flags=ReplyFlags.STALE_STIFFNESS | ReplyFlags.OFF_AXIS)
    packet = encode_reply(unknown)
    assert math.isnan(struct.unpack_from("<d", packet, 736)[0]) and packet[692] == 0b1100
    decoded = decode_reply(packet)
    assert decoded.force_error is None and not decoded.is_on_axis
    assert decode_reply(encode_reply(Reply(Status.CONVERGED, 1, 0.0, force_error=0.0))).force_error == 0.0


@pytest.mark.parametrize("version", [2, 3])
def test_a_reply_of_the_size_of_the_other_version_is_refused(version):
    packet = bytearray(encode_reply(Reply(Status.CONVERGED, 1, 0.0, version=version)))
    packet[4] = 5 - version
    with pytest.raises(WireError):
        decode_reply(packet)


@given(REQUESTS)
def test_each_request_is_decoded_unchanged(request):
    assert decode_request_without_pose_check(encode_request(request)) == request


@given(REPLIES)
def test_each_reply_is_decoded_unchanged(reply):
    packet = encode_reply(reply)
    assert len(packet) == REPLY_SIZES[reply.version] and decode_reply(packet) == reply


def test_nan_is_decoded_unchanged():
    request = decode_request_without_pose_check(
        encode_request(Request(1, float("nan"), (float("inf"), 0.0, float("nan")))))
    assert request.time != request.time and request.position[0] == float("inf")


@given(st.binary(max_size=600))
def test_noise_is_refused(noise):
    for decode in (decode_request_without_pose_check, decode_reply):
        with pytest.raises(WireError):
            decode(noise)


@given(st.binary(min_size=64, max_size=120))
def test_noise_after_a_valid_head_is_refused_unless_it_has_the_right_size(noise):
    packet = GOLDEN_REQUEST[:24] + noise
    if len(packet) == REQUEST_SIZE and noise[-8:] in (bytes(8), b"\x01" + bytes(7)):
        assert decode_request_without_pose_check(packet).sequence == 0x0102030405060708
    else:
        with pytest.raises(WireError):
            decode_request_without_pose_check(packet)


@pytest.mark.parametrize(("at", "value"), [(0, b"TSRP"), (4, b"\x04\x00"), (6, b"\x03\x00"), (6, b"\x00\x00"),
                                           (88, b"\x02\x00\x00\x00"),
                                           (92, b"\x01\x00\x00\x00")])
def test_an_invalid_field_is_refused(at, value):
    packet = bytearray(GOLDEN_REQUEST)
    packet[at:at + len(value)] = value
    with pytest.raises(WireError):
        decode_request_without_pose_check(packet)


@given(st.integers(0, 2**16 - 1).filter(lambda version: version not in VERSIONS), U64, REAL, st.binary(max_size=200))
def test_the_head_of_another_version_is_decoded(version, sequence, time, rest):
    for magic, decode in ((b"TSRQ", decode_request_without_pose_check), (b"TSRP", decode_reply)):
        with pytest.raises(OtherVersionError) as caught:
            decode(struct.pack("<4sHHQd", magic, version, 9, sequence, time) + rest)
        assert (caught.value.version, caught.value.sequence, caught.value.time) == (version, sequence, time)


def test_statuses_of_a_step_are_those_of_the_tissue():
    for status in ForceStatus:
        assert Status(status).message == status.message
    for status in Status:
        assert status.message and (status >= 100 or status in list(ForceStatus))


def test_the_documentation_has_the_layout_of_the_packets(root):
    """In the tables of docs/wire_protocol.md, offsets follow from the sizes and end at the size of the packet."""
    size = {"char": 1, "uint16": 2, "uint32": 4, "uint64": 8, "float64": 8}
    text = (root / "docs" / "wire_protocol.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (\w+)(?: x (\d+))? \| (\w+) \|", text, re.MULTILINE)
    starts = [k for k, row in enumerate(rows) if row[0] == "0"]
    assert len(starts) == 2
    for table, end, kind in ((rows[:starts[1]], REQUEST_SIZE, Request), (rows[starts[1]:], REPLY_SIZE, Reply)):
        offset = 0
        for at, number, count, _ in table:
            assert int(at) == offset
            offset += size[number] * int(count or 1)
        assert offset == end
        assert set(kind._fields) <= {name for *_, name in table}


def test_the_c_header_has_the_same_numbers(root):
    header = (root / "haptics" / "clients" / "c" / "include" / "tissue_sim_client.h").read_text(encoding="utf-8")
    defined = {name: int(value) for name, value in re.findall(r"TISSUE_SIM_(\w+)(?: =)? (\d+)", header)}
    assert (defined["VERSION"], defined["REQUEST_SIZE"], defined["REPLY_SIZE"]) == (VERSION, REQUEST_SIZE, REPLY_SIZE)
    assert defined["RESET"] == RequestFlags.RESET
    for status in (*ForceStatus, Status.BUSY, Status.RELEASED):
        assert defined[status.name] == status
