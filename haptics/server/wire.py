"""Encode and decode the UDP packets between a client and the tissue: one reply for each request, fixed layouts.

Packets are little-endian, in SI units and without padding; docs/wire_protocol.md lists the offsets. The coordinate
frame is `FRAME`. Both packets carry all six degrees of freedom, also if the scene uses fewer. Requests of the versions
2 and 3 differ only in the version number. A reply has the version of its request; a reply of version 3 is a reply of
version 2 with additional fields at its end.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum, IntFlag
from itertools import chain
from typing import NamedTuple

from tissue_sim.tool_force import ForceStatus

#: Default version of a client. A change of a layout, or of the meaning of a field, requires a new version.
VERSION = 3
#: Versions in which a server answers.
VERSIONS = (2, 3)
#: First bytes of a request.
REQUEST_MAGIC = b"TSRQ"
#: First bytes of a reply.
REPLY_MAGIC = b"TSRP"
#: Description of the coordinate frame, part of the answer to ``describe``.
FRAME = ("origin at the centre of the undeformed top face, z out of the tissue, right-handed; forces and torques are "
         "those on the tool, so pushing in gives a positive z force; depth = -z; orientation is a unit quaternion "
         "(w, x, y, z); SI units")

#: Magic, version, kind or status, sequence, time: the same in every version, so that a version is always recognised.
_HEAD = struct.Struct("<4sHHQd")
#: Request.
_REQUEST = struct.Struct("<4sHHQdQ3d4dII")
#: Reply of version 2.
_REPLY = struct.Struct("<4sHHQdQ3d3d36d36d4dII4Q")
#: Additional fields of a reply of version 3: stiffness_age, force_error, error_age, least_tool_mass.
_VERSION_3_FIELDS = struct.Struct("<4d")
#: Size of a request, bytes.
REQUEST_SIZE = _REQUEST.size
#: Version -> size of a reply, bytes.
REPLY_SIZES = {2: _REPLY.size, 3: _REPLY.size + _VERSION_3_FIELDS.size}
#: Size of a reply of the default version, bytes.
REPLY_SIZE = REPLY_SIZES[VERSION]

Vector = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]
_NO_VECTOR: Vector = (0.0, 0.0, 0.0)
_NO_MATRIX: Matrix = ((0.0,) * 6,) * 6


class RequestKind(IntEnum):
    """Kind of a request: a step, or the goodbye of a client."""

    #: Step the tissue to the pose of the request.
    STEP = 1
    #: Release the tissue for other clients.
    GOODBYE = 2


class RequestFlags(IntFlag):
    """Flags of a request, bits that change how the step is made."""

    NONE = 0
    #: Restore the undeformed state of the tissue before this step.
    RESET = 1


class ReplyFlags(IntFlag):
    """Flags of a reply, bits with information on the force."""

    NONE = 0
    #: The force includes the mass of the tissue.
    INERTIAL = 1
    #: The force was limited to the largest force of the server; the stiffness is then zero.
    LIMITED = 2
    #: The stiffness is older than `haptics.safety.coupling.CouplingSettings.longest_stiffness_age`.
    STALE_STIFFNESS = 4
    #: The tool is off the axis of an axisymmetric scene, or tilted; the force neglects this (version 3).
    OFF_AXIS = 8


class Status(IntEnum):
    """Status of a reply: below 100 a `tissue_sim.tool_force.ForceStatus` with a force; from 100, no step was made."""

    CONVERGED = ForceStatus.CONVERGED
    LATE = ForceStatus.LATE
    STOPPED = ForceStatus.STOPPED
    REFUSED = ForceStatus.REFUSED
    FADING = ForceStatus.FADING
    RETURNING = ForceStatus.RETURNING
    FAILED = ForceStatus.FAILED
    BUSY = 100
    OTHER_VERSION = 101
    RELEASED = 102

    @property
    def message(self) -> str:
        """Meaning of the status in words, with the remedy."""
        match self:
            case Status.BUSY:
                return "another client owns the tissue; try again after its goodbye or its silence"
            case Status.OTHER_VERSION:
                return "the server uses the protocol version of this reply; use a client of that version"
            case Status.RELEASED:
                return "the client has said goodbye; the tissue is free for another client"
            case _:
                return ForceStatus(self).message


class WireError(ValueError):
    """A packet does not belong to this protocol; the message gives the reason."""


class OtherVersionError(WireError):
    """A packet has another version, so that only its head can be decoded.

    Attributes:
        version: version of the packet.
        sequence: sequence number of the packet.
        time: time of the packet, s.
    """

    def __init__(self, version: int, sequence: int, time: float):
        super().__init__(f"version must be {' or '.join(map(str, VERSIONS))}; got {version}")
        self.version, self.sequence, self.time = version, sequence, time


class Request(NamedTuple):
    """Request of a client: pose of the tool at a time.

    Attributes:
        sequence: number of the request, 0 to 2^64 - 1, increasing.
        time: time on the clock of the client, s; the time step is the difference to the time of the last step.
        position: position of the tool tip x, y, z, m.
        orientation: unit quaternion (w, x, y, z) of the tool.
        session: random number that identifies the client; 0: the client is identified by its address.
        kind: value of `RequestKind`.
        flags: bits of `RequestFlags`.
        version: version of the request and of its reply.
    """

    sequence: int
    time: float
    position: Vector = _NO_VECTOR
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    session: int = 0
    kind: int = RequestKind.STEP
    flags: int = RequestFlags.NONE
    version: int = VERSION


class Reply(NamedTuple):
    """Reply of the server: force on the tool, its stiffness, and information on its accuracy.

    Attributes:
        status: value of `Status`; later servers may use further values.
        sequence: sequence number of the request.
        time: time of the request, s.
        session: session number of the request.
        force: force on the tool, N, shape (3,).
        torque: torque on the tool about its tip, N m, shape (3,).
        stiffness: static stiffness of the tissue: minus the derivative of (force, torque) with respect to (position,
            rotation vector), N/m, N, N m, shape (6, 6).
        step_stiffness: the same derivative within this step, including the mass of the tissue if it is modelled.
        age: time since the last equilibrium, s; 0: this answer is an equilibrium.
        compute_time: wall time of the step, s.
        residual: relative residual: norm of the unbalanced forces divided by the norm of the balanced forces, 1.
        dt: time step of this step, s.
        iterations: number of linear solutions in this step.
        flags: bits of `ReplyFlags`.
        malformed: number of packets since the start of the server that were not requests.
        stale: number of requests since the start that were not newer than the last request of their client.
        skipped: number of requests since the start that were replaced by a newer one.
        turned_away: number of requests since the start from clients that do not own the tissue.
        version: version of the packet. A reply of version 2 does not contain the fields below; they have these
            defaults.
        stiffness_age: time since the stiffness was computed, s.
        force_error: estimated error of the force, N; None: unknown (NaN in the packet).
        error_age: time since the error was estimated, s.
        least_tool_mass: smallest mass of a tool for which an explicit coupling is stable at this time step, kg.
    """

    status: int
    sequence: int
    time: float
    session: int = 0
    force: Vector = _NO_VECTOR
    torque: Vector = _NO_VECTOR
    stiffness: Matrix = _NO_MATRIX
    step_stiffness: Matrix = _NO_MATRIX
    age: float = 0.0
    compute_time: float = 0.0
    residual: float = 0.0
    dt: float = 0.0
    iterations: int = 0
    flags: int = ReplyFlags.NONE
    malformed: int = 0
    stale: int = 0
    skipped: int = 0
    turned_away: int = 0
    version: int = VERSION
    stiffness_age: float = 0.0
    force_error: float | None = None
    error_age: float = 0.0
    least_tool_mass: float = 0.0

    @property
    def is_on_axis(self) -> bool:
        """Whether the tool is on the axis of an axisymmetric scene; the force assumes that it is."""
        return not self.flags & ReplyFlags.OFF_AXIS


def encode_request(request: Request) -> bytes:
    """Return the packet of a request, `REQUEST_SIZE` bytes."""
    return _REQUEST.pack(REQUEST_MAGIC, request.version, request.kind, request.sequence, request.time, request.session,
                         *request.position, *request.orientation, request.flags, 0)


def decode_request_without_pose_check(packet: bytes | bytearray | memoryview) -> Request:
    """Return the request in a packet.

    The numbers of the pose are not checked and may be NaN; `StepService` checks them.

    Args:
        packet: bytes of a datagram.

    Raises:
        OtherVersionError: the packet is a request of another version.
        WireError: the packet is not a request, or its size, kind, flags or reserved field are invalid.
    """
    version = _decode_version(packet, REQUEST_MAGIC)
    _check_packet_size(packet, REQUEST_SIZE)
    (_, _, kind, sequence, time, session, x, y, z, qw, qx, qy, qz, flags, reserved) = _REQUEST.unpack(packet)
    if kind not in _KINDS or flags > _ALL_FLAGS or reserved:
        raise WireError(f"kind must be one of {sorted(_KINDS)}, flags at most {_ALL_FLAGS:#x} and the reserved field "
                        f"0; got {kind}, {flags:#x} and {reserved:#x}")
    return Request(sequence, time, (x, y, z), (qw, qx, qy, qz), session, kind, flags, version)


def encode_reply(reply: Reply) -> bytes:
    """Return the packet of a reply; its size is `REPLY_SIZES` of its version."""
    (status, sequence, time, session, force, torque, stiffness, step_stiffness, age, compute_time, residual, dt,
     iterations, flags, malformed, stale, skipped, turned_away, version, stiffness_age, force_error, error_age,
     least_tool_mass) = reply
    packet = _REPLY.pack(REPLY_MAGIC, version, status, sequence, time, session, *force, *torque,
                         *chain.from_iterable(stiffness), *chain.from_iterable(step_stiffness), age, compute_time,
                         residual, dt, iterations, flags, malformed, stale, skipped, turned_away)
    if version == 2:
        return packet
    return packet + _VERSION_3_FIELDS.pack(stiffness_age, math.nan if force_error is None else force_error, error_age,
                                           least_tool_mass)


def decode_reply(packet: bytes | bytearray | memoryview) -> Reply:
    """Return the reply in a packet.

    Args:
        packet: bytes of a datagram.

    Raises:
        OtherVersionError: the packet is a reply of another version.
        WireError: the packet is not a reply, or its size is invalid.
    """
    version = _decode_version(packet, REPLY_MAGIC)
    _check_packet_size(packet, REPLY_SIZES[version])
    values = _REPLY.unpack_from(packet)
    stiffness, step_stiffness = (tuple(values[start:start + 6] for start in range(first, first + 36, 6))
                                 for first in (12, 48))
    reply = Reply._make((*values[2:6], values[6:9], values[9:12], stiffness, step_stiffness, *values[84:], version,
                         0.0, None, 0.0, 0.0))
    if version == 2:
        return reply
    stiffness_age, force_error, error_age, least_tool_mass = _VERSION_3_FIELDS.unpack_from(packet, _REPLY.size)
    return reply._replace(stiffness_age=stiffness_age, force_error=None if math.isnan(force_error) else force_error,
                          error_age=error_age, least_tool_mass=least_tool_mass)


#: Valid kinds of a request.
_KINDS = frozenset(map(int, RequestKind))
#: All valid flags of a request.
_ALL_FLAGS = int(RequestFlags.RESET)


def _decode_version(packet: bytes | bytearray | memoryview, magic: bytes) -> int:
    """Return the version of a packet after checking its size and its first bytes."""
    if len(packet) < _HEAD.size:
        raise WireError(f"a packet must have at least {_HEAD.size} bytes; got {len(packet)}")
    found, version, _, sequence, time = _HEAD.unpack_from(packet)
    if found != magic:
        raise WireError(f"a packet must begin with {magic!r}; got {found!r}")
    if version not in VERSIONS:
        raise OtherVersionError(version, sequence, time)
    return int(version)


def _check_packet_size(packet: bytes | bytearray | memoryview, size: int) -> None:
    """Raise WireError if a packet does not have the given size, bytes."""
    if len(packet) != size:
        raise WireError(f"a packet must have {size} bytes; got {len(packet)}")
