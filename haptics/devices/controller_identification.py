"""Identify the controller at a serial port when the expected one does not answer."""

from __future__ import annotations

import time

from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine
from haptics.protocols import tic

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
