"""Server of a tissue for other programs: poses and forces over UDP, configuration over TCP, in one thread.

The packets of the owner of a tissue arrive on a separate socket; the replies to all other clients are limited.
"""

from __future__ import annotations

import ipaddress
import math
import os
import selectors
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from haptics.server.commands import ConfigurationCommands, ConfigurationPort, Description
from haptics.server.steps import SILENCE, Address, ServedTissue, ServerLimits, StepCounters, StepService
from haptics.server.wire import REQUEST_SIZE
from tissue_sim.errors import InputError
from tissue_sim.realtime.force_fading import ForceFader


@dataclass(frozen=True)
class ReplyRateLimit:
    """Token bucket for the replies to clients that do not own the tissue.

    Attributes:
        replies_per_second: replies per second and address, 1/s. A larger value takes more time from the owner.
        burst: replies to one address that may follow each other at once.
        most_addresses: largest number of addresses that are remembered; packets of further addresses are dropped.
    """

    replies_per_second: float = 100.0
    burst: float = 20.0
    most_addresses: int = 64


#: Rate limit of every server.
RATE_LIMIT = ReplyRateLimit()


def open_owner_socket_or_none(owner: Address, port: socket.socket) -> socket.socket | None:
    """Open a socket on the same port that receives only the packets of the owner, so that no flood fills its buffer.

    Linux delivers a packet to the socket that is connected to its sender, and to an unconnected socket otherwise.

    Args:
        owner: address of the owner.
        port: bound socket that receives the packets of all other clients.

    Returns:
        The connected socket. None if the operating system does not allow two sockets on a port; the packets of the
        owner then arrive at `port`.
    """
    if os.name != "posix":
        return None
    connected = socket.socket(port.family, socket.SOCK_DGRAM)
    try:
        connected.setblocking(False)
        # The option is set only during the bind: with it, other programs could also share the port.
        for each in (port, connected):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        connected.bind(port.getsockname())
        connected.connect(owner)
    except OSError:
        connected.close()
        return None
    finally:
        for each in (port, connected):
            with suppress(OSError):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return connected


class ReplyLimiter:
    """Limit the replies to each address by a token bucket.

    The bucket holds `ReplyRateLimit.burst` tokens and gains `ReplyRateLimit.replies_per_second`; a reply costs one.
    """

    def __init__(self):
        #: Address -> remaining tokens, and time of their last update, s.
        self._buckets: dict[Address, tuple[float, float]] = {}

    def take_token(self, address: Address, now: float) -> bool:
        """Use one token of an address; return False if it has no token, so that its packet must be dropped.

        A new address is refused while `ReplyRateLimit.most_addresses` other addresses are active.

        Args:
            address: address of the sender.
            now: time on the clock of the server, s.
        """
        limit = RATE_LIMIT
        tokens, before = self._buckets.get(address, (limit.burst, now))
        if address not in self._buckets and len(self._buckets) >= limit.most_addresses:
            refill_time = limit.burst / limit.replies_per_second
            self._buckets = {each: bucket for each, bucket in self._buckets.items() if now - bucket[1] < refill_time}
            if len(self._buckets) >= limit.most_addresses:
                return False
        tokens = min(limit.burst, tokens + (now - before) * limit.replies_per_second)
        if tokens < 1.0:
            # Store the new time too, so that each interval adds tokens only once.
            self._buckets[address] = (tokens, now)
            return False
        self._buckets[address] = (tokens - 1.0, now)
        return True


#: Address that only programs of this computer can reach.
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class ServerLoopSettings:
    """Settings of the loop of a server.

    Attributes:
        most_datagrams: largest number of datagrams of the owner that are read before a step.
        most_foreign_datagrams: largest number of datagrams of other clients that are read before a step if the owner
            has a separate socket. A small value keeps a flood from delaying the owner.
        longest_sleep: longest wait for a packet, s; a stop that cannot wake the server takes this long.
        check_interval: time between two checks for stalled configuration connections, s.
    """

    most_datagrams: int = 64
    most_foreign_datagrams: int = 8
    longest_sleep: float = 0.25
    check_interval: float = 1.0


#: Settings of every server.
_SETTINGS = ServerLoopSettings()


class TissueServer:
    """Serve one tissue: `run` answers packets until `stop` is called; only the thread of `run` uses the tissue.

    Args:
        tissue: tissue to step: a `tissue_sim.Simulator` after its warm-up, or any object with ``step(pose, dt)`` and
            ``reset()``.
        host: address of the network interface.
        port: UDP port of the poses; 0: a free port.
        configuration_port: TCP port of the configuration; 0: a free port, None: no configuration.
        description: entries of the answer to ``describe`` about scene, material and mesh, of JSON types; or a function
            that returns them at the time of the command.
        parameters: name -> value of each parameter that ``set_parameters`` accepts, SI units.
        silence: time without a packet after which the owner can lose the tissue to another client, s.
        limits: limits of poses, times and forces; None: default `ServerLimits`.
        releases: whether a force without equilibrium is faded out; see `ForceFader`.
        rebuild: function that creates a tissue equal to the first one, called after a failed step; None: the failed
            tissue is reset.
        session: session number of the only client that may own the tissue; None: every client may.
        spin: time of polling after a packet before the server sleeps, s. Polling avoids the delay of waking up, and
            uses a whole processor while a client is active.
        expose: whether an address that other computers can reach is allowed. The protocol has no password.

    Attributes:
        address: address and UDP port of the poses.
        configuration_address: address and TCP port of the configuration; None: no configuration.

    Raises:
        InputError: a port is invalid or in use, the address does not belong to this computer, or other computers can
            reach the address and `expose` is False.
    """

    def __init__(self, tissue: ServedTissue, *, host: str = LOOPBACK, port: int = 0,
                 configuration_port: int | None = None,
                 description: Description | None = None, parameters: Mapping[str, float] | None = None,
                 silence: float = SILENCE, limits: ServerLimits | None = None, releases: bool = True,
                 rebuild: Callable[[], ServedTissue] | None = None, session: int | None = None, spin: float = 0.0,
                 expose: bool = False):
        _require_loopback_or_expose(host, expose)
        self._service = StepService(tissue, silence, limits=limits, release=ForceFader() if releases else None,
                                    rebuild=rebuild, session=session)
        self._spin, self._last_packet = spin, -math.inf
        self._stopping = False
        self._selector = selectors.DefaultSelector()
        self._poses = _open_bound_socket(socket.SOCK_DGRAM, host, port, "port")
        #: Socket that receives only the packets of the owner; None: no owner, or not supported by the system.
        self._owner_socket: socket.socket | None = None
        #: Address of the owner for which the socket was opened; None: no owner.
        self._owner: Any = None
        self._limiter = ReplyLimiter()
        self._configuration: ConfigurationPort | None = None
        self.address: tuple[str, int] = self._poses.getsockname()[:2]
        self.configuration_address: tuple[str, int] | None = None
        self._wake_receiver, self._wake_sender = socket.socketpair()
        try:
            if configuration_port is not None:
                listener = _open_bound_socket(socket.SOCK_STREAM, host, configuration_port, "configuration_port")
                commands = ConfigurationCommands(self._service, description, parameters)
                self._configuration = ConfigurationPort(listener, commands.execute, self._selector)
                self.configuration_address = listener.getsockname()[:2]
            self._poses.setblocking(False)
            self._wake_sender.setblocking(False)
            self._selector.register(self._poses, selectors.EVENT_READ)
            self._selector.register(self._wake_receiver, selectors.EVENT_READ)
        except BaseException:
            self.close()
            raise
        # One byte more than a request, so that a longer datagram is not mistaken for a request.
        self._packet = memoryview(bytearray(REQUEST_SIZE + 1))

    @property
    def counters(self) -> StepCounters:
        """Numbers of packets and steps since the server started."""
        return self._service.counters

    def run(self) -> None:
        """Answer packets until `stop` is called."""
        now = time.monotonic()
        next_check = now + _SETTINGS.check_interval
        while not self._stopping:
            if now - self._last_packet < self._spin:
                # Give the processor first to the client and to other waiting programs.
                _yield_processor()
                events = self._selector.select(0.0)
            else:
                events = self._selector.select(_SETTINGS.longest_sleep)
            if events:
                self._answer_poses()
            now = time.monotonic()
            for key, _ in events:
                # An earlier event of this loop may have closed the connection.
                if key.data is not None and not isinstance(key.fileobj, int) and key.fileobj.fileno() >= 0:
                    key.data(now)
                    self._answer_poses()
            if now > next_check:
                next_check = now + _SETTINGS.check_interval
                if self._configuration is not None:
                    self._configuration.close_stalled_and_idle_connections(now)

    def stop(self) -> None:
        """Make `run` return after its present step; may be called from any thread or signal handler."""
        self._stopping = True
        with suppress(OSError):  # already closed, or the wake-up is already queued
            self._wake_sender.send(b"!")

    def close(self) -> None:
        """Close all sockets, which frees the ports."""
        if self._configuration is not None:
            self._configuration.close()
            self._configuration = None
        for each in (self._owner_socket, self._poses, self._wake_receiver, self._wake_sender):
            if each is not None:
                each.close()
        self._selector.close()

    def __enter__(self) -> TissueServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_poses(self) -> None:
        """Read the waiting datagrams, those of the owner first, then step to the newest pose and reply."""
        service = self._service
        if self._owner_socket is not None:
            self._process_waiting_datagrams(self._owner_socket, _SETTINGS.most_datagrams)
        self._process_waiting_datagrams(self._poses, _SETTINGS.most_datagrams if self._owner_socket is None
                                        else _SETTINGS.most_foreign_datagrams)
        if service.owner_address != self._owner:
            self._replace_owner_socket()
        answer = service.step(time.monotonic())
        if answer is not None:
            self._send_reply_or_count_unsent(*answer)
            self._last_packet = time.monotonic()
            service.restart_owner_silence_timer(self._last_packet)

    def _process_waiting_datagrams(self, source: socket.socket, most: int) -> None:
        """Read datagrams of a socket, and answer those that need no step.

        Args:
            source: socket to read.
            most: largest number of datagrams.
        """
        service, packet = self._service, self._packet
        for _ in range(most):
            try:
                size, address = source.recvfrom_into(packet)
            except (BlockingIOError, ConnectionRefusedError):  # No datagram, or the owner has closed its port.
                break
            except ConnectionResetError:  # Windows: a client that was answered has closed its port.
                continue
            except OSError:  # Windows: the datagram is longer than the buffer.
                self.counters.malformed += 1
                continue
            now = time.monotonic()
            if service.owner_address not in (None, address) and not self._limiter.take_token(address, now):
                self.counters.flooded += 1
                continue
            self._last_packet = now
            reply = service.receive(packet[:size], address, now)
            if reply is not None:
                self._send_reply_or_count_unsent(reply, address)

    def _replace_owner_socket(self) -> None:
        """Replace the socket of the previous owner by a socket for the present owner."""
        if self._owner_socket is not None:
            self._selector.unregister(self._owner_socket)
            self._owner_socket.close()
        owner = self._owner = self._service.owner_address
        self._owner_socket = None if owner is None else open_owner_socket_or_none(owner, self._poses)
        if self._owner_socket is not None:
            self._selector.register(self._owner_socket, selectors.EVENT_READ)

    def _send_reply_or_count_unsent(self, reply: bytes, address: Any) -> None:
        """Send a reply; count it as unsent if the operating system refuses it."""
        try:
            self._poses.sendto(reply, address)
        except OSError:  # The send buffer is full, or the client cannot be reached: the next reply may succeed.
            self.counters.unsent += 1


#: Function that gives the processor to other waiting threads and programs.
_yield_processor = getattr(os, "sched_yield", partial(time.sleep, 0.0))


def _require_loopback_or_expose(host: str, expose: bool) -> None:
    """Refuse an invalid address, and an address that other computers can reach unless `expose` is True."""
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise InputError(f"the host must be an IP address such as {LOOPBACK}; got {host!r}", field="host") from None
    if not (loopback or expose):
        raise InputError(f"the host must be a loopback address such as {LOOPBACK} unless expose is set; got {host}. "
                         "Other computers can reach this address, and the protocol has no password", field="host")


def _open_bound_socket(kind: socket.SocketKind, host: str, port: int, field: str) -> socket.socket:
    """Return a socket that is bound to an address; a TCP socket also listens.

    Args:
        kind: UDP or TCP.
        host: address of the network interface.
        port: port; 0: a free port.
        field: name of the argument in error messages.

    Raises:
        InputError: the port is invalid or in use, or the address does not belong to this computer.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"the port must be 1 to 65535, or 0 for a free port; got {port}", field=field)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, kind)
    try:
        if kind == socket.SOCK_STREAM and os.name == "posix":
            # On Windows this option would let two servers share the port.
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((host, port))
        if kind == socket.SOCK_STREAM:
            bound.listen()
    except OSError as error:
        bound.close()
        raise InputError(f"{host}:{port} cannot be used ({error.strerror}); close the program that uses it, or choose "
                         "another port, or 0 for a free port", field=field) from None
    return bound
