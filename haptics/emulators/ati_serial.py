"""The stand-alone controller of an ATI force/torque sensor, played on a pseudo-terminal.

Records leave as fast as the baud rate carries them. At another baud rate than its own it receives and sends garbage, as
far as the terminal tells the rate. What it says between a command and its prompt, its banner, and its answer to what it
does not know are this house's: no source that was at hand gives them.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from haptics.devices.ati_serial import MODES
from haptics.devices.contracts import Bench, DeviceError, ForceSensor, SampleStatus
from haptics.devices.settings import read_choices, read_settings
from haptics.devices.virtual.faults import Faults
from haptics.emulators.terminal import TerminalEmulator
from haptics.protocols.ati_serial import (
    CHANNELS,
    HIGHEST,
    LOWEST,
    ONE_RECORD,
    PROMPT,
    RESET,
    RETURN,
    Record,
    encode_ascii,
    encode_binary,
    seconds_on_the_line,
)
from tissue_sim.errors import InputError

_END = b"\r\n"
#: Biases that it can hold.
_LEVELS = 3


class AtiSerialEmulator(TerminalEmulator):
    """Answers CD A/B/R/E/U, SA, SB, SU, SZ, QR, QS, ^T and ^W from a force sensor.

    Channels that the sensor does not have read zero. A load beyond its range, or beyond that of the counts, sets the
    error flag. ``CD E`` is accepted and changes nothing.

    Args:
        sensor: whose forces it tells; it is started and stopped with it.
        counts_per_N, counts_per_Nm: its calibration.
        baud: of the line. mode: at power on, ``"ascii"`` or ``"binary"``.
        padded: whether the fields of a line have six characters.
        faults: on the line.

    Raises:
        InputError: a number that is not positive.
    """

    name = "ati-serial"

    def __init__(self, sensor: ForceSensor, counts_per_N: float = 100.0, counts_per_Nm: float = 4000.0,
                 baud: int = 9600, mode: str = "ascii", padded: bool = True, faults: Faults | None = None):
        super().__init__(faults or Faults())
        for field, value in (("counts_per_N", counts_per_N), ("counts_per_Nm", counts_per_Nm), ("baud", baud)):
            if not value > 0:
                raise InputError(f"{value:g}; give a number above zero", field=field)
        self._sensor, self._baud, self._mode_at_start, self._padded = sensor, baud, mode, padded
        self._scale = (counts_per_N,) * 3 + (counts_per_Nm,) * 3
        #: Records that it has sent.
        self.records = 0
        self._power_on()

    @property
    def address(self) -> str:
        return (f"ati-serial:{self.path},counts_per_N={self._scale[0]:g},counts_per_Nm={self._scale[-1]:g},"
                f"baud={self._baud},mode={self._mode_at_start}")

    def describe(self) -> dict[str, Any]:
        return {"emulator": self.name, "terminal": self.path, "baud": self._baud, "mode": self._mode,
                "padded_fields": self._padded, "counts_per_N": self._scale[0], "counts_per_Nm": self._scale[-1],
                "records": self.records}

    def begin(self) -> None:
        self._sensor.start()
        self._power_on()

    def end(self) -> None:
        self._sensor.stop()

    def _power_on(self) -> None:
        self._mode, self._streams, self._command = self._mode_at_start, False, b""
        self._biases: deque[tuple[int, ...]] = deque(maxlen=_LEVELS)
        self._loads: deque[tuple[float, ...]] = deque([(0.0,) * 6], maxlen=1)
        self._faulty = False
        #: (when its last byte has left, message); until when the line is taken, s.
        self._leaving: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0

    def received(self, data: bytes) -> list[bytes]:
        if not self._is_its_baud():
            self._send(PROMPT + _END)
            return []
        for value in data:
            byte = bytes([value])
            if byte == RESET:
                self._power_on()
                self._send(b"ATI stand-alone controller (emulated)" + _END + PROMPT)
            elif byte == ONE_RECORD:
                self._send(self._record())
                self.records += 1
            elif byte == RETURN:
                self._answer(self._command)
                self._command = b""
            elif not self._streams:
                self._command += byte
        return []

    def due(self) -> list[bytes]:
        now = time.monotonic()
        while self._streams and self._free_at <= now:
            # The next one begins where the last one ended, as long as the thread is not far behind.
            self._send(self._record(), max(self._free_at, now - 0.1))
            self.records += 1
        ready = []
        while self._leaving and self._leaving[0][0] <= now:
            ready.append(self._leaving.popleft()[1])
        return ready if self._is_its_baud() else [bytes(byte ^ 0xA5 for byte in message) for message in ready]

    def _is_its_baud(self) -> bool:
        """Whether the client has set the terminal to its baud rate."""
        import termios

        wanted = getattr(termios, f"B{self._baud}", None)
        return wanted is None or termios.tcgetattr(self._slave)[5] == wanted

    def _send(self, message: bytes, begins: float | None = None) -> None:
        begins = max(self._free_at, time.monotonic()) if begins is None else begins
        self._free_at = begins + seconds_on_the_line(len(message), self._baud)
        self._leaving.append((self._free_at, message))

    def _answer(self, command: bytes) -> None:
        """Do a command, and say so."""
        self._streams = False
        words = command.decode("ascii", "replace").upper().split()
        match words:
            case ["CD", ("A" | "B") as mode]:
                self._mode = MODES["AB".index(mode)]
            case ["SA", number] if number.isascii() and number.isdigit():
                self._loads = deque(self._loads, maxlen=max(int(number), 1))
            case ["SB"]:
                self._biases.append(self._counts())
            case ["SU"]:
                if self._biases:
                    self._biases.pop()
            case ["SZ"]:
                self._biases.clear()
            case ["QR"]:
                self._send(command + _END + self._record() + _END * (self._mode == "binary") + PROMPT)
                self.records += 1
                return
            case ["QS"]:
                self._send(command + _END)
                self._streams = True
                return
            case [] | ["CD", "R" | "E" | "U"]:
                pass
            case _:
                self._send(command + _END + b"ERROR: no such command" + _END + PROMPT)
                return
        self._send(command + _END + _END + PROMPT)

    def _record(self) -> bytes:
        """The next record as it stands on the line."""
        counts = self._counts()
        bias = self._biases[-1] if self._biases else (0,) * 6
        biased = [count - zero for count, zero in zip(counts, bias, strict=True)]
        told = tuple(min(max(count, LOWEST), HIGHEST) for count in biased)
        record = Record(int(self._faulty or list(told) != biased), told)
        return encode_binary(record) if self._mode == "binary" else encode_ascii(record, self._padded) + _END

    def _counts(self) -> tuple[int, ...]:
        """What it measures now, averaged, without a bias."""
        try:
            samples = self._sensor.read()
        except DeviceError:
            samples, self._faulty = (), True
        for sample in samples:
            named = dict(zip(self._sensor.channels, sample.values, strict=True))
            self._loads.append(tuple(named.get(name, 0.0) for name in CHANNELS))
        if samples:
            self._faulty = any(sample.status & (SampleStatus.SATURATED | SampleStatus.FAULT) for sample in samples)
        means = (sum(column) / len(self._loads) for column in zip(*self._loads, strict=True))
        return tuple(round(mean * scale) for mean, scale in zip(means, self._scale, strict=True))


def emulate_ati_serial(bench: Bench, text: str, faults: Faults) -> AtiSerialEmulator:
    """``ati-serial:counts_per_N=100,counts_per_Nm=4000,baud=9600,mode=ascii,padded=1``."""
    words, rest = read_choices(text, mode=MODES)
    given = read_settings(rest, counts_per_N=100.0, counts_per_Nm=4000.0, baud=9600, padded=1)
    return AtiSerialEmulator(bench.sensor, given["counts_per_N"], given["counts_per_Nm"], int(given["baud"]),
                             words["mode"], bool(given["padded"]), faults)
