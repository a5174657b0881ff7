"""Build and run the test programs of the clients in C and C#, which execute one command a line."""

import shutil
import struct
import subprocess
from pathlib import Path

import pytest

CLIENTS = ("c", "csharp")
C_COMPILER = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
CPP_COMPILER = shutil.which("g++") or shutil.which("clang++")
MCS = shutil.which("mcs")
MONO = shutil.which("mono")
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
needs_c = pytest.mark.skipif(C_COMPILER is None, reason="compiles the C client and finds no C compiler on this machine "
                             "(Debian: apt-get install gcc libc6-dev)")
needs_csharp = pytest.mark.skipif(MCS is None or MONO is None, reason="compiles and runs the C# client and finds no "
                                  "mcs or mono on this machine (Debian: apt-get install mono-mcs mono-runtime)")
PARAMETERS = [pytest.param("c", marks=needs_c), pytest.param("csharp", marks=needs_csharp)]


def compile_or_fail(*words):
    """Run a compiler, which must print nothing."""
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0 and done.stderr == "", done.stdout + done.stderr


def build_driver(root: Path, client: str, folder: Path) -> list[str]:
    """Compile the test program of a client with the strictest warnings, and return the command that runs it."""
    sources, tests = root / "haptics" / "clients", root / "tests" / "haptics" / "clients"
    if client == "c":
        compile_or_fail(C_COMPILER, "-std=c99", "-O2", *WARNINGS, f"-I{sources / 'c' / 'include'}", "-o",
                        folder / "driver", tests / "client_driver.c")
        return [str(folder / "driver")]
    compile_or_fail(MCS, "-langversion:7", "-warn:4", "-warnaserror", f"-out:{folder / 'driver.exe'}",
                    sources / "csharp" / "TissueSimClient.cs", tests / "ClientDriver.cs")
    return [str(MONO), str(folder / "driver.exe")]


def to_hex(*values: float) -> str:
    """Return the bits of doubles as words of 16 hexadecimal digits."""
    return " ".join(struct.pack(">d", value).hex() for value in values)


def from_hex(word: str) -> float:
    """Return the double of 16 hexadecimal digits."""
    return struct.unpack(">d", bytes.fromhex(word))[0]


class Driver:
    """A running test program; `ask` sends one command and returns the words of the answer."""

    def __init__(self, command: list[str]):
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                                         encoding="utf-8", bufsize=1)

    def send(self, *words: object) -> None:
        """Send a command without waiting for its answer."""
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()

    def receive(self) -> list[str]:
        """Return the words of the next answer."""
        line = self._process.stdout.readline()
        assert line, "the test program has ended"
        return line.split()

    def ask(self, *words: object) -> list[str]:
        self.send(*words)
        return self.receive()

    def open(self, port: int, timeout: float = 60.0, version: int = 3) -> None:
        assert self.ask("open", port, to_hex(timeout), version) == ["ok"]

    def step(self, time: float, depth: float, reset: bool = False, quaternion=(1.0, 0.0, 0.0, 0.0)) -> list[str]:
        return self.ask("step", to_hex(time, 0.0, 0.0, -depth, *quaternion), int(reset))

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.wait(60.0)
        self._process.stdout.close()
