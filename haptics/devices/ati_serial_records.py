"""Sources of the records of an ATI stand-alone controller: a stream of ASCII lines, or requested binary records."""

from __future__ import annotations

import time

from haptics.devices.serial_line import SerialLine
from haptics.protocols.ati_serial import (
    CARRIAGE_RETURN,
    FORMAT,
    ONE_RECORD,
    AtiSerialRecord,
    compute_transmission_time,
    decode_ascii_record_or_none,
    decode_binary_record_or_none,
    has_padded_fields,
)


class AsciiRecordStream:
    """Source of records as lines that the controller streams.

    Args:
        line: Open serial port.

    Attributes:
        length: Length of a record on the line, bytes.
        wrong: Last line that was no record.
    """

    def __init__(self, line: SerialLine):
        self._line, self._rest = line, b""
        self._forms: set[bool] = set()
        #: True if fields are padded; None: both forms are accepted.
        self._padded: bool | None = None
        self.length, self.wrong = FORMAT.padded_length, b""

    def start_stream(self) -> None:
        """Send the command that makes the controller stream records."""
        self._line.write(b"QS" + CARRIAGE_RETURN)

    def read_records_with_none_for_garbled(self, timeout: float) -> list[AtiSerialRecord | None]:
        """Return the records that arrive within `timeout` seconds, with None in place of each garbled record."""
        *lines, self._rest = (self._rest + self._line.read_within(timeout)).split(CARRIAGE_RETURN)
        if len(self._rest) > 4 * FORMAT.padded_length:
            # Longer than any record: the line ending was lost.
            lines, self._rest = [*lines, self._rest], b""
        records = []
        for text in (line.removeprefix(b"\n") for line in lines):
            if text:
                record = decode_ascii_record_or_none(text, self._padded)
                records.append(record)
                if record is None:
                    self.wrong = text
                elif self._padded is None:
                    self._forms.add(has_padded_fields(text))
                    self.length = len(text) + 2
        return records

    def accept_only_observed_record_format(self) -> None:
        """From now on accept only lines of the form, padded or not, that all records so far had."""
        self._padded = self._forms == {True}


class BinaryRecordRequester:
    """Source of binary records that are requested one at a time.

    Args:
        line: Open serial port.
        baud: Baud rate.
        timeout: Longest wait for the beginning of an answer, s.

    Attributes:
        length: Length of a request and a record on the line, bytes.
        wrong: Last answer that was no record.
    """

    length = FORMAT.binary_length + 1

    def __init__(self, line: SerialLine, baud: int, timeout: float):
        self._line = line
        #: Pause that ends an answer, s; adapters delay bytes by up to 16 ms.
        self._pause = 0.03 + compute_transmission_time(self.length, baud)
        #: Longest wait for the first byte of an answer, s.
        self._timeout = max(timeout, self._pause)
        self.wrong = b""

    def start_stream(self) -> None:
        """Do nothing; each record is requested."""
        return

    def read_records_with_none_for_garbled(self, timeout: float) -> list[AtiSerialRecord | None]:
        """Request one record; return [record], [None] for a wrong length, or [] without an answer.

        `timeout` is ignored.
        """
        self._line.read()  # discards late bytes of an earlier answer
        self._line.write(ONE_RECORD)
        answer = self._line.read_within(self._timeout)
        while 0 < len(answer) < FORMAT.binary_length and (more := self._line.read_within(self._pause)):
            answer += more
        answer += self._line.read()
        if not answer:
            return []
        record = decode_binary_record_or_none(answer)
        if record is None:
            self.wrong = answer
            if len(answer) > FORMAT.binary_length:
                read_until_quiet(self._line, self._pause)
        return [record]

    def accept_only_observed_record_format(self) -> None:
        """Do nothing; binary records have one form."""
        return


def read_until_quiet(line: SerialLine, quiet: float, first: float = 0.0, longest: float = 1.5) -> bytes:
    """Return all bytes that arrive before a pause of `quiet` s, or within `longest` s.

    Args:
        line: Serial port.
        quiet: Duration of the pause, s.
        first: Longest wait for the first byte, s.
        longest: Longest duration of the call, s.
    """
    received, end = b"", time.monotonic() + longest
    while time.monotonic() < end:
        more = line.read_within(quiet if received else max(quiet, first))
        if not more:
            break
        received += more
    return received


def is_printable_text(data: bytes) -> bool:
    """Return True if all bytes are printable ASCII, line ends, tabs, ACK or NUL."""
    return all(byte in b"\r\n\t\x06\0" or 32 <= byte < 127 for byte in data)


def quote_last_bytes(data: bytes) -> str:
    """Return the last 40 bytes as quoted text for a message, or ``nothing arrived`` for no bytes."""
    return repr(data.strip()[-40:].decode("ascii", "backslashreplace")) if data.strip() else "nothing arrived"
