"""A serial port, with one sentence for each way in which it can fail to open."""

from __future__ import annotations

import errno
import time
from pathlib import Path

from haptics.devices.contracts import DeviceError

#: Longest wait for a first byte before the clock is looked at again, s.
_WAIT = 0.02


class SerialLine:
    """An open port; not shared with another program. Making one opens it.

    Args:
        port: such as ``/dev/ttyUSB0`` or ``COM3``.
        baud: bits in a second.
        owner: who speaks on it, in messages: ``"the Tic"``.

    Raises:
        DeviceError: no such port (names those that are there), no permission, or in use.
    """

    def __init__(self, port: str, baud: int, owner: str):
        import serial

        self.port, self._owner, self._kept = port, owner, b""
        try:
            self._serial = serial.Serial(port, baud, timeout=_WAIT, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError) as error:
            raise DeviceError(_why_not(port, owner, error)) from None

    def write(self, data: bytes) -> None:
        """Send all of it.

        Raises:
            DeviceError: the port is gone, or takes nothing for a second.
        """
        try:
            self._serial.write(data)
        except OSError as error:
            raise DeviceError(self._gone(error)) from None

    def read(self) -> bytes:
        """What has come since the last call; does not wait.

        Raises:
            DeviceError: the port is gone.
        """
        self._fetch(wait=False)
        data, self._kept = self._kept, b""
        return data

    def read_within(self, timeout: float) -> bytes:
        """What has come, as soon as there is something; empty where nothing comes in that time, s.

        Raises:
            DeviceError: the port is gone.
        """
        end = time.monotonic() + timeout
        self._fetch(wait=False)
        while not self._kept and time.monotonic() < end:
            self._fetch(wait=True)
        data, self._kept = self._kept, b""
        return data

    def read_some(self, count: int, timeout: float) -> bytes:
        """The next bytes.

        Args:
            count: how many. timeout: s.

        Raises:
            DeviceError: the port is gone, or fewer came in that time (says how many).
        """
        end = time.monotonic() + timeout
        while len(self._kept) < count:
            if time.monotonic() >= end:
                raise DeviceError(f"{self._owner} at {self.port} answered {len(self._kept)} of {count} bytes within "
                                  f"{timeout:g} s; check that it has power, the cable and the baud rate")
            self._fetch(wait=True)
        data, self._kept = self._kept[:count], self._kept[count:]
        return data

    def read_line(self, timeout: float, ending: bytes = b"\n") -> bytes:
        """The next line, without its ending.

        Args:
            timeout: s. ending: of a line.

        Raises:
            DeviceError: the port is gone, or no whole line came in that time.
        """
        end = time.monotonic() + timeout
        while ending not in self._kept:
            if time.monotonic() >= end:
                raise DeviceError(f"{self._owner} at {self.port} answered no whole line within {timeout:g} s (so far "
                                  f"{self._kept[:40]!r}); check that it has power, the cable and the baud rate")
            self._fetch(wait=True)
        line, _, self._kept = self._kept.partition(ending)
        return line

    def _fetch(self, wait: bool) -> None:
        """Keep what is there; where it is nothing, wait a moment for the first byte."""
        try:
            waiting = self._serial.in_waiting
            if waiting or wait:
                self._kept += self._serial.read(waiting or 1)
        except (OSError, TypeError) as error:  # pyserial's TypeError: another thread has closed it
            raise DeviceError(self._gone(error)) from None

    def close(self) -> None:
        """Nothing where it is closed."""
        self._serial.close()

    def _gone(self, error: Exception) -> str:
        return f"{self._owner} at {self.port} is gone ({error}); plug it in again and start anew"


def _why_not(port: str, owner: str, error: Exception) -> str:
    """The sentence for a port that does not open."""
    number = getattr(error, "errno", None)
    if number in (errno.EACCES, errno.EPERM):
        return (f"no permission to open {port} for {owner}; add yourself to the group that owns it ({_group(port)}), "
                f"as with 'sudo usermod -aG {_group(port)} $USER', and log in again")
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error).lower():
        return f"{port} is in use by another program; close that one, then start {owner} again"
    if number == errno.ENOENT or isinstance(error, FileNotFoundError):
        there = serial_ports()
        return (f"there is no port {port} for {owner}; "
                + (f"there are {', '.join(there)}" if there else "no serial port is there: plug the device in"))
    return f"{port} cannot be opened for {owner} ({error}); give the port of a serial device, such as /dev/ttyUSB0"


def _group(port: str) -> str:
    try:
        return Path(port).group()
    # The last one is what pathlib raises on Windows, which has no groups.
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def serial_ports() -> list[str]:
    """The serial ports of this computer."""
    from serial.tools.list_ports import comports

    return sorted(port.device for port in comports())
