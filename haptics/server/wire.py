"""The UDP protocol between a simulator that is not ours and the tissue: one request, one reply, fixed layouts.

Little-endian, SI, no padding; docs/wire_protocol.md has the offsets. The frame is that of the scenes (`FRAME`), and
both packets carry all six degrees of freedom, whatever the scene uses of them. Requests of versions 2 and 3 differ in
the version alone; a reply has the version of its request, and one of version 3 continues where that of version 2 ends.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum, IntFlag
from itertools import chain
from typing import NamedTuple

from tissue_sim.tool_force import ForceStatus

#: Version of the requests of a client. Every change of a layout or of the meaning of a field makes a new version.
VERSION = 3
#: Versions in which a server answers.
VERSIONS = (2, 3)
REQUEST_MAGIC, REPLY_MAGIC = b"TSRQ", b"TSRP"
FRAME = ("origin at the centre of the undeformed top face, z out of the tissue, right-handed; forces and torques are "
         "those on the tool, so pushing in gives a positive z force; depth = -z; orientation is a unit quaternion "
         "(w, x, y, z); SI units")

#: magic, version, kind or status, sequence, time: the same in every version, so that any two can tell each other apart.
_HEAD = struct.Struct("<4sHHQd")
_REQUEST = struct.Struct("<4sHHQdQ3d4dII")
#: Reply of version 2.
_REPLY = struct.Struct("<4sHHQdQ3d3d36d36d4dII4Q")
#: End of a reply of version 3: stiffness_age, force_error, error_age, least_tool_mass.
_AGES = struct.Struct("<4d")
REQUEST_SIZE = _REQUEST.size
#: Bytes of a reply, by version.
REPLY_SIZES = {2: _REPLY.size, 3: _REPLY.size + _AGES.size}
REPLY_SIZE = REPLY_SIZES[VERSION]

Vector = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]
_NO_VECTOR: Vector = (0.0, 0.0, 0.0)
_NO_MATRIX: Matrix = ((0.0,) * 6,) * 6


class Kind(IntEnum):
    """What a request asks for."""

    STEP = 1
    GOODBYE = 2


class RequestFlags(IntFlag):
    """RESET (bit 0): put the tissue back to its undeformed state before this step."""

    NONE = 0
    RESET = 1


class ReplyFlags(IntFlag):
    """INERTIAL (bit 0): the mass of the tissue was taken into account. LIMITED (bit 1): the force was cut to the
    largest one that the server gives; the stiffness is zero then. STALE_STIFFNESS (bit 2): the stiffness is older than
    `haptics.safety.coupling.LONGEST_STIFFNESS_AGE`. OFF_AXIS (bit 3, version 3): the tool is away from or across the
    axis of an axisymmetric scene, which the force does not take into account."""

    NONE = 0
    INERTIAL = 1
    LIMITED = 2
    STALE_STIFFNESS = 4
    OFF_AXIS = 8


class Status(IntEnum):
    """Below 100: of a step, as `tissue_sim.tool_force.ForceStatus`, with a force; from 100 on: no step was made."""

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
        """What it means, and what to do."""
        match self:
            case Status.BUSY:
                return "another client owns the tissue; try again when it has said goodbye or fallen silent"
            case Status.OTHER_VERSION:
                return "the server speaks the version of this reply; use a client of that version"
            case Status.RELEASED:
                return "goodbye: the tissue is free for another client"
            case _:
                return ForceStatus(self).message


class WireError(ValueError):
    """A packet that is not of this protocol; the text says what is wrong with it."""


class OtherVersionError(WireError):
    """A packet of another version, of which only the head is known.

    Attributes:
        version, sequence, time: as in the packet.
    """

    def __init__(self, version: int, sequence: int, time: float):
        super().__init__(f"version must be {' or '.join(map(str, VERSIONS))}; got {version}")
        self.version, self.sequence, self.time = version, sequence, time


class Request(NamedTuple):
    """Where the tool is.

    Attributes:
        sequence: number of the packet, 0 to 2^64 - 1; greater than all before.
        time: on the client's clock, s; the time step is the difference to that of the last step.
        position: x, y, z, m.
        orientation: unit quaternion (w, x, y, z).
        session: a random number that the client has chosen, by which the server knows it; 0: by its address only.
        kind: a step, or goodbye.
        flags: see `RequestFlags`.
        version: of the packet, and of the reply to it.
    """

    sequence: int
    time: float
    position: Vector = _NO_VECTOR
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    session: int = 0
    kind: int = Kind.STEP
    flags: int = RequestFlags.NONE
    version: int = VERSION


class Reply(NamedTuple):
    """The force on the tool, and how far it can be believed.

    Attributes:
        status: a value of `Status`; later servers may know more.
        sequence, time, session: of the request that is answered.
        force: N. torque: N m, about the tool's tip.
        stiffness: the tissue's own: minus the derivative of (force, torque) with (position, rotation vector), 6 x 6,
            N/m, N, N m, without its mass.
        step_stiffness: the same within this step, with the mass where that was taken into account.
        age: time since the last equilibrium, s; 0 where this is one.
        compute_time: wall time of the step, s.
        residual: unbalanced over balanced forces.
        dt: time step that was used, s.
        iterations: linear solves of the step.
        flags: see `ReplyFlags`.
        malformed, stale, skipped, turned_away: packets since the server started that were no requests; that were not
            newer than the last; in whose place a newer one was answered; that came from a client without the tissue.
        version: of the packet. In version 2 the fields below do not exist; they have these defaults.
        stiffness_age: time since the stiffness was evaluated, s.
        force_error: estimated error of the force, N; None if it is unknown (NaN in the packet).
        error_age: time since this error was estimated, s.
        least_tool_mass: smallest mass of a tool that an explicit coupling keeps stable at this time step, kg.
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
        """Whether the tool is on the axis of an axisymmetric scene, as the force assumes."""
        return not self.flags & ReplyFlags.OFF_AXIS


def encode_request(request: Request) -> bytes:
    """The packet of a request, `REQUEST_SIZE` bytes."""
    return _REQUEST.pack(REQUEST_MAGIC, request.version, request.kind, request.sequence, request.time, request.session,
                         *request.position, *request.orientation, request.flags, 0)


def decode_request(packet: bytes | bytearray | memoryview) -> Request:
    """The request in a packet. Its numbers may be NaN: it is not for the wire to say what a pose may be.

    Raises:
        OtherVersionError: of another version.
        WireError: not a request; or of this version with another size, kind, flag, or something in the reserved field.
    """
    version = _checked_version(packet, REQUEST_MAGIC)
    _check_size(packet, REQUEST_SIZE)
    (_, _, kind, sequence, time, session, x, y, z, qw, qx, qy, qz, flags, reserved) = _REQUEST.unpack(packet)
    if kind not in _KINDS or flags > _ALL_FLAGS or reserved:
        raise WireError(f"unknown kind {kind}, flags {flags:#x} or reserved {reserved:#x}")
    return Request(sequence, time, (x, y, z), (qw, qx, qy, qz), session, kind, flags, version)


def encode_reply(reply: Reply) -> bytes:
    """The packet of a reply, as long as `REPLY_SIZES` says for its version."""
    (status, sequence, time, session, force, torque, stiffness, step_stiffness, age, compute_time, residual, dt,
     iterations, flags, malformed, stale, skipped, turned_away, version, stiffness_age, force_error, error_age,
     least_tool_mass) = reply
    packet = _REPLY.pack(REPLY_MAGIC, version, status, sequence, time, session, *force, *torque,
                         *chain.from_iterable(stiffness), *chain.from_iterable(step_stiffness), age, compute_time,
                         residual, dt, iterations, flags, malformed, stale, skipped, turned_away)
    if version == 2:
        return packet
    return packet + _AGES.pack(stiffness_age, math.nan if force_error is None else force_error, error_age,
                               least_tool_mass)


def decode_reply(packet: bytes | bytearray | memoryview) -> Reply:
    """The reply in a packet.

    Raises:
        OtherVersionError: of another version.
        WireError: not a reply, or of this version with another size.
    """
    version = _checked_version(packet, REPLY_MAGIC)
    _check_size(packet, REPLY_SIZES[version])
    values = _REPLY.unpack_from(packet)
    stiffness, step_stiffness = (tuple(values[start:start + 6] for start in range(first, first + 36, 6))
                                 for first in (12, 48))
    reply = Reply._make((*values[2:6], values[6:9], values[9:12], stiffness, step_stiffness, *values[84:], version,
                         0.0, None, 0.0, 0.0))
    if version == 2:
        return reply
    stiffness_age, force_error, error_age, least_tool_mass = _AGES.unpack_from(packet, _REPLY.size)
    return reply._replace(stiffness_age=stiffness_age, force_error=None if math.isnan(force_error) else force_error,
                          error_age=error_age, least_tool_mass=least_tool_mass)


_KINDS = frozenset(map(int, Kind))
_ALL_FLAGS = int(RequestFlags.RESET)


def _checked_version(packet: bytes | bytearray | memoryview, magic: bytes) -> int:
    if len(packet) < _HEAD.size:
        raise WireError(f"a packet must have at least {_HEAD.size} bytes; got {len(packet)}")
    found, version, _, sequence, time = _HEAD.unpack_from(packet)
    if found != magic:
        raise WireError(f"a packet must begin with {magic!r}; got {found!r}")
    if version not in VERSIONS:
        raise OtherVersionError(version, sequence, time)
    return int(version)


def _check_size(packet: bytes | bytearray | memoryview, size: int) -> None:
    if len(packet) != size:
        raise WireError(f"a packet must have {size} bytes; got {len(packet)}")
