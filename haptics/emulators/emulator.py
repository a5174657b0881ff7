"""Base classes and table of emulators: programs that any client of a device can connect to instead of the device.

Emulators of serial devices have a pseudo-terminal instead of a serial port.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
from abc import ABC, abstractmethod
from typing import Any, Self

from haptics.devices.contracts import Bench, DeviceError
from haptics.devices.virtual.faults import Faults, FaultyMessageQueue
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.registry import Registry


class Emulator(ABC):
    """A program that speaks the protocol of a device. The constructor opens no connection; `start` does.

    Attributes:
        name: Name of the protocol, as in ``tissue-sim emulate NAME``.
    """

    name: str

    @property
    @abstractmethod
    def address(self) -> str:
        """Name for `make_sensor`, `make_stage` or `make_haptic_device`; known after `start`."""

    @abstractmethod
    def start(self) -> None:
        """Open the connection and answer in a thread; has no effect on a started emulator.

        Raises:
            DeviceError: The connection cannot be opened.
        """

    @abstractmethod
    def stop(self) -> None:
        """Close the connection and stop the device that backs it; has no effect on a stopped emulator."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return protocol, address, settings and counts of messages. Keys carry units, values have JSON types."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


#: Emulators by name; each is a function of (bench, settings after the colon, faults).
EMULATORS: Registry[Any] = Registry("emulator", "tissue_sim.emulators", {
    "rdt": "haptics.emulators.rdt:make_rdt_emulator",
    "ati-serial": "haptics.emulators.ati_serial:make_ati_serial_emulator",
    "tic": "haptics.emulators.tic:make_tic_emulator",
    "grbl": "haptics.emulators.grbl:make_grbl_emulator",
    "haply": "haptics.emulators.haply:make_haply_emulator",
})


def make_emulator(name: str, bench: Bench, faults: Faults | None = None) -> Emulator:
    """Make an emulator by name, without starting it.

    Args:
        name: Name of the protocol, followed by a colon and its settings if it has any: ``rdt:port=49152``.
        bench: Devices whose samples and motions the emulator transmits; the emulator starts and stops the one it uses.
        faults: Faults of the connection; faults of sensor and motor belong to the bench.

    Raises:
        InputError: No emulator has this name (the message names the nearest), or the settings are invalid.
    """
    protocol, _, settings = name.partition(":")
    return EMULATORS.find(protocol)(bench, settings, faults or Faults())


__getattr__ = make_getattr_for_old_names(__name__, {"TerminalEmulator": "SerialDeviceEmulator"})

#: Longest wait for received bytes before `SerialDeviceEmulator.advance_and_get_messages_to_send` is called again, s.
_POLL = 0.5e-3


class SerialDeviceEmulator(Emulator):
    """An emulator that answers on a pseudo-terminal.

    Args:
        faults: Faults of the connection.

    Attributes:
        path: Path of the terminal for the client, such as ``/dev/pts/3``; empty before `start`.
    """

    def __init__(self, faults: Faults):
        self._faults = faults
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._master = self._slave = -1
        self.path = ""

    @abstractmethod
    def power_on_with_backing_device(self) -> None:
        """Set the state after power-on and start the device behind the emulator; called before the terminal opens."""

    @abstractmethod
    def stop_backing_device(self) -> None:
        """Stop the device behind the emulator; called after the terminal has closed."""

    @abstractmethod
    def execute_bytes_and_get_answers(self, data: bytes) -> list[bytes]:
        """Execute received bytes, which may hold part of a command or several commands; return the answers."""

    def advance_and_get_messages_to_send(self) -> list[bytes]:
        """Advance the state to now, and return the messages to send now; called about every 0.5 ms. Here none."""
        return []

    def start(self) -> None:
        """Open the pseudo-terminal and answer in a thread; has no effect on a started emulator.

        Raises:
            DeviceError: the platform has no pseudo-terminals.
        """
        if self._thread is not None:
            return
        if sys.platform == "win32":
            raise DeviceError("Windows has no pseudo-terminals; start the emulator on Linux or macOS")
        import tty

        self.power_on_with_backing_device()
        self._master, self._slave = os.openpty()
        # The open slave keeps the terminal alive while no client is connected.
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        os.set_blocking(self._master, False)
        self._ending.clear()
        self._thread = threading.Thread(target=self._run_terminal, name=f"{self.name} emulator", daemon=True)
        self._thread.start()

    def _run_terminal(self) -> None:
        """Answer received bytes and send due messages until `stop`; the body of the thread."""
        line = FaultyMessageQueue(self._faults, time.monotonic())
        while not self._ending.is_set():
            readable, _, _ = select.select([self._master], [], [], _POLL)
            now = time.monotonic()
            messages = []
            if readable:
                with contextlib.suppress(BlockingIOError, OSError):
                    data = os.read(self._master, 65536)
                    if not line.is_disconnected(now):
                        messages = self.execute_bytes_and_get_answers(data)
            for message in (*messages, *self.advance_and_get_messages_to_send()):
                line.put_message(message, now)
            for message in line.take_due_messages(now):
                # If the client does not read, excess bytes are lost, as on a wire without flow control.
                with contextlib.suppress(BlockingIOError):
                    os.write(self._master, message)

    def stop(self) -> None:
        """End the thread, close the pseudo-terminal and stop the device that backs the emulator."""
        if self._thread is None:
            return
        self._ending.set()
        self._thread.join()
        self._thread = None
        os.close(self._master)
        os.close(self._slave)
        self.stop_backing_device()
