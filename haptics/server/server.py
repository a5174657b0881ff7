"""A tissue for programs that are not ours: poses in and forces out over UDP, configuration over TCP, in one thread."""

from __future__ import annotations

import ipaddress
import math
import os
import selectors
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from haptics.safety.force_release import ForceRelease
from haptics.server.commands import Commands, Description
from haptics.server.connections import ConfigurationPort
from haptics.server.owner_port import Allowance, open_for
from haptics.server.scene_limits import SceneLimits
from haptics.server.steps import SILENCE, Counters, ServedTissue, StepService
from haptics.server.wire import REQUEST_SIZE
from tissue_sim.errors import InputError

LOOPBACK = "127.0.0.1"
#: Datagrams of the owner, and of others, that are looked at before a step is made: no flood keeps the owner waiting.
_MOST_DATAGRAMS, _MOST_OF_OTHERS = 64, 8
#: Longest sleep, s; a stop that cannot wake the server takes so long.
_WAIT = 0.25


class TissueServer:
    """Serves one tissue. `run` answers until `stop`; the tissue is touched by the thread of `run` only.

    Args:
        tissue: what is stepped; `tissue_sim.Simulator`, warmed up, or anything with ``step(pose, dt)`` and ``reset()``.
        host: address of the network interface.
        port: UDP port of the poses; 0 chooses a free one.
        configuration_port: TCP port of the configuration; 0 chooses a free one, None: no configuration.
        description: what ``describe`` says of scene, material and mesh; of JSON's types, or what gives it then.
        parameters: name -> value of what ``set_parameters`` may set, SI.
        silence: a client that is silent for so long loses the tissue to another, s.
        limits: of poses, times and forces; see `SceneLimits`.
        releases: whether a force without an equilibrium is let go; see `ForceRelease`.
        rebuild: another tissue like the first one, for after a step that failed; None: that one is reset.
        session: number by which the one client that may have the tissue is known; None: whoever comes first.
        spin: keep polling for so long after a packet before going to sleep, s. It saves the time of waking up, and
            takes a whole processor while a client is there.
        expose: allow an address that other machines can reach. The protocol has no password.

    Raises:
        InputError: a port that is taken or none, an address that is none of this machine's, or one that other machines
            can reach without `expose`.
    """

    def __init__(self, tissue: ServedTissue, *, host: str = LOOPBACK, port: int = 0,
                 configuration_port: int | None = None,
                 description: Description | None = None, parameters: Mapping[str, float] | None = None,
                 silence: float = SILENCE, limits: SceneLimits | None = None, releases: bool = True,
                 rebuild: Callable[[], ServedTissue] | None = None, session: int | None = None, spin: float = 0.0,
                 expose: bool = False):
        _require_loopback(host, expose)
        self._service = StepService(tissue, silence, limits=limits, release=ForceRelease() if releases else None,
                                    rebuild=rebuild, session=session)
        self._spin, self._heard = spin, -math.inf
        self._stopping = False
        self._selector = selectors.DefaultSelector()
        self._poses = _bound(socket.SOCK_DGRAM, host, port, "port")
        #: Of the owner alone, and who that is; None where there is none.
        self._owned: socket.socket | None = None
        self._owner: Any = None
        self._strangers = Allowance()
        self._configuration: ConfigurationPort | None = None
        self.address: tuple[str, int] = self._poses.getsockname()[:2]
        self.configuration_address: tuple[str, int] | None = None
        self._alarm, self._bell = socket.socketpair()
        try:
            if configuration_port is not None:
                listener = _bound(socket.SOCK_STREAM, host, configuration_port, "configuration_port")
                commands = Commands(self._service, description, parameters)
                self._configuration = ConfigurationPort(listener, commands.execute, self._selector)
                self.configuration_address = listener.getsockname()[:2]
            self._poses.setblocking(False)
            self._bell.setblocking(False)
            self._selector.register(self._poses, selectors.EVENT_READ)
            self._selector.register(self._alarm, selectors.EVENT_READ)
        except BaseException:
            self.close()
            raise
        # One byte more than a request: a longer datagram must not pass for one.
        self._packet = memoryview(bytearray(REQUEST_SIZE + 1))

    @property
    def counters(self) -> Counters:
        """Packets and steps since the server started."""
        return self._service.counters

    def run(self) -> None:
        """Answer until `stop` is called."""
        now = time.monotonic()
        next_look = now + 1.0
        while not self._stopping:
            if now - self._heard < self._spin:
                # The client, or whoever else waits for this processor, goes first.
                _let_others_run()
                events = self._selector.select(0.0)
            else:
                events = self._selector.select(_WAIT)
            if events:
                self._answer_poses()
            now = time.monotonic()
            for key, _ in events:
                # A connection that an earlier one has pushed out is no longer registered.
                if key.data is not None and not isinstance(key.fileobj, int) and key.fileobj.fileno() >= 0:
                    key.data(now)
                    self._answer_poses()
            if now > next_look:
                next_look = now + 1.0
                if self._configuration is not None:
                    self._configuration.close_stalled(now)

    def stop(self) -> None:
        """Make `run` return after the step that it is at; from any thread or signal handler."""
        self._stopping = True
        with suppress(OSError):  # closed already, or it rings
            self._bell.send(b"!")

    def close(self) -> None:
        """Free the ports."""
        if self._configuration is not None:
            self._configuration.close()
            self._configuration = None
        for own in (self._owned, self._poses, self._alarm, self._bell):
            if own is not None:
                own.close()
        self._selector.close()

    def __enter__(self) -> TissueServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_poses(self) -> None:
        """Look at what has come, the owner's first, then step to its newest pose."""
        service = self._service
        if self._owned is not None:
            self._take(self._owned, _MOST_DATAGRAMS)
        self._take(self._poses, _MOST_DATAGRAMS if self._owned is None else _MOST_OF_OTHERS)
        if service.owner != self._owner:
            self._follow_owner()
        answer = service.step(time.monotonic())
        if answer is not None:
            self._send(*answer)
            self._heard = time.monotonic()
            service.answered(self._heard)

    def _take(self, own: socket.socket, most: int) -> None:
        """Look at the datagrams of a socket."""
        service, packet = self._service, self._packet
        for _ in range(most):
            try:
                size, address = own.recvfrom_into(packet)
            except (BlockingIOError, ConnectionRefusedError):  # nothing more, or the owner has closed its port
                break
            except ConnectionResetError:  # Windows: a client that was answered has closed its port
                continue
            except OSError:  # Windows: longer than the buffer
                self.counters.malformed += 1
                continue
            now = time.monotonic()
            if service.owner not in (None, address) and not self._strangers.takes(address, now):
                self.counters.flooded += 1
                continue
            self._heard = now
            at_once = service.take(packet[:size], address, now)
            if at_once is not None:
                self._send(at_once, address)

    def _follow_owner(self) -> None:
        """Take the packets of a new owner apart from all others."""
        if self._owned is not None:
            self._selector.unregister(self._owned)
            self._owned.close()
        owner = self._owner = self._service.owner
        self._owned = None if owner is None else open_for(owner, self._poses)
        if self._owned is not None:
            self._selector.register(self._owned, selectors.EVENT_READ)

    def _send(self, reply: bytes, address: Any) -> None:
        try:
            self._poses.sendto(reply, address)
        except OSError:  # a full buffer, a client without an address: the next reply may pass
            self.counters.unsent += 1


_let_others_run = getattr(os, "sched_yield", partial(time.sleep, 0.0))


def _require_loopback(host: str, expose: bool) -> None:
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise InputError(f"{host!r} is not an address; give one such as {LOOPBACK}", field="host") from None
    if not (loopback or expose):
        raise InputError(f"{host} can be reached by other machines, and the protocol has no password; expose it "
                         f"explicitly, or leave it out for {LOOPBACK}", field="host")


def _bound(kind: socket.SocketKind, host: str, port: int, field: str) -> socket.socket:
    """A socket that is bound, and listens where it can."""
    if not 0 <= port <= 65535:
        raise InputError(f"{port} is not a port; give 1 to 65535, or 0 for a free one", field=field)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    own = socket.socket(family, kind)
    try:
        if kind == socket.SOCK_STREAM and os.name == "posix":
            # On Windows this would let two servers share the port.
            own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind((host, port))
        if kind == socket.SOCK_STREAM:
            own.listen()
    except OSError as error:
        own.close()
        raise InputError(f"{host}:{port} cannot be used ({error.strerror}); close the program that has it, give "
                         "another port, or 0 for a free one", field=field) from None
    return own
