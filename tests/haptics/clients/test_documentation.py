"""The programs in docs/client_c.md and docs/client_csharp.md: compiled without a warning, and run against a server."""

import re
import socket
import subprocess
import threading

import pytest
from client_drivers import C_COMPILER, CPP_COMPILER, MCS, MONO, WARNINGS, compile_or_fail, needs_c, needs_csharp

from haptics.server.server import TissueServer
from haptics.server.wire import Reply, RequestKind, Status, decode_request_without_pose_check, encode_reply
from tissue_sim.tool_force import ForceStatus, ToolForce

#: Output of the programs: a spring of 800 N/m.
FORCES = "".join(f"{k} mm: {0.8 * k:.1f} N\n" for k in range(6))


class Spring:
    def step(self, pose, dt):
        return ToolForce.from_axial_force(800.0 * pose.depth, 800.0, ForceStatus.CONVERGED)

    def reset(self):
        pass


@pytest.fixture
def port():
    with TissueServer(Spring(), port=0, configuration_port=None) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        yield server.address[1]
        server.stop()
        thread.join(300.0)


def blocks(root, page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", (root / "docs" / page).read_text(encoding="utf-8"),
                      re.MULTILINE | re.DOTALL)


def output(*words):
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, encoding="utf-8", timeout=600)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return done.stdout


@needs_c
def test_c_program(root, tmp_path, port):
    program, = blocks(root, "client_c.md", "c")
    (tmp_path / "program.c").write_text(program, encoding="utf-8")
    compile_or_fail(C_COMPILER, "-std=c99", *WARNINGS, f"-I{root / 'haptics' / 'clients' / 'c' / 'include'}", "-o",
                    tmp_path / "program", tmp_path / "program.c")
    assert output(tmp_path / "program", port) == FORCES


@needs_csharp
def test_csharp_program_and_unity_component(root, tmp_path, port):
    client = root / "haptics" / "clients" / "csharp" / "TissueSimClient.cs"
    program, component = blocks(root, "client_csharp.md", "csharp")
    (tmp_path / "Program.cs").write_text(program, encoding="utf-8")
    (tmp_path / "TissueTool.cs").write_text(component, encoding="utf-8")
    compile_or_fail(MCS, "-langversion:7", "-warnaserror", f"-out:{tmp_path / 'program.exe'}", client,
                    tmp_path / "Program.cs")
    assert output(MONO, tmp_path / "program.exe", port) == FORCES
    # The fields of the component are set in the editor, not in the source: warning 649.
    compile_or_fail(MCS, "-langversion:7", "-warnaserror", "-nowarn:649", "-target:library",
                    f"-out:{tmp_path / 'tool.dll'}", client, tmp_path / "TissueTool.cs",
                    root / "tests" / "haptics" / "clients" / "UnityEngineDeclarations.cs")


#: Calls the component of the documentation with a server whose statuses are REFUSED, FAILED and CONVERGED.
COMPONENT_PROGRAM = """using System;
using System.Reflection;
using TissueSim;
using UnityEngine;

static class Program
{
    static void Main(string[] arguments)
    {
        TissueTool tool = new TissueTool();
        tool.scene = new Transform();
        tool.tip = new Transform();
        tool.body = new Rigidbody();
        tool.port = int.Parse(arguments[0]);
        Call(tool, "OnEnable");
        FieldInfo client = typeof(TissueTool).GetField("client", BindingFlags.NonPublic | BindingFlags.Instance);
        ((TissueClient)client.GetValue(tool)).Timeout = 60.0;
        for (int k = 0; k < 4; k++)
            Call(tool, "FixedUpdate");
        Call(tool, "OnDisable");
    }

    static void Call(TissueTool tool, string name)
    {
        typeof(TissueTool).GetMethod(name, BindingFlags.NonPublic | BindingFlags.Instance).Invoke(tool, null);
    }
}
"""


def flags_of_steps(statuses, run):
    """Flags of the steps that a program sends to a server whose answers have these statuses."""
    flags = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def answer():
            steps = iter(statuses)
            while True:
                packet, address = server.recvfrom(200)
                if packet == b"end":
                    return
                request = decode_request_without_pose_check(packet)
                status = Status.RELEASED
                if request.kind == RequestKind.STEP:
                    flags.append(int(request.flags))
                    status = next(steps, Status.CONVERGED)
                server.sendto(encode_reply(Reply(status, request.sequence, request.time, request.session,
                                                 (0.0, 0.0, 0.0))), address)

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            run(server.getsockname()[1])
        finally:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
                end.sendto(b"end", server.getsockname())
            thread.join(300.0)
    return flags


@needs_c
def test_c_programs_request_the_reset_until_a_step_is_executed(root, tmp_path):
    sources = root / "haptics" / "clients" / "c"
    program, = blocks(root, "client_c.md", "c")
    (tmp_path / "program.c").write_text(program, encoding="utf-8")
    statuses = [Status.REFUSED, Status.FAILED]
    for source, words in ((tmp_path / "program.c", []), (sources / "examples" / "drive_needle.c", [0.001, 5])):
        compile_or_fail(C_COMPILER, "-std=c99", *WARNINGS, f"-I{sources / 'include'}", "-o", tmp_path / source.stem,
                        source)
        assert flags_of_steps(statuses, lambda port, program=tmp_path / source.stem, words=words: output(
            program, port, *words)) == [1, 1, 1, 0, 0, 0]


@needs_c
@pytest.mark.skipif(CPP_COMPILER is None, reason="compiles the example at 1 kHz and finds no C++ compiler on this "
                    "machine (Debian: apt-get install g++)")
def test_example_loop_requests_the_reset_until_a_step_is_executed(root, tmp_path):
    """An answered step ends the reset; a busy machine may answer later than within the period of the loop."""
    sources = root / "haptics" / "clients" / "c"
    # With a time-out of one minute every step is answered.
    text = (sources / "examples" / "haptic_loop.cpp").read_text(encoding="utf-8").replace(", period);", ", 60.0);")
    (tmp_path / "loop.cpp").write_text(text, encoding="utf-8")
    compile_or_fail(CPP_COMPILER, "-std=c++11", *WARNINGS, f"-I{sources / 'include'}", "-o", tmp_path / "loop",
                    tmp_path / "loop.cpp")
    flags = flags_of_steps([Status.REFUSED, Status.FAILED], lambda port: output(tmp_path / "loop", port, 1.0))
    assert flags[:3] == [1, 1, 1] and set(flags[3:]) == {0}


@needs_csharp
def test_csharp_programs_request_the_reset_until_a_step_is_executed(root, tmp_path):
    client = root / "haptics" / "clients" / "csharp" / "TissueSimClient.cs"
    program, component = blocks(root, "client_csharp.md", "csharp")
    for name, text in (("Program", program), ("TissueTool", component), ("ComponentProgram", COMPONENT_PROGRAM)):
        (tmp_path / f"{name}.cs").write_text(text, encoding="utf-8")
    compile_or_fail(MCS, "-langversion:7", f"-out:{tmp_path / 'program.exe'}", client, tmp_path / "Program.cs")
    compile_or_fail(MCS, "-langversion:7", f"-out:{tmp_path / 'component.exe'}", client, tmp_path / "TissueTool.cs",
                    tmp_path / "ComponentProgram.cs",
                    root / "tests" / "haptics" / "clients" / "UnityEngineDeclarations.cs")
    for name, expected in (("program", [1, 1, 1, 0, 0, 0]), ("component", [1, 1, 1, 0])):
        assert flags_of_steps([Status.REFUSED, Status.FAILED], lambda port, name=name: output(
            MONO, tmp_path / f"{name}.exe", port)) == expected


@needs_c
@pytest.mark.skipif(CPP_COMPILER is None, reason="compiles the function for Unreal Engine and finds no C++ compiler on "
                    "this machine (Debian: apt-get install g++)")
def test_unreal_function(root, tmp_path):
    function, = blocks(root, "client_csharp.md", "cpp")
    (tmp_path / "tissue.cpp").write_text('#include "unreal_declarations.h"\n' + function, encoding="utf-8")
    compile_or_fail(CPP_COMPILER, "-std=c++17", *WARNINGS, f"-I{root / 'haptics' / 'clients' / 'c' / 'include'}",
                    f"-I{root / 'tests' / 'haptics' / 'clients'}", "-c", "-o", tmp_path / "tissue.o",
                    tmp_path / "tissue.cpp")
