"""Trial of a mutant: run the related tests on a copy of the repository that contains the fault."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.mutants.drawing import Mutant
from benchmarks.mutants.related_tests import ImportGraph, related_tests
from tissue_sim.files import get_cache_folder

#: Results of a trial.
KILLED_FAST = "killed by command two"
KILLED_SLOW = "killed by the slow tests"
SURVIVED = "survived"
OUT_OF_TIME = "survived, out of time"
#: pytest's exit code for tests without failure, and for an empty selection.
_PASSED = (0, 5)
#: Folders that no test reads.
_LEFT_OUT = shutil.ignore_patterns(".git", "__pycache__", ".*_cache", "build", "*.egg-info")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (tests/\S+?\.py(?:::.+?)?)(?: - .*)?$", re.MULTILINE)
#: Lines that pytest writes about a test that takes too long.
_TOO_LONG = re.compile(r'^  File ".*/(tests/[^"]+)", line \d+ in (test_\w+)$', re.MULTILINE)


@dataclass(frozen=True)
class TrialSettings:
    """Limits of a trial.

    Attributes:
        files: largest number of test files. A larger number finds more faults and takes longer.
        fast_seconds: limit of the CPU time of the tests of command two, s.
        slow_seconds: limit of the CPU time of the slow tests, s; 0: no slow tests.
        test_seconds: time limit of one test, s; a test that takes longer has failed.
        load: largest ratio of time to CPU time, on a busy machine or for tests that wait.
        known_failures: largest number of failures that also occur without the fault; these tests are left out.
    """

    files: int = 12
    fast_seconds: float = 60.0
    slow_seconds: float = 120.0
    test_seconds: float = 180.0
    load: float = 10.0
    known_failures: int = 5


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        result: one of the results of this module.
        test: the test that failed, or an empty string.
        seconds: duration of the trial, s.
    """

    result: str
    test: str
    seconds: float


class Laboratory:
    """Copy of the repository, in which one file at a time is replaced by a mutant."""

    def __init__(self, root: Path, folder: Path, settings: TrialSettings):
        self.root = folder / root.name
        self._settings = settings
        shutil.copytree(root, self.root, ignore=_LEFT_OUT)
        kernels = folder / "kernels"
        if get_cache_folder().is_dir():
            # Faulty kernels must not enter the cache of the user.
            shutil.copytree(get_cache_folder(), kernels)
        data = os.environ.get("TISSUE_SIM_DATA", str(root.parent / "shared" / "data"))
        self._environment = {**os.environ, "PYTHONPATH": str(self.root), "TISSUE_SIM_CACHE": str(kernels),
                             "TISSUE_SIM_DATA": data, "MPLBACKEND": "Agg"}
        self.graph = ImportGraph.read(self.root)

    def try_mutant(self, mutant: Mutant) -> Outcome:
        """Run the related tests of command two, then the slow ones, until a test fails because of the fault."""
        started = time.monotonic()
        files = related_tests(self.graph, mutant, self._settings.files)
        result, test = SURVIVED, ""
        if files:
            for marker, seconds, killed in (("not slow", self._settings.fast_seconds, KILLED_FAST),
                                            ("slow", self._settings.slow_seconds, KILLED_SLOW)):
                found = self._find_failure(mutant, files, marker, seconds) if seconds else ""
                if found:
                    result, test = killed, found
                    break
                if found is None:
                    result = OUT_OF_TIME
        return Outcome(result, test, time.monotonic() - started)

    def _find_failure(self, mutant: Mutant, files: list[str], marker: str, seconds: float) -> str | None:
        """Name of a test that fails with the fault and passes without it; empty: none; None: out of time."""
        left_out: list[str] = []
        while len(left_out) <= self._settings.known_failures:
            self._write(mutant, with_fault=True)
            try:
                code, failed = self._run_tests([*files, *(f"--deselect={name}" for name in left_out)], marker,
                                               seconds)
            except subprocess.TimeoutExpired:
                return None
            finally:
                self._write(mutant, with_fault=False)
            if code in _PASSED:
                return ""
            # Without a name, the tests could not be collected.
            if self._pass_without_fault(failed or files, seconds):
                return " ".join(failed) or f"pytest, exit code {code}"
            if not failed:
                return ""
            left_out += failed[:1]
        return ""

    def _pass_without_fault(self, tests: list[str], seconds: float) -> bool:
        try:
            code, _ = self._run_tests(tests, "slow or not slow", seconds)
        except subprocess.TimeoutExpired:
            return False
        return code in _PASSED

    def _write(self, mutant: Mutant, with_fault: bool) -> None:
        path = self.root / mutant.path
        original = path.with_suffix(".original")
        if with_fault:
            source = path.read_bytes()
            original.write_bytes(source)
            path.write_bytes(mutant.apply(source))
        else:
            original.replace(path)
        # Two files of equal size, written in the same second, have the same bytecode for Python.
        Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)

    def _run_tests(self, arguments: list[str], marker: str, seconds: float) -> tuple[int, list[str]]:
        """Run tests until the first failure. Returns pytest's exit code and arguments that select the failed test.

        Raises:
            TimeoutExpired: the limit of the CPU time is exceeded.
        """
        report = self.root.parent / "report.txt"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-m", marker, "-p", "no:cacheprovider",
                   "-o", f"faulthandler_timeout={self._settings.test_seconds}",
                   "-o", "faulthandler_exit_on_timeout=true", *arguments]
        with report.open("w", encoding="utf-8") as stream:
            process = subprocess.Popen(command, cwd=self.root, env=self._environment, stdin=subprocess.DEVNULL,
                                       stdout=stream, stderr=subprocess.STDOUT, start_new_session=True)
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds)))
            try:
                code = process.wait(self._settings.load * seconds)
            finally:
                # Tests that are stopped leave child processes.
                _kill_group(process)
        if code in (-signal.SIGKILL, -signal.SIGXCPU):
            raise subprocess.TimeoutExpired(command, seconds)
        text = report.read_text(encoding="utf-8", errors="replace")
        selections = [[name] for name in _FAILED.findall(text)]
        selections += [[file, "-k", name] for file, name in _TOO_LONG.findall(text)]
        return code, selections[0] if selections else []


def _kill_group(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError):  # all processes of the group have ended
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def without_slow_tests(settings: TrialSettings) -> TrialSettings:
    """The same settings without slow tests."""
    return replace(settings, slow_seconds=0.0)
