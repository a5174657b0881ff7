"""An ATI force/torque sensor behind its stand-alone controller, on a serial port.

The controller sends its records as a stream of ASCII lines, or on request as binary records. Checked against this
project's emulator only; unverified on hardware.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from haptics.devices.contracts import SAMPLE_BUFFER, DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.serial_line import SerialLine
from haptics.devices.settings import (
    parse_number_settings,
    parse_word_settings_and_remaining_text,
    split_address_and_settings_text,
)
from haptics.protocols.ati_serial import (
    CARRIAGE_RETURN,
    CHANNELS,
    FORMAT,
    ONE_RECORD,
    PROMPT,
    AtiSerialRecord,
    compute_transmission_time,
    decode_ascii_record_or_none,
    decode_binary_record_or_none,
    has_count_at_end_of_range,
    has_padded_fields,
)
from tissue_sim.errors import InputError


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


#: Forms of the records.
MODES = ("ascii", "binary")
#: Name of the controller in messages.
_OWNER = "the ATI controller"


@dataclass(frozen=True)
class AtiSerialWaitingTimes:
    """Waiting times of an `AtiSerialSensor`, s."""

    #: Time for which `start` observes the records to find their form and rate.
    observation: float = 0.5
    #: Longest wait for the end of an answer, and for the first record.
    patience: float = 5.0
    #: Longest wait for the beginning of an answer.
    answer: float = 0.5
    #: Time without a record after which the controller counts as lost; at least `silent_periods` sampling periods.
    silence: float = 2.0
    #: See `silence`.
    silent_periods: int = 5
    #: Largest relative difference between the measured rate and the rate of the line at which the rate of the line is
    #: used; a larger difference shows that the controller, not the line, limits the rate.
    rate_tolerance: float = 0.2
    #: Time over which a tare averages.
    tare: float = 0.1


#: Settings of all sensors of this process.
TIMING = AtiSerialWaitingTimes()


class AtiSerialSensor(ForceSensor):
    """A six-axis sensor on RS-232. `start` configures the controller and observes its records for half a second.

    In ASCII mode the controller streams (command ``QS``). A record with a missing, additional or wrong character is
    left out, and its sequence number with it. Without a checksum some errors are undetectable, see
    `haptics.protocols.ati_serial.decode_ascii_record_or_none`.

    In binary mode this program requests each record (``^T``), so that a lost byte damages one record only: the 13 bytes
    have no marker of their beginning. Wrong bytes are undetectable. The checksum of ``CD E`` is not used, because its
    definition is not published in the sources at hand.

    This program numbers the records: the line transmits no numbers, so the loss of a complete record is undetectable.
    `start` clears the biases stored in the controller (``SZ``); the tare is applied by this program.

    Args:
        port: Such as ``/dev/ttyUSB0``.
        counts_per_N: Counts per newton, from the calibration.
        counts_per_Nm: Counts per newton metre, from the calibration.
        baud: Baud rate of the controller, shown on its display at power-on.
        mode: One of `MODES`.
        rate: Sampling rate, Hz; None: measured by `start`, and until then the rate that the line permits.
        average: Number of the controller's samples to average (``SA``); 0: no averaging.

    Raises:
        InputError: A number is outside its range, or the mode is unknown.
    """

    channels = CHANNELS

    def __init__(self, port: str, counts_per_N: float, counts_per_Nm: float, baud: int = 9600, mode: str = "ascii",
                 rate: float | None = None, average: int = 0):
        for field, value in (("counts_per_N", counts_per_N), ("counts_per_Nm", counts_per_Nm)):
            if not value > 0:
                raise InputError(f"the counts per unit must be above 0; got {value:g}. Give the counts per unit of "
                                 "the sensor's calibration sheet", field=field)
        if baud <= 0:
            raise InputError(f"the baud rate must be above 0; got {baud}. Give the baud rate of the controller, such "
                             "as 9600",
                             field="baud")
        if mode not in MODES:
            raise InputError(f"the mode of the records must be {' or '.join(MODES)}; got {mode!r}", field="mode")
        if rate is not None and not rate > 0:
            raise InputError(f"the sampling rate must be above 0; got {rate:g} Hz. Leave it out to measure the rate",
                             field="rate_hz")
        if not 0 <= average <= 255:
            raise InputError(f"the number of averaged samples must be 0 to 255; got {average}. Give 0 for no averaging",
                             field="average")
        self._port, self._baud, self._mode, self._average = port, baud, mode, average
        self._scale = (counts_per_N,) * 3 + (counts_per_Nm,) * 3
        self._given_rate = rate
        length = FORMAT.padded_length if mode == "ascii" else FORMAT.binary_length + 1
        self.rate = rate or 1.0 / compute_transmission_time(length, baud)
        self._zero = (0.0,) * 6
        self._receiver: _RecordReceiverThread | None = None

    def start(self) -> None:
        """Open the port, configure the controller, observe its records and start the thread that receives them."""
        if self._receiver is not None:
            return
        line = SerialLine(self._port, self._baud, _OWNER)
        try:
            self._stop_stream_and_set_record_mode(line)
            source = (AsciiRecordStream(line) if self._mode == "ascii"
                      else BinaryRecordRequester(line, self._baud, TIMING.answer))
            source.start_stream()
            self._store_observed_format_and_rate(source)
        except BaseException:
            line.close()
            raise
        silence = max(TIMING.silence, TIMING.silent_periods / self.rate)
        self._receiver = _RecordReceiverThread(line, source, self._port, silence)

    def read(self) -> tuple[ForceSample, ...]:
        """Return all samples received since the last call, oldest first, forces in N and torques in N m."""
        return tuple(self._convert_record(*each)
                     for each in self._get_receiver_or_raise().take_new_records_with_gap_flags())

    def _convert_record(self, received: _ReceivedRecord, gap: bool) -> ForceSample:
        """Return the force sample of a record; `gap` tells whether records before it were lost."""
        status = SampleStatus.GAP if gap else SampleStatus.GOOD
        if received.record.flag:
            # The controller has one flag for a saturated and for a disconnected sensor.
            status |= SampleStatus.SATURATED | SampleStatus.FAULT
        if has_count_at_end_of_range(received.record):
            status |= SampleStatus.SATURATED
        counts = received.record.counts
        values = tuple((count - zero) / scale
                       for count, zero, scale in zip(counts, self._zero, self._scale, strict=True))
        return ForceSample(counts, values, received.sequence, int(status), received.time)

    def tare(self) -> None:
        """Set the mean counts of the last 0.1 s as zero; if that time has no record, those of the last record."""
        recent = self._get_receiver_or_raise().get_counts_of_last_seconds(TIMING.tare)
        self._zero = tuple(sum(counts) / len(recent) for counts in zip(*recent, strict=True))

    def stop(self) -> None:
        """End the thread and close the port."""
        if self._receiver is not None:
            receiver, self._receiver = self._receiver, None
            receiver.stop_and_close()

    def describe(self) -> dict[str, Any]:
        """Return a dictionary: port, mode, rate, resolution, range, number of garbled records; keys carry units."""
        force, torque = self._scale[0], self._scale[-1]
        return {"sensor": "ATI stand-alone controller", "port": self._port, "baud": self._baud, "mode": self._mode,
                "channels": list(self.channels), "rate_Hz": self.rate, "averaged_samples": self._average,
                "resolution_N": 1.0 / force, "resolution_Nm": 1.0 / torque,
                "range_N": FORMAT.highest_count / force, "range_Nm": FORMAT.highest_count / torque,
                "garbled_records": self._receiver.garbled if self._receiver else 0,
                "verified": "against an emulator only"}

    def _get_receiver_or_raise(self) -> _RecordReceiverThread:
        """Return the thread that receives the records; raise a `DeviceError` if the sensor is not started."""
        if self._receiver is None:
            raise DeviceError(f"the ATI controller at {self._port} is not started; start it first")
        return self._receiver

    def _stop_stream_and_set_record_mode(self, line: SerialLine) -> None:
        """Stop the stream of the controller, and set the mode: forces and torques, no checksum, no biases.

        Raises:
            DeviceError: The controller does not answer.
        """
        quiet = 0.05 + compute_transmission_time(FORMAT.padded_length + 8, self._baud)
        answer = b""
        for _ in range(3):
            line.write(CARRIAGE_RETURN)
            answer = read_until_quiet(line, quiet, TIMING.answer)
            if answer.rstrip(b" \r\n\0").endswith(PROMPT) and is_printable_text(answer[-3:]):
                break
        else:
            raise DeviceError(_describe_missing_prompt(self._port, self._baud, answer))
        for command in ("CD U", f"CD {self._mode[0].upper()}", "CD R", f"SA {self._average}", "SZ"):
            line.write(command.encode("ascii") + CARRIAGE_RETURN)
            answer, end = b"", time.monotonic() + TIMING.patience
            while not answer.rstrip().endswith(PROMPT):
                if time.monotonic() >= end:
                    raise DeviceError(f"the ATI controller at {self._port} did not end its answer to {command!r} "
                                      f"({quote_last_bytes(answer)}) with its prompt '>'; switch it off and on, and "
                                      "start again")
                answer += line.read_within(0.1)

    def _store_observed_format_and_rate(self, source: AsciiRecordStream | BinaryRecordRequester) -> None:
        """Read records to fix their form and to set `rate`; discards the records.

        The duration is `AtiSerialWaitingTimes.observation`.
        """
        times: list[float] = []
        end = time.monotonic() + TIMING.patience
        while not times or time.monotonic() < times[0] + TIMING.observation or len(times) < 3:
            times += [time.monotonic() for record in source.read_records_with_none_for_garbled(0.1)
                      if record is not None]
            if time.monotonic() >= end + (TIMING.observation if times else 0.0):
                raise DeviceError(f"the ATI controller at {self._port} sends no records of a flag and six counts "
                                  f"({quote_last_bytes(source.wrong)}); select all six components (CV 3F), and check "
                                  "the baud rate and the cable")
        source.accept_only_observed_record_format()
        line_rate = 1.0 / compute_transmission_time(source.length, self._baud)
        measured = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        is_close = abs(measured - line_rate) <= TIMING.rate_tolerance * line_rate
        self.rate = self._given_rate or (line_rate if is_close or measured > line_rate else measured)


class _ReceivedRecord(NamedTuple):
    """A record with its number and its time of receipt, s on the clock of `time.monotonic`."""

    record: AtiSerialRecord
    sequence: int
    time: float


class _RecordReceiverThread:
    """A thread that receives records, so that each has the time of its receipt.

    Args:
        line: Open serial port.
        source: Source of the records on this port.
        port: Name of the port, for messages.
        silence: Time without a record after which the controller counts as lost, s.

    Attributes:
        garbled: Number of records left out.
    """

    def __init__(self, line: SerialLine, source: AsciiRecordStream | BinaryRecordRequester, port: str, silence: float):
        self._line, self._source, self._port, self._silence = line, source, port, silence
        self._waiting: deque[_ReceivedRecord] = deque(maxlen=SAMPLE_BUFFER)
        self._recent: deque[_ReceivedRecord] = deque(maxlen=SAMPLE_BUFFER)
        #: Number of the next record to receive, and of the next one to be read.
        self._number, self._next = 0, 0
        self.garbled = 0
        self._trouble: DeviceError | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._receive_records, name=f"ATI at {port}", daemon=True)
        self._thread.start()

    def _receive_records(self) -> None:
        """Receive records until the end or an error; the body of the thread."""
        last_received, wrong = time.monotonic(), b""
        try:
            while not self._ending.is_set():
                records = self._source.read_records_with_none_for_garbled(0.02)
                now = time.monotonic()
                for record in records:
                    if record is None:
                        self.garbled += 1
                        wrong = self._source.wrong
                    else:
                        last_received, wrong = now, b""
                        received = _ReceivedRecord(record, self._number, now)
                        self._waiting.append(received)
                        self._recent.append(received)
                    self._number += 1
                if now - last_received > self._silence:
                    # Some controllers report a saturated or disconnected sensor in words.
                    sent = f"no complete record ({quote_last_bytes(wrong)})" if wrong else "nothing"
                    raise DeviceError(f"the ATI controller at {self._port} has sent {sent} for {self._silence:.2g} s; "
                                      "check its power, its sensor and the cable, and start it again")
        except DeviceError as error:
            self._trouble = error

    def take_new_records_with_gap_flags(self) -> list[tuple[_ReceivedRecord, bool]]:
        """Return (record, whether records before it are missing) for each record received since the last call.

        Raises:
            DeviceError: The thread ended because of an error, and all records have been returned.
        """
        found = []
        while self._waiting:
            received = self._waiting.popleft()
            found.append((received, received.sequence != self._next))
            self._next = received.sequence + 1
        if not found and self._trouble is not None:
            raise self._trouble
        return found

    def get_counts_of_last_seconds(self, seconds: float) -> list[tuple[int, ...]]:
        """Return the counts of the records of the last `seconds` s; wait until at least one record was received.

        Raises:
            DeviceError: The thread ended because of an error.
        """
        while not self._recent:
            if self._trouble is not None:
                raise self._trouble
            self._ending.wait(1e-3)
        if self._trouble is not None:
            raise self._trouble
        records = list(self._recent)
        since = records[-1].time - seconds
        return [each.record.counts for each in records if each.time >= since]

    def stop_and_close(self) -> None:
        """Stop the thread and the stream of the controller, and close the port."""
        self._ending.set()
        self._thread.join()
        try:
            self._line.write(CARRIAGE_RETURN)
        except DeviceError:
            pass  # the controller is disconnected, so there is no stream to stop
        finally:
            self._line.close()


def _describe_missing_prompt(port: str, baud: int, answer: bytes) -> str:
    """Return cause and remedy for a port at which no prompt arrives."""
    if not answer:
        return (f"nothing answers at {port}; check that the ATI controller has power, the cable, and the baud rate "
                f"(here {baud}; its display shows its own at power on)")
    if sum(not is_printable_text(bytes([byte])) for byte in answer) > len(answer) / 8:
        return (f"the bytes from {port} are no text at {baud} baud; give the baud rate of the ATI controller, which "
                "its display shows at power on, as in baud=38400")
    return (f"the device at {port} is not an ATI controller (it sent {quote_last_bytes(answer)} and no prompt '>'); "
            "give the port of the controller")


def make_ati_serial_sensor(text: str) -> AtiSerialSensor:
    """Return a sensor that is not started, from port and settings; the counts per unit are required.

    Defaults: ``ati-serial:/dev/ttyUSB0,counts_per_N=...,counts_per_Nm=...,baud=9600,mode=ascii,rate_hz=0,average=0``;
    ``rate_hz=0`` measures the rate.
    """
    example = "ati-serial:/dev/ttyUSB0,counts_per_N=100,counts_per_Nm=4000"
    port, rest = split_address_and_settings_text(text, "the port of the controller", example)
    words, rest = parse_word_settings_and_remaining_text(rest, mode=MODES)
    given = parse_number_settings(rest, counts_per_N=0.0, counts_per_Nm=0.0, baud=9600, rate_hz=0.0, average=0)
    return AtiSerialSensor(port, given["counts_per_N"], given["counts_per_Nm"], int(given["baud"]), words["mode"],
                           given["rate_hz"] or None, int(given["average"]))
