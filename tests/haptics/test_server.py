"""`TissueServer` on real sockets: poses, forces, ownership, and errors."""

import socket
import sys
import threading
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from haptics.server.client import TissueClient
from haptics.server.server import TissueServer
from haptics.server.wire import REPLY_SIZE, VERSION, Request, Status, decode_reply, encode_request
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce


class MaxwellTissue:
    """Spring of 1 N/mm in parallel with a Maxwell element of 0.1 s; `gate` blocks a step until it is set."""

    def __init__(self):
        self.threads, self.gate, self.entered = set(), threading.Event(), threading.Event()
        self.gate.set()
        self.reset()

    def reset(self):
        self.threads.add(threading.get_ident())
        self.viscous_force, self.depth = 0.0, 0.0

    def step(self, pose, dt):
        self.threads.add(threading.get_ident())
        self.entered.set()
        assert self.gate.wait(300.0)
        self.viscous_force = (self.viscous_force + 500.0 * (pose.depth - self.depth)) * (1.0 - dt / (0.1 + dt))
        self.depth = pose.depth
        return ToolForce.from_axial_force(1e3 * pose.depth + self.viscous_force, 1.5e3, ForceStatus.CONVERGED,
                                          depth=pose.depth)


@contextmanager
def serving(tissue, **options):
    """Run a server in a separate thread; without `releases` its forces equal those of the tissue from the first."""
    with TissueServer(tissue, **{"releases": False, **options}) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            yield server
        finally:
            server.stop()
            thread.join(300.0)
            assert not thread.is_alive()


@pytest.fixture(params=[0.0, 1e-3], ids=["sleeping", "spinning"])
def server(request):
    with serving(MaxwellTissue(), spin=request.param) as server:
        yield server


def test_forces_are_those_of_the_tissue(server):
    reference, last = MaxwellTissue(), None
    path = [(0.001 * k, 0.0002 * (k % 7)) for k in range(40)]
    with TissueClient(server.address[1], timeout=60.0) as client:
        for time, depth in path:
            reply = client.step(depth, at=time)
            expected = reference.step(Pose((0.0, 0.0, -depth)), 0.0 if last is None else time - last)
            assert reply.force == expected.force_vector and reply.stiffness == expected.stiffness_matrix
            last = time
        assert client.step(Pose((0.001, 0.002, -0.003), (0.0, 1.0, 0.0, 0.0)), at=last).status == Status.CONVERGED
        assert client.step(0.001, at=last - 5.0).status == Status.REFUSED
        assert client.step(0.001, at=0.0, reset=True).force == pytest.approx((0.0, 0.0, 1.5))
    assert server.counters.refused == 1 and server.counters.converged == len(path) + 2


def test_a_client_faster_than_the_steps_builds_no_queue(server):
    tissue = server._service.tissue
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(60.0)
        client.connect(server.address)
        tissue.gate.clear()
        client.send(encode_request(Request(0, 0.0)))
        assert tissue.entered.wait(300.0)
        for sequence in range(1, 11):
            client.send(encode_request(Request(sequence, sequence * 1e-3)))
        tissue.gate.set()
        replies = [decode_reply(client.recv(REPLY_SIZE)) for _ in range(2)]
    assert [reply.sequence for reply in replies] == [0, 10]
    assert replies[1].skipped == 9 and replies[1].dt == 0.01


def test_a_second_client_gets_busy_and_the_tissue_after_the_goodbye(server):
    port = server.address[1]
    with TissueClient(port, timeout=60.0) as second:
        with TissueClient(port, timeout=60.0) as first:
            assert first.step(0.001).status == Status.CONVERGED
            assert second.step(0.009).status == Status.BUSY
            assert first.step(0.001).turned_away == 1
        assert second.step(0.001).status == Status.CONVERGED
    assert server.counters.clients == 2


def test_a_silent_client_loses_the_tissue(monkeypatch):
    """With a simulated clock, so that the load of the computer has no effect."""
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("haptics.server.server.time", clock)
    with serving(MaxwellTissue(), silence=0.05) as server:
        first, second = (TissueClient(server.address[1], timeout=60.0) for _ in range(2))
        assert first.step(0.001).status == Status.CONVERGED
        assert second.step(0.001).status == Status.BUSY
        clock.now += 0.1
        assert second.step(0.001).status == Status.CONVERGED
        assert first.step(0.001).status == Status.BUSY
        second.close()
        first.close()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux allows a separate socket of the owner on the same port")
def test_a_flood_of_others_does_not_take_the_tissue_or_the_time(server):
    """Ten thousand packets of another client: all requests of the owner are answered, and answered first."""
    with TissueClient(server.address[1], timeout=60.0) as client, \
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flooder:
        assert client.step(0.001).status == Status.CONVERGED
        sequence = 0
        for _ in range(20):
            for _ in range(500):
                flooder.sendto(encode_request(Request(sequence, 0.0, session=5)), server.address)
                sequence += 1
            assert client.step(0.001).status == Status.CONVERGED
        # Checked before the goodbye, after which the flooding client may own the tissue.
        assert server.counters.clients == 1 and server.counters.flooded > 0


def test_a_client_that_starts_inside_the_tissue_starts_without_force():
    with serving(MaxwellTissue(), releases=True) as server, TissueClient(server.address[1], timeout=60.0) as client:
        reply = client.step(0.001)
        assert (reply.status, reply.force[2]) == (Status.RETURNING, 0.0)
        while reply.status == Status.RETURNING:
            reply = client.step(0.001)
        assert reply.status == Status.CONVERGED and reply.force[2] > 1.0


def test_a_failed_step_does_not_end_the_server(server, capfd):
    tissue = server._service.tissue
    step = tissue.step

    def fail(pose, dt):
        raise OverflowError("cannot convert float infinity to integer")

    with TissueClient(server.address[1], timeout=60.0) as client:
        client.step(0.0)
        tissue.step = fail
        assert client.step(0.0).status == Status.FAILED
        tissue.step = step
        assert client.step(0.0).status == Status.CONVERGED
    assert "a step failed (OverflowError: cannot convert" in capfd.readouterr().err


def test_noise_is_dropped_and_the_server_goes_on(server):
    with TissueClient(server.address[1], timeout=60.0) as client, \
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for noise in (b"", b"x", bytes(87), bytes(88), bytes(5000)):
            stranger.sendto(noise, server.address)
        good = encode_request(Request(1, 0.0))
        stranger.sendto(good[:-1], server.address)
        stranger.sendto(good + b"longer", server.address)
        assert client.step(0.001).malformed == 7


def test_another_version_is_answered_with_the_version_of_the_server(server):
    other_version = bytearray(encode_request(Request(3, 1.0)))
    other_version[4:6] = b"\x09\x00"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(60.0)
        client.sendto(other_version + bytes(40), server.address)
        packet = client.recv(REPLY_SIZE)
    assert packet[4:6] == bytes((VERSION, 0)) and decode_reply(packet).status == Status.OTHER_VERSION


def test_the_client_reports_another_version_of_the_server():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as future:
        future.bind(("127.0.0.1", 0))
        client = TissueClient(future.getsockname()[1], timeout=60.0)

        def answer():
            packet, address = future.recvfrom(200)
            future.sendto(b"TSRP\x04\x00" + packet[6:24], address)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(InputError, match="uses protocol version 4, this client version 3"):
            client.step(0.001)
        thread.join()
        client._socket.close()


def test_the_client_ignores_replies_after_a_timeout(server):
    tissue = server._service.tissue
    client = TissueClient(server.address[1], timeout=0.05)
    tissue.gate.clear()
    with pytest.raises(TimeoutError):
        client.step(0.001, at=0.0)
    assert tissue.entered.wait(300.0)
    tissue.gate.set()
    client._socket.settimeout(60.0)
    reply = client.step(0.002, at=0.1)
    assert reply.sequence == 1 and reply.force[2] == pytest.approx(2.5)
    client.close()


def test_datagrams_that_are_no_replies_do_not_extend_the_timeout():
    """A socket that sends damaged replies without end."""
    ended = threading.Event()

    def send_damaged_replies(damaged):
        _, address = damaged.recvfrom(1024)
        while not ended.is_set():
            damaged.sendto(b"no reply", address)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as damaged:
        damaged.bind(("127.0.0.1", 0))
        sender = threading.Thread(target=send_damaged_replies, args=(damaged,))
        sender.start()
        try:
            with TissueClient(damaged.getsockname()[1], timeout=0.2) as client, \
                    pytest.raises(TimeoutError, match=r"no reply within 0\.2 s"):
                client.step(0.001)
        finally:
            ended.set()
            sender.join(300.0)


def test_a_polling_client_waits_for_a_late_reply(server):
    tissue = server._service.tissue
    with TissueClient(server.address[1], timeout=60.0, polls=3) as client:
        tissue.gate.clear()
        threading.Timer(0.1, tissue.gate.set).start()
        assert client.step(0.001, at=0.0).force[2] == 1.5
    with TissueClient(server.address[1], timeout=60.0, polls=10**9) as client:
        assert client.step(0.001, at=0.0, reset=True).force[2] == 1.5


def test_a_client_without_a_server_raises():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    client = TissueClient(port, timeout=0.2)
    with pytest.raises(OSError):  # connection refused, or a timeout on systems that do not report refused packets
        client.step(0.001)
    client.close()


def test_only_the_thread_of_the_server_uses_the_tissue(server):
    tissue = server._service.tissue
    tissue.threads.clear()
    with TissueClient(server.address[1], timeout=60.0) as client:
        client.step(0.001, reset=True)
        client.step(0.002)
    assert len(tissue.threads) == 1 and threading.get_ident() not in tissue.threads


def test_stop_may_be_called_before_run_and_twice():
    with TissueServer(MaxwellTissue()) as server:
        server.stop()
        server.stop()
        server.run()


def test_a_used_port_is_refused():
    with (TissueServer(MaxwellTissue(), configuration_port=0) as first,
          pytest.raises(InputError, match=r"^port: 127\.0\.0\.1:\d+ cannot be used .*another port")):
        TissueServer(MaxwellTissue(), port=first.address[1])
    with (TissueServer(MaxwellTissue(), configuration_port=0) as first,
          pytest.raises(InputError, match=r"^configuration_port: 127\.0\.0\.1:\d+ cannot be used")):
        TissueServer(MaxwellTissue(), configuration_port=first.configuration_address[1])


def test_close_frees_the_ports():
    with TissueServer(MaxwellTissue(), configuration_port=0) as first:
        ports = first.address[1], first.configuration_address[1]
    with TissueServer(MaxwellTissue(), port=ports[0], configuration_port=ports[1]) as again:
        assert (again.address[1], again.configuration_address[1]) == ports


@pytest.mark.parametrize(("options", "expected"), [
    ({"host": "0.0.0.0"}, "host: the host must be a loopback address .* got 0.0.0.0. Other computers can reach"),
    ({"host": "192.168.1.7"}, "Other computers can reach this address"),
    ({"host": "nowhere"}, "host: the host must be an IP address such as 127.0.0.1; got 'nowhere'"),
    ({"host": "203.0.113.9", "expose": True}, "203.0.113.9:0 cannot be used"),
    ({"port": 65536}, "^port: the port must be 1 to 65535, or 0 for a free port; got 65536"),
    ({"configuration_port": -1}, "configuration_port: the port must be 1 to 65535, or 0 for a free port; got -1"),
])
def test_an_invalid_address_is_refused(options, expected):
    with pytest.raises(InputError, match=expected):
        TissueServer(MaxwellTissue(), **options)


def test_a_public_interface_requires_expose():
    with TissueServer(MaxwellTissue(), host="0.0.0.0", expose=True) as server:
        assert server.address[0] == "0.0.0.0"
