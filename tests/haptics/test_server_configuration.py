"""Configuration port of a tissue server: lines of JSON over TCP on real sockets."""

import json
import selectors
import socket
import threading
from dataclasses import dataclass

import numpy as np
import pytest

from haptics.server.client import TissueClient
from haptics.server.commands import CONNECTION_LIMITS, ConfigurationPort
from haptics.server.server import TissueServer
from tissue_sim.errors import InputError
from tissue_sim.tool_force import ForceStatus, ToolForce

DESCRIPTION = {"scene": "needle_indentation", "mesh": {"elements": np.int64(80)}}


@dataclass
class Cap:
    """Outline of a surface with four points."""

    outline: np.ndarray

    def triangles(self, segments):
        angle = 2 * np.pi * np.arange(segments) / segments
        vertices = np.concatenate([[(r * np.cos(a), r * np.sin(a), z) for a in angle] for r, z in self.outline])
        return vertices, np.arange(3 * segments).reshape(-1, 3)


class SettableTissue:
    """Spring with a settable stiffness, whose force depends on the largest depth so far."""

    def __init__(self):
        self.stiffness, self.deepest, self.threads = 1e3, 0.0, set()

    def step(self, pose, dt):
        self.threads.add(threading.get_ident())
        self.deepest = max(self.deepest, pose.depth)
        return ToolForce.from_axial_force(self.stiffness * self.deepest, self.stiffness, ForceStatus.CONVERGED)

    def reset(self):
        self.threads.add(threading.get_ident())
        self.deepest = 0.0

    def set_parameters(self, C10):
        if C10 <= 0:
            raise InputError(f"{C10:g} is not positive", field="C10")
        self.stiffness = C10

    def save(self):
        return self.deepest

    def restore(self, state):
        self.deepest = state

    def surface(self):
        return Cap(np.array([[0.0, -self.deepest], [0.01, -0.001], [0.04, 0.0], [0.04, -0.07]]))


class Line:
    """One connection to the configuration port."""

    def __init__(self, server):
        self.socket = socket.create_connection(server.configuration_address, timeout=60.0)
        self.file = self.socket.makefile("rb")

    def ask(self, command, **more):
        self.socket.sendall(json.dumps({"command": command, **more}).encode() + b"\n")
        return self.answer()

    def send(self, content):
        self.socket.sendall(content)

    def answer(self):
        return json.loads(self.file.readline())

    def close(self):
        self.file.close()
        self.socket.close()


@pytest.fixture
def server():
    with TissueServer(SettableTissue(), releases=False, configuration_port=0, description=DESCRIPTION,
                      parameters={"C10": 1e3}) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        yield server
        server.stop()
        thread.join(300.0)
        assert not thread.is_alive()


@pytest.fixture
def line(server):
    line = Line(server)
    yield line
    line.close()


@pytest.fixture
def client(server):
    with TissueClient(server.address[1], timeout=60.0) as client:
        yield client


def test_describe_returns_the_scene(line):
    answer = line.ask("describe")
    assert answer["protocol"] == {"version": 3, "request_bytes": 96, "reply_bytes": 760}
    assert "z out of the tissue" in answer["frame"]
    assert answer["scene"] == "needle_indentation" and answer["mesh"] == {"elements": 80}
    assert answer["parameters"] == {"C10": 1e3} and "surface" in answer["commands"]


def test_parameters_are_set_between_steps(line, client):
    assert client.step(0.002).force[2] == 2.0
    assert line.ask("set_parameters", parameters={"C10": 3000}) == {"command": "set_parameters",
                                                                    "parameters": {"C10": 3000.0}}
    assert client.step(0.002).force[2] == 6.0
    assert line.ask("describe")["parameters"] == {"C10": 3000.0}


def test_reset_restarts_the_time_step(line, client):
    client.step(0.004, at=5.0)
    assert client.step(0.001, at=6.0).force[2] == 4.0
    assert line.ask("reset") == {"command": "reset"}
    reply = client.step(0.001, at=7.0)
    assert reply.force[2] == 1.0 and reply.dt == 0.0


def test_saved_states_are_restored(line, client):
    client.step(0.003, at=1.0)
    assert line.ask("save", name="deep")["states"] == ["deep"]
    line.ask("set_parameters", parameters={"C10": 10.0})
    client.step(0.009, at=2.0)
    assert line.ask("restore", name="deep")["parameters"] == {"C10": 1e3}
    reply = client.step(0.0, at=3.0)
    assert reply.force[2] == 3.0 and reply.dt == 0.0
    assert line.ask("restore", name="dep")["error"] == "name: unknown state 'dep'; did you mean 'deep'?"
    for number in range(15):
        line.ask("save", name=str(number))
    assert "at most 16 states can be saved" in line.ask("save", name="one more")["error"]
    assert len(line.ask("save", name="deep")["states"]) == 16, "an existing name may be used again"


def test_surface_returns_the_outline_and_on_request_a_mesh(line, client):
    client.step(0.005)
    answer = line.ask("surface")
    assert answer == {"command": "surface", "outline": [[0.0, -0.005], [0.01, -0.001], [0.04, 0.0], [0.04, -0.07]]}
    answer = line.ask("surface", segments=200)
    vertices, triangles = SettableTissue().surface().triangles(200)
    assert np.array(answer["vertices"]).shape == vertices.shape == (800, 3)
    np.testing.assert_array_equal(np.array(answer["vertices"])[200:], vertices[200:])
    np.testing.assert_array_equal(answer["triangles"], triangles)
    assert "segments" in line.ask("surface", segments=2)["error"]
    assert "segments" in line.ask("surface", segments=10**9)["error"]


def test_statistics_returns_the_counters(line, client):
    client.step(0.001)
    answer = line.ask("statistics")
    assert answer["steps"] == answer["converged"] == answer["clients"] == 1 and answer["malformed"] == 0
    assert answer["owner"] == f"127.0.0.1:{client._socket.getsockname()[1]}"
    client.close()
    assert line.ask("statistics")["owner"] is None


@pytest.mark.parametrize(("content", "expected"), [
    (b"hello", "must be JSON"),
    (b'{"command": "describe"', "must be JSON"),
    (b"\xff\xfe", "must be JSON"),
    (b"[" * 20000, "must be JSON"),
    (b"[]", "command: the command must be one of describe, "),
    (b'{"command": 3}', "; got none"),
    (b'{"command": "descibe"}', "command: unknown command 'descibe'; did you mean 'describe'?"),
    (b'{"command": "surface", "segment": 8}', "segment: unknown key; did you mean 'segments'?"),
    (b'{"command": "reset", "hard": true}', "hard: unknown key"),
    (b'{"command": "set_parameters"}', "parameters: is missing"),
    (b'{"command": "set_parameters", "parameters": {"C1": 5}}',
     "parameters.C1: unknown parameter; did you mean 'C10'?"),
    (b'{"command": "set_parameters", "parameters": {"C10": "soft"}}', "parameters"),
    (b'{"command": "set_parameters", "parameters": {"self": 1}}', "parameters.self: unknown parameter"),
    (b'{"command": "set_parameters", "parameters": {"C10": -1}}', "C10: -1 is not positive"),
    (b'{"command": "set_parameters", "parameters": {"C10": 1e999}}', ""),
    (b'{"command": "save", "name": ""}', "name"),
    (b'{"command": "restore", "name": "x"}', "name: unknown state 'x'; no state was saved"),
    (b"x" * (CONNECTION_LIMITS.longest_line + 1), f"a line must have at most {CONNECTION_LIMITS.longest_line} bytes"),
    (b"x" * 1_000_000, f"a line must have at most {CONNECTION_LIMITS.longest_line} bytes"),
], ids=lambda content: content[:40] if isinstance(content, bytes) else "")
def test_an_invalid_line_is_answered_and_the_connection_stays_open(line, content, expected):
    line.send(content + b"\n")
    answer = line.answer()
    assert list(answer) == ["error"] and expected in answer["error"] and len(answer["error"]) < 500
    assert line.ask("describe")["parameters"] == {"C10": 1e3}


def test_a_tissue_without_a_method_gives_an_error():
    class Plain:
        def step(self, pose, dt):
            return ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)

        def reset(self):
            pass

    with TissueServer(Plain(), configuration_port=0) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        line = Line(server)
        assert line.ask("surface")["error"].startswith("command: this tissue does not support 'surface'")
        assert "no parameters to set" in line.ask("set_parameters", parameters={"C10": 1.0})["error"]
        line.close()
        server.stop()
        thread.join(300.0)


def test_lines_may_arrive_in_pieces_or_together(line):
    for piece in (b'{"comm', b'and": "statis', b'tics"}\r\n\n  \n{"command": "reset"}\n{"command": "describe"}\n{"com'):
        line.send(piece)
    assert [line.answer()["command"] for _ in range(3)] == ["statistics", "reset", "describe"]
    line.send(b'mand": "reset"}\n')
    assert line.answer() == {"command": "reset"}


def test_web_page_is_shown_the_door_before_its_body(server, line, client):
    client.step(0.004)
    line.send(b'POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n{"command": "reset"}\n')
    assert line.file.read() == b""
    assert client.step(0.0).force[2] == 4.0, "the reset in the body must not be executed"


def test_client_that_does_not_read_stops_nobody(server, line, client):
    """200 unread answers do not delay the steps."""
    line.socket.setblocking(False)
    request = b'{"command": "surface", "segments": 256}\n' * 200
    line.socket.send(request)
    for _ in range(200):
        assert client.step(0.001).status == 0
    other = Line(server)
    assert other.ask("describe")["scene"] == "needle_indentation"
    other.close()


def test_a_client_that_disconnects_during_an_answer_does_not_disturb_others(server, client):
    for _ in range(20):
        connection = Line(server)
        connection.send(b'{"command": "surface", "segments": 256}\n' * 3)
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        connection.close()
    for _ in range(50):
        assert client.step(0.001).status == 0


def test_only_the_thread_of_the_server_uses_the_tissue(server, line, client):
    for _ in range(5):
        client.step(0.001)
        line.ask("reset")
    assert len(server._service.tissue.threads) == 1 and threading.get_ident() not in server._service.tissue.threads


class Port:
    """`ConfigurationPort` that the test works by hand, with a simulated clock."""

    def __init__(self):
        self.selector, self.now = selectors.DefaultSelector(), 0.0
        listener = socket.create_server(("127.0.0.1", 0))
        self.address = listener.getsockname()
        self.port = ConfigurationPort(listener, lambda line: iter([line.upper() + b"\n"]), self.selector)

    def connect(self):
        peer = socket.create_connection(self.address, timeout=60.0)
        self.turn()
        return peer

    def turn(self):
        while events := self.selector.select(0.05):
            for key, _ in events:
                if key.fileobj.fileno() >= 0:
                    key.data(self.now)

    def closed(self, peer):
        self.turn()
        peer.settimeout(0.05)
        try:
            return peer.recv(1) == b""
        except TimeoutError:
            return False


@pytest.fixture
def port():
    port = Port()
    yield port
    port.port.close()
    port.selector.close()


def test_stalled_and_idle_connections_are_closed(port):
    unfinished, idle = port.connect(), port.connect()
    unfinished.sendall(b"half a li")
    port.turn()
    port.port.close_stalled_and_idle_connections(CONNECTION_LIMITS.stalled)
    assert not port.closed(unfinished) and not port.closed(idle)
    port.port.close_stalled_and_idle_connections(CONNECTION_LIMITS.stalled + 0.1)
    assert port.closed(unfinished) and not port.closed(idle)
    port.port.close_stalled_and_idle_connections(CONNECTION_LIMITS.idle + 0.1)
    assert port.closed(idle)
    unfinished.close()
    idle.close()


def test_a_new_connection_replaces_the_one_idle_for_longest(port):
    peers = []
    for number in range(CONNECTION_LIMITS.most_connections):
        port.now = float(number)
        peers.append(port.connect())
    port.now = 20.0
    peers[0].sendall(b"alive\n")
    port.turn()
    assert peers[0].recv(10) == b"ALIVE\n"
    peers.append(port.connect())
    assert port.closed(peers[1]) and not any(port.closed(peers[k]) for k in (0, 2, CONNECTION_LIMITS.most_connections))
    for peer in peers:
        peer.close()


def test_a_command_that_fails_costs_no_server(server, line, client, capfd):
    def fail(**values):
        raise ZeroDivisionError("in the tissue")

    server._service.tissue.set_parameters = fail
    answer = line.ask("set_parameters", parameters={"C10": 2e3})
    assert answer == {"error": "the command failed (ZeroDivisionError); see the log of the server for the reason"}
    assert "a command failed (ZeroDivisionError: in the tissue)" in capfd.readouterr().err
    assert line.ask("describe")["parameters"] == {"C10": 1e3} and client.step(0.001).status == 0


@pytest.mark.parametrize("noise", [b'{"command": "\xed\xa0\x80"}', b'"\xfe"', b'{"\xff": 1}', b"\xff\xfe", b"{" * 3000])
def test_bytes_that_are_no_text_are_answered(line, client, noise):
    line.send(noise + b"\n")
    assert "must be JSON" in line.answer()["error"]
    assert line.ask("describe")["scene"] == "needle_indentation"
