"""Who owns the tissue, and which of its packets make a step. Knows nothing of sockets and has no clock."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from haptics.safety.coupling import is_stale
from haptics.safety.force_release import ForceRelease
from haptics.server.scene_limits import SceneLimits
from haptics.server.wire import (
    Kind,
    OtherVersionError,
    Reply,
    ReplyFlags,
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
_INERTIAL, _LIMITED = int(ReplyFlags.INERTIAL), int(ReplyFlags.LIMITED)
_STALE, _OFF_AXIS = int(ReplyFlags.STALE_STIFFNESS), int(ReplyFlags.OFF_AXIS)
#: The owner of the tissue loses it to another client after this time without a packet, s.
SILENCE = 5.0
_NO_FORCE = ToolForce.axial(0.0, 0.0, ForceStatus.CONVERGED)


class ServedTissue(Tissue, Protocol):
    """What a server needs of a tissue; `tissue_sim.Simulator` is one."""

    def reset(self) -> None:
        """Back to the undeformed state."""


@dataclass(slots=True)
class Counters:
    """Packets and steps since the server started.

    Attributes:
        steps: answered, by status: converged, late, stopped, refused, fading, returning, failed.
        limited: answers whose force was cut.
        malformed: no requests; dropped.
        stale: not newer than the last one of their client; dropped.
        skipped: in whose place a newer one was answered.
        turned_away: from a client without the tissue; answered with BUSY.
        other_version: of another version; answered with ours.
        unsent: replies that the system would not take.
        flooded: from who sends too much; dropped.
        clients: that owned the tissue, one after the other.
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

    def count(self, status: ForceStatus) -> None:
        """Count a step that was answered."""
        self.steps += 1
        name = _NAMES[status]
        setattr(self, name, getattr(self, name) + 1)


_NAMES = {status: status.name.lower() for status in ForceStatus}


class _Owner:
    """The client that has the tissue.

    Attributes:
        address: where its packets come from.
        session: its number; 0: it is known by its address.
        sequence: of its newest packet.
        heard: when the server last had to do with it, s on the server's clock.
        time: of its last step on its own clock, s; None before the first.
        pose: of that step.
    """

    __slots__ = ("address", "heard", "pose", "sequence", "session", "time")

    def __init__(self, address: Address, session: int):
        self.address, self.session, self.sequence, self.heard = address, session, -1, -math.inf
        self.time: float | None = None
        self.pose: Pose | None = None

    def sent(self, request: Request, address: Address) -> bool:
        """Whether a request is one of this client's. One that shows the number may have got another address."""
        return request.session == self.session and (self.session != 0 or address == self.address)


class StepService:
    """Steps a tissue for one client at a time.

    The first to speak owns the tissue until it says goodbye, or falls silent and another speaks. Packets are taken as
    they come, and the newest is stepped: a client that sends faster than steps are made gets no queue. What the scene
    cannot hold is refused before the tissue sees it, a force without an equilibrium is let go, and a step that raises
    anything, or answers no number, is FAILED and costs the tissue its state, not the server its life.

    Args:
        tissue: what is stepped.
        silence: after which an owner loses the tissue to another client, s.
        limits: of poses, times and forces.
        release: lets a force without an equilibrium go; None: replies hold what the tissue answers.
        rebuild: another tissue like the first one, for after a step that failed; None: that one is reset.
        session: the number by which the one client that may have the tissue is known; None: whoever comes first.
        log: takes one line about each failure.

    Attributes:
        tissue: the one that is stepped now.
        log: as given, or to standard error.
    """

    def __init__(self, tissue: ServedTissue, silence: float = SILENCE, *, limits: SceneLimits | None = None,
                 release: ForceRelease | None = None, rebuild: Callable[[], ServedTissue] | None = None,
                 session: int | None = None, log: Callable[[str], None] | None = None):
        self.tissue, self.silence = tissue, silence
        self.limits, self._release, self._session = limits or SceneLimits(), release, session
        self._rebuild, self.log = rebuild, log or _to_standard_error
        self.counters = Counters()
        self._owner: _Owner | None = None
        self._newest: Request | None = None
        self._last = _NO_FORCE
        # Whether the tissue has failed, and could not be built anew yet.
        self._broken = False

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
            return self._without_step(Status.OTHER_VERSION, Request(error.sequence, error.time))
        except WireError:
            counters.malformed += 1
            return None
        owner = self._owner
        if self._session not in (None, request.session):
            counters.turned_away += 1
            return self._without_step(Status.BUSY, request)
        if owner is not None and now - owner.heard <= self.silence:
            if not owner.sent(request, address):
                counters.turned_away += 1
                return self._without_step(Status.BUSY, request)
            if request.sequence <= owner.sequence:
                counters.stale += 1
                return None
        if request.kind == Kind.GOODBYE:
            self._let_go()
            return self._without_step(Status.RELEASED, request)
        # An owner that was silent goes on where it was, unless it starts to count anew.
        if owner is None or not owner.sent(request, address) or request.sequence <= owner.sequence:
            self._let_go()
            owner = self._owner = _Owner(address, request.session)
            self._engage()
            counters.clients += 1
        owner.sequence, owner.heard, owner.address = request.sequence, now, address
        if self._newest is not None:
            counters.skipped += 1
            request = request._replace(flags=request.flags | self._newest.flags)  # a reset is not skipped
        self._newest = request
        return None

    def step(self, now: float) -> tuple[bytes, Address] | None:
        """Step to the newest pose that was taken.

        Args:
            now: server's clock, s.

        Returns:
            The reply and the address of its client; None where no pose is waiting.
        """
        if self._newest is None or self._owner is None:
            return None
        request, self._newest, owner = self._newest, None, self._owner
        answer, dt = self._answer(request, owner)
        if self._release is not None:
            answer = self._release.step(answer, now)
        answer, limited = self.limits.limited(answer)
        counters = self.counters
        counters.count(answer.status)
        counters.limited += limited
        flags = (_INERTIAL * answer.inertial | _LIMITED * limited | _STALE * is_stale(answer)
                 | _OFF_AXIS * (request.version > 2 and not answer.is_on_axis))
        reply = Reply(answer.status, request.sequence, request.time, request.session, answer.force_vector,
                      answer.torque_vector, answer.stiffness_matrix, answer.within_step, answer.age,
                      answer.compute_time, answer.residual, dt, answer.iterations, flags, counters.malformed,
                      counters.stale, counters.skipped, counters.turned_away, request.version, answer.stiffness_age,
                      answer.force_error, answer.error_age, answer.least_tool_mass)
        return encode_reply(reply), owner.address

    def answered(self, now: float) -> None:
        """The owner's silence begins here: a step may have taken long."""
        if self._owner is not None:
            self._owner.heard = now

    def begin_anew(self) -> None:
        """The tissue was changed from elsewhere: the next step has no time step."""
        self._last = _NO_FORCE
        self._engage()
        if self._owner is not None:
            self._owner.time = self._owner.pose = None

    def _answer(self, request: Request, owner: _Owner) -> tuple[ToolForce, float]:
        """The answer of the tissue, or the last one as refused where it is not asked; and the dt used."""
        reset = request.flags & _RESET
        dt = 0.0 if owner.time is None or reset else request.time - owner.time
        try:
            if not math.isfinite(request.time):
                raise InputError("no time", field="time")
            pose = Pose(request.position, request.orientation)
            self.limits.require(pose, None if reset else owner.pose, dt)
        except InputError:
            return self._refused(), 0.0
        try:
            if self._broken:
                self._build_anew()
            if reset:
                self.tissue.reset()
                self.begin_anew()
            answer = self.tissue.step(pose, dt)
            if not answer.is_finite:
                raise ArithmeticError("the force is not a number")
        except Exception as error:
            if isinstance(error, InputError) and not self._broken:
                return self._refused(), 0.0
            return self._failed(error), 0.0
        if answer.status == ForceStatus.REFUSED:
            return answer, 0.0
        owner.time, owner.pose, self._last = request.time, pose, answer
        return answer, dt

    def _refused(self) -> ToolForce:
        return replace(self._last, status=ForceStatus.REFUSED, iterations=0, compute_time=0.0)

    def _failed(self, error: Exception) -> ToolForce:
        """No force, and another tissue for the next step."""
        self.log(f"a step failed ({type(error).__name__}: {str(error)[:200]}); the tissue begins anew")
        self._broken = True
        try:
            self._build_anew()
        except Exception as again:
            self.log(f"the tissue cannot be built anew yet ({type(again).__name__}: {str(again)[:200]})")
        self.begin_anew()
        return replace(_NO_FORCE, status=ForceStatus.FAILED)

    def _build_anew(self) -> None:
        if self._rebuild is None:
            self.tissue.reset()
        else:
            self.tissue = self._rebuild()
        self._broken = False

    def _let_go(self) -> None:
        """Of the owner."""
        if self._newest is not None:
            self.counters.skipped += 1
        self._owner = self._newest = None

    def _engage(self) -> None:
        """The next force is a client's first one."""
        if self._release is not None:
            self._release.reset()

    def _without_step(self, status: Status, request: Request) -> bytes:
        counters = self.counters
        return encode_reply(Reply(status, request.sequence, request.time, request.session,
                                  malformed=counters.malformed, stale=counters.stale,
                                  skipped=counters.skipped, turned_away=counters.turned_away,
                                  version=request.version))


def _to_standard_error(line: str) -> None:
    print(f"tissue-sim: {line}", file=sys.stderr, flush=True)
