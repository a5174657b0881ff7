"""Client of a tissue server for Python programs and tests."""

from __future__ import annotations

import secrets
import socket
import time
from contextlib import suppress

from haptics.server.server import LOOPBACK
from haptics.server.wire import (
    REPLY_SIZE,
    VERSION,
    VERSIONS,
    OtherVersionError,
    Reply,
    Request,
    RequestFlags,
    RequestKind,
    WireError,
    decode_reply,
    encode_request,
)
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose


class TissueClient:
    """Send poses to a tissue server, and wait for the forces.

    Args:
        port: UDP port of the server.
        host: address of the server.
        timeout: longest wait for a reply, s.
        polls: number of checks for a reply, a few microseconds each, before the client sleeps until the reply arrives.
        session: number that identifies this client at the server; None: a random number.
        version: protocol version, one of `haptics.server.wire.VERSIONS`.

    Attributes:
        session: number that identifies this client at the server.

    Raises:
        InputError: the version is not supported.
    """

    def __init__(self, port: int, host: str = LOOPBACK, timeout: float = 1.0, polls: int = 0,
                 session: int | None = None, version: int = VERSION):
        if version not in VERSIONS:
            raise InputError(f"the protocol version must be {' or '.join(map(str, VERSIONS))}; got {version!r}",
                             field="version")
        self._version = version
        self._timeout, self._polls, self._sequence = timeout, polls, 0
        self.session = secrets.randbits(64) | 1 if session is None else session
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.settimeout(timeout)
            self._socket.connect((host, port))
        except BaseException:
            self._socket.close()
            raise

    def step(self, pose: Pose | float, at: float | None = None, *, reset: bool = False) -> Reply:
        """Send a pose, and wait for the reply with the force.

        Args:
            pose: pose of the tool, or depth of its tip on the axis, m.
            at: time on a clock of the caller that does not decrease, s; None: the clock of this computer.
            reset: whether the tissue is reset to its undeformed state before the step.

        Returns:
            The reply. Check its status: BUSY, for example, means that another client owns the tissue.

        Raises:
            InputError: the server uses another protocol version.
            TimeoutError: no reply arrived within `timeout`.
            ConnectionRefusedError: no program listens on this port of this computer.
        """
        if not isinstance(pose, Pose):
            pose = Pose((0.0, 0.0, -pose))
        at = time.monotonic() if at is None else at
        return self._exchange_request(Request(self._sequence, at, pose.position, pose.orientation, self.session,
                                              flags=RequestFlags.RESET if reset else RequestFlags.NONE,
                                              version=self._version))

    def close(self) -> None:
        """Send a goodbye, so that another client can own the tissue at once, and close the socket."""
        # The server may have ended already, or use another version.
        with self._socket, suppress(OSError, InputError):
            self._exchange_request(Request(self._sequence, 0.0, session=self.session, kind=RequestKind.GOODBYE,
                                           version=self._version))

    def __enter__(self) -> TissueClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _exchange_request(self, request: Request) -> Reply:
        """Send a request, and return its reply; replies to earlier requests are dropped."""
        self._sequence += 1
        self._socket.send(encode_request(request))
        end = time.monotonic() + self._timeout
        while time.monotonic() <= end:
            try:
                reply = decode_reply(self._receive_datagram_or_raise())
            except OtherVersionError as error:
                raise InputError(f"the server uses protocol version {error.version}, this client version "
                                 f"{self._version}; install the same tissue_sim on both sides") from None
            except WireError:
                continue
            # A server of version 2 answers a request of version 3 without a step, in its own version.
            if reply.version != request.version:
                raise InputError(f"the server uses protocol version {reply.version}, this client version "
                                 f"{self._version}; create the client with version={reply.version}")
            if (reply.sequence, reply.session) == (request.sequence, request.session):
                return reply
        # Only replies to earlier requests, or datagrams that are no replies, arrived.
        raise TimeoutError(f"no reply within {self._timeout:g} s")

    def _receive_datagram_or_raise(self) -> bytes:
        """Return the next datagram: poll first, then wait up to the timeout, after which TimeoutError is raised."""
        if self._polls:
            self._socket.setblocking(False)
            try:
                for _ in range(self._polls):
                    with suppress(BlockingIOError):
                        return self._socket.recv(REPLY_SIZE + 1)
            finally:
                self._socket.settimeout(self._timeout)
        return self._socket.recv(REPLY_SIZE + 1)
