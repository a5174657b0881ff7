"""Measurements in separate processes: the 1 kHz loop, several simulators at once, and the server."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from math import sin
from pathlib import Path

import numpy as np

import tissue_sim as ts
from benchmarks import ROOT, child_environment
from benchmarks.peers.work_precision import MATERIAL
from benchmarks.realtime.ticks import say
from haptics.server.client import TissueClient

_COMMAND = [sys.executable, "-m", "scenes.cli"]
#: How a client waits: number of polls for a reply before it sleeps; 2000 polls take longer than a step.
_WAITS = {"sleeping": 0, "polling": 2000}


def loops(seconds: float) -> list[dict]:
    """Return the report of `tissue-sim loop` in a random motion, with and without real-time privileges.

    Raises:
        SystemExit: the loop failed.
    """
    found = []
    for title, flags in (("with SCHED_FIFO", []), ("without", ["--no-real-time"])):
        say(f"loop of {seconds:g} s {title}")
        done = subprocess.run([*_COMMAND, "loop", "needle_indentation", "--seconds", str(seconds), "--json", *flags],
                              env=child_environment(), capture_output=True, text=True, encoding="utf-8", check=False)
        if done.returncode:
            raise SystemExit(f"tissue-sim loop: {done.stderr.strip()}")
        found.append({"case": title, **json.loads(done.stdout)})
    return found


def throughput(processes: int, seconds: float) -> dict:
    """Return steps per second of simulators that run at the same time, each in its process."""
    say(f"{processes} simulators at once")
    workers = [subprocess.Popen([sys.executable, "-m", "benchmarks.realtime.worker"], env=child_environment(),
                                text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8")
               for _ in range(processes)]
    try:
        for worker in workers:
            if worker.stdout.readline() != "ready\n":
                raise SystemExit("a simulator in a child process did not start")
        for worker in workers:
            worker.stdin.write(f"{seconds}\n")
            worker.stdin.flush()
        reports = [json.loads(worker.stdout.readline()) for worker in workers]
    finally:
        for worker in workers:
            worker.communicate()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    rate = sum(report["steps"] / report["wall_s"] for report in reports)
    return {"processes": processes, "cores": cores, "steps_per_s": rate,
            "steps_per_s_per_core": rate / min(cores, processes),
            "steps_per_cpu_s": sum(report["steps"] for report in reports) / sum(report["cpu_s"] for report in reports),
            "peak_memory_MB": max(report["peak_memory_MB"] or 0.0 for report in reports)}


def throughputs(processes: int, seconds: float) -> list[dict]:
    """Return the throughput of one simulator and of several, each with its rate over that of one."""
    found = [throughput(count, seconds) for count in (1, processes)]
    return [{**row, "over_one": row["steps_per_s"] / found[0]["steps_per_s"]} for row in found]


@contextmanager
def _serving() -> Iterator[int]:
    """Start a server of the needle without a budget, and yield its UDP port."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "silicone.material.json"
        ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
        server = subprocess.Popen([*_COMMAND, "serve", "--material", str(path), "--port", "0", "--budget-us", "0",
                                   "--inertia", "off", "--json"], env=child_environment(), text=True, encoding="utf-8",
                                  stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        try:
            ready = server.stdout.readline()
            if not ready:
                raise SystemExit("tissue-sim serve did not start")
            yield json.loads(ready)["port"]
        finally:
            server.send_signal(signal.SIGTERM)
            server.communicate()


def _python_client(port: int, steps: int, period: float, polls: int) -> np.ndarray:
    """Return time beyond the step (us), time of the step (us) and status, shape (steps, 3), for a Python client."""
    found = np.empty((steps, 3))
    with TissueClient(port, polls=polls) as client:
        deadline = time.perf_counter()
        for k in range(steps):
            deadline += period
            if period and (rest := deadline - time.perf_counter()) > 0.0:
                time.sleep(rest)
            depth = 0.005 * sin(3e-3 * k) ** 2
            sent = time.perf_counter()
            reply = client.step(depth, at=1e-3 * k, reset=k == 0)
            took = time.perf_counter() - sent
            found[k] = 1e6 * (took - reply.compute_time), 1e6 * reply.compute_time, reply.status
    return found


def _c_client(program: Path, port: int, steps: int, period: float, polls: int) -> np.ndarray:
    words = [str(program), *map(str, (port, steps, period, polls))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"the C client: {done.stderr.strip()}")
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)


def _compile(folder: str) -> Path | None:
    """Compile the C client; return None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    program = Path(folder) / "realtime_round_trip"
    subprocess.run([compiler, "-std=c99", "-O2", f"-I{ROOT / 'docs' / 'client'}", "-o", str(program),
                    str(Path(__file__).with_name("round_trip.c")), "-lm"], check=True)
    return program


def round_trips(steps: int) -> list[dict]:
    """Return the wall time from a pose to its force beyond the step: C and Python client, at 1 kHz and without pauses.

    A polling client of a polling server needs a core for each: where another process runs, they meet on one.
    """
    found = []
    with tempfile.TemporaryDirectory() as folder, _serving() as port:
        program = _compile(folder)
        for client, (wait, polls), (pace, period) in product(
                ("C", "Python") if program else ("Python",), _WAITS.items(),
                (("1 kHz", 1e-3), ("one after the other", 0.0))):
            say(f"round trips of the {client} client, {wait}, {pace}")
            times = (_c_client(program, port, steps, period, polls) if client == "C"
                     else _python_client(port, steps, period, polls))
            beyond, compute = np.quantile(times[:, :2], (0.5, 0.99, 1.0), axis=0).T.tolist()
            found.append({"client": f"{client}, {wait}", "pace": pace, "steps": steps,
                          **dict(zip(("beyond_us_p50", "beyond_us_p99", "beyond_us_max"), beyond, strict=True)),
                          **dict(zip(("step_us_p50", "step_us_p99", "step_us_max"), compute, strict=True)),
                          "statuses": {str(int(status)): count for status, count
                                       in Counter(times[:, 2].tolist()).items()}})
    return found
