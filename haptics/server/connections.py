"""The TCP port of a server: lines in, lines out, in small pieces between two steps."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable, Iterator

#: Bytes of a line and of one read; connections at a time.
LONGEST_LINE, READ_SIZE, MOST_CONNECTIONS = 65536, 65536, 8
#: A connection is closed after so long with a line begun or an answer unread, or with nothing at all, s.
STALLED, IDLE = 10.0, 600.0

_TOO_LONG = b'{"error":"a line of more than %d bytes; send one short command a line"}\n' % LONGEST_LINE

Execute = Callable[[bytes], Iterator[bytes]]


class ConfigurationPort:
    """Accepts connections on a listening socket and answers their lines.

    Everything happens in `work`, one piece at a time and never waiting: whoever owns the selector decides when.

    Args:
        listener: bound and listening.
        execute: the answer to a line, in pieces; raises ConnectionAbortedError to have the connection closed.
        selector: where the sockets are registered; the data of each is its `work(now)`.
    """

    def __init__(self, listener: socket.socket, execute: Execute, selector: selectors.BaseSelector):
        self._listener, self._execute, self._selector = listener, execute, selector
        self._connections: set[_Connection] = set()
        listener.setblocking(False)
        selector.register(listener, selectors.EVENT_READ, self.work)

    def work(self, now: float) -> None:
        """Accept one connection; where there are too many, the one that was idle for longest is closed."""
        try:
            peer, _ = self._listener.accept()
        except OSError:  # it has left again, or the process has no more files
            return
        if len(self._connections) == MOST_CONNECTIONS:
            min(self._connections, key=lambda connection: connection.heard).close()
        self._connections.add(_Connection(peer, self._execute, self._selector, self._connections.discard, now))

    def close_stalled(self, now: float) -> None:
        """Close the connections whose other end has died or does not read."""
        for connection in [*self._connections]:
            if now - connection.heard > (STALLED if connection.busy else IDLE):
                connection.close()

    def close(self) -> None:
        """Close the port and all connections."""
        for connection in [*self._connections]:
            connection.close()
        self._selector.unregister(self._listener)
        self._listener.close()


class _Connection:
    """One client of the port. It is read only while it has no answer to take: nothing piles up.

    Attributes:
        heard: when it last sent or took something, s.
    """

    def __init__(self, peer: socket.socket, execute: Execute, selector: selectors.BaseSelector,
                 closed: Callable[[_Connection], None], now: float):
        self._peer, self._execute, self._selector, self._closed, self.heard = peer, execute, selector, closed, now
        self._inbox, self._outbox = bytearray(), b""
        self._answer: Iterator[bytes] | None = None
        self._too_long = False
        peer.setblocking(False)
        self._interest = selectors.EVENT_READ
        selector.register(peer, self._interest, self.work)

    @property
    def busy(self) -> bool:
        """Whether a line is begun, or an answer not taken."""
        return bool(self._inbox or self._too_long or self._outbox or self._answer)

    def work(self, now: float) -> None:
        """One piece: read, execute a line, make a piece of the answer, or send."""
        try:
            self._work(now)
        except BlockingIOError:
            return
        except OSError:  # the other end has left, or must go
            self.close()
            return
        ready = self._outbox or self._answer is not None or b"\n" in self._inbox
        interest = selectors.EVENT_WRITE if ready else selectors.EVENT_READ
        if interest != self._interest:
            self._interest = interest
            self._selector.modify(self._peer, interest, self.work)

    def close(self) -> None:
        """Close the connection; what it has not taken is lost."""
        self._selector.unregister(self._peer)
        self._peer.close()
        self._closed(self)

    def _work(self, now: float) -> None:
        if not self._outbox and self._answer is None:
            if b"\n" not in self._inbox:
                received = self._peer.recv(READ_SIZE)
                if not received:
                    raise ConnectionResetError
                self.heard = now
                self._inbox += received
            line, end, _ = self._inbox.partition(b"\n")
            if end:
                del self._inbox[:len(line) + 1]
                if self._too_long or len(line) > LONGEST_LINE:
                    self._answer = iter((_TOO_LONG,))
                elif line.strip():
                    self._answer = self._execute(bytes(line))
                self._too_long = False
            elif len(line) > LONGEST_LINE:
                self._inbox.clear()
                self._too_long = True
        if not self._outbox and self._answer is not None:
            self._outbox = next(self._answer, b"")
            if not self._outbox:
                self._answer = None
        if self._outbox:
            sent = self._peer.send(self._outbox)
            self.heard = now
            self._outbox = self._outbox[sent:]
