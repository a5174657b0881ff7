"""Configuration port of a server: TCP connections that send and receive lines, in small pieces between two steps."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of the configuration port.

    Attributes:
        longest_line: largest length of a line, bytes; a longer line gets an error.
        read_size: largest number of bytes of one read.
        most_connections: largest number of open connections; a further connection closes the one idle for longest.
        stalled: time after which a connection with an unfinished line or an unread answer is closed, s.
        idle: time after which a connection without traffic is closed, s.
    """

    longest_line: int = 65536
    read_size: int = 65536
    most_connections: int = 8
    stalled: float = 10.0
    idle: float = 600.0


#: Limits of every configuration port.
CONNECTION_LIMITS = ConnectionLimits()

_TOO_LONG = (b'{"error":"a line must have at most %d bytes; send one short command per line"}\n'
             % CONNECTION_LIMITS.longest_line)

Execute = Callable[[bytes], Iterator[bytes]]


class ConfigurationPort:
    """Accept TCP connections, and answer their lines.

    `accept_and_evict_idle_connection` and the connections do one piece of work per call and never wait. The owner of
    the selector decides when to call.

    Args:
        listener: bound and listening socket.
        execute: function that returns the answer to a line in pieces; it raises ConnectionAbortedError to close the
            connection.
        selector: selector at which the sockets are registered; the data of each socket is the function that serves the
            socket, with the time, s, as its argument.
    """

    def __init__(self, listener: socket.socket, execute: Execute, selector: selectors.BaseSelector):
        self._listener, self._execute, self._selector = listener, execute, selector
        self._connections: set[_ConfigurationConnection] = set()
        listener.setblocking(False)
        selector.register(listener, selectors.EVENT_READ, self.accept_and_evict_idle_connection)

    def accept_and_evict_idle_connection(self, now: float) -> None:
        """Accept one connection; if there are too many, close the connection that was idle for longest.

        Args:
            now: time on the clock of the server, s.
        """
        try:
            peer, _ = self._listener.accept()
        except OSError:  # The client has disconnected, or the process has no free file descriptor.
            return
        if len(self._connections) == CONNECTION_LIMITS.most_connections:
            min(self._connections, key=lambda connection: connection.last_traffic).close()
        self._connections.add(_ConfigurationConnection(peer, self._execute, self._selector, self._connections.discard,
                                                       now))

    def close_stalled_and_idle_connections(self, now: float) -> None:
        """Close the connections without traffic, see `ConnectionLimits.stalled` and `ConnectionLimits.idle`.

        Args:
            now: time on the clock of the server, s.
        """
        for connection in [*self._connections]:
            limit = CONNECTION_LIMITS.stalled if connection.is_busy else CONNECTION_LIMITS.idle
            if now - connection.last_traffic > limit:
                connection.close()

    def close(self) -> None:
        """Close the port and all connections."""
        for connection in [*self._connections]:
            connection.close()
        self._selector.unregister(self._listener)
        self._listener.close()


class _ConfigurationConnection:
    """One TCP connection to the configuration port; it is read only while no answer is pending, so that no queue grows.

    Attributes:
        last_traffic: time at which bytes were last received or sent, s.
    """

    def __init__(self, peer: socket.socket, execute: Execute, selector: selectors.BaseSelector,
                 on_close: Callable[[_ConfigurationConnection], None], now: float):
        self._peer, self._execute, self._selector = peer, execute, selector
        self._on_close, self.last_traffic = on_close, now
        self._inbox, self._outbox = bytearray(), b""
        self._answer: Iterator[bytes] | None = None
        #: Whether the rest of a line that exceeds the limit is being discarded.
        self._too_long = False
        peer.setblocking(False)
        self._interest = selectors.EVENT_READ
        selector.register(peer, self._interest, self.serve_connection_once)

    @property
    def is_busy(self) -> bool:
        """Whether a line is incomplete, or an answer is not fully sent."""
        return bool(self._inbox or self._too_long or self._outbox or self._answer)

    def serve_connection_once(self, now: float) -> None:
        """Do one piece of work: receive bytes, execute a line, compute a piece of the answer, or send bytes.

        Args:
            now: time on the clock of the server, s.
        """
        try:
            self._do_next_work_piece(now)
        except BlockingIOError:
            return
        except OSError:  # The client has disconnected, or `execute` closes the connection.
            self.close()
            return
        ready = self._outbox or self._answer is not None or b"\n" in self._inbox
        interest = selectors.EVENT_WRITE if ready else selectors.EVENT_READ
        if interest != self._interest:
            self._interest = interest
            self._selector.modify(self._peer, interest, self.serve_connection_once)

    def close(self) -> None:
        """Close the connection; bytes that were not sent are lost."""
        self._selector.unregister(self._peer)
        self._peer.close()
        self._on_close(self)

    def _do_next_work_piece(self, now: float) -> None:
        """Receive bytes, execute one line, or send a part of its answer; OSError: the client has disconnected."""
        if not self._outbox and self._answer is None:
            if b"\n" not in self._inbox:
                received = self._peer.recv(CONNECTION_LIMITS.read_size)
                if not received:
                    raise ConnectionResetError
                self.last_traffic = now
                self._inbox += received
            line, end, _ = self._inbox.partition(b"\n")
            if end:
                del self._inbox[:len(line) + 1]
                if self._too_long or len(line) > CONNECTION_LIMITS.longest_line:
                    self._answer = iter((_TOO_LONG,))
                elif line.strip():
                    self._answer = self._execute(bytes(line))
                self._too_long = False
            elif len(line) > CONNECTION_LIMITS.longest_line:
                self._inbox.clear()
                self._too_long = True
        if not self._outbox and self._answer is not None:
            self._outbox = next(self._answer, b"")
            if not self._outbox:
                self._answer = None
        if self._outbox:
            sent = self._peer.send(self._outbox)
            self.last_traffic = now
            self._outbox = self._outbox[sent:]
