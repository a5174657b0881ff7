"""Assign the tissue to one client, and step it to the newest valid request; independent of sockets and clocks."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from haptics.safety.coupling import is_tool_force_stiffness_stale
from haptics.server.wire import (
    OtherVersionError,
    Reply,
    ReplyFlags,
    Request,
    RequestFlags,
    RequestKind,
    Status,
    WireError,
    decode_request_without_pose_check,
    encode_reply,
)
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.public_names import OldName, make_getattr_for_old_names
from tissue_sim.realtime.force_fading import ForceFader
from tissue_sim.realtime.tissue import MotionLimits
from tissue_sim.tool_force import ForceStatus, Tissue, ToolForce, make_axial_stiffness_matrix

__getattr__ = make_getattr_for_old_names(__name__, {"SceneLimits": "ServerLimits"})

_NO_STIFFNESS = make_axial_stiffness_matrix(0.0)


@dataclass(frozen=True)
class ServerLimits(MotionLimits):
    """Limits of the requests of a client (the fields of the base class), and of the force in a reply.

    Attributes:
        force: largest magnitude of the force in a reply, N.

    Raises:
        InputError: a limit is not positive.
    """

    force: float = 100.0

    def limit_force_and_zero_stiffness(self, answer: ToolForce) -> tuple[ToolForce, bool]:
        """Scale an answer so that its force does not exceed the limit.

        Force and torque are scaled by the same factor. The stiffness of a scaled answer is zero, because a client that
        extrapolates with the stiffness must not exceed the limit.

        Args:
            answer: answer of the tissue.

        Returns:
            The answer or its scaled copy, and whether it was scaled.
        """
        force = math.hypot(*answer.wrench[:3])
        if force <= self.force:
            return answer, False
        scaled = answer.multiply_force_and_set_status(self.force / force, answer.status)
        return replace(scaled, stiffness_matrix=_NO_STIFFNESS, ahead=None, step_stiffness_matrix=None,
                       stiffness_age=0.0, force_error=None, error_age=0.0), True


#: Address of a client as a socket returns it: host, port, and further entries for IPv6.
Address = tuple[Any, ...]
# Flags as plain integers, because operations on enumerations cost a microsecond each.
#: `RequestFlags.RESET` as an integer.
_RESET = int(RequestFlags.RESET)
#: `ReplyFlags.INERTIAL` as an integer.
_INERTIAL = int(ReplyFlags.INERTIAL)
#: `ReplyFlags.LIMITED` as an integer.
_LIMITED = int(ReplyFlags.LIMITED)
#: `ReplyFlags.STALE_STIFFNESS` as an integer.
_STALE = int(ReplyFlags.STALE_STIFFNESS)
#: `ReplyFlags.OFF_AXIS` as an integer.
_OFF_AXIS = int(ReplyFlags.OFF_AXIS)
#: Time without a packet after which the owner can lose the tissue to another client, s.
SILENCE = 5.0
_NO_FORCE = ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)


class ServedTissue(Tissue, Protocol):
    """Interface of a tissue that a server can step and reset; `tissue_sim.Simulator` implements it."""

    def reset(self) -> None:
        """Restore the undeformed state of the tissue."""


@dataclass(slots=True)
class StepCounters:
    """Numbers of packets and steps since the server started; the names are keys of the command ``statistics``.

    Attributes:
        steps: answered steps.
        converged: steps with the status CONVERGED.
        late: steps with the status LATE.
        stopped: steps with the status STOPPED.
        refused: steps with the status REFUSED.
        fading: steps with the status FADING.
        returning: steps with the status RETURNING.
        failed: steps with the status FAILED.
        limited: answers whose force was limited.
        malformed: dropped packets that are not requests.
        stale: dropped requests that are not newer than the last request of their client.
        skipped: requests that were replaced by a newer one before the step.
        turned_away: requests of clients that do not own the tissue, answered with BUSY.
        other_version: packets of another protocol version, answered with the version of the server.
        unsent: replies that the operating system refused to send.
        flooded: packets dropped because their sender exceeded the rate limit.
        clients: clients that owned the tissue, one after the other.
    """

    steps: int = 0
    converged: int = 0
    late: int = 0
    stopped: int = 0
    refused: int = 0
    fading: int = 0
    returning: int = 0
    failed: int = 0
    limited: int = 0
    malformed: int = 0
    stale: int = 0
    skipped: int = 0
    turned_away: int = 0
    other_version: int = 0
    unsent: int = 0
    flooded: int = 0
    clients: int = 0

    def count_step_status(self, status: ForceStatus) -> None:
        """Add 1 to the counter of answered steps with this status of the force."""
        self.steps += 1
        name = _NAMES[status]
        setattr(self, name, getattr(self, name) + 1)


_NAMES = {status: status.name.lower() for status in ForceStatus}


class _OwnerClient:
    """The client that owns the tissue.

    Attributes:
        address: address of the client.
        session: session number of the client; 0: the client is identified by its address.
        sequence: sequence number of its newest request.
        last_contact: time of the last request or reply, s on the clock of the server.
        time: time of the last step on the clock of the client, s; None before the first step.
        pose: pose of the last step; None before the first step.
    """

    __slots__ = ("address", "last_contact", "pose", "sequence", "session", "time")

    def __init__(self, address: Address, session: int):
        self.address, self.session, self.sequence, self.last_contact = address, session, -1, -math.inf
        self.time: float | None = None
        self.pose: Pose | None = None

    def is_sender_of_request(self, request: Request, address: Address) -> bool:
        """Return whether a request is from this client: same session number, or same address if the number is 0."""
        return request.session == self.session and (self.session != 0 or address == self.address)


class StepService:
    """Step a tissue for one client at a time.

    Ownership. The first client to send a request owns the tissue. Another client can take over when the owner says
    goodbye, or sends nothing for `silence` seconds.

    Steps. Only the newest request is stepped: a client that sends faster than the steps are made builds up no queue.
    A request outside of the limits is refused without a step, and a force without equilibrium is faded out. If a step
    raises an error or returns a number that is not finite, the reply has the status FAILED and the tissue is rebuilt;
    the server keeps running.

    Args:
        tissue: tissue to step.
        silence: time without a packet after which the owner can lose the tissue to another client, s.
        limits: limits of poses, times and forces; None: default limits.
        release: fades a force without equilibrium; None: replies contain the unchanged answer of the tissue.
        rebuild: function that creates a tissue equal to the first one, called after a failed step; None: the failed
            tissue is reset.
        session: session number of the only client that may own the tissue; None: every client may.
        log: function that receives one line about each failure; None: lines go to standard error.

    Attributes:
        tissue: tissue that is stepped at present.
        limits: limits in use.
        counters: numbers of packets and steps.
        log: function that receives one line about each failure.
    """

    def __init__(self, tissue: ServedTissue, silence: float = SILENCE, *, limits: ServerLimits | None = None,
                 release: ForceFader | None = None, rebuild: Callable[[], ServedTissue] | None = None,
                 session: int | None = None, log: Callable[[str], None] | None = None):
        self.tissue, self.silence = tissue, silence
        self.limits, self._release, self._session = limits or ServerLimits(), release, session
        self._rebuild, self.log = rebuild, log or _print_to_standard_error
        self.counters = StepCounters()
        self._owner: _OwnerClient | None = None
        self._newest: Request | None = None
        self._last = _NO_FORCE
        #: Whether the tissue has failed and is not rebuilt yet.
        self._is_broken = False

    @property
    def owner_address(self) -> Address | None:
        """Address of the client that owns the tissue; None: no client owns it."""
        return None if self._owner is None else self._owner.address

    def receive(self, packet: bytes | bytearray | memoryview, address: Address, now: float) -> bytes | None:
        """Process one datagram: store a request of the owner for the next step, or answer it without a step.

        Args:
            packet: bytes of the datagram.
            address: address of its sender.
            now: time on the clock of the server, s.

        Returns:
            Reply to send at once; None if the datagram was stored or dropped.
        """
        counters = self.counters
        try:
            request = decode_request_without_pose_check(packet)
        except OtherVersionError as error:
            counters.other_version += 1
            return self._encode_status_reply(Status.OTHER_VERSION, Request(error.sequence, error.time))
        except WireError:
            counters.malformed += 1
            return None
        owner = self._owner
        if self._session not in (None, request.session):
            counters.turned_away += 1
            return self._encode_status_reply(Status.BUSY, request)
        if owner is not None and now - owner.last_contact <= self.silence:
            if not owner.is_sender_of_request(request, address):
                counters.turned_away += 1
                return self._encode_status_reply(Status.BUSY, request)
            if request.sequence <= owner.sequence:
                counters.stale += 1
                return None
        if request.kind == RequestKind.GOODBYE:
            self._release_owner()
            return self._encode_status_reply(Status.RELEASED, request)
        # After a silence the owner keeps its state, unless its sequence numbers restart.
        if owner is None or not owner.is_sender_of_request(request, address) or request.sequence <= owner.sequence:
            self._release_owner()
            owner = self._owner = _OwnerClient(address, request.session)
            self._treat_next_force_as_first()
            counters.clients += 1
        owner.sequence, owner.last_contact, owner.address = request.sequence, now, address
        if self._newest is not None:
            counters.skipped += 1
            # The reset flag of a skipped request still applies.
            request = request._replace(flags=request.flags | self._newest.flags)
        self._newest = request
        return None

    take = OldName("receive")

    def step(self, now: float) -> tuple[bytes, Address] | None:
        """Step the tissue to the pose of the newest request, and encode the reply.

        Args:
            now: time on the clock of the server, s.

        Returns:
            The reply and the address of the client; None if no pose is waiting.
        """
        if self._newest is None or self._owner is None:
            return None
        request, self._newest, owner = self._newest, None, self._owner
        answer, dt = self._step_or_refuse_and_get_time_step(request, owner)
        if self._release is not None:
            answer = self._release.step(answer, now)
        answer, limited = self.limits.limit_force_and_zero_stiffness(answer)
        counters = self.counters
        counters.count_step_status(answer.status)
        counters.limited += limited
        flags = (_INERTIAL * answer.inertial | _LIMITED * limited | _STALE * is_tool_force_stiffness_stale(answer)
                 | _OFF_AXIS * (request.version > 2 and not answer.is_on_axis))
        reply = Reply(answer.status, request.sequence, request.time, request.session, answer.force_vector,
                      answer.torque_vector, answer.stiffness_matrix, answer.stiffness_matrix_within_step, answer.age,
                      answer.compute_time, answer.residual, dt, answer.iterations, flags, counters.malformed,
                      counters.stale, counters.skipped, counters.turned_away, request.version, answer.stiffness_age,
                      answer.force_error, answer.error_age, answer.least_tool_mass)
        return encode_reply(reply), owner.address

    def restart_owner_silence_timer(self, now: float) -> None:
        """Restart the silence of the owner after its reply, because the step may have taken long.

        Args:
            now: time on the clock of the server, s.
        """
        if self._owner is not None:
            self._owner.last_contact = now

    def clear_last_step_record(self) -> None:
        """Discard the last step after the state of the tissue was replaced: the next step has the time step zero."""
        self._last = _NO_FORCE
        self._treat_next_force_as_first()
        if self._owner is not None:
            self._owner.time = self._owner.pose = None

    def _step_or_refuse_and_get_time_step(self, request: Request, owner: _OwnerClient) -> tuple[ToolForce, float]:
        """Check a request, and step the tissue to its pose.

        Args:
            request: newest request of the owner.
            owner: the owner.

        Returns:
            The answer of the tissue, or the last answer with the status REFUSED; and the time step that was used, s.
        """
        reset = request.flags & _RESET
        dt = 0.0 if owner.time is None or reset else request.time - owner.time
        try:
            if not math.isfinite(request.time):
                raise InputError(f"the time of a request must be finite; got {request.time}", field="time")
            pose = Pose(request.position, request.orientation)
            self.limits.require_valid_step(pose, None if reset else owner.pose, dt)
        except InputError:
            return self._copy_last_force_as_refused(), 0.0
        try:
            if self._is_broken:
                self._rebuild_or_reset_tissue()
            if reset:
                self.tissue.reset()
                self.clear_last_step_record()
            answer = self.tissue.step(pose, dt)
            if not answer.is_finite:
                raise ArithmeticError("the force of the tissue must be finite; got NaN or infinity")
        except Exception as error:
            if isinstance(error, InputError) and not self._is_broken:
                return self._copy_last_force_as_refused(), 0.0
            return self._rebuild_and_make_failed_force(error), 0.0
        if answer.status == ForceStatus.REFUSED:
            return answer, 0.0
        owner.time, owner.pose, self._last = request.time, pose, answer
        return answer, dt

    def _copy_last_force_as_refused(self) -> ToolForce:
        """Return a copy of the last force of the tissue with the status REFUSED."""
        return replace(self._last, status=ForceStatus.REFUSED, iterations=0, compute_time=0.0)

    def _rebuild_and_make_failed_force(self, error: Exception) -> ToolForce:
        """Rebuild the tissue after an error, and return a zero force with the status FAILED."""
        self.log(f"a step failed ({type(error).__name__}: {str(error)[:200]}); the tissue is rebuilt, undeformed")
        self._is_broken = True
        try:
            self._rebuild_or_reset_tissue()
        except Exception as again:
            self.log(f"the tissue could not be rebuilt; the next step tries again ({type(again).__name__}: "
                     f"{str(again)[:200]})")
        self.clear_last_step_record()
        return replace(_NO_FORCE, status=ForceStatus.FAILED)

    def _rebuild_or_reset_tissue(self) -> None:
        """Replace the tissue by the result of `rebuild`, or reset it if no such function was given."""
        if self._rebuild is None:
            self.tissue.reset()
        else:
            self.tissue = self._rebuild()
        self._is_broken = False

    def _release_owner(self) -> None:
        """Discard the owner and its waiting request."""
        if self._newest is not None:
            self.counters.skipped += 1
        self._owner = self._newest = None

    def _treat_next_force_as_first(self) -> None:
        """Treat the next force as the first force of a client."""
        if self._release is not None:
            self._release.reset()

    def _encode_status_reply(self, status: Status, request: Request) -> bytes:
        """Return the reply to a request that makes no step."""
        counters = self.counters
        return encode_reply(Reply(status, request.sequence, request.time, request.session,
                                  malformed=counters.malformed, stale=counters.stale,
                                  skipped=counters.skipped, turned_away=counters.turned_away,
                                  version=request.version))


def _print_to_standard_error(line: str) -> None:
    """Print a log line to standard error."""
    print(f"tissue-sim: {line}", file=sys.stderr, flush=True)
