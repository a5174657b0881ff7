"""The clients in C and C# against servers: forces, restart, time-outs, versions, a second client, frames."""

import math
import random
import socket
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from client_drivers import PARAMETERS, Driver, build_driver, from_hex, to_hex

from haptics.server.client import TissueClient
from haptics.server.server import TissueServer
from haptics.server.wire import Reply, Status, decode_request_without_pose_check, encode_reply
from tissue_sim.errors import InputError
from tissue_sim.tool_force import ForceStatus, ToolForce

BUSY = "another client owns the tissue; try again after its goodbye or its silence"
NO_SERVER = "nothing listens on that port; start tissue-sim serve"


class Spring:
    """Spring of 800 N/m, as in the documentation."""

    def step(self, pose, dt):
        return ToolForce.from_axial_force(800.0 * pose.depth, 800.0, ForceStatus.CONVERGED)

    def reset(self):
        pass


@contextmanager
def serving(port=0, tissue=None, **options):
    with TissueServer(tissue or Spring(), port=port, configuration_port=None, **options) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            yield server.address[1]
        finally:
            server.stop()
            thread.join(300.0)
            assert not thread.is_alive()


@pytest.fixture(scope="module", params=PARAMETERS)
def command(request, root, tmp_path_factory):
    return build_driver(root, request.param, tmp_path_factory.mktemp(request.param))


@pytest.fixture
def driver(command):
    with Driver(command) as driver:
        yield driver


def force(words):
    """Status, whether it is the first step, and axial force of an answer."""
    assert words[0] == "ok", words
    return int(words[1]), words[2] == "1", from_hex(words[5])


def sentence(words):
    return words[0], " ".join(words[1:])


def test_forces_are_those_of_the_python_client(driver):
    path = [(0.001 * k + 1e-4 * math.sin(k), 0.003 * math.sin(0.05 * k) ** 2) for k in range(100)]
    with serving() as port, TissueClient(port, timeout=60.0) as client:
        expected = [client.step(depth, at=time) for time, depth in path]
        client.close()
        driver.open(port)
        for (time, depth), reply in zip(path, expected, strict=True):
            words = driver.step(time, depth)
            assert force(words) == (reply.status, time == path[0][0], reply.force[2])
            assert from_hex(words[6]) == reply.dt
        assert driver.ask("close") == ["ok"]
        # The goodbye has released the tissue.
        with TissueClient(port, timeout=60.0) as again:
            assert again.step(0.0).status == Status.CONVERGED


def test_client_reaches_the_server_with_its_first_step_after_a_restart(driver):
    """No wait: the first step after the port is open again has a force, and states that the tissue is a new one."""
    with serving() as port:
        driver.open(port)
        assert force(driver.step(0.0, 0.0)) == (ForceStatus.CONVERGED, True, 0.0)
        assert force(driver.step(0.001, 0.002)) == (ForceStatus.CONVERGED, False, 1.6)
    for time in (0.002, 0.003):
        assert sentence(driver.step(time, 0.002)) == ("no_server", NO_SERVER)
    with serving(port):
        assert force(driver.step(0.004, 0.0)) == (ForceStatus.CONVERGED, True, 0.0)
        assert force(driver.step(0.005, 0.002)) == (ForceStatus.CONVERGED, False, 1.6)
        driver.ask("close")


def test_restart_is_stated_when_the_first_reply_is_late(driver):
    """The reply to step 1 arrives after its time-out, during step 2; a server that starts makes no time step."""
    late = []

    def replies(request):
        if request.time == 1.0:
            late.append(reply_to(request, 1.0, dt=0.0))
            return []
        return [*late, reply_to(request, 7.0, dt=0.5)]

    with answering(replies) as port:
        driver.open(port, timeout=0.05)
        assert driver.step(1.0, 0.001)[0] == "no_reply"
        # A busy machine may need longer than the time-out for an answer.
        answers = [words for words in (driver.step(2.0 + 0.5 * k, 0.001) for k in range(100)) if words[0] == "ok"]
        assert [force(words)[1] for words in answers] == [True] + [False] * (len(answers) - 1)
        assert len(answers) > 1
        driver.ask("close")


def test_connect_waits_until_the_server_starts(driver):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    driver.open(port)
    assert sentence(driver.ask("connect", to_hex(0.0))) == ("no_server", NO_SERVER)
    driver.send("connect", to_hex(600.0))
    with serving(port):
        assert driver.receive() == ["ok"]
        assert force(driver.step(0.0, 0.001))[1]
        driver.ask("close")


def test_python_client_reaches_the_server_after_a_restart():
    with serving() as port:
        client = TissueClient(port, timeout=60.0)
        assert client.step(0.0, at=0.0).status == Status.CONVERGED
    with pytest.raises(ConnectionRefusedError):
        client.step(0.001, at=0.001)
    with serving(port):
        reply = client.step(0.0, at=0.002)
        assert (reply.status, reply.dt) == (Status.CONVERGED, 0.0)
        client.close()


def test_second_client_gets_a_sentence_and_the_tissue_after_the_goodbye(command):
    with serving() as port, Driver(command) as first, Driver(command) as second:
        first.open(port)
        second.open(port)
        assert second.ask("connect", to_hex(0.0)) == ["ok"]  # the tissue is free; asking does not take it
        assert force(first.step(0.0, 0.0))[0] == ForceStatus.CONVERGED
        assert sentence(second.ask("connect", to_hex(0.0))) == ("busy", BUSY)
        assert sentence(second.step(0.0, 0.001)) == ("busy", BUSY)
        # The first client does not notice the second one.
        assert force(first.step(0.001, 0.002)) == (ForceStatus.CONVERGED, False, 1.6)
        first.ask("close")
        assert force(second.step(0.001, 0.0)) == (ForceStatus.CONVERGED, True, 0.0)
        second.ask("close")


@contextmanager
def answering(make_packets):
    """A server of one thread that answers each request by the packets of a function of the request."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def answer():
            while True:
                packet, address = server.recvfrom(200)
                if packet == b"end":
                    return
                for reply in make_packets(decode_request_without_pose_check(packet)):
                    server.sendto(reply, address)

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
                end.sendto(b"end", server.getsockname())
            thread.join(300.0)
            assert not thread.is_alive()


def reply_to(request, axial_force, status=0, **changes):
    return encode_reply(Reply(status, request.sequence, request.time, request.session, (0.0, 0.0, axial_force),
                              version=request.version)._replace(**changes))


@pytest.mark.parametrize(("own", "other"), [(3, 4), (3, 2), (2, 3), (3, 1)])
def test_another_version_is_refused_by_a_sentence_with_both(driver, own, other):
    def reply(request):
        packet = bytearray(reply_to(request, 7.0, Status.OTHER_VERSION, version=2 if other == 2 else 3))
        packet[4] = other
        return [bytes(packet)]

    expected = ("other_version", f"the server uses protocol version {other}, this client version {own}; install the "
                "same tissue_sim on both sides")
    with answering(reply) as port:
        driver.open(port, version=own)
        assert sentence(driver.ask("connect", to_hex(60.0))) == expected
        assert sentence(driver.step(0.0, 0.001)) == expected
        driver.ask("close")
        if own == 3:
            with TissueClient(port, timeout=60.0) as client, \
                    pytest.raises(InputError, match=f"version {other}, this client version 3"):
                client.step(0.001)


def test_late_and_foreign_packets_are_passed_over(driver):
    """Noise, the late reply to the step before, and replies to another session come first."""
    def replies(request):
        return [b"noise", b"", reply_to(request, -1.0, sequence=request.sequence - 1 & 2**64 - 1),
                reply_to(request, -2.0, session=request.session ^ 2), reply_to(request, 7.0)[:-1],
                reply_to(request, 7.0)]

    with answering(replies) as port:
        driver.open(port)
        assert [force(driver.step(0.001 * k, 0.001))[2] for k in range(3)] == [7.0] * 3
        driver.ask("close")


def test_no_reply_ends_with_the_time_out_and_the_next_step_is_answered(driver):
    def replies(request):
        return [] if request.time == 1.0 else [reply_to(request, request.time)]

    with answering(replies) as port:
        driver.open(port, timeout=0.05)
        assert sentence(driver.step(1.0, 0.001))[0] == "no_reply"
        # A busy machine may need longer than the time-out for an answer.
        assert "ok" in [driver.step(2.0, 0.001)[0] for _ in range(100)]
        driver.ask("close")


@pytest.mark.parametrize(("time", "position", "quaternion"), [
    (math.nan, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), (math.inf, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    (0.0, (0.0, math.nan, 0.0), (1.0, 0.0, 0.0, 0.0)), (0.0, (0.0, 0.0, -math.inf), (1.0, 0.0, 0.0, 0.0)),
    (0.0, (0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)), (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    (0.0, (0.0, 0.0, 0.0), (1.0, 0.1, 0.0, 0.0))])
def test_invalid_pose_is_not_sent(driver, time, position, quaternion):
    requests = []

    def record(request):
        requests.append(request)
        return [reply_to(request, 7.0)]

    with answering(record) as port:
        driver.open(port)
        words = driver.ask("step", to_hex(time, *position, *quaternion), 0)
        assert sentence(words) == ("bad_pose", "time and pose must be finite, and the orientation a unit quaternion")
        assert not requests
        driver.ask("close")


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1001.0, 1e200])
def test_invalid_force_is_not_returned(driver, wrong):
    with answering(lambda request: [reply_to(request, wrong if request.time == 1.0 else 7.0)]) as port:
        driver.open(port)
        assert driver.step(0.0, 0.001)[0] == "ok"
        assert driver.step(1.0, 0.001)[0] == "bad_reply"
        assert driver.ask("largest", to_hex(6.0)) == ["ok"]
        assert driver.step(2.0, 0.001)[0] == "bad_reply"
        assert driver.ask("largest", to_hex(8.0)) == ["ok"]
        assert driver.step(3.0, 0.001)[0] == "ok"
        driver.ask("close")


def test_first_step_is_stated_after_a_reply_with_an_invalid_force(driver):
    """The first reply of the server has no finite force; the next answer states the first step."""
    with answering(lambda request: [reply_to(request, math.nan if request.time == 1.0 else 7.0,
                                             dt=0.0 if request.time == 1.0 else 0.5)]) as port:
        driver.open(port)
        assert driver.step(1.0, 0.001)[0] == "bad_reply"
        assert force(driver.step(2.0, 0.001)) == (ForceStatus.CONVERGED, True, 7.0)
        assert force(driver.step(3.0, 0.001)) == (ForceStatus.CONVERGED, False, 7.0)
        driver.ask("close")


@pytest.mark.parametrize("case", ["late", "invalid"])
def test_answer_is_unchanged_without_a_valid_reply(driver, case):
    """A late reply to the step before arrives while this step has none; or the force of the reply is not finite."""
    def replies(request):
        if request.time < 1.0:
            return [reply_to(request, 7.0)]
        if case == "late":
            return [reply_to(request, -1.0, sequence=request.sequence - 1)]
        return [reply_to(request, math.nan)]

    with answering(replies) as port:
        driver.open(port)
        assert force(driver.step(0.0, 0.001))[2] == 7.0
        if case == "late":
            driver.ask("timeout", to_hex(0.2))
        assert driver.step(1.0, 0.001)[0] == {"late": "no_reply", "invalid": "bad_reply"}[case]
        assert [from_hex(word) for word in driver.ask("force")[1:]] == [0.0, 0.0, 7.0]
        driver.ask("close")


@pytest.mark.parametrize("timeout", [math.nan, 0.0, -1.0, math.inf])
def test_invalid_time_out_is_refused(command, driver, timeout):
    """C# refuses the assignment and keeps its value; C refuses the next step, and sends nothing."""
    requests = []

    def record(request):
        requests.append(request)
        return [reply_to(request, 7.0)]

    with answering(record) as port:
        driver.open(port)
        words = driver.ask("timeout", to_hex(timeout))
        if command[0].endswith("mono"):
            assert words[0] == "refused" and "positive and finite" in " ".join(words)
            assert force(driver.step(0.0, 0.001))[2] == 7.0
        else:
            assert sentence(driver.step(0.0, 0.001)) == (
                "other", "the address must be a numeric IPv4 address and the time-out positive")
            assert not requests
            assert driver.ask("timeout", to_hex(60.0)) == ["ok"]
        driver.ask("close")


def test_largest_force_that_is_not_a_number_accepts_no_force(driver):
    with answering(lambda request: [reply_to(request, 7.0)]) as port:
        driver.open(port)
        assert driver.ask("largest", to_hex(math.nan)) == ["ok"]
        assert driver.step(0.0, 0.001)[0] == "bad_reply"
        driver.ask("close")


#: Scene to engine: Unity exchanges y and z; Unreal changes the sign of y, and counts in cm.
UNITY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
UNREAL = np.diag([1.0, -1.0, 1.0])


def rotate(quaternion, vector):
    """Rotate by q v q*, the formula of both engines: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = quaternion[0], np.array(quaternion[1:])
    return vector + 2.0 * w * np.cross(u, vector) + 2.0 * np.cross(u, np.cross(u, vector))


def test_frames_of_engines(command, driver):
    """Rotated points, torques r x F and poses that return, for random poses."""
    reflection, length = (UNITY, 1.0) if command[0].endswith("mono") else (UNREAL, 100.0)
    generator = random.Random(5)
    for _ in range(20):
        position, arm, pull = (np.array([generator.uniform(-1, 1) for _ in range(3)]) for _ in range(3))
        orientation = np.array([generator.gauss(0, 1) for _ in range(4)])
        orientation /= np.linalg.norm(orientation)
        torque = np.cross(arm, pull)
        words = driver.ask("convert", to_hex(*position, *orientation, *pull, *torque))
        values = np.array([from_hex(word) for word in words[1:]])
        there, xyzw, force_there, torque_there, back, orientation_back = np.split(values, [3, 7, 10, 13, 16])
        assert there == pytest.approx(length * reflection @ position, abs=1e-12)
        # A point of the tool: rotated in the scene and mapped, or mapped and rotated in the engine.
        point = np.array([generator.uniform(-1, 1) for _ in range(3)])
        engine_quaternion = (xyzw[3], *xyzw[:3])
        assert rotate(engine_quaternion, reflection @ point) == pytest.approx(reflection @ rotate(orientation, point),
                                                                             abs=1e-12)
        # The unit of force is N in Unity and kg cm/s^2 in Unreal; lever arms are in m and cm.
        assert force_there == pytest.approx(length * reflection @ pull, abs=1e-12)
        assert torque_there == pytest.approx(np.cross(length * reflection @ arm, force_there), abs=1e-9)
        assert back == pytest.approx(position, abs=1e-15) and (orientation_back == orientation).all()


def test_pushing_into_tissue_that_faces_up_gives_an_upward_force(command, driver):
    """Scene z is up: y in Unity, z in Unreal; a tool turned by +90 degrees about z turns x into y of the scene."""
    half = math.sqrt(0.5)
    words = driver.ask("convert", to_hex(0.0, 0.0, -0.01, half, 0.0, 0.0, half, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0))
    values = [from_hex(word) for word in words[1:14]]
    x_axis = rotate((values[6], *values[3:6]), np.array([1.0, 0.0, 0.0]))
    if command[0].endswith("mono"):
        assert values[:3] == pytest.approx([0.0, -0.01, 0.0]) and values[7:10] == pytest.approx([0.0, 2.0, 0.0])
        assert x_axis == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)
    else:
        assert values[:3] == pytest.approx([0.0, 0.0, -1.0]) and values[7:10] == pytest.approx([0.0, 0.0, 200.0])
        assert x_axis == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)
