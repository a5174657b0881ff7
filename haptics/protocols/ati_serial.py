"""What the stand-alone controller of an ATI force/torque sensor says on its serial line.

Commands are two letters, some with an argument, and a carriage return; the controller repeats them and ends its answer
with the prompt ``>``. A record holds an error flag and six counts: forces along x, y, z, then torques about them.

Sources: ATI, Installation and Operations Manual for Stand-Alone F/T Sensor Systems (9610-05-1001): the commands, and
the ASCII record ``0,-413,-1080,-2480,-3532,45,5890``. That the fields of a controller on the bench are padded to six
characters and its lines end in CR LF, as in ``0,  -102,   -99,  -225,   -20,    39,   -39``, is what public drivers
for it say; both forms are read. The checksum of ``CD E``, which only binary records have, is left out: how it is
computed is in neither.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
#: Largest and smallest count: at the end of the range the true value may be larger.
LOWEST, HIGHEST = -32768, 32767
#: After an answer; the end of a command; asks for one binary record with no echo; starts the controller anew.
PROMPT, RETURN, ONE_RECORD, RESET = b">", b"\r", b"\x14", b"\x17"
#: Bytes of a binary record.
BINARY_LENGTH = 13
#: Characters of a padded field, and bytes of a line of them: the flag, six fields with commas before, and CR LF.
PADDED_WIDTH, PADDED_LENGTH = 6, 1 + 6 * 7 + 2
#: On the line with 8N1: a start bit, eight of the byte, a stop bit.
_BITS = 10
_BINARY = struct.Struct(">B6h")
_COUNT = r"(?:0|-?[1-9][0-9]{0,4})"
_PLAIN = re.compile(rf"[0-9](?:,{_COUNT}){{6}}", re.ASCII)
_PADDED = re.compile(rf"[0-9](?:,(?=.{{{PADDED_WIDTH}}}(?:,|\Z)) *{_COUNT}){{6}}", re.ASCII)


@dataclass(frozen=True, slots=True)
class Record:
    """One measurement.

    Attributes:
        flag: 0, or there is an error: saturation, a sensor that is not connected.
        counts: of `CHANNELS`, from `LOWEST` to `HIGHEST`.
    """

    flag: int
    counts: tuple[int, ...]


def encode_ascii(record: Record, padded: bool = True) -> bytes:
    """A record as a line, without its end."""
    width = PADDED_WIDTH if padded else 0
    return ",".join([str(record.flag), *(f"{count:{width}d}" for count in record.counts)]).encode("ascii")


def decode_ascii(line: bytes, padded: bool | None = None) -> Record | None:
    """The record in a line without its end; None: there is none.

    Accepts exactly what `encode_ascii` writes, so a line that lost or won a character, or has a wrong one, is seen,
    with an exception that no reader without a checksum can see: a digit, sign or blank that became another one with
    which the field still is a number, the beginning of one record with the end of another, where all between them was
    lost and the fields fit, and where the fields are not padded, a digit that is missing or too many.

    Args:
        line: bytes. padded: whether fields have six characters; None: either.
    """
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return None
    forms = [form for form, wanted in ((_PADDED, True), (_PLAIN, False)) if padded in (None, wanted)]
    if not any(form.fullmatch(text) for form in forms):
        return None
    flag, *counts = (int(field) for field in text.split(","))
    return Record(flag, tuple(counts)) if all(LOWEST <= count <= HIGHEST for count in counts) else None


def is_padded(line: bytes) -> bool:
    """Whether a line without its end has the form of a padded record."""
    return decode_ascii(line, padded=True) is not None


def encode_binary(record: Record) -> bytes:
    """The 13 bytes of a record."""
    return _BINARY.pack(record.flag, *record.counts)


def decode_binary(data: bytes) -> Record | None:
    """The record in 13 bytes; None: of another length. Nothing in them tells whether one is wrong."""
    if len(data) != BINARY_LENGTH:
        return None
    flag, *counts = _BINARY.unpack(data)
    return Record(flag, tuple(counts))


def is_at_end_of_range(record: Record) -> bool:
    """Whether a count is the largest or the smallest there is."""
    return any(count in (LOWEST, HIGHEST) for count in record.counts)


def seconds_on_the_line(bytes_sent: int, baud: float) -> float:
    """How long so many bytes take, s."""
    return _BITS * bytes_sent / baud
