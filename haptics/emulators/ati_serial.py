"""Emulator of the stand-alone controller of an ATI force/torque sensor, on a pseudo-terminal.

The baud rate limits the rate of the records. If the client sets the terminal to another baud rate, both sides receive
garbage. The text between a command and its prompt, the banner, and the answer to an unknown command are not documented
in the sources of `haptics.protocols.ati_serial`; they are invented here.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from haptics.devices.ati_serial import MODES
from haptics.devices.contracts import Bench, DeviceError, ForceSensor, SampleStatus
from haptics.devices.settings import parse_number_settings, parse_word_settings_and_remaining_text
from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import SerialDeviceEmulator
from haptics.protocols.ati_serial import (
    CARRIAGE_RETURN,
    CHANNELS,
    FORMAT,
    ONE_RECORD,
    PROMPT,
    RESET,
    AtiSerialRecord,
    compute_transmission_time,
    encode_ascii_record_without_ending,
    encode_binary_record,
)
from tissue_sim.errors import InputError

#: Line ending.
_END = b"\r\n"
#: Largest number of stored biases.
_BIAS_LEVELS = 3


class AtiSerialEmulator(SerialDeviceEmulator):
    """Emulate the commands CD A/B/R/E/U, SA, SB, SU, SZ, QR, QS, ^T and ^W with the samples of a sensor.

    Channels that the sensor lacks read 0. A load beyond the range of the sensor or of the counts sets the error flag.
    ``CD E`` is accepted without effect.

    Args:
        sensor: Source of the samples; the emulator starts and stops it.
        counts_per_N: Counts per newton.
        counts_per_Nm: Counts per newton metre.
        baud: Baud rate.
        mode: Mode at power-on, ``"ascii"`` or ``"binary"``.
        padded: True if fields are padded to six characters.
        faults: Faults of the connection.

    Attributes:
        records: Number of records sent.

    Raises:
        InputError: A number is not positive.
    """

    name = "ati-serial"

    def __init__(self, sensor: ForceSensor, counts_per_N: float = 100.0, counts_per_Nm: float = 4000.0,
                 baud: int = 9600, mode: str = "ascii", padded: bool = True, faults: Faults | None = None):
        super().__init__(faults or Faults())
        for field, value in (("counts_per_N", counts_per_N), ("counts_per_Nm", counts_per_Nm), ("baud", baud)):
            if not value > 0:
                raise InputError(f"counts per unit and baud rate must be above 0; got {value:g}", field=field)
        self._sensor, self._baud, self._mode_at_start, self._padded = sensor, baud, mode, padded
        self._scale = (counts_per_N,) * 3 + (counts_per_Nm,) * 3
        self.records = 0
        self._set_power_on_state()

    @property
    def address(self) -> str:
        """Name for `make_sensor` that connects to this emulator: terminal, counts per unit, baud rate and mode."""
        return (f"ati-serial:{self.path},counts_per_N={self._scale[0]:g},counts_per_Nm={self._scale[-1]:g},"
                f"baud={self._baud},mode={self._mode_at_start}")

    def describe(self) -> dict[str, Any]:
        """Return terminal, baud rate, mode, counts per unit and number of records sent."""
        return {"emulator": self.name, "terminal": self.path, "baud": self._baud, "mode": self._mode,
                "padded_fields": self._padded, "counts_per_N": self._scale[0], "counts_per_Nm": self._scale[-1],
                "records": self.records}

    def power_on_with_backing_device(self) -> None:
        """Start the sensor that supplies the samples, and set the state of the emulated controller after power-on."""
        self._sensor.start()
        self._set_power_on_state()

    def stop_backing_device(self) -> None:
        """Stop the sensor that supplies the samples."""
        self._sensor.stop()

    def _set_power_on_state(self) -> None:
        """Set all variables of the emulated controller to their values after power-on."""
        self._mode, self._streams, self._command = self._mode_at_start, False, b""
        self._biases: deque[tuple[int, ...]] = deque(maxlen=_BIAS_LEVELS)
        #: Loads to average.
        self._loads: deque[tuple[float, ...]] = deque([(0.0,) * 6], maxlen=1)
        self._faulty = False
        #: Messages on the line: time at which the last byte leaves, s, and bytes.
        self._leaving: deque[tuple[float, bytes]] = deque()
        #: Time until which the line is occupied, s.
        self._free_at = 0.0

    def execute_bytes_and_get_answers(self, data: bytes) -> list[bytes]:
        """Execute the received commands and return no answers.

        `advance_and_get_messages_to_send` returns the answers at the speed of the line.
        """
        if not self._has_matching_baud():
            self._schedule_transmission(PROMPT + _END)
            return []
        for value in data:
            byte = bytes([value])
            if byte == RESET:
                self._set_power_on_state()
                self._schedule_transmission(b"ATI stand-alone controller (emulated)" + _END + PROMPT)
            elif byte == ONE_RECORD:
                self._schedule_transmission(self._encode_next_record())
                self.records += 1
            elif byte == CARRIAGE_RETURN:
                self._execute_command(self._command)
                self._command = b""
            elif not self._streams:
                self._command += byte
        return []

    def advance_and_get_messages_to_send(self) -> list[bytes]:
        """Queue the streamed records that are due, and return the messages whose last byte has been transmitted."""
        now = time.monotonic()
        while self._streams and self._free_at <= now:
            # The next record follows the last one without a pause, unless the thread is 0.1 s behind.
            self._schedule_transmission(self._encode_next_record(), max(self._free_at, now - 0.1))
            self.records += 1
        ready = []
        while self._leaving and self._leaving[0][0] <= now:
            ready.append(self._leaving.popleft()[1])
        if self._has_matching_baud():
            return ready
        return [bytes(byte ^ 0xA5 for byte in message) for message in ready]

    def _has_matching_baud(self) -> bool:
        """Return True if the terminal has the controller's baud rate, or if the platform does not know this rate."""
        import termios

        speed = getattr(termios, f"B{self._baud}", None)
        return speed is None or termios.tcgetattr(self._slave)[5] == speed

    def _schedule_transmission(self, message: bytes, begins: float | None = None) -> None:
        """Queue a message for the line, beginning at a time on the clock, s; None: as soon as the line is free."""
        begins = max(self._free_at, time.monotonic()) if begins is None else begins
        self._free_at = begins + compute_transmission_time(len(message), self._baud)
        self._leaving.append((self._free_at, message))

    def _execute_command(self, command: bytes) -> None:
        """Execute a command line without its ending, and queue the answer; ends the stream of records."""
        self._streams = False
        words = command.decode("ascii", "replace").upper().split()
        match words:
            case ["CD", ("A" | "B") as mode]:
                self._mode = MODES["AB".index(mode)]
            case ["SA", number] if number.isascii() and number.isdigit():
                self._loads = deque(self._loads, maxlen=max(int(number), 1))
            case ["SB"]:
                self._biases.append(self._measure_mean_raw_counts())
            case ["SU"]:
                if self._biases:
                    self._biases.pop()
            case ["SZ"]:
                self._biases.clear()
            case ["QR"]:
                record = self._encode_next_record() + _END * (self._mode == "binary")
                self._schedule_transmission(command + _END + record + PROMPT)
                self.records += 1
                return
            case ["QS"]:
                self._schedule_transmission(command + _END)
                self._streams = True
                return
            case [] | ["CD", "R" | "E" | "U"]:
                pass
            case _:
                self._schedule_transmission(command + _END + b"ERROR: no such command" + _END + PROMPT)
                return
        self._schedule_transmission(command + _END + _END + PROMPT)

    def _encode_next_record(self) -> bytes:
        """Measure, subtract the bias, and return the bytes of the record in the selected mode, ASCII or binary."""
        counts = self._measure_mean_raw_counts()
        bias = self._biases[-1] if self._biases else (0,) * 6
        biased = [count - zero for count, zero in zip(counts, bias, strict=True)]
        clipped = tuple(min(max(count, FORMAT.lowest_count), FORMAT.highest_count) for count in biased)
        record = AtiSerialRecord(int(self._faulty or list(clipped) != biased), clipped)
        if self._mode == "binary":
            return encode_binary_record(record)
        return encode_ascii_record_without_ending(record, self._padded) + _END

    def _measure_mean_raw_counts(self) -> tuple[int, ...]:
        """Read the sensor, update the error flag, and return six mean counts; the bias is not yet subtracted."""
        try:
            samples = self._sensor.read()
        except DeviceError:
            samples, self._faulty = (), True
        for sample in samples:
            by_name = dict(zip(self._sensor.channels, sample.values, strict=True))
            self._loads.append(tuple(by_name.get(name, 0.0) for name in CHANNELS))
        if samples:
            self._faulty = any(sample.status & (SampleStatus.SATURATED | SampleStatus.FAULT) for sample in samples)
        means = (sum(column) / len(self._loads) for column in zip(*self._loads, strict=True))
        return tuple(round(mean * scale) for mean, scale in zip(means, self._scale, strict=True))


def make_ati_serial_emulator(bench: Bench, text: str, faults: Faults) -> AtiSerialEmulator:
    """Make an emulator from settings ``counts_per_N=100,counts_per_Nm=4000,baud=9600,mode=ascii,padded=1``."""
    words, rest = parse_word_settings_and_remaining_text(text, mode=MODES)
    given = parse_number_settings(rest, counts_per_N=100.0, counts_per_Nm=4000.0, baud=9600, padded=1)
    return AtiSerialEmulator(bench.sensor, given["counts_per_N"], given["counts_per_Nm"], int(given["baud"]),
                             words["mode"], bool(given["padded"]), faults)
