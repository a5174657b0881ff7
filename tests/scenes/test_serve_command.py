"""`tissue-sim serve`: a line when ready, forces and configuration while running, counters at the end."""

import json
import math
import re
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from haptics.server.client import TissueClient
from haptics.server.wire import Status
from scenes.cli import main
from scenes.commands.serve import make_served_scene_json_object

SIZES = ["--radius-mm", "40", "--height-mm", "70"]


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    path = tmp_path_factory.mktemp("material") / "m.material.json"
    assert main(["material", "new", "--law", "reduced_polynomial_2", "--set", "C10=1404.9", "--set", "C20=699.4",
                 "--bulk-ratio", "10000", "-o", str(path)]) == 0
    return str(path)


@contextmanager
def serving(root, material, *words):
    """Run the command in a separate process; yield the process and its first line."""
    process = subprocess.Popen([sys.executable, "-m", "scenes.cli", "serve", "--material", material, "--port", "0",
                                "--budget-us", "0", *SIZES, *words], cwd=root, text=True, encoding="utf-8",
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        yield process, process.stdout.readline()
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def served(root, material):
    """Ports of a running server; with JSON its counters go to stderr at the end."""
    with serving(root, material, "--json") as (process, line):
        answer = json.loads(line)
        assert set(answer) == {"host", "port", "configuration_port", "real_time"}
        yield answer
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=600)
        assert process.returncode == 0 and out == ""
        assert re.search(r"answered \d+ poses of \d+ clients", err)


@pytest.fixture
def ask(served):
    """Function that sends a configuration command and returns the answer."""
    with socket.create_connection((served["host"], served["configuration_port"]), timeout=600) as peer:
        lines = peer.makefile("rb")

        def ask(command, **more):
            peer.sendall(json.dumps({"command": command, **more}).encode() + b"\n")
            return json.loads(lines.readline())

        yield ask
        lines.close()


@pytest.fixture
def client(served):
    with TissueClient(served["port"], timeout=600) as client:
        yield client


def advance(client, depth):
    """Move from rest to a depth at 2.5 mm/s, where inertia is negligible; return the last reply."""
    for k in range(round(depth / 5e-5) + 1):
        reply = client.step(5e-5 * k, at=0.02 * k, reset=k == 0)
        assert reply.status == Status.CONVERGED and reply.age == 0.0 and not reply.flags
    return reply


@pytest.mark.slow
def test_force_agrees_with_the_reference_curve(client, reference):
    """Bonded punch at 2 mm: within 1 % of an independent solver."""
    displacement, force = np.loadtxt(reference / "punch_bonded_face_side_wall_RP.csv", delimiter=",", unpack=True)
    reply = advance(client, 0.002)
    assert reply.force[2] == pytest.approx(np.interp(2.0, displacement, force), rel=0.01)
    assert reply.force[:2] == (0.0, 0.0) and reply.iterations > 0
    slope = (advance(client, 0.00205).force[2] - advance(client, 0.00195).force[2]) / 1e-4
    assert reply.stiffness[2][2] == pytest.approx(slope, rel=0.01)


@pytest.mark.slow
def test_fast_tool_has_inertial_force(client):
    client.step(0.0, at=0.0, reset=True)
    assert client.step(0.0001, at=0.001).flags == 1


def test_describe_returns_the_scene(ask):
    answer = ask("describe")
    assert answer["scene"] == "needle_indentation" and answer["protocol"]["version"] == 3
    assert answer["tool"]["shape"] == "flat" and answer["tool"]["radius"] == 0.008
    assert answer["specimen"]["radius"] == 0.04 and answer["specimen"]["height"] == 0.07
    assert answer["interfaces"]["friction"] == "bonded"
    assert answer["material"]["law"] == "reduced_polynomial_2" and answer["material"]["mu0_Pa"] == pytest.approx(2809.8)
    assert answer["parameters"] == {"C10": 1404.9, "C20": 699.4, "bulk.bulk_ratio": 1e4}
    assert answer["mesh"]["elements"] > 10
    assert answer["box"] is None
    assert answer["first_touch"] == {"position": [0.0, 0.0, 0.0], "orientation": [1.0, 0.0, 0.0, 0.0],
                                     "way": [0.0, 0.0, -1.0]}


def test_describe_returns_box_and_error_of_a_reduced_model():
    """The answer also contains the direction of a tilted tool, as docs/wire_protocol.md defines it."""
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(3e-3, points=2), tool=ts.Tool("flat", radius=8e-3),
        friction="bonded", approach=ts.Approach(15e-3, math.radians(10.0)))
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))
    reduced = SimpleNamespace(box=ts.PoseBox(2e-3, 3e-3, 0.1), report={"force_rms_error": 0.007})
    arguments = SimpleNamespace(scene="needle_indentation", material=None, inertia="auto", largest_force_N=100.0,
                                solver="reduced")
    simulator = SimpleNamespace(mesh=None, resolution="own mesh", force_error=None, budget=None)
    answer = make_served_scene_json_object(arguments, experiment, ts.MaterialFile.of(material), simulator, reduced)
    assert answer["box"] == {"sideways": 2e-3, "depth": 3e-3, "turn": 0.1} and answer["force_error"] == 0.007
    touch = answer["first_touch"]
    assert touch["position"] == pytest.approx((0.015, 0.0, 0.0), abs=1e-12)
    assert touch["orientation"] == pytest.approx((0.99619, 0.0, -0.08716, 0.0), abs=1e-5)
    assert touch["way"] == pytest.approx((0.17365, 0.0, -0.98481), abs=1e-5)


def test_parameters_are_set_without_a_restart(ask, client):
    soft = advance(client, 0.001).force[2]
    assert ask("set_parameters", parameters={"C10": 2809.8, "C20": 1398.8})["parameters"]["C10"] == 2809.8
    hard = advance(client, 0.001).force[2]
    assert ask("set_parameters", parameters={"C10": 1404.9, "C20": 699.4})["parameters"]["C10"] == 1404.9
    assert hard == pytest.approx(2 * soft, rel=1e-4), "K follows mu0"
    assert "did you mean 'C10'?" in ask("set_parameters", parameters={"C1": 3.0})["error"]


def test_poses_beyond_the_scene_are_refused(ask, client):
    """Poses that once ended the process, or gave 180 kN."""
    assert ask("describe")["limits"] == {"deepest": pytest.approx(0.063), "force": 100.0}
    force = advance(client, 0.002).force[2]
    for k, depth in enumerate((-1e300, 1e300, -1e300, 0.071, 1e3, 0.064)):
        assert client.step(depth, at=5.0 + k).status == Status.REFUSED
    assert client.step(0.002, at=1e300).status == Status.REFUSED
    assert "must be at most 1e+09 Pa" in ask("set_parameters", parameters={"C10": 1e41})["error"]
    reply = client.step(0.002, at=5.0)
    while reply.status == Status.RETURNING:
        reply = client.step(0.002, at=5.0)
    assert reply.status == Status.CONVERGED and reply.force[2] == pytest.approx(force, rel=0.01)


def test_surface_follows_the_tool(ask, client):
    advance(client, 0.003)
    outline = np.array(ask("surface")["outline"])
    assert outline[0] == pytest.approx([0.0, -0.003], abs=1e-5), "the tissue is bonded to the tool's face"
    assert outline[:, 0].max() == pytest.approx(0.04, abs=1e-3) and outline[:, 1].min() == pytest.approx(-0.07)
    answer = ask("surface", segments=24)
    vertices, triangles = np.array(answer["vertices"]), np.array(answer["triangles"])
    assert vertices.shape[1] == triangles.shape[1] == 3 and 0 <= triangles.min() <= triangles.max() < len(vertices)
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() == pytest.approx(outline[:, 0].max())


def test_saved_states_restore_their_force(ask, client):
    force = advance(client, 0.002).force[2]
    assert "at 2 mm" in ask("save", name="at 2 mm")["states"]
    advance(client, 0.0)
    assert "error" not in ask("restore", name="at 2 mm")
    reply = client.step(0.002, at=9.0)
    # The force must not jump when the tool is placed inside the tissue.
    assert reply.status == Status.RETURNING and reply.force[2] == 0.0
    while reply.status == Status.RETURNING:
        reply = client.step(0.002, at=9.0)
    assert reply.force[2] == pytest.approx(force, rel=1e-5)


@pytest.mark.slow
def test_ctrl_c_ends_with_counters(root, material):
    with serving(root, material, "--configuration-port", "0") as (process, line):
        assert line.startswith("serving needle_indentation on 127.0.0.1:") and line.endswith("Ctrl-C stops\n")
        port = int(line.split(" (UDP)")[0].rpartition(":")[2])
        with TissueClient(port, timeout=600) as client:
            client.step(0.0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=600)
    assert process.returncode == 0 and err == ""
    assert "answered 1 poses of 1 clients" in out and "0 malformed" in out


@pytest.mark.parametrize(("words", "expected"), [
    (["--port", "70000"], "must be at most 65535; got '70000'"),
    (["--host", "0.0.0.0"], "host: the host must be a loopback address"),
    (["--scene", "needle"], "unknown scene 'needle'"),
    (["--largest-force-N", "1e6"], "--largest-force-N: must be at most 100 N; got 1e+06 N"),
    (["--session", "0"], "must be a whole number of at least 1; got '0'"),
    (["--spin-us", "-1"], "must be zero or a positive number; got '-1'"),
    (["--tilt-mm", "0.3"], "--tilt-mm: corrects whole force curves and is not available in real time"),
    (["--slip", "0.0001"], "--slip: corrects whole force curves and is not available in real time"),
])
def test_bad_input_is_one_sentence(material, capsys, words, expected):
    capsys.readouterr()
    assert main(["serve", "--material", material, "--port", "0", *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and expected in err


def test_taken_port_is_one_sentence(material, capsys):
    capsys.readouterr()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = str(taken.getsockname()[1])
        assert main(["serve", "--material", material, "--port", port]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and f"127.0.0.1:{port} cannot be used" in err
