"""RDT: bytes of the manual, the settings page, and invalid bytes."""

import os
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.protocols import rdt
from haptics.protocols.rdt import BoxSettings, RdtRecord, RdtRequest
from tissue_sim.errors import InputError

CASES = int(os.environ.get("TISSUE_SIM_FUZZ_CASES", "500"))
counts = st.integers(-2**31, 2**31 - 1)
words = st.integers(0, 2**32 - 1)
records = st.builds(RdtRecord, words, words, words, st.tuples(*[counts] * 6))


def test_requests_equal_the_manual():
    """Net F/T manual, section RDT: header 0x1234, command, number of samples, in network byte order."""
    assert rdt.pack_request(RdtRequest(rdt.RdtCommand.REAL_TIME, 0)) == bytes.fromhex("1234000200000000")
    assert rdt.pack_request(RdtRequest(rdt.RdtCommand.BUFFERED, 258)) == bytes.fromhex("1234000300000102")
    assert rdt.pack_request(RdtRequest(rdt.RdtCommand.BIAS)) == bytes.fromhex("1234004200000000")
    assert rdt.pack_request(RdtRequest(rdt.RdtCommand.STOP)) == bytes.fromhex("1234000000000000")
    assert rdt.unpack_request_or_none(bytes.fromhex("1234000300000102")) == RdtRequest(rdt.RdtCommand.BUFFERED, 258)


def test_a_record_equals_the_manual():
    """Net F/T manual: rdt_sequence, ft_sequence, status, Fx, Fy, Fz, Tx, Ty, Tz; here with a negative force."""
    data = bytes.fromhex("00000001 00000064 00000000 0000000a ffffffff 000f4240 00000000 80000000 7fffffff".replace(
        " ", ""))
    assert rdt.unpack_records_or_none(data) == [RdtRecord(1, 100, 0, (10, -1, 1_000_000, 0, -2**31, 2**31 - 1))]


@given(st.lists(records, min_size=1, max_size=rdt.DATAGRAM.max_records))
def test_records_survive_packing_and_unpacking(sent):
    assert rdt.unpack_records_or_none(rdt.pack_records(sent)) == sent


@settings(max_examples=CASES, deadline=None)
@given(st.binary(max_size=1500))
def test_a_fraction_of_a_record_is_refused(data):
    found = rdt.unpack_records_or_none(data)
    if data and len(data) % 36 == 0 and len(data) // 36 <= 40:
        assert found is not None and rdt.pack_records(found) == data
    else:
        assert found is None


@pytest.mark.slow
@settings(max_examples=CASES, deadline=None)
@given(st.binary(max_size=12))
def test_other_bytes_are_no_request(data):
    asked = rdt.unpack_request_or_none(data)
    assert (asked is not None) == (len(data) == 8 and data[:2] == b"\x12\x34")
    assert asked is None or rdt.pack_request(asked) == data


@pytest.mark.parametrize(("status", "fault", "out_of_range", "said"), [
    (0x00000000, False, False, "reports an error"), (0x00010000, False, False, "reports an error"),
    (0x80000005, True, False, "its temperature is out of range, a gage is broken"),
    (0x88000000, True, True, "a gage is out of range"), (0xC0000000, True, True, "force or torque is out of range"),
    (0x80020000, True, True, "saturated"), (0x00000008, True, False, "busy"),
])
def test_status_words_equal_the_manual(status, fault, out_of_range, said):
    """Ethernet Axia manual 9610-05-Ethernet Axia-09, tables 4.7 and 4.9, with the example 80000005."""
    assert (rdt.is_sample_unreliable(status), rdt.has_exceeded_range(status)) == (fault, out_of_range)
    assert said in rdt.describe_status(status) and f"0x{status:08x}" in rdt.describe_status(status)


@pytest.mark.parametrize(("force", "torque", "newtons", "newton_metres"), [
    ("N", "N-m", 1.0, 1.0), ("kN", "kN-m", 1e3, 1e3), ("lbf", "lbf-in", 4.4482216152605, 0.1129848290276167),
    ("klbf", "lbf-ft", 4448.2216152605, 1.3558179483314004), ("kg", "kg-cm", 9.80665, 0.0980665),
    ("N", "N-mm", 1.0, 1e-3),
])
def test_units_are_read_from_the_box(force, torque, newtons, newton_metres):
    """Factors according to NIST SP 811, appendix B."""
    box = BoxSettings(1000.0, 10.0, force, torque)
    assert box.newtons_per_count == pytest.approx(newtons / 1000.0, rel=1e-12)
    assert box.newton_metres_per_count == pytest.approx(newton_metres / 10.0, rel=1e-12)


@pytest.mark.parametrize("name", ["stone", "", "Nm"])
def test_an_unknown_unit_is_refused_with_the_remedy(name):
    with pytest.raises(InputError, match=r"the unit of torque must be a known unit; .* one of N-m, .* configurations "
                       r"page"):
        _ = BoxSettings(1.0, 1.0, "N", name).newton_metres_per_count
    with pytest.raises(InputError, match="the unit of force must be a known unit"):
        _ = BoxSettings(1.0, 1.0, "furlong", "N-m").newtons_per_count


def test_a_written_settings_page_is_read_back():
    box = BoxSettings(1e6, 2.5e5, "lbf", "lbf-in", 7000.0, "Net F/T <1>", "FT12345")
    assert rdt.parse_settings_page(rdt.encode_settings_page(box)) == box


def test_a_page_of_a_real_box_is_read():
    """Field names of the Net F/T manual, netftapi2.xml; with additional fields, a namespace, and without a rate."""
    page = (b'<?xml version="1.0"?><netft xmlns="urn:x"><runstat>0x00000000</runstat><setcfgsel>0</setcfgsel>'
            b"<cfgcpf>1000000</cfgcpf><cfgcpt>1000000000</cfgcpt><scfgfu>N</scfgfu><scfgtu>N-mm</scfgtu>"
            b"<cfgcalsn>FT01234</cfgcalsn></netft>")
    assert rdt.parse_settings_page(page) == BoxSettings(1e6, 1e9, "N", "N-mm", None, "", "FT01234")


@pytest.mark.parametrize(("page", "field"), [
    (b"<html>not closed", "settings"), (b"", "settings"), (b"\xff\xfe\x00", "settings"),
    (b"<netft><cfgcpt>1</cfgcpt></netft>", "cfgcpf"), (b"<netft><cfgcpf>0</cfgcpf></netft>", "cfgcpf"),
    (b"<netft><cfgcpf>1</cfgcpf><cfgcpt>nan</cfgcpt></netft>", "cfgcpt"),
    (b'<!DOCTYPE n [<!ENTITY a "b">]><netft><cfgcpf>1</cfgcpf></netft>', "settings"),
])
def test_pages_of_other_servers_are_refused(page, field):
    with pytest.raises(InputError) as caught:
        rdt.parse_settings_page(page)
    assert caught.value.field == field


@settings(max_examples=CASES, deadline=None)
@given(st.one_of(st.binary(max_size=300), st.text(max_size=300).map(str.encode),
                 st.lists(st.tuples(st.sampled_from(["cfgcpf", "cfgcpt", "scfgfu", "comrdtrate", "x"]),
                                    st.text(alphabet="0123456789.eE+-naninf<>&", max_size=8)), max_size=6)
                 .map(lambda parts: "".join(["<n>", *(f"<{k}>{v}</{k}>" for k, v in parts), "</n>"]).encode())))
def test_a_page_with_an_invalid_scale_is_refused(page):
    try:
        box = rdt.parse_settings_page(page)
    except InputError:
        return
    assert 0 < box.counts_per_force < float("inf") and 0 < box.counts_per_torque < float("inf")


def test_sizes_of_records_and_requests():
    assert rdt.RECORD_SIZE == 36 == struct.calcsize(">III6i")
