"""A WebSocket client for use by one thread, with a timeout for each call and no background thread."""

from __future__ import annotations

import contextlib
import socket
import time
from urllib.parse import urlsplit

from tissue_sim.errors import InputError


class WebSocketClosedError(OSError):
    """The other end has closed the connection, or is not a WebSocket server."""


class WebSocketClientConnection:
    """A connection to a WebSocket server, for one thread. The constructor opens the connection.

    Args:
        address: ``ws://HOST:PORT/PATH``.
        timeout: Longest time to connect, s.

    Raises:
        OSError: No server listens at the address, or the server does not answer.
        WebSocketClosedError: The server is not a WebSocket server.
    """

    def __init__(self, address: str, timeout: float):
        from websockets.client import ClientProtocol
        from websockets.protocol import State
        from websockets.uri import parse_uri

        host, port = parse_host_and_port(address)
        self._open = State.OPEN
        self._socket = socket.create_connection((host, port), timeout)
        try:
            # Nagle's algorithm would delay a force until the next one fills a packet.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._protocol = ClientProtocol(parse_uri(address))
            self._protocol.send_request(self._protocol.connect())
            self._parts: list[bytes] = []
            self._send_queued_data(timeout)
            end = time.monotonic() + timeout
            while self._protocol.state is not self._open:
                if self._protocol.handshake_exc is not None:
                    raise WebSocketClosedError(f"the server is not a WebSocket server: {self._protocol.handshake_exc}")
                remaining = end - time.monotonic()
                if remaining <= 0:
                    raise TimeoutError(f"the server does not answer the WebSocket handshake within {timeout:g} s")
                self._receive_data_and_send_replies(remaining)
        except BaseException:
            self._socket.close()
            raise

    def send(self, message: str, timeout: float) -> None:
        """Send one text message, and wait until the system has accepted its bytes.

        Raises:
            OSError: The connection is closed, or accepts no data within `timeout` seconds.
        """
        self._require_open()
        self._protocol.send_text(message.encode())
        self._send_queued_data(timeout)

    def wait_and_receive_all_messages(self, timeout: float) -> list[bytes]:
        """Wait up to `timeout` seconds for a message and return all received messages.

        Returns:
            Messages in order of receipt; empty if none arrived in time.

        Raises:
            OSError: The connection is closed.
        """
        end = time.monotonic() + timeout
        while not (messages := self._take_complete_messages()):
            self._require_open()
            remaining = end - time.monotonic()
            if remaining <= 0:
                return []
            with contextlib.suppress(TimeoutError):
                self._receive_data_and_send_replies(remaining)
        return messages

    def close(self) -> None:
        """Send the closing frame and disconnect; never raises."""
        with contextlib.suppress(Exception):
            if self._protocol.state is self._open:
                self._protocol.send_close(1000)
                self._send_queued_data(0.1)
        self._socket.close()

    def _require_open(self) -> None:
        """Raise a WebSocketClosedError if the connection is not open."""
        if self._protocol.state is not self._open:
            raise WebSocketClosedError("the server has closed the connection")

    def _receive_data_and_send_replies(self, timeout: float) -> None:
        """Read the socket once, waiting up to `timeout` s (TimeoutError), and send the protocol's replies."""
        self._socket.settimeout(timeout)
        data = self._socket.recv(65536)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._send_queued_data(0.1)
        if not data:
            # After the handshake, messages received before the end are returned first; the next call reports the end.
            if self._protocol.handshake_exc is not None:
                raise WebSocketClosedError(f"the server is not a WebSocket server: {self._protocol.handshake_exc}")
            if not self._protocol.events:
                raise WebSocketClosedError("the server has closed the connection")

    def _send_queued_data(self, timeout: float) -> None:
        """Send all data that the protocol has queued, such as messages and replies to pings."""
        for data in self._protocol.data_to_send():
            if data:
                self._socket.settimeout(timeout)
                self._socket.sendall(data)

    def _take_complete_messages(self) -> list[bytes]:
        """Remove and return the complete messages received so far; a fragment stays until its message is complete."""
        from websockets.frames import Frame, Opcode

        messages = []
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    messages.append(b"".join(self._parts))
                    self._parts = []
        return messages


def parse_host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of an address.

    Raises:
        InputError: The address is not of the form ``ws://HOST:PORT``.
    """
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme != "ws" or not parts.hostname or port is None:
            raise InputError(f"the address must be ws://HOST:PORT, such as ws://127.0.0.1:10001; got {address!r}",
                             field="address")
    return parts.hostname, port
