"""Records of the ATI stand-alone controller: records of public sources, and arbitrary bytes."""

import os

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from haptics.protocols.ati_serial import (
    FORMAT,
    AtiSerialRecord,
    compute_transmission_time,
    decode_ascii_record_or_none,
    decode_binary_record_or_none,
    encode_ascii_record_without_ending,
    encode_binary_record,
    has_count_at_end_of_range,
    has_padded_fields,
)

CASES = settings(max_examples=int(os.environ.get("TISSUE_SIM_FUZZ_CASES", "500")), deadline=None)
#: Of the manual (9610-05-1001); of a published driver's notes on what came from its controller, both forms.
OF_THE_MANUAL = b"0,-413,-1080,-2480,-3532,45,5890"
PADDED = b"0,  -102,   -99,  -225,   -20,    39,   -39"
BINARY = b"\x00\xff\x93\xff\x98\xfei\xff\xbb\x00\x06\xff\xdb"

counts = st.integers(FORMAT.lowest_count, FORMAT.highest_count)
records = st.builds(AtiSerialRecord, st.integers(0, 9), st.tuples(*[counts] * 6))
pieces = st.lists(st.sampled_from([b"0", b",", b" ", b"-", b"45", b"-3532", b"\r", b"\n", b">", b"QS", b"\xff", b"00",
                                   b"+", b"1_0", "\u0663".encode()])).map(b"".join)


def test_records_of_public_sources_are_decoded():
    assert decode_ascii_record_or_none(OF_THE_MANUAL) == AtiSerialRecord(0, (-413, -1080, -2480, -3532, 45, 5890))
    assert decode_ascii_record_or_none(PADDED) == AtiSerialRecord(0, (-102, -99, -225, -20, 39, -39))
    assert decode_binary_record_or_none(BINARY) == AtiSerialRecord(0, (-109, -104, -407, -69, 6, -37))
    assert has_padded_fields(PADDED) and not has_padded_fields(OF_THE_MANUAL)


def test_records_are_encoded_in_the_public_form():
    assert encode_ascii_record_without_ending(AtiSerialRecord(0, (-413, -1080, -2480, -3532, 45, 5890)), padded=False) \
        == OF_THE_MANUAL
    assert encode_ascii_record_without_ending(AtiSerialRecord(0, (-102, -99, -225, -20, 39, -39))) == PADDED
    assert encode_binary_record(AtiSerialRecord(0, (-109, -104, -407, -69, 6, -37))) == BINARY
    assert len(PADDED) + 2 == FORMAT.padded_length and len(BINARY) == FORMAT.binary_length


def test_transmission_time_of_a_record():
    assert compute_transmission_time(len(OF_THE_MANUAL) + 2, 9600) == pytest.approx(35.4e-3, abs=0.1e-3)
    assert compute_transmission_time(FORMAT.padded_length, 9600) == pytest.approx(46.9e-3, abs=0.1e-3)


@pytest.mark.parametrize("line", [
    b"", b"0", b">", b"QS", b"0,1,2,3,4,5", b"0,1,2,3,4,5,6,7", b"0,1,2,3,4,5,", b",1,2,3,4,5,6", b"00,1,2,3,4,5,6",
    b"-1,1,2,3,4,5,6", b"0,01,2,3,4,5,6", b"0,-0,2,3,4,5,6", b"0,+1,2,3,4,5,6", b"0,1.0,2,3,4,5,6", b"0,1e3,2,3,4,5,6",
    b"0,32768,2,3,4,5,6", b"0,-32769,2,3,4,5,6", b"0,1_0,2,3,4,5,6", b"0, 1,2,3,4,5,6", b"0,1 ,2,3,4,5,6",
    b"0,1,2,3,4,5,6\n", b"\n0,1,2,3,4,5,6", b"0,\xb2,2,3,4,5,6", "0,\u0663,2,3,4,5,6".encode(),
    PADDED[:-1], PADDED + b"0", PADDED.replace(b",  ", b", ", 1), b"Grbl 1.1h ['$' for help]"])
def test_lines_that_are_no_records_are_refused(line):
    assert decode_ascii_record_or_none(line) is None


@pytest.mark.slow
@CASES
@given(records, st.booleans())
@example(AtiSerialRecord(0, (FORMAT.lowest_count,) * 6), True)
def test_every_record_survives_encoding_and_decoding(record, padded):
    assert decode_ascii_record_or_none(encode_ascii_record_without_ending(record, padded)) == record
    assert decode_ascii_record_or_none(encode_ascii_record_without_ending(record, padded), padded) == record
    assert decode_binary_record_or_none(encode_binary_record(record)) == record


@CASES
@given(st.one_of(st.binary(max_size=60), pieces, st.text(alphabet="0123456789,- ", max_size=50).map(str.encode)))
def test_only_encoded_records_are_decoded(line):
    record = decode_ascii_record_or_none(line)
    assert record is None or line in (encode_ascii_record_without_ending(record, padded=False),
                                      encode_ascii_record_without_ending(record))
    record = decode_binary_record_or_none(line)
    assert (record is None) == (len(line) != FORMAT.binary_length)
    assert record is None or encode_binary_record(record) == line


@pytest.mark.slow
@CASES
@given(records, st.booleans(), st.integers(0, 60), st.integers(0, 255))
def test_a_wrong_character_is_detected_unless_it_is_a_digit_a_sign_or_a_blank(record, padded, place, byte):
    line = encode_ascii_record_without_ending(record, padded)
    place %= len(line)
    wrong = line[:place] + bytes([byte]) + line[place + 1:]
    if wrong != line and decode_ascii_record_or_none(wrong, padded) is not None:
        assert byte in b"0123456789- "
        assert line[place] in b"0123456789- "


@pytest.mark.slow
@CASES
@given(records, st.integers(0, 60), st.integers(0, 255), st.booleans())
def test_with_padding_a_missing_or_additional_character_is_detected(record, place, byte, less):
    line = encode_ascii_record_without_ending(record)
    place %= len(line)
    wrong = line[:place] + (b"" if less else bytes([byte])) + line[place + less:]
    assert decode_ascii_record_or_none(wrong, padded=True) is None


@pytest.mark.slow
@CASES
@given(records, records, st.integers(1, 60), st.integers(1, 60))
def test_with_padding_parts_of_two_records_are_refused(one, other, end, begin):
    """Parts of two records, as after an interruption of the line, have another length, or the parts fit together."""
    head, tail = encode_ascii_record_without_ending(one)[:end], encode_ascii_record_without_ending(other)[begin:]
    if len(head) + len(tail) != FORMAT.padded_length - 2:
        assert decode_ascii_record_or_none(head + tail, padded=True) is None


def test_counts_at_the_ends_of_the_range_are_detected():
    assert has_count_at_end_of_range(AtiSerialRecord(0, (0, 0, FORMAT.highest_count, 0, 0, 0)))
    assert has_count_at_end_of_range(AtiSerialRecord(0, (0, 0, 0, 0, 0, FORMAT.lowest_count)))
    assert not has_count_at_end_of_range(AtiSerialRecord(
        1, (FORMAT.highest_count - 1, FORMAT.lowest_count + 1, 0, 0, 0, 0)))
