"""Messages of the stand-alone controller of an ATI force/torque sensor on its serial line.

Commands are two letters, some with an argument, and a carriage return. The controller repeats a command and ends its
answer with the prompt ``>``. A record has an error flag and six counts: forces along x, y, z, then torques about them.

Sources: ATI, Installation and Operations Manual for Stand-Alone F/T Sensor Systems (9610-05-1001), for the commands and
the ASCII record ``0,-413,-1080,-2480,-3532,45,5890``. According to public drivers, real controllers pad the fields to
six characters and end lines with CR LF, as in ``0,  -102,   -99,  -225,   -20,    39,   -39``; both forms are read. The
checksum of ``CD E``, for binary records only, is not supported, because neither source defines it.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

#: Names of the six counts of a record.
CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


@dataclass(frozen=True)
class RecordLimitsAndLengths:
    """Range and lengths of the records on the line.

    Attributes:
        lowest_count: smallest count of a channel, a signed 16-bit number; the true value may be smaller.
        highest_count: largest count of a channel, a signed 16-bit number; the true value may be larger.
        binary_length: length of a binary record, bytes: the flag and six 16-bit counts.
        padded_width: width of a padded field, characters.
        padded_length: length of a line of padded fields, bytes: the flag, six fields with a comma each, CR and LF.
        bits_per_byte: bits per byte on the line with 8N1: start bit, eight data bits, stop bit.
    """

    lowest_count: int = -32768
    highest_count: int = 32767
    binary_length: int = 13
    padded_width: int = 6
    padded_length: int = 1 + 6 * 7 + 2
    bits_per_byte: int = 10


#: Format of every sensor of this kind.
FORMAT = RecordLimitsAndLengths()
#: End of an answer.
PROMPT = b">"
#: End of a command.
CARRIAGE_RETURN = b"\r"
#: Request for one binary record, without echo.
ONE_RECORD = b"\x14"
#: Restart of the controller.
RESET = b"\x17"
#: Binary record: flag and six counts.
_BINARY = struct.Struct(">B6h")
#: A count without leading zeros.
_COUNT = r"(?:0|-?[1-9][0-9]{0,4})"
_PLAIN = re.compile(rf"[0-9](?:,{_COUNT}){{6}}", re.ASCII)
_PADDED = re.compile(rf"[0-9](?:,(?=.{{{FORMAT.padded_width}}}(?:,|\Z)) *{_COUNT}){{6}}", re.ASCII)


@dataclass(frozen=True, slots=True)
class AtiSerialRecord:
    """One sample.

    Attributes:
        flag: 0, or an error: saturation, or a disconnected sensor.
        counts: Counts of `CHANNELS`, `RecordLimitsAndLengths.lowest_count` to `RecordLimitsAndLengths.highest_count`.
    """

    flag: int
    counts: tuple[int, ...]


def encode_ascii_record_without_ending(record: AtiSerialRecord, padded: bool = True) -> bytes:
    """Return the ASCII line of a record, flag and six counts separated by commas, without the line ending."""
    width = FORMAT.padded_width if padded else 0
    return ",".join([str(record.flag), *(f"{count:{width}d}" for count in record.counts)]).encode("ascii")


def decode_ascii_record_or_none(line: bytes, padded: bool | None = None) -> AtiSerialRecord | None:
    """Return the record in an ASCII line without its ending; None: the line is no record.

    Accepts exactly the lines that `encode_ascii_record_without_ending` writes, so most transmission errors are
    detected. Without a
    checksum these errors are undetectable: a digit, sign or blank replaced by another one that leaves a valid number;
    the beginning of one record joined to the end of another where the fields fit; without padding, a missing or
    additional digit.

    Args:
        line: Bytes of the line.
        padded: True: fields have six characters. False: fields have no padding. None: both forms are accepted.
    """
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return None
    forms = [form for form, is_padded_form in ((_PADDED, True), (_PLAIN, False)) if padded in (None, is_padded_form)]
    if not any(form.fullmatch(text) for form in forms):
        return None
    flag, *counts = (int(field) for field in text.split(","))
    is_in_range = all(FORMAT.lowest_count <= count <= FORMAT.highest_count for count in counts)
    return AtiSerialRecord(flag, tuple(counts)) if is_in_range else None


def has_padded_fields(line: bytes) -> bool:
    """Return True if a line without its ending is a record with padded fields."""
    return decode_ascii_record_or_none(line, padded=True) is not None


def encode_binary_record(record: AtiSerialRecord) -> bytes:
    """Return the 13 bytes of a record in binary mode: flag and six 16-bit counts, the high byte first."""
    return _BINARY.pack(record.flag, *record.counts)


def decode_binary_record_or_none(data: bytes) -> AtiSerialRecord | None:
    """Return the record in 13 bytes; None: the length is wrong. Transmission errors are undetectable."""
    if len(data) != FORMAT.binary_length:
        return None
    flag, *counts = _BINARY.unpack(data)
    return AtiSerialRecord(flag, tuple(counts))


def has_count_at_end_of_range(record: AtiSerialRecord) -> bool:
    """Return True if a count is the largest or the smallest one: the true value may be beyond it."""
    return any(count in (FORMAT.lowest_count, FORMAT.highest_count) for count in record.counts)


def compute_transmission_time(bytes_sent: int, baud: float) -> float:
    """Return the time, s, that a number of bytes needs on a line at a baud rate, bits/s."""
    return FORMAT.bits_per_byte * bytes_sent / baud
