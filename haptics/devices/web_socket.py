"""A WebSocket as a line on which one thread speaks and listens: no thread of its own, no waiting in between."""

from __future__ import annotations

import contextlib
import socket
import time
from urllib.parse import urlsplit

from tissue_sim.errors import InputError


class LineClosedError(OSError):
    """The other end has closed the line, or never was one."""


class WebSocketLine:
    """A connection to a server; not shared by threads. Making one opens it.

    Args:
        address: ``ws://HOST:PORT/PATH``.
        timeout: for the connection, s.

    Raises:
        OSError: nobody listens there, or it does not answer.
        LineClosedError: who listens there speaks no WebSocket.
    """

    def __init__(self, address: str, timeout: float):
        from websockets.client import ClientProtocol
        from websockets.protocol import State
        from websockets.uri import parse_uri

        host, port = check_address(address)
        self._open = State.OPEN
        self._socket = socket.create_connection((host, port), timeout)
        try:
            # A force that waits for the next one to fill a packet is too late.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._protocol = ClientProtocol(parse_uri(address))
            self._protocol.send_request(self._protocol.connect())
            self._parts: list[bytes] = []
            self._flush(timeout)
            end = time.monotonic() + timeout
            while self._protocol.state is not self._open:
                if self._protocol.handshake_exc is not None:
                    raise LineClosedError(f"it speaks no WebSocket: {self._protocol.handshake_exc}")
                left = end - time.monotonic()
                if left <= 0:
                    raise TimeoutError("no answer to the handshake")
                self._fetch(left)
        except BaseException:
            self._socket.close()
            raise

    def send(self, message: str, timeout: float) -> None:
        """Send a text.

        Raises:
            OSError: the line is closed, or takes nothing for that time, s.
        """
        self._require_open()
        self._protocol.send_text(message.encode())
        self._flush(timeout)

    def receive(self, timeout: float) -> list[bytes]:
        """The messages that have come; waits for the first, s.

        Returns:
            In their order; none where none came in that time.

        Raises:
            OSError: the line is closed.
        """
        end = time.monotonic() + timeout
        while not (messages := self._messages()):
            self._require_open()
            left = end - time.monotonic()
            if left <= 0:
                return []
            with contextlib.suppress(TimeoutError):
                self._fetch(left)
        return messages

    def close(self) -> None:
        """Say that this is the end, and disconnect; never raises."""
        with contextlib.suppress(Exception):
            if self._protocol.state is self._open:
                self._protocol.send_close(1000)
                self._flush(0.1)
        self._socket.close()

    def _require_open(self) -> None:
        if self._protocol.state is not self._open:
            raise LineClosedError("the other end has closed it")

    def _fetch(self, timeout: float) -> None:
        self._socket.settimeout(timeout)
        data = self._socket.recv(65536)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._flush(0.1)
        if not data:
            # Outside of the handshake, the state says so to the next caller; messages before the end are kept.
            if self._protocol.handshake_exc is not None:
                raise LineClosedError(f"it speaks no WebSocket: {self._protocol.handshake_exc}")
            if not self._protocol.events:
                raise LineClosedError("the other end has closed it")

    def _flush(self, timeout: float) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.settimeout(timeout)
                self._socket.sendall(data)

    def _messages(self) -> list[bytes]:
        from websockets.frames import Frame, Opcode

        messages = []
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    messages.append(b"".join(self._parts))
                    self._parts = []
        return messages


def check_address(address: str) -> tuple[str, int]:
    """Host and port of an address.

    Raises:
        InputError: not of the form ``ws://HOST:PORT``.
    """
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme != "ws" or not parts.hostname or port is None:
        raise InputError(f"{address!r} is not the address of a service; give ws://HOST:PORT, such as "
                         "ws://127.0.0.1:10001", field="address")
    return parts.hostname, port
