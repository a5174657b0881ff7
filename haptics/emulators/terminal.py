"""A device on a serial port, played on a pseudo-terminal: real terminal semantics, no cable."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
from abc import abstractmethod

from haptics.devices.contracts import DeviceError
from haptics.devices.virtual.faults import Faults, FaultyLine
from haptics.emulators.emulator import Emulator

#: How long the thread waits for bytes before it looks what is due, s.
_WAIT = 0.5e-3


class TerminalEmulator(Emulator):
    """Answers on a pseudo-terminal.

    Args:
        faults: on the line.
    """

    def __init__(self, faults: Faults):
        self._faults = faults
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._master = self._slave = -1
        #: What the client opens, such as ``/dev/pts/3``.
        self.path = ""

    @abstractmethod
    def begin(self) -> None:
        """Start what is behind it; called before the line opens."""

    @abstractmethod
    def end(self) -> None:
        """Stop what is behind it."""

    @abstractmethod
    def received(self, data: bytes) -> list[bytes]:
        """Answers, a message each, to bytes of the client, which may be a part of a command, or several."""

    def due(self) -> list[bytes]:
        """What is sent unasked, a message each; asked about every half millisecond."""
        return []

    def start(self) -> None:
        if self._thread is not None:
            return
        if sys.platform == "win32":
            raise DeviceError("Windows has no pseudo-terminals; start the emulator on Linux or macOS")
        import tty

        self.begin()
        self._master, self._slave = os.openpty()
        # The slave stays open here: the line is there while no client is.
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        os.set_blocking(self._master, False)
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name=f"{self.name} emulator", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        line = FaultyLine(self._faults, time.monotonic())
        while not self._ending.is_set():
            readable, _, _ = select.select([self._master], [], [], _WAIT)
            now = time.monotonic()
            messages = []
            if readable:
                with contextlib.suppress(BlockingIOError, OSError):
                    data = os.read(self._master, 65536)
                    if not line.is_silent(now):
                        messages = self.received(data)
            for message in (*messages, *self.due()):
                line.put(message, now)
            for message in line.take(now):
                # A client that does not read loses what does not fit, as on a wire without flow control.
                with contextlib.suppress(BlockingIOError):
                    os.write(self._master, message)

    def stop(self) -> None:
        if self._thread is None:
            return
        self._ending.set()
        self._thread.join()
        self._thread = None
        os.close(self._master)
        os.close(self._slave)
        self.end()
