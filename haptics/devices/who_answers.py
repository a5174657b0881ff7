"""Which other controller stands at a serial port, when the one that was asked for does not answer."""

from __future__ import annotations

import time

from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine
from haptics.protocols import tic

#: How long another controller has for its answer, s.
_WAIT = 0.3


def who_answers(line: SerialLine) -> str:
    """Half a sentence about another device that answers on a line, with its name for `open_stage`; empty: none known.

    It is sent an empty line and a question for a Tic: neither moves anything.
    """
    try:
        text = _said_to(line, b"\r")
        if b"Grbl" in text or text.strip() == b"ok" or b"\nok" in text or text.startswith((b"error:", b"ALARM:")):
            return f"; a Grbl answers there: name it grbl:{line.port}"
        if text.rstrip().endswith(b">"):
            return f"; an ATI controller answers there: name it ati-serial:{line.port}"
        block = _said_to(line, tic.encode(tic.Command.GET_VARIABLE, tic.Variable.STATUS, tic.STATUS_SIZE))
        if tic.parse_status(block) is not None:
            return f"; a Tic answers there: name it tic:{line.port}"
    except DeviceError:
        return ""
    return ""


def _said_to(line: SerialLine, question: bytes) -> bytes:
    """What comes back within a moment."""
    line.read()
    line.write(question)
    end, text = time.monotonic() + _WAIT, b""
    while time.monotonic() < end:
        text += line.read()
        time.sleep(0.01)
    return text
