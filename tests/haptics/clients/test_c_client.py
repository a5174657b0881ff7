"""The C client of haptics/clients/c: compiled without a warning, and the same forces as stepping in Python."""

import math
import re
import shutil
import socket
import subprocess
import threading
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from client_drivers import C_COMPILER as COMPILER
from client_drivers import CPP_COMPILER as CPLUSPLUS
from client_drivers import WARNINGS, compile_or_fail

import tissue_sim as ts
from haptics.clients import get_source_folder
from haptics.server.server import TissueServer
from haptics.server.wire import Reply, Request, decode_request_without_pose_check, encode_reply, encode_request
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

CMAKE = shutil.which("cmake")
#: Text of the status BUSY.
BUSY = "another client owns the tissue; try again after its goodbye or its silence"
#: Folder of the client in the repository.
CLIENT = Path("haptics") / "clients" / "c"
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
def serving(tissue, port=0):
    with TissueServer(tissue, port=port) as server:
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
    compile_or_fail(COMPILER, "-std=c99", "-O2", *WARNINGS, *options, f"-I{root / CLIENT / 'include'}", "-o", program,
                    root / CLIENT / "examples" / "drive_needle.c")
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
        assert done.returncode == 1 and done.stderr == f"drive_needle: {BUSY}\n"
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
                           f"-I{root / CLIENT / 'include'}", "-o", str(program), str(source)], capture_output=True,
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
        assert done.stderr == ("drive_needle: the server uses protocol version 4, this client version 3; install "
                               "the same tissue_sim on both sides\n")


def test_refused_pose_reaches_the_program(drive_needle, tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("0.0 0.00005\n-5.0 0.00005\n0.15 1e300\n0.1 20.0\n0.2 0.002\n", encoding="utf-8")
    with serving(Gel()) as port:
        answered = forces(drive(drive_needle, port, path))
    assert [status for _, _, status in answered] == [0, 3, 3, 3, 0]
    assert answered[1][1] == answered[2][1] == answered[3][1] == answered[0][1]


def test_number_that_is_not_finite_is_refused_before_it_is_sent(drive_needle, tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("0.0 0.00005\n0.1 nan\n", encoding="utf-8")
    with serving(Gel()) as port:
        done = drive(drive_needle, port, path)
    assert done.returncode == 1 and len(done.stdout.splitlines()) == 1
    assert done.stderr == "drive_needle: time and pose must be finite, and the orientation a unit quaternion\n"


def test_former_folder_has_the_same_client(root, tmp_path):
    """docs/client contains no second implementation, only an #include."""
    stub = root / "docs" / "client" / "tissue_sim_client.h"
    assert len(stub.read_text(encoding="utf-8").splitlines()) == 2
    source = root / CLIENT / "src" / "tissue_sim_client.c"
    done = subprocess.run([COMPILER, "-std=c99", *WARNINGS, f"-I{stub.parent}", "-c", "-o", str(tmp_path / "client.o"),
                           str(source)], capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr


CONSUMER = """cmake_minimum_required(VERSION 3.13)
project(consumer C CXX)
find_package(tissue_sim_client 3 REQUIRED)
add_executable(consumer consumer.cpp)
target_link_libraries(consumer tissue_sim::tissue_sim_client)
"""


@pytest.mark.slow
@pytest.mark.skipif(CMAKE is None or CPLUSPLUS is None, reason="builds the C library with CMake and finds no cmake or "
                    "C++ compiler on this machine (Debian: apt-get install cmake make g++)")
@pytest.mark.parametrize("shared", [False, True], ids=["static", "shared"])
def test_library_is_built_installed_and_found(root, tmp_path, path_file, shared):
    """The library and its examples from a copy of the sources, and another project that uses the installation."""
    def cmake(*words):
        done = subprocess.run([CMAKE, *map(str, words)], capture_output=True, text=True, encoding="utf-8")
        assert done.returncode == 0, done.stdout + done.stderr

    shutil.copytree(get_source_folder() / "c", tmp_path / "source")
    prefix = tmp_path / "prefix"
    cmake("-S", tmp_path / "source", "-B", tmp_path / "build", f"-DBUILD_SHARED_LIBS={'ON' if shared else 'OFF'}")
    cmake("--build", tmp_path / "build")
    cmake("--install", tmp_path / "build", "--prefix", prefix)
    names = {path.name for path in prefix.rglob("*tissue_sim_*")}
    assert {"tissue_sim_client.h", "tissue_sim_unreal.h", "tissue_sim_clientConfig.cmake"} <= names
    assert any(name.startswith("libtissue_sim_client.") and name.endswith(".a") != shared for name in names)
    (tmp_path / "consumer").mkdir()
    (tmp_path / "consumer" / "CMakeLists.txt").write_text(CONSUMER, encoding="utf-8")
    (tmp_path / "consumer" / "consumer.cpp").write_text(
        (root / CLIENT / "examples" / "haptic_loop.cpp").read_text(encoding="utf-8").replace(
            "#ifndef TISSUE_SIM_CLIENT_LIBRARY", "#if 0"), encoding="utf-8")
    cmake("-S", tmp_path / "consumer", "-B", tmp_path / "consumer" / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    cmake("--build", tmp_path / "consumer" / "build")
    with serving(Gel()) as port:
        answered = forces(drive(tmp_path / "build" / "examples" / "drive_needle", port, path_file))
        check_loop(drive(tmp_path / "consumer" / "build" / "consumer", port, 0.1, 0.002))
    assert [force for _, force, _ in answered] == pytest.approx([one.force for one in stepped(Gel())], rel=1e-12)


def check_loop(done):
    """Check the last line of the 1 kHz example."""
    assert done.returncode == 0, done.stderr
    line = re.fullmatch(r"steps (\d+), round trip p50 (\d+) us, p99 (\d+) us, largest force ([\d.]+) N, late (\d+), "
                        r"without server (\d+), starts (\d+)", done.stdout.splitlines()[-1])
    assert line, done.stdout
    steps, p50, p99, largest, _, _, starts = map(float, line.groups())
    assert steps >= 1 and 0 < p50 <= p99 and starts >= 1
    assert 0.0 <= largest <= 2.5  # 800 (1 + 40 d) d + 300 d + damping is 2.4 N at 2 mm


@pytest.fixture(scope="module")
def haptic_loop(root, tmp_path_factory):
    if CPLUSPLUS is None:
        pytest.skip("compiles the C++ example and finds no C++ compiler on this machine (Debian: apt-get install g++)")
    program = tmp_path_factory.mktemp("cpp") / "haptic_loop"
    compile_or_fail(CPLUSPLUS, "-std=c++11", "-O2", *WARNINGS, f"-I{root / CLIENT / 'include'}", "-o", program,
                    root / CLIENT / "examples" / "haptic_loop.cpp")
    return program


def test_example_loop_prints_round_trips_and_force(haptic_loop):
    with serving(Gel()) as port:
        check_loop(drive(haptic_loop, port, 0.5, 0.002))


def test_example_loop_uses_a_restarted_server(haptic_loop):
    """Stopped and started on the same port while the loop runs: the loop prints a line for each server."""
    with serving(Gel()) as port:
        loop = subprocess.Popen([str(haptic_loop), str(port), "600", "0.002"], stdout=subprocess.PIPE,
                                stderr=subprocess.PIPE, text=True, encoding="utf-8")
        assert any("first step at this server" in line for line in loop.stdout)
    try:
        with serving(Gel(), port):
            assert any("first step at this server" in line for line in loop.stdout)
    finally:
        loop.kill()
        loop.communicate()


@pytest.mark.skipif(CPLUSPLUS is None, reason="compiles the C client's header as C++ and finds no C++ compiler on this "
                    "machine (Debian: apt-get install g++)")
def test_header_is_also_cplusplus(root, tmp_path):
    done = subprocess.run([CPLUSPLUS, "-x", "c++", "-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-c",
                           f"-I{root / CLIENT / 'include'}", "-o", str(tmp_path / "client.o"),
                           str(root / CLIENT / "examples" / "drive_needle.c")],
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
    done = subprocess.run([COMPILER, "-std=c99", *WARNINGS, f"-I{root / CLIENT / 'include'}", "-o", str(program),
                           str(tmp_path / "one.c"), str(tmp_path / "two.c")], capture_output=True, text=True,
                          encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert drive(program).stdout == BUSY + "\n"


#: Replacement of the Winsock header that counts calls; `startup_result` is the result of WSAStartup.
WINSOCK = """#include <arpa/inet.h>
#include <stdint.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <unistd.h>
typedef int SOCKET;
typedef struct { int unused; } WSADATA;
typedef unsigned long DWORD;
typedef union { int64_t QuadPart; } LARGE_INTEGER;
#define INVALID_SOCKET (-1)
#define FIONBIO 1L
#define WSAECONNRESET 1
#define WSAEWOULDBLOCK 2
#define MAKEWORD(low, high) ((low) | (high) << 8)
static int startups, cleanups, startup_result;
static int WSAStartup(int version, WSADATA *data) { (void)version; (void)data; startups++; return startup_result; }
static int WSACleanup(void) { cleanups++; return 0; }
static int WSAGetLastError(void) { return WSAEWOULDBLOCK; }
static void WSASetLastError(int error) { (void)error; }
static int ioctlsocket(SOCKET own, long command, u_long *value) { (void)own; (void)command; (void)value; return 0; }
static int closesocket(SOCKET own) { return close(own); }
static void Sleep(DWORD milliseconds) { (void)milliseconds; }
static int QueryPerformanceCounter(LARGE_INTEGER *count) { static int64_t now; count->QuadPart = now++; return 1; }
static int QueryPerformanceFrequency(LARGE_INTEGER *count) { count->QuadPart = 1; return 1; }
"""

#: Opens clients that fail and one that does not; prints the numbers of WSAStartup and WSACleanup after each.
WINSOCK_PROGRAM = """#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#include "tissue_sim_client.h"
int main(void) {
    tissue_sim_client client;
    memset(&client, 0x5a, sizeof client);
    startup_result = 1;
    printf("%d ", tissue_sim_open(&client, "127.0.0.1", 9, 1.0));
    printf("%s. ", tissue_sim_message(&client));
    tissue_sim_close(&client);
    printf("%d %d\\n", startups, cleanups);
    startup_result = 0;
    printf("%d ", tissue_sim_open(&client, "localhost", 9, 1.0));
    tissue_sim_close(&client);
    printf("%d %d\\n", startups, cleanups);
    printf("%d ", tissue_sim_open(&client, "127.0.0.1", 9, 0.5));
    tissue_sim_close(&client);
    tissue_sim_close(&client);
    printf("%d %d\\n", startups, cleanups);
    return 0;
}
"""


def test_each_startup_of_winsock_has_its_cleanup(root, tmp_path):
    """The code for Windows with a replacement of Winsock: a failed WSAStartup needs no WSACleanup, all others one."""
    (tmp_path / "winsock2.h").write_text(WINSOCK, encoding="utf-8")
    (tmp_path / "ws2tcpip.h").write_text("", encoding="utf-8")
    (tmp_path / "windows.c").write_text(WINSOCK_PROGRAM, encoding="utf-8")
    compile_or_fail(COMPILER, "-std=gnu99", "-D_WIN32", f"-I{tmp_path}", f"-I{root / CLIENT / 'include'}", "-o",
                    tmp_path / "windows", tmp_path / "windows.c")
    assert drive(tmp_path / "windows").stdout.splitlines() == [
        "-2 the address must be a numeric IPv4 address and the time-out positive. 1 0", "-2 2 1", "0 3 2"]
