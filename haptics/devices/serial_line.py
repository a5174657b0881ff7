"""A serial port with buffered reads, messages with the remedy for each failure, and identification of its controller.

The controller is identified when the expected one does not answer.
"""

from __future__ import annotations

import errno
import time
from pathlib import Path

from haptics.devices.contracts import DeviceError
from haptics.protocols import tic

#: Longest blocking wait for a first byte; longer timeouts repeat the wait, s.
_WAIT = 0.02


class SerialLine:
    """An open serial port, for the exclusive use of this program. The constructor opens the port.

    Args:
        port: Such as ``/dev/ttyUSB0`` or ``COM3``.
        baud: Bits per second.
        owner: Device at the port, for messages, such as ``"the Tic"``.

    Raises:
        DeviceError: The port does not exist (the message lists the existing ones), permission is missing, or another
            program uses the port.
    """

    def __init__(self, port: str, baud: int, owner: str):
        import serial

        self.port, self._owner, self._kept = port, owner, b""
        try:
            self._serial = serial.Serial(port, baud, timeout=_WAIT, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError) as error:
            raise DeviceError(_describe_open_failure(port, owner, error)) from None

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises:
            DeviceError: The port has disappeared, or accepts no data for one second.
        """
        try:
            self._serial.write(data)
        except OSError as error:
            raise DeviceError(self._describe_lost_port(error)) from None

    def read(self) -> bytes:
        """Return the bytes received since the last call, without waiting.

        Raises:
            DeviceError: The port has disappeared.
        """
        self._move_received_bytes_to_buffer(wait=False)
        data, self._kept = self._kept, b""
        return data

    def read_within(self, timeout: float) -> bytes:
        """Return received bytes as soon as there are any, after at most `timeout` seconds; empty if none arrive.

        Raises:
            DeviceError: The port has disappeared.
        """
        end = time.monotonic() + timeout
        self._move_received_bytes_to_buffer(wait=False)
        while not self._kept and time.monotonic() < end:
            self._move_received_bytes_to_buffer(wait=True)
        data, self._kept = self._kept, b""
        return data

    def read_exactly(self, count: int, timeout: float) -> bytes:
        """Return exactly the next `count` bytes.

        Args:
            count: Number of bytes.
            timeout: Longest wait, s.

        Raises:
            DeviceError: The port has disappeared, or fewer bytes arrived in time (the message states their number).
        """
        end = time.monotonic() + timeout
        while len(self._kept) < count:
            if time.monotonic() >= end:
                raise DeviceError(f"{self._owner} at {self.port} answered {len(self._kept)} of {count} bytes within "
                                  f"{timeout:g} s; check that it has power, the cable and the baud rate")
            self._move_received_bytes_to_buffer(wait=True)
        data, self._kept = self._kept[:count], self._kept[count:]
        return data

    def read_line_or_raise(self, timeout: float, ending: bytes = b"\n") -> bytes:
        """Wait for the next line, and return its bytes without the ending.

        Args:
            timeout: Longest wait, s.
            ending: Bytes that end a line.

        Raises:
            DeviceError: The port has disappeared, or no complete line arrived in time.
        """
        end = time.monotonic() + timeout
        while ending not in self._kept:
            if time.monotonic() >= end:
                raise DeviceError(f"{self._owner} at {self.port} answered no whole line within {timeout:g} s (so far "
                                  f"{self._kept[:40]!r}); check that it has power, the cable and the baud rate")
            self._move_received_bytes_to_buffer(wait=True)
        line, _, self._kept = self._kept.partition(ending)
        return line

    def _move_received_bytes_to_buffer(self, wait: bool) -> None:
        """Move received bytes from the port to the buffer; with `wait`, wait up to `_WAIT` s for the first one."""
        try:
            waiting = self._serial.in_waiting
            if waiting or wait:
                self._kept += self._serial.read(waiting or 1)
        except (OSError, TypeError) as error:  # pyserial's TypeError: another thread has closed it
            raise DeviceError(self._describe_lost_port(error)) from None

    def close(self) -> None:
        """Close the port; has no effect on a closed port."""
        self._serial.close()

    def _describe_lost_port(self, error: Exception) -> str:
        """Return the message for a port that has disappeared."""
        return f"{self._owner} at {self.port} is gone ({error}); plug it in again and start again"


def _describe_open_failure(port: str, owner: str, error: Exception) -> str:
    """Return the message, cause and remedy, for a port that does not open."""
    number = getattr(error, "errno", None)
    if number in (errno.EACCES, errno.EPERM):
        group = _find_port_group_or_dialout(port)
        return (f"no permission to open {port} for {owner}; add yourself to the group that owns it ({group}), "
                f"as with 'sudo usermod -aG {group} $USER', and log in again")
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error).lower():
        return f"{port} is in use by another program; close that one, then start {owner} again"
    if number == errno.ENOENT or isinstance(error, FileNotFoundError):
        ports = list_serial_port_names()
        return (f"there is no port {port} for {owner}; "
                + (f"the ports are {', '.join(ports)}" if ports else "no serial port was found: plug the device in"))
    return f"{port} cannot be opened for {owner} ({error}); give the port of a serial device, such as /dev/ttyUSB0"


def _find_port_group_or_dialout(port: str) -> str:
    """Return the name of the Unix group that owns the file of a port; ``dialout`` if it cannot be found."""
    try:
        return Path(port).group()
    # The group only completes the advice of a message: the port may be gone (OSError) or owned by a number without a
    # name (KeyError), and Windows has no groups (NotImplementedError).
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def list_serial_port_names() -> list[str]:
    """Return the names of this computer's serial ports, such as ``/dev/ttyUSB0``, sorted."""
    from serial.tools.list_ports import comports

    return sorted(port.device for port in comports())


#: Time allowed for the answer of another controller, s.
_ANSWER_TIMEOUT = 0.3


def probe_controller_and_get_hint(line: SerialLine) -> str:
    """Find which controller answers on an open serial line, and return a hint to append to an error message.

    Sends an empty line and a status query of a Tic; neither moves a motor.

    Returns:
        A text such as ``"; a Tic answers there: name it tic:PORT"``; ``""`` if no known controller answers.
    """
    try:
        text = _send_and_collect_answer_bytes(line, b"\r")
        if b"Grbl" in text or text.strip() == b"ok" or b"\nok" in text or text.startswith((b"error:", b"ALARM:")):
            return f"; a Grbl answers there: name it grbl:{line.port}"
        if text.rstrip().endswith(b">"):
            return f"; an ATI controller answers there: name it ati-serial:{line.port}"
        query = tic.encode_command(tic.TicCommand.GET_VARIABLE, tic.VariableOffset.STATUS, tic.BlockLength.STATUS)
        block = _send_and_collect_answer_bytes(line, query)
        if tic.parse_status_or_none(block) is not None:
            return f"; a Tic answers there: name it tic:{line.port}"
    except DeviceError:
        return ""
    return ""


def _send_and_collect_answer_bytes(line: SerialLine, question: bytes) -> bytes:
    """Discard received bytes, send `question`, and return all bytes (or none) that arrive in `_ANSWER_TIMEOUT` s."""
    line.read()
    line.write(question)
    end, text = time.monotonic() + _ANSWER_TIMEOUT, b""
    while time.monotonic() < end:
        text += line.read()
        time.sleep(0.01)
    return text
