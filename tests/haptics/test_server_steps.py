"""`StepService`: ownership, steps and time steps, without sockets and with a simulated clock."""

import math
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.server.steps import ServerLimits, StepService
from haptics.server.wire import VERSION, Request, RequestFlags, RequestKind, Status, decode_reply, encode_request
from tissue_sim.errors import InputError
from tissue_sim.realtime.force_fading import ForceFader
from tissue_sim.tool_force import ForceStatus, ToolForce

A = ("127.0.0.1", 5001)
B = ("127.0.0.1", 5002)


class RecordingTissue:
    """Spring of 1 N/mm that records its steps and resets."""

    def __init__(self):
        self.steps, self.resets = [], 0

    def step(self, pose, dt):
        self.steps.append((pose.depth, dt))
        return ToolForce.from_axial_force(1e3 * pose.depth, 1e3, ForceStatus.CONVERGED, iterations=2, residual=1e-7,
                                          inertial=True,
                                          compute_time=3e-4)

    def reset(self):
        self.resets += 1


@pytest.fixture
def service():
    return StepService(RecordingTissue(), silence=1.0, log=[].append)


def packet(sequence, time=None, depth=0.001, **changes):
    return encode_request(Request(sequence, sequence * 1e-3 if time is None else time, (0.0, 0.0, -depth))
                          ._replace(**changes))


def ask(service, *packets, address=A, now=0.0):
    """Send packets, make one step, and return the reply to the last packet."""
    immediate = None
    for each in packets:
        immediate = service.receive(each, address, now)
    answer = service.step(now)
    if answer is None:
        return None if immediate is None else decode_reply(immediate)
    assert answer[1] == address
    service.restart_owner_silence_timer(now)
    return decode_reply(answer[0])


def test_the_reply_contains_the_answer_of_the_tissue(service):
    reply = ask(service, packet(17, depth=0.002))
    assert (reply.status, reply.sequence, reply.time) == (Status.CONVERGED, 17, 0.017)
    assert reply.force == (0.0, 0.0, 2.0) and reply.torque == (0.0, 0.0, 0.0)
    assert [[value for value in row if value] for row in reply.stiffness] == [[], [], [1e3], [], [], []]
    assert (reply.iterations, reply.residual, reply.flags, reply.compute_time) == (2, 1e-7, 1, 3e-4)


def test_the_time_step_is_the_difference_of_the_request_times(service):
    replies = [ask(service, packet(k, time)) for k, time in enumerate((10.0, 10.5, 10.5, 12.0))]
    assert [reply.dt for reply in replies] == [0.0, 0.5, 0.0, 1.5]
    assert [dt for _, dt in service.tissue.steps] == [0.0, 0.5, 0.0, 1.5]


def test_only_the_newest_pose_is_stepped_with_the_whole_time_step(service):
    ask(service, packet(0, 0.0))
    reply = ask(service, packet(1, 0.1), packet(2, 0.2), packet(3, 0.3, depth=0.004))
    assert reply.sequence == 3 and reply.skipped == 2
    assert service.tissue.steps[1:] == [(0.004, 0.3)]


def test_an_older_request_is_dropped_and_counted(service):
    ask(service, packet(5))
    assert ask(service, packet(5)) is None and ask(service, packet(4)) is None
    assert ask(service, packet(6)).stale == 2
    # A late packet that arrives together with the newest.
    assert ask(service, packet(9), packet(8)).sequence == 9
    assert service.counters.stale == 3 and len(service.tissue.steps) == 3


def test_malformed_packets_are_dropped_and_counted(service):
    for noise in (b"", b"hello", packet(1)[:-1], packet(1) + b"\0", bytes(88)):
        assert ask(service, noise) is None
    assert service.owner_address is None, "noise must not become the owner"
    assert ask(service, packet(1)).malformed == 5


@pytest.mark.parametrize("changes", [
    {"position": (0.0, 0.0, math.nan)}, {"position": (math.inf, 0.0, 0.0)}, {"orientation": (math.nan, 0, 0, 0)},
    {"orientation": (1.0, 0.1, 0.0, 0.0)}, {"orientation": (0.0, 0.0, 0.0, 0.0)}, {"time": math.nan},
    {"time": math.inf}, {"time": -0.001}, {"time": 1e300}, {"time": 1e6},
    {"position": (0.0, 0.0, 1e300)}, {"position": (0.0, 0.0, -1e300)}, {"position": (0.0, 11.0, -0.003)},
], ids=str)
def test_a_refused_pose_keeps_the_state_and_the_last_force(service, changes):
    ask(service, packet(0, 0.0, depth=0.003))
    reply = ask(service, packet(1, **{"time": 0.1, **changes}))
    assert reply.status == Status.REFUSED and reply.force == (0.0, 0.0, 3.0) and reply.iterations == 0
    assert service.tissue.steps == [(0.003, 0.0)]
    # The next valid request continues from the last valid request.
    assert ask(service, packet(2, 0.25)).dt == 0.25


def test_a_refusal_by_the_tissue_does_not_advance_time(service):
    ask(service, packet(0, 0.0))
    step, service.tissue.step = service.tissue.step, lambda pose, dt: ToolForce.from_axial_force(1.0, 2.0,
                                                                                                 ForceStatus.REFUSED)
    assert ask(service, packet(1, 0.1)).status == Status.REFUSED

    def refuse(pose, dt):
        raise InputError("not there")

    service.tissue.step = refuse
    assert ask(service, packet(2, 0.2)).status == Status.REFUSED
    service.tissue.step = step
    assert ask(service, packet(3, 0.3)).dt == 0.3
    assert service.counters.refused == 2 and service.counters.steps == 4


def test_the_reset_flag_resets_before_the_step_and_is_never_skipped(service):
    ask(service, packet(0, 5.0))
    # After a reset the time may be smaller.
    reply = ask(service, packet(1, 0.0, flags=RequestFlags.RESET))
    assert service.tissue.resets == 1 and reply.dt == 0.0 and reply.status == Status.CONVERGED
    reply = ask(service, packet(2, 0.1, flags=RequestFlags.RESET), packet(3, 0.2))
    assert service.tissue.resets == 2 and reply.sequence == 3 and reply.dt == 0.0
    reply = ask(service, packet(4, 0.3, flags=RequestFlags.RESET, position=(0.0, 0.0, math.nan)))
    assert service.tissue.resets == 2 and reply.status == Status.REFUSED


def test_a_reset_applies_even_if_its_step_is_refused(service):
    ask(service, packet(0, 5.0, depth=0.003))
    step, service.tissue.step = service.tissue.step, lambda pose, dt: ToolForce.from_axial_force(1.0, 2.0,
                                                                                                 ForceStatus.REFUSED)
    ask(service, packet(1, 6.0, flags=RequestFlags.RESET))
    service.tissue.step = step
    assert ask(service, packet(2, math.nan)).force == (0.0, 0.0, 0.0)
    assert ask(service, packet(3, 7.0)).dt == 0.0


def test_the_old_name_take_warns(service):
    with pytest.warns(DeprecationWarning, match="renamed to receive"):
        assert service.take(packet(0), A, 0.0) is None


def test_the_first_of_two_waiting_clients_owns_the_tissue(service):
    assert service.receive(packet(0), A, 0.0) is None
    assert decode_reply(service.receive(packet(0), B, 0.0)).status == Status.BUSY


def test_the_first_client_owns_the_tissue(service):
    ask(service, packet(0), address=A, now=0.0)
    reply = ask(service, packet(900, 7.0), address=B, now=0.5)
    assert (reply.status, reply.sequence, reply.time, reply.turned_away) == (Status.BUSY, 900, 7.0, 1)
    assert reply.force == (0.0, 0.0, 0.0) and len(service.tissue.steps) == 1
    assert ask(service, packet(901, kind=RequestKind.GOODBYE), address=B, now=0.5).status == Status.BUSY
    assert service.owner_address == A and ask(service, packet(1), address=A, now=0.6).turned_away == 2


def test_a_silent_owner_loses_the_tissue_to_another_client(service):
    ask(service, packet(50, 8.0), address=A, now=0.0)
    assert ask(service, packet(0, 3.0), address=B, now=1.01).dt == 0.0
    assert service.owner_address == B and service.counters.clients == 2
    assert ask(service, packet(51, 9.0), address=A, now=1.02).status == Status.BUSY


def test_the_silence_starts_with_the_reply(service):
    service.receive(packet(0), A, 0.0)
    service.step(0.0)
    service.restart_owner_silence_timer(5.0)  # a long step
    assert ask(service, packet(0), address=B, now=5.9).status == Status.BUSY


def test_stale_packets_do_not_extend_the_ownership(service):
    ask(service, packet(9), address=A, now=0.0)
    service.receive(packet(9), A, 0.9)
    assert ask(service, packet(0), address=B, now=1.1).status == Status.CONVERGED


def test_a_silent_owner_continues_or_restarts_its_sequence(service):
    ask(service, packet(5, 1.0), now=0.0)
    assert ask(service, packet(6, 4.0), now=3.0).dt == 3.0, "the time of a pause counts"
    assert ask(service, packet(0, 0.0), now=6.0).dt == 0.0, "a restarted program"
    assert service.counters.clients == 2


def test_a_goodbye_releases_the_tissue_at_once(service):
    ask(service, packet(0), address=A)
    reply = ask(service, packet(1), packet(2, kind=RequestKind.GOODBYE), address=A)
    assert (reply.status, reply.sequence) == (Status.RELEASED, 2)
    assert service.owner_address is None and service.counters.skipped == 1
    assert ask(service, packet(0), address=B).status == Status.CONVERGED


def test_another_version_is_answered_with_the_version_of_the_server(service):
    other_version = bytearray(packet(77, 1.5))
    other_version[4:6] = b"\x04\x00"
    reply = ask(service, bytes(other_version) + b"more of version 4")
    assert (reply.status, reply.sequence, reply.time) == (Status.OTHER_VERSION, 77, 1.5)
    assert service.owner_address is None and service.counters.other_version == 1 and reply.version == VERSION


@pytest.mark.parametrize("version", [2, 3])
def test_a_reply_has_the_version_of_its_request(service, version):
    old = bytearray(packet(0))
    old[4] = version
    reply = ask(service, bytes(old))
    assert (reply.status, reply.version) == (Status.CONVERGED, version)


def test_statuses_are_counted(service):
    statuses = [ForceStatus.CONVERGED, ForceStatus.LATE, ForceStatus.LATE, ForceStatus.STOPPED, ForceStatus.REFUSED]
    for number, status in enumerate(statuses):
        service.tissue.step = lambda pose, dt, status=status: ToolForce.from_axial_force(1.0, 2.0, status)
        assert ask(service, packet(number)).status == status
    counters = service.counters
    assert (counters.steps, counters.converged, counters.late, counters.stopped, counters.refused) == (5, 1, 2, 1, 1)


class TestSceneLimits:
    def test_a_depth_beyond_the_limit_is_refused(self):
        service = StepService(RecordingTissue(), limits=ServerLimits(deepest=0.07))
        assert ask(service, packet(0, 0.0, depth=0.05)).status == Status.CONVERGED
        for number, depth in enumerate((0.071, 0.1, 1e3, 1e300, 1.7e308), start=1):
            assert ask(service, packet(number, 0.1, depth=depth)).status == Status.REFUSED
        assert service.tissue.steps == [(0.05, 0.0)]

    def test_a_jump_is_refused_until_the_time_step_allows_it(self, service):
        ask(service, packet(0, 0.0, depth=0.0))
        replies = [ask(service, packet(k, 1e-3 * k, depth=0.45)) for k in range(1, 8)]
        assert [reply.status for reply in replies[:4]] == [Status.REFUSED] * 4
        assert replies[-1].status == Status.CONVERGED and max(reply.dt for reply in replies) == 5e-3

    def test_above_the_tissue_jumps_are_allowed(self, service):
        heights = [-0.2, -5.0, -0.001, 0.001]
        assert [ask(service, packet(k, depth=depth)).status for k, depth in enumerate(heights)] == [0, 0, 0, 0]

    def test_a_zero_time_step_has_no_speed_limit(self, service):
        ask(service, packet(0, 1.0, depth=0.0))
        assert ask(service, packet(1, 1.0, depth=0.02)).status == Status.CONVERGED

    def test_no_reply_has_more_than_the_largest_force(self):
        service = StepService(RecordingTissue(), limits=ServerLimits(force=2.5))
        reply = ask(service, packet(0, depth=0.002))
        assert (reply.force[2], reply.flags, service.counters.limited) == (2.0, 1, 0)
        reply = ask(service, packet(1, depth=0.009))
        assert reply.force == (0.0, 0.0, 2.5) and reply.flags == 3 and service.counters.limited == 1
        assert not any(map(any, reply.stiffness)) and not any(map(any, reply.step_stiffness))

    @pytest.mark.parametrize("bad", [{"deepest": 0.0}, {"force": -1.0}, {"speed": math.nan}])
    def test_an_invalid_limit_is_refused(self, bad):
        with pytest.raises(InputError, match=f"^{next(iter(bad))}: must be positive"):
            ServerLimits(**bad)


class TestFailure:
    @pytest.fixture
    def failing(self):
        """Service whose tissue fails below 3 mm and is replaced by a new one, and the list of its log lines."""
        class Brittle(RecordingTissue):
            def step(self, pose, dt):
                if pose.depth > 0.003:
                    raise OverflowError("cannot convert float infinity\nto integer")
                return super().step(pose, dt)

        log = []
        return StepService(Brittle(), rebuild=Brittle, log=log.append), log

    def test_a_step_that_raises_is_failed_and_the_next_one_is_stepped(self, failing):
        service, log = failing
        first = service.tissue
        assert ask(service, packet(0, 0.0, depth=0.002)).force[2] == 2.0
        reply = ask(service, packet(1, 0.1, depth=0.004))
        assert (reply.status, reply.force, reply.dt) == (Status.FAILED, (0.0, 0.0, 0.0), 0.0)
        assert not any(map(any, reply.stiffness))
        assert len(log) == 1 and "OverflowError: cannot convert" in log[0]
        assert service.tissue is not first
        assert ask(service, packet(2, 0.2, depth=0.001)).status == Status.CONVERGED
        assert service.tissue.steps == [(0.001, 0.0)] and service.counters.failed == 1

    def test_a_force_that_is_not_finite_is_a_failure(self, service):
        service.tissue.step = lambda pose, dt: ToolForce.from_axial_force(math.nan, 1.0, ForceStatus.CONVERGED)
        assert ask(service, packet(0)).status == Status.FAILED and service.tissue.resets == 1

    def test_a_failed_rebuild_is_repeated(self):
        made, log = [], []

        def rebuild():
            made.append(RecordingTissue())
            if len(made) == 1:
                raise MemoryError("not now")
            return made[-1]

        service = StepService(RecordingTissue(), rebuild=rebuild, log=log.append)

        def fail(pose, dt):
            raise ZeroDivisionError

        service.tissue.step = fail
        assert ask(service, packet(0, 0.0)).status == Status.FAILED
        assert "could not be rebuilt; the next step tries again" in log[1]
        assert ask(service, packet(1, 0.1)).status == Status.CONVERGED and service.tissue is made[1]


class TestRelease:
    @pytest.fixture
    def service(self):
        return StepService(RecordingTissue(), release=ForceFader())

    def drive(self, service, depths, start=0, status=ForceStatus.CONVERGED):
        """Step through depths at 1 kHz, and return the replies."""
        service.tissue.step = lambda pose, dt: ToolForce.from_axial_force(1e3 * pose.depth, 1e3, status)
        return [ask(service, packet(start + k, depth=depth), now=1e-3 * (start + k)) for k, depth in enumerate(depths)]

    def test_a_client_that_starts_in_the_air_gets_the_forces_of_the_tissue(self, service):
        replies = self.drive(service, [1e-5 * k for k in range(100)])
        assert [reply.status for reply in replies] == [Status.CONVERGED] * 100
        assert [reply.force[2] for reply in replies] == [1e3 * (1e-5 * k) for k in range(100)]

    def test_a_client_that_starts_inside_starts_without_force(self, service):
        for first in (0, 1000):  # the second time after a reset by a command
            service.clear_last_step_record()
            replies = self.drive(service, [0.003] * 100, start=first)
            assert (replies[0].status, replies[0].force[2]) == (Status.RETURNING, 0.0)
            assert replies[-1].status == Status.CONVERGED and replies[-1].force[2] == 3.0

    def test_a_frozen_force_fades_whatever_the_client_says_of_time(self, service):
        self.drive(service, [0.0, 0.001, 0.002, 0.003])
        service.tissue.step = lambda pose, dt: ToolForce.from_axial_force(3.0, 1e3, ForceStatus.STOPPED)
        replies = [ask(service, packet(4 + k, 0.003, depth=0.003), now=1e-3 * (4 + k)) for k in range(200)]
        assert replies[0].force[2] == 3.0 and replies[0].status == Status.STOPPED
        assert replies[-1].force[2] == replies[-1].stiffness[2][2] == 0.0 and replies[-1].status == Status.FADING
        back = self.drive(service, [0.002] * 100, start=204)
        assert back[0].status == Status.RETURNING and back[0].force[2] < 0.01
        assert back[-1].status == Status.CONVERGED and back[-1].force[2] == 2.0

    def test_the_force_of_refused_poses_fades(self, service):
        self.drive(service, [0.0, 0.003])
        replies = [ask(service, packet(2 + k, math.nan), now=1e-3 * (2 + k)) for k in range(200)]
        assert {reply.status for reply in replies} == {Status.REFUSED}
        assert replies[0].force[2] == 3.0 and replies[-1].force[2] == 0.0


class TestSession:
    def test_the_session_number_identifies_a_client_on_another_port(self, service):
        assert ask(service, packet(0, session=77), address=A).session == 77
        assert ask(service, packet(1, session=78), address=A).status == Status.BUSY
        assert ask(service, packet(2, session=77), address=B).status == Status.CONVERGED
        assert service.owner_address == B and service.counters.clients == 1

    def test_a_stated_number_is_the_only_one_that_is_heard(self):
        service = StepService(RecordingTissue(), session=7)
        assert ask(service, packet(0)).status == ask(service, packet(0, session=8)).status == Status.BUSY
        assert service.owner_address is None and ask(service, packet(0, session=7)).status == Status.CONVERGED
        assert ask(service, packet(1, kind=RequestKind.GOODBYE, session=8)).status == Status.BUSY
        assert service.owner_address == A


@given(st.lists(st.tuples(st.sampled_from(["step", "from A", "from B", "noise", "wait", "bye"]), st.integers(0, 30))))
def test_each_packet_is_counted_once(events):
    """Each received packet is stepped, skipped, stale, turned away, malformed or a goodbye."""
    service, now, received, goodbyes = StepService(RecordingTissue(), silence=1.0), 0.0, 0, 0
    for event, sequence in events:
        if event == "step":
            service.step(now)
            service.restart_owner_silence_timer(now)
        elif event == "wait":
            now += sequence / 10
        else:
            special = {"noise": b"noise", "bye": packet(sequence, kind=RequestKind.GOODBYE)}
            one = special.get(event, packet(sequence, 0.0))
            immediate = service.receive(one, B if event == "from B" else A, now)
            received += 1
            goodbyes += immediate is not None and decode_reply(immediate).status == Status.RELEASED
    service.step(now)
    counters = service.counters
    assert counters.steps == len(service.tissue.steps)
    assert received == (counters.steps + counters.skipped + counters.stale + counters.turned_away + counters.malformed
                        + goodbyes)


@given(st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=30))
def test_answered_sequence_numbers_increase(sequences):
    service, answered, clock = StepService(RecordingTissue(), silence=math.inf), [], count()
    for sequence in sequences:
        reply = ask(service, packet(sequence, float(next(clock))))
        answered += [] if reply is None else [reply.sequence]
    assert answered == sorted(set(answered)) and answered[0] == sequences[0] and answered[-1] == max(sequences)
