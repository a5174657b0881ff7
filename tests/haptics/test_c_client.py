"""The C client of docs/client: compiled without a warning, and the same forces as stepping in Python."""

import math
import shutil
import socket
import subprocess
import threading
from contextlib import contextmanager
from dataclasses import replace

import pytest

import tissue_sim as ts
from haptics.server.server import TissueServer
from haptics.server.wire import Reply, Request, decode_request_without_pose_check, encode_reply, encode_request
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

COMPILER = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
CPLUSPLUS = shutil.which("g++") or shutil.which("clang++")
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
#: Time, s, and depth, m: in at 50 mm/s, a pause, irregular motion with uneven time steps, out.
PATH = [(0.001 * k + 0.0003 * math.sin(k), 0.004 * math.sin(0.03 * k) ** 2 + 1e-4 * math.sin(0.7 * k))
        for k in range(200)]

pytestmark = pytest.mark.skipif(COMPILER is None, reason="compiles the C client and finds no C compiler on this "
                                "machine (Debian: apt-get install gcc libc6-dev)")


class Gel:
    """Stiffening, relaxing, damped: its force depends on every bit of depth and time step."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.depth, self.pull = 0.0, 0.0

    def step(self, pose, dt):
        speed = (pose.depth - self.depth) / dt if dt > 0 else 0.0
        self.pull = (self.pull + 300.0 * (pose.depth - self.depth)) * math.exp(-dt / 0.05)
        self.depth = pose.depth
        force = 800.0 * pose.depth * (1.0 + 40.0 * pose.depth) + self.pull + 0.5 * speed
        return ToolForce.from_axial_force(force, 800.0, ForceStatus.CONVERGED)


@contextmanager
def serving(tissue):
    with TissueServer(tissue) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            yield server.address[1]
        finally:
            server.stop()
            thread.join(300.0)


def compiled(root, folder, *options):
    """The example, compiled as the strictest user would."""
    program = folder / "drive_needle"
    done = subprocess.run([COMPILER, "-std=c99", "-O2", *WARNINGS, *options, "-o", str(program),
                           str(root / "docs" / "client" / "drive_needle.c")], capture_output=True, text=True,
                          encoding="utf-8")
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return program


@pytest.fixture(scope="module")
def drive_needle(root, tmp_path_factory):
    return compiled(root, tmp_path_factory.mktemp("c"))


@pytest.fixture
def path_file(tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("".join(f"{time!r} {depth!r}\n" for time, depth in PATH), encoding="utf-8")
    return path


def drive(program, *words):
    return subprocess.run([str(program), *map(str, words)], capture_output=True, text=True, encoding="utf-8",
                          timeout=600)


def forces(done):
    """Depth, force and status of each line."""
    assert done.returncode == 0, done.stderr
    return [(float(depth), float(force), int(status))
            for depth, force, status in (line.split() for line in done.stdout.splitlines())]


def stepped(tissue):
    """The same path, stepped in Python."""
    times = [time for time, _ in PATH]
    return [tissue.step(Pose((0.0, 0.0, -depth)), time - before)
            for (time, depth), before in zip(PATH, [times[0], *times], strict=False)]


def test_forces_are_those_of_stepping_in_python(drive_needle, path_file):
    expected = stepped(Gel())
    with serving(Gel()) as port:
        for _ in range(2):  # the second run begins with a reset, too
            answered = forces(drive(drive_needle, port, path_file))
            assert [depth for depth, _, _ in answered] == [depth for _, depth in PATH]
            assert [status for _, _, status in answered] == [ForceStatus.CONVERGED] * len(PATH)
            assert [force for _, force, _ in answered] == pytest.approx([one.force for one in expected], rel=1e-12)


def test_forces_of_the_simulator(drive_needle, path_file):
    """Two simulators of the study's needle: one behind the wire, one in this program; 1e-9 relative."""
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                           density=1040.0, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.05),)))
    experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(0.005, 21), tool=ts.Tool("flat", radius=0.008))
    here, served = (ts.Simulator(ts.Model(experiment, material)) for _ in range(2))
    here.warm_up()
    served.warm_up()
    expected = stepped(here)
    with serving(served) as port:
        answered = forces(drive(drive_needle, port, path_file))
    assert [status for _, _, status in answered] == [one.status for one in expected]
    assert max(one.force for one in expected) > 0.5
    assert [force for _, force, _ in answered] == pytest.approx([one.force for one in expected], rel=1e-9, abs=1e-12)


def test_plain_ramp(drive_needle):
    with serving(Gel()) as port:
        answered = forces(drive(drive_needle, port, 0.005, 10))
    assert [depth for depth, _, _ in answered] == pytest.approx([0.0005 * k for k in range(11)])


def test_what_goes_wrong_is_one_sentence(drive_needle, path_file, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as owner, serving(Gel()) as port:
        assert drive(drive_needle).returncode == 2
        done = drive(drive_needle, port, tmp_path / "missing.txt")
        assert done.returncode == 2 and "cannot read" in done.stderr
        owner.settimeout(60.0)
        owner.sendto(encode_request(Request(0, 0.0)), ("127.0.0.1", port))
        owner.recv(500)
        done = drive(drive_needle, port, path_file)
        assert done.returncode == 1 and done.stderr == "drive_needle: another client has the tissue\n"
    done = drive(drive_needle, port, path_file)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr == "drive_needle: nothing listens on that port; start tissue-sim serve\n"


def test_a_client_of_version_2_gets_the_same_forces(root, tmp_path, path_file):
    program = compiled(root, tmp_path, "-DTISSUE_SIM_VERSION=2")
    expected = stepped(Gel())
    with serving(Gel()) as port:
        answered = forces(drive(program, port, path_file))
    assert [status for _, _, status in answered] == [ForceStatus.CONVERGED] * len(PATH)
    assert [force for _, force, _ in answered] == pytest.approx([one.force for one in expected], rel=1e-12)


#: Prints the fields of one answer.
FIELDS = """#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#include "tissue_sim_client.h"
#include <stdio.h>
#include <stdlib.h>
int main(int argc, char **argv) {
    tissue_sim_client client;
    tissue_sim_pose pose = {{0.0, 0.0, -0.001}, {1.0, 0.0, 0.0, 0.0}};
    tissue_sim_answer got;
    if (argc != 2 || tissue_sim_open(&client, "127.0.0.1", (uint16_t)atoi(argv[1]), 60.0) != TISSUE_SIM_OK) return 1;
    if (tissue_sim_step(&client, 0.0, &pose, 0, &got) != TISSUE_SIM_OK) return 2;
    printf("%d %d %d %g %g %g %g\\n", got.stale_stiffness, got.is_on_axis, got.has_force_error, got.stiffness_age,
           got.has_force_error ? got.force_error : -1.0, got.error_age, got.least_tool_mass);
    tissue_sim_close(&client);
    return 0;
}
"""


class Aged(Gel):
    """Answers with an old stiffness, away from its axis."""

    error = 0.25

    def step(self, pose, dt):
        return replace(super().step(pose, dt), stiffness_age=0.5, force_error=self.error, error_age=0.125,
                       least_tool_mass=0.0625, is_on_axis=False)


class Unknown(Aged):
    error = None


@pytest.mark.parametrize(("version", "tissue", "expected"), [
    (3, Aged, "1 0 1 0.5 0.25 0.125 0.0625"), (3, Unknown, "1 0 0 0.5 -1 0.125 0.0625"), (2, Aged, "1 1 0 0 -1 0 0")])
def test_every_part_of_an_answer_has_its_age(root, tmp_path, version, tissue, expected):
    """Version 2 has the flag of a stale stiffness only."""
    source, program = tmp_path / "fields.c", tmp_path / "fields"
    source.write_text(FIELDS, encoding="utf-8")
    done = subprocess.run([COMPILER, "-std=c99", *WARNINGS, f"-DTISSUE_SIM_VERSION={version}",
                           f"-I{root / 'docs' / 'client'}", "-o", str(program), str(source)], capture_output=True,
                          text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    with serving(tissue()) as port:
        assert drive(program, port).stdout.strip() == expected


@pytest.mark.parametrize("version", [3, 4])
def test_only_the_reply_of_this_version_to_this_request_counts(drive_needle, version):
    """A server that first sends noise, the reply to an older request, and one for another session."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(60.0)

        def answer():
            for sequence in range(3 if version == 3 else 2):  # the last is the goodbye
                packet, address = server.recvfrom(200)
                request = decode_request_without_pose_check(packet)
                assert request.sequence == sequence and request.session != 0
                server.sendto(b"noise", address)
                for other in (Reply(0, sequence - 1 & 2**64 - 1, 0.0, request.session, (0.0, 0.0, -1.0)),
                              Reply(0, sequence, 0.0, request.session + 1 & 2**64 - 1, (0.0, 0.0, -2.0))):
                    server.sendto(encode_reply(other), address)
                reply = bytearray(encode_reply(Reply(0, sequence, 0.0, request.session, (0.0, 0.0, 7.0))))
                reply[4] = version
                server.sendto(reply, address)

        thread = threading.Thread(target=answer)
        thread.start()
        done = drive(drive_needle, server.getsockname()[1], 0.001, 1)
        thread.join(60.0)
        assert not thread.is_alive()
    if version == 3:
        assert [force for _, force, _ in forces(done)] == [7.0, 7.0]
    else:
        assert done.returncode == 1
        assert done.stderr == "drive_needle: the server speaks another version of the protocol\n"


def test_refused_pose_reaches_the_program(drive_needle, tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("0.0 0.00005\n0.1 nan\n-5.0 0.00005\n0.15 1e300\n0.2 0.002\n", encoding="utf-8")
    with serving(Gel()) as port:
        answered = forces(drive(drive_needle, port, path))
    assert [status for _, _, status in answered] == [0, 3, 3, 3, 0]
    assert answered[1][1] == answered[2][1] == answered[3][1] == answered[0][1]


@pytest.mark.skipif(CPLUSPLUS is None, reason="compiles the C client's header as C++ and finds no C++ compiler on this "
                    "machine (Debian: apt-get install g++)")
def test_header_is_also_cplusplus(root, tmp_path):
    done = subprocess.run([CPLUSPLUS, "-x", "c++", "-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-c",
                           "-o", str(tmp_path / "client.o"), str(root / "docs" / "client" / "drive_needle.c")],
                          capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr


def test_header_alone_needs_nothing_else(root, tmp_path):
    """Two files of one program include it; the implementation is in one of them."""
    (tmp_path / "one.c").write_text('#include "tissue_sim_client.h"\n'
                                    "const char *busy(void) { return tissue_sim_text(TISSUE_SIM_BUSY); }\n",
                                    encoding="utf-8")
    (tmp_path / "two.c").write_text("#define TISSUE_SIM_CLIENT_IMPLEMENTATION\n"
                                    '#include "tissue_sim_client.h"\n#include <stdio.h>\n'
                                    "const char *busy(void);\nint main(void) { puts(busy()); return 0; }\n",
                                    encoding="utf-8")
    program = tmp_path / "program"
    done = subprocess.run([COMPILER, "-std=c99", *WARNINGS, f"-I{root / 'docs' / 'client'}", "-o", str(program),
                           str(tmp_path / "one.c"), str(tmp_path / "two.c")], capture_output=True, text=True,
                          encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert drive(program).stdout == "another client has the tissue\n"
