"""A force/torque sensor of ATI behind its stand-alone controller, on a serial port.

Only run against this house's emulator: unverified on hardware.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.serial_line import SerialLine
from haptics.devices.settings import read_choices, read_settings, split_target
from haptics.protocols.ati_serial import (
    BINARY_LENGTH,
    CHANNELS,
    HIGHEST,
    ONE_RECORD,
    PADDED_LENGTH,
    PROMPT,
    RETURN,
    Record,
    decode_ascii,
    decode_binary,
    is_at_end_of_range,
    is_padded,
    seconds_on_the_line,
)
from tissue_sim.errors import InputError

MODES = ("ascii", "binary")
#: Samples that wait to be read; older ones are lost.
BUFFER = 4096
#: How long the records are watched before the start is done: form and rate, s; and the longest wait for the first, s.
_WATCHED, _PATIENCE = 0.5, 5.0
#: How long the controller may take to begin an answer, s.
_ANSWER = 0.5
#: A line that is silent for so long has lost the controller, s; or for so many periods, where that is longer.
_SILENCE, _SILENT_PERIODS = 2.0, 5
#: Of the rate of the line, by which the measured one may be off before it counts: the controller is the slower one.
_NEAR = 0.2
#: Time of which a tare takes the mean, s.
_TARED = 0.1
_OWNER = "the ATI controller"


class AtiSerialSensor(ForceSensor):
    """Six channels by RS-232; `start` sets the controller up and watches its records for half a second.

    In ASCII the controller streams (``QS``). A record that lost or won a character, or has a wrong one, is left out and
    its number with it. Without a checksum, a digit, sign or blank that became another one with which the field still is
    a number cannot be seen, nor, where the controller does not pad its fields, a digit that is missing.

    In binary this program asks for each record (``^T``), so that a lost byte spoils one record and not all after it:
    the 13 bytes have nothing to find their beginning by. A wrong byte cannot be seen. The checksum of ``CD E`` is not
    used: how it is computed is in no source that was at hand.

    The numbers of the records are this program's: the line has none, and a record that was lost whole is not seen. The
    biases in the controller are cleared (``SZ``); the tare is this program's, so the counts stay as they are.

    Args:
        port: such as ``/dev/ttyUSB0``.
        counts_per_N, counts_per_Nm: of the calibration.
        baud: as the controller is set; its display shows it at power on.
        mode: of `MODES`.
        rate: Hz; None: as measured at the start, and before that what the line carries.
        average: of so many of the controller's samples (``SA``); 0: none.

    Raises:
        InputError: a number that is not positive, or an unknown mode.
    """

    channels = CHANNELS

    def __init__(self, port: str, counts_per_N: float, counts_per_Nm: float, baud: int = 9600, mode: str = "ascii",
                 rate: float | None = None, average: int = 0):
        for field, value in (("counts_per_N", counts_per_N), ("counts_per_Nm", counts_per_Nm)):
            if not value > 0:
                raise InputError(f"{value:g} counts; give the counts per unit of the sensor's calibration sheet, above "
                                 "zero", field=field)
        if baud <= 0:
            raise InputError(f"{baud} baud; give the one that the controller is set to, such as 9600", field="baud")
        if mode not in MODES:
            raise InputError(f"{mode!r} is no mode; give {' or '.join(MODES)}", field="mode")
        if rate is not None and not rate > 0:
            raise InputError(f"{rate:g} Hz; give a number above zero, or leave it out to measure it", field="rate_hz")
        if not 0 <= average <= 255:
            raise InputError(f"{average}; give 0 to 255 samples", field="average")
        self._port, self._baud, self._mode, self._average = port, baud, mode, average
        self._scale = (counts_per_N,) * 3 + (counts_per_Nm,) * 3
        self._given_rate = rate
        self.rate = rate or 1.0 / seconds_on_the_line(PADDED_LENGTH if mode == "ascii" else BINARY_LENGTH + 1, baud)
        self._zero = (0.0,) * 6
        self._running: _Running | None = None

    def start(self) -> None:
        if self._running is not None:
            return
        line = SerialLine(self._port, self._baud, _OWNER)
        try:
            self._set_up(line)
            source = _AsciiStream(line) if self._mode == "ascii" else _BinaryRequests(line, self._baud)
            source.begin()
            self._watch(source)
        except BaseException:
            line.close()
            raise
        self._running = _Running(line, source, self._port, max(_SILENCE, _SILENT_PERIODS / self.rate))

    def read(self) -> tuple[ForceSample, ...]:
        return tuple(self._sample(*each) for each in self._started().take())

    def _sample(self, kept: _Kept, gap: bool) -> ForceSample:
        status = SampleStatus.GAP if gap else SampleStatus.GOOD
        if kept.record.flag:
            # The controller has one flag for both: the sensor is at its end, or there is none.
            status |= SampleStatus.SATURATED | SampleStatus.FAULT
        if is_at_end_of_range(kept.record):
            status |= SampleStatus.SATURATED
        counts = kept.record.counts
        values = tuple((count - zero) / scale
                       for count, zero, scale in zip(counts, self._zero, self._scale, strict=True))
        return ForceSample(counts, values, kept.sequence, int(status), kept.received)

    def tare(self) -> None:
        """The mean of the last tenth of a second counts as zero, or where that has none, the last record."""
        recent = self._started().recent(_TARED)
        self._zero = tuple(sum(counts) / len(recent) for counts in zip(*recent, strict=True))

    def stop(self) -> None:
        if self._running is not None:
            running, self._running = self._running, None
            running.end()

    def describe(self) -> dict[str, Any]:
        force, torque = self._scale[0], self._scale[-1]
        return {"sensor": "ATI stand-alone controller", "port": self._port, "baud": self._baud, "mode": self._mode,
                "channels": list(self.channels), "rate_Hz": self.rate, "averaged_samples": self._average,
                "resolution_N": 1.0 / force, "resolution_Nm": 1.0 / torque,
                "range_N": HIGHEST / force, "range_Nm": HIGHEST / torque,
                "garbled_records": self._running.garbled if self._running else 0,
                "verified": "against an emulator only"}

    def _started(self) -> _Running:
        if self._running is None:
            raise DeviceError(f"the ATI controller at {self._port} is not started; start it first")
        return self._running

    def _set_up(self, line: SerialLine) -> None:
        """Let it end what it does, and choose mode, forces and torques, no checksum, no bias."""
        quiet = 0.05 + seconds_on_the_line(PADDED_LENGTH + 8, self._baud)
        said = b""
        for _ in range(3):
            line.write(RETURN)
            said = _all_said(line, quiet, _ANSWER)
            if said.rstrip(b" \r\n\0").endswith(PROMPT) and _is_text(said[-3:]):
                break
        else:
            raise DeviceError(_not_a_controller(self._port, self._baud, said))
        for command in ("CD U", f"CD {self._mode[0].upper()}", "CD R", f"SA {self._average}", "SZ"):
            line.write(command.encode("ascii") + RETURN)
            answer, end = b"", time.monotonic() + _PATIENCE
            while not answer.rstrip().endswith(PROMPT):
                if time.monotonic() >= end:
                    raise DeviceError(f"the ATI controller at {self._port} did not end its answer to {command!r} "
                                      f"({_shown(answer)}) with its prompt '>'; switch it off and on, and start again")
                answer += line.read_within(0.1)

    def _watch(self, source: _AsciiStream | _BinaryRequests) -> None:
        """Wait for records; see their form and rate. They are thrown away."""
        times: list[float] = []
        end = time.monotonic() + _PATIENCE
        while not times or time.monotonic() < times[0] + _WATCHED or len(times) < 3:
            times += [time.monotonic() for record in source.take(0.1) if record is not None]
            if time.monotonic() >= end + (_WATCHED if times else 0.0):
                raise DeviceError(f"the ATI controller at {self._port} sends no records of a flag and six counts "
                                  f"({_shown(source.wrong)}); select all six components (CV 3F), and check the baud "
                                  "rate and the cable")
        source.settle()
        line_rate = 1.0 / seconds_on_the_line(source.length, self._baud)
        measured = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        near = abs(measured - line_rate) <= _NEAR * line_rate
        self.rate = self._given_rate or (line_rate if near or measured > line_rate else measured)


class _Kept(NamedTuple):
    """A record that waits to be read."""

    record: Record
    sequence: int
    received: float


class _Running:
    """A controller that sends, and the thread that receives: so that a record has the time of its receipt.

    Args:
        line: open. source: of records. port: in messages. silence: after which it is lost, s.
    """

    def __init__(self, line: SerialLine, source: _AsciiStream | _BinaryRequests, port: str, silence: float):
        self._line, self._source, self._port, self._silence = line, source, port, silence
        self._waiting: deque[_Kept] = deque(maxlen=BUFFER)
        self._recent: deque[_Kept] = deque(maxlen=BUFFER)
        self._number = 0
        self._next = 0
        #: Records that were left out.
        self.garbled = 0
        self._trouble: DeviceError | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._receive, name=f"ATI at {port}", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        heard, wrong = time.monotonic(), b""
        try:
            while not self._ending.is_set():
                records = self._source.take(0.02)
                now = time.monotonic()
                for record in records:
                    if record is None:
                        self.garbled += 1
                        wrong = self._source.wrong
                    else:
                        heard, wrong = now, b""
                        kept = _Kept(record, self._number, now)
                        self._waiting.append(kept)
                        self._recent.append(kept)
                    self._number += 1
                if now - heard > self._silence:
                    # A controller whose sensor is saturated or not connected may tell so in words.
                    sent = f"no whole record ({_shown(wrong)})" if wrong else "nothing"
                    raise DeviceError(f"the ATI controller at {self._port} has sent {sent} for {self._silence:.2g} s; "
                                      "check its power, its sensor and the cable, and start it again")
        except DeviceError as error:
            self._trouble = error

    def take(self) -> list[tuple[_Kept, bool]]:
        """The records since the last call, each with whether some before it are missing."""
        found = []
        while self._waiting:
            kept = self._waiting.popleft()
            found.append((kept, kept.sequence != self._next))
            self._next = kept.sequence + 1
        if not found and self._trouble is not None:
            raise self._trouble
        return found

    def recent(self, seconds: float) -> list[tuple[int, ...]]:
        """Counts of that time until now; at least of one record."""
        while not self._recent:
            if self._trouble is not None:
                raise self._trouble
            self._ending.wait(1e-3)
        if self._trouble is not None:
            raise self._trouble
        kept = list(self._recent)
        since = kept[-1].received - seconds
        return [each.record.counts for each in kept if each.received >= since]

    def end(self) -> None:
        """Stop the stream, and close the line."""
        self._ending.set()
        self._thread.join()
        try:
            self._line.write(RETURN)
        except DeviceError:
            pass  # It is gone: there is nothing to stop.
        finally:
            self._line.close()


class _AsciiStream:
    """Records as lines, one after the other."""

    def __init__(self, line: SerialLine):
        self._line, self._rest = line, b""
        self._forms: set[bool] = set()
        #: Whether fields are padded; None: not seen yet.
        self._padded: bool | None = None
        #: Bytes of a record, and the last line that was none.
        self.length, self.wrong = PADDED_LENGTH, b""

    def begin(self) -> None:
        self._line.write(b"QS" + RETURN)

    def take(self, timeout: float) -> list[Record | None]:
        """The records that come, None for each that is garbled; waits at most so long, s."""
        *lines, self._rest = (self._rest + self._line.read_within(timeout)).split(RETURN)
        if len(self._rest) > 4 * PADDED_LENGTH:
            # No line is that long: what ends them was lost.
            lines, self._rest = [*lines, self._rest], b""
        records = []
        for text in (line.removeprefix(b"\n") for line in lines):
            if text:
                record = decode_ascii(text, self._padded)
                records.append(record)
                if record is None:
                    self.wrong = text
                elif self._padded is None:
                    self._forms.add(is_padded(text))
                    self.length = len(text) + 2
        return records

    def settle(self) -> None:
        """From now on records have the form that all so far had."""
        self._padded = self._forms == {True}


class _BinaryRequests:
    """Records that are asked for, one at a time."""

    #: With the byte that asks.
    length = BINARY_LENGTH + 1

    def __init__(self, line: SerialLine, baud: int):
        self._line = line
        #: A pause within an answer after which no more of it comes, s: adapters hold bytes back for up to 16 ms.
        self._pause = 0.03 + seconds_on_the_line(self.length, baud)
        #: The last answer that was no record.
        self.wrong = b""

    def begin(self) -> None:
        return

    def take(self, timeout: float) -> list[Record | None]:
        """The answer to one request; None: it was cut, or too long. Empty: there was none."""
        self._line.read()  # What came late belongs to no request.
        self._line.write(ONE_RECORD)
        answer = self._line.read_within(max(_ANSWER, self._pause))
        while 0 < len(answer) < BINARY_LENGTH and (more := self._line.read_within(self._pause)):
            answer += more
        answer += self._line.read()
        if not answer:
            return []
        record = decode_binary(answer)
        if record is None:
            self.wrong = answer
            if len(answer) > BINARY_LENGTH:
                _all_said(self._line, self._pause)
        return [record]

    def settle(self) -> None:
        return


def _all_said(line: SerialLine, quiet: float, first: float = 0.0, longest: float = 1.5) -> bytes:
    """What comes until the line is quiet for so long, s; the first of it may take as long as `first`."""
    said, end = b"", time.monotonic() + longest
    while time.monotonic() < end:
        more = line.read_within(quiet if said else max(quiet, first))
        if not more:
            break
        said += more
    return said


def _is_text(data: bytes) -> bool:
    return all(byte in b"\r\n\t\x06\0" or 32 <= byte < 127 for byte in data)


def _shown(data: bytes) -> str:
    return repr(data.strip()[-40:].decode("ascii", "backslashreplace")) if data.strip() else "nothing came"


def _not_a_controller(port: str, baud: int, said: bytes) -> str:
    """The sentence for a port at which no prompt comes."""
    if not said:
        return (f"nobody answers at {port}; check that the ATI controller has power, the cable, and the baud rate "
                f"(here {baud}; its display shows its own at power on)")
    if sum(not _is_text(bytes([byte])) for byte in said) > len(said) / 8:
        return (f"what comes from {port} is no text at {baud} baud; give the baud rate of the ATI controller, which "
                "its display shows at power on, as in baud=38400")
    return (f"what answers at {port} is not an ATI controller (it says {_shown(said)} and no prompt '>'); give the "
            "port of the controller")


def open_ati_serial(text: str) -> AtiSerialSensor:
    """``ati-serial:/dev/ttyUSB0,counts_per_N=...,counts_per_Nm=...,baud=9600,mode=ascii,rate_hz=0,average=0``.

    The counts per unit are those of the calibration and have to be given; a ``rate_hz`` of 0 is measured.
    """
    example = "ati-serial:/dev/ttyUSB0,counts_per_N=100,counts_per_Nm=4000"
    port, rest = split_target(text, "the port of the controller", example)
    words, rest = read_choices(rest, mode=MODES)
    given = read_settings(rest, counts_per_N=0.0, counts_per_Nm=0.0, baud=9600, rate_hz=0.0, average=0)
    return AtiSerialSensor(port, given["counts_per_N"], given["counts_per_Nm"], int(given["baud"]), words["mode"],
                           given["rate_hz"] or None, int(given["average"]))
