"""A client of a tissue server, for tests and for programs in Python."""

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
    Kind,
    OtherVersionError,
    Reply,
    Request,
    RequestFlags,
    WireError,
    decode_reply,
    encode_request,
)
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose


class TissueClient:
    """Sends poses and waits for forces.

    Args:
        port: UDP port of the server.
        host: its address.
        timeout: longest wait for a reply, s.
        polls: how often to look for a reply, a few us each, before sleeping until it comes.
        session: number by which the server knows this client; a random one by default.
        version: of the protocol, one of `haptics.server.wire.VERSIONS`.

    Raises:
        InputError: another version.
    """

    def __init__(self, port: int, host: str = LOOPBACK, timeout: float = 1.0, polls: int = 0,
                 session: int | None = None, version: int = VERSION):
        if version not in VERSIONS:
            raise InputError(f"version must be {' or '.join(map(str, VERSIONS))}; got {version!r}.", field="version")
        self._version = version
        self._timeout, self._polls, self._sequence = timeout, polls, 0
        self.session = secrets.randbits(64) | 1 if session is None else session
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(timeout)
        self._socket.connect((host, port))

    def step(self, pose: Pose | float, at: float | None = None, *, reset: bool = False) -> Reply:
        """Go to a pose and wait for the force.

        Args:
            pose: of the tool, or its depth, m.
            at: s on a clock of your own, never backwards; this computer's by default.
            reset: put the tissue back to its undeformed state before.

        Returns:
            The reply, whatever its status: look at it (BUSY: another client has the tissue).

        Raises:
            InputError: the server speaks another version.
            TimeoutError: no reply in time.
            ConnectionRefusedError: nobody listens on that port of this machine.
        """
        if not isinstance(pose, Pose):
            pose = Pose((0.0, 0.0, -pose))
        at = time.monotonic() if at is None else at
        return self._ask(Request(self._sequence, at, pose.position, pose.orientation, self.session,
                                 flags=RequestFlags.RESET if reset else RequestFlags.NONE,
                                 version=self._version))

    def close(self) -> None:
        """Say goodbye, so that another client can have the tissue at once."""
        with self._socket, suppress(OSError):  # the server may have gone before
            self._ask(Request(self._sequence, 0.0, session=self.session, kind=Kind.GOODBYE,
                              version=self._version))

    def __enter__(self) -> TissueClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, request: Request) -> Reply:
        self._sequence += 1
        self._socket.send(encode_request(request))
        end = time.monotonic() + self._timeout
        while True:
            try:
                reply = decode_reply(self._receive())
            except OtherVersionError as error:
                raise InputError(f"the server speaks version {error.version} of the protocol, and this client "
                                 f"{self._version}; install the same tissue_sim on both sides") from None
            except WireError:
                continue
            # A server of version 2 answers a request of version 3 without a step, in its own version.
            if reply.version != request.version:
                raise InputError(f"the server speaks version {reply.version} of the protocol, and this client "
                                 f"{self._version}; give version={reply.version}")
            if (reply.sequence, reply.session) == (request.sequence, request.session):
                return reply
            if time.monotonic() > end:  # replies to requests that were given up
                raise TimeoutError(f"no reply in {self._timeout:g} s")

    def _receive(self) -> bytes:
        if self._polls:
            self._socket.setblocking(False)
            try:
                for _ in range(self._polls):
                    with suppress(BlockingIOError):
                        return self._socket.recv(REPLY_SIZE + 1)
            finally:
                self._socket.settimeout(self._timeout)
        return self._socket.recv(REPLY_SIZE + 1)
