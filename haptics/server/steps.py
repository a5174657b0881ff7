"""Who owns the tissue, and which of its packets make a step. Knows nothing of sockets and has no clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

from haptics.server.wire import (
    Kind,
    OtherVersionError,
    Reply,
    Request,
    RequestFlags,
    Status,
    WireError,
    decode_request,
    encode_reply,
)
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, Tissue, ToolForce

#: Of a client, as sockets give it: host, port and what else there is.
Address = tuple[Any, ...]
#: A plain number: flags of an enumeration cost a microsecond to compare.
_RESET = int(RequestFlags.RESET)
#: The owner of the tissue loses it after this time without a packet, s.
SILENCE = 1.0


class ServedTissue(Tissue, Protocol):
    """What a server needs of a tissue; `tissue_sim.Simulator` is one."""

    def reset(self) -> None:
        """Back to the undeformed state."""


@dataclass(slots=True)
class Counters:
    """Packets and steps since the server started.

    Attributes:
        steps: answered, by status: converged, late, stopped, refused.
        malformed: no requests; dropped.
        stale: not newer than the last one of their client; dropped.
        skipped: in whose place a newer one was answered.
        turned_away: from a client without the tissue; answered with BUSY.
        other_version: of another version; answered with ours.
        unsent: replies that the system would not take.
        clients: that owned the tissue, one after the other.
    """

    steps: int = 0
    converged: int = 0
    late: int = 0
    stopped: int = 0
    refused: int = 0
    malformed: int = 0
    stale: int = 0
    skipped: int = 0
    turned_away: int = 0
    other_version: int = 0
    unsent: int = 0
    clients: int = 0

    def count(self, status: ForceStatus) -> None:
        """Count a step that was answered."""
        self.steps += 1
        match status:
            case ForceStatus.CONVERGED:
                self.converged += 1
            case ForceStatus.LATE:
                self.late += 1
            case ForceStatus.STOPPED:
                self.stopped += 1
            case _:
                self.refused += 1


class _Owner:
    """The client that has the tissue.

    Attributes:
        address: where its packets come from.
        sequence: of its newest packet.
        heard: when the server last had to do with it, s on the server's clock.
        time: of its last step on its own clock, s; None before the first.
    """

    __slots__ = ("address", "heard", "sequence", "time")

    def __init__(self, address: Address):
        self.address, self.sequence, self.heard = address, -1, -math.inf
        self.time: float | None = None


class StepService:
    """Steps a tissue for one client at a time.

    The first to speak owns the tissue until it says goodbye, or falls silent and another speaks. Packets are taken as
    they come, and the newest is stepped: a client that sends faster than steps are made gets no queue.

    Args:
        tissue: what is stepped.
        silence: after which an owner loses the tissue to another client, s.
    """

    def __init__(self, tissue: ServedTissue, silence: float = SILENCE):
        self.tissue, self.silence = tissue, silence
        self.counters = Counters()
        self._owner: _Owner | None = None
        self._newest: Request | None = None
        self._last = ToolForce.axial(0.0, 0.0, ForceStatus.CONVERGED)

    @property
    def owner(self) -> Address | None:
        """Address of the client that has the tissue."""
        return None if self._owner is None else self._owner.address

    def take(self, packet: bytes | bytearray | memoryview, address: Address, now: float) -> bytes | None:
        """Look at one datagram.

        Args:
            packet: its bytes.
            address: of its sender.
            now: server's clock, s.

        Returns:
            What to answer at once; None where there is nothing to answer yet.
        """
        counters = self.counters
        try:
            request = decode_request(packet)
        except OtherVersionError as error:
            counters.other_version += 1
            return self._without_step(Status.OTHER_VERSION, error.sequence, error.time)
        except WireError:
            counters.malformed += 1
            return None
        owner = self._owner
        if owner is not None and now - owner.heard <= self.silence:
            if address != owner.address:
                counters.turned_away += 1
                return self._without_step(Status.BUSY, request.sequence, request.time)
            if request.sequence <= owner.sequence:
                counters.stale += 1
                return None
        if request.kind == Kind.GOODBYE:
            self._release()
            return self._without_step(Status.RELEASED, request.sequence, request.time)
        # An owner that was silent goes on where it was, unless it starts to count anew.
        if owner is None or address != owner.address or request.sequence <= owner.sequence:
            self._release()
            owner = self._owner = _Owner(address)
            counters.clients += 1
        owner.sequence, owner.heard = request.sequence, now
        if self._newest is not None:
            counters.skipped += 1
            request = request._replace(flags=request.flags | self._newest.flags)  # a reset is not skipped
        self._newest = request
        return None

    def step(self) -> tuple[bytes, Address] | None:
        """Step to the newest pose that was taken.

        Returns:
            The reply and the address of its client; None where no pose is waiting.
        """
        if self._newest is None or self._owner is None:
            return None
        request, self._newest, owner = self._newest, None, self._owner
        answer, dt = self._answer(request, owner)
        counters = self.counters
        counters.count(answer.status)
        reply = Reply(answer.status, request.sequence, request.time, answer.force_vector, answer.torque_vector,
                      answer.stiffness_matrix, answer.age, answer.compute_time, answer.residual, dt, answer.iterations,
                      int(answer.inertial), counters.malformed, counters.stale,
                      counters.skipped, counters.turned_away)
        return encode_reply(reply), owner.address

    def answered(self, now: float) -> None:
        """The owner's silence begins here: a step may have taken long."""
        if self._owner is not None:
            self._owner.heard = now

    def begin_anew(self) -> None:
        """The tissue was changed from elsewhere: the next step has no time step."""
        self._last = ToolForce.axial(0.0, 0.0, ForceStatus.CONVERGED)
        if self._owner is not None:
            self._owner.time = None

    def _answer(self, request: Request, owner: _Owner) -> tuple[ToolForce, float]:
        """The answer of the tissue, or the last one as refused where the pose or the time is none; and the dt used."""
        reset = request.flags & _RESET
        dt = 0.0 if owner.time is None or reset else request.time - owner.time
        try:
            if not math.isfinite(request.time + sum(request.position) + sum(request.orientation)) or dt < 0.0:
                raise InputError("no pose, or a time before the last")
            pose = Pose(request.position, request.orientation)
            if reset:
                self.tissue.reset()
                self.begin_anew()
            answer = self.tissue.step(pose, dt)
        except InputError:
            answer = replace(self._last, status=ForceStatus.REFUSED, iterations=0, compute_time=0.0)
        if answer.status == ForceStatus.REFUSED:
            return answer, 0.0
        owner.time, self._last = request.time, answer
        return answer, dt

    def _release(self) -> None:
        if self._newest is not None:
            self.counters.skipped += 1
        self._owner = self._newest = None

    def _without_step(self, status: Status, sequence: int, time: float) -> bytes:
        counters = self.counters
        return encode_reply(Reply(status, sequence, time, malformed=counters.malformed, stale=counters.stale,
                                  skipped=counters.skipped, turned_away=counters.turned_away))
