"""The programs in docs/client_c.md and docs/client_csharp.md: compiled without a warning, and run against a server."""

import re
import subprocess
import threading

import pytest
from client_drivers import C_COMPILER, CPP_COMPILER, MCS, MONO, WARNINGS, compile_or_fail, needs_c, needs_csharp

from haptics.server.server import TissueServer
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


@needs_c
@pytest.mark.skipif(CPP_COMPILER is None, reason="compiles the function for Unreal Engine and finds no C++ compiler on "
                    "this machine (Debian: apt-get install g++)")
def test_unreal_function(root, tmp_path):
    function, = blocks(root, "client_csharp.md", "cpp")
    (tmp_path / "tissue.cpp").write_text('#include "unreal_declarations.h"\n' + function, encoding="utf-8")
    compile_or_fail(CPP_COMPILER, "-std=c++17", *WARNINGS, f"-I{root / 'haptics' / 'clients' / 'c' / 'include'}",
                    f"-I{root / 'tests' / 'haptics' / 'clients'}", "-c", "-o", tmp_path / "tissue.o",
                    tmp_path / "tissue.cpp")
