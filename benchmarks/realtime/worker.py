"""One simulator in one process, for `processes`: report ready, read a number of seconds, step, report."""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import json
import sys
import time

from benchmarks.realtime.ticks import cases, drive
from haptics.loop.loop import read_peak_memory_bytes_or_none


def run_process() -> None:
    simulator = cases()[0].simulator()
    drive(simulator)
    print("ready", flush=True)
    seconds = float(sys.stdin.readline())
    steps, began, used = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() - began < seconds:
        steps += len(drive(simulator).force)
    peak = read_peak_memory_bytes_or_none()
    print(json.dumps({"steps": steps, "wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - used,
                      "peak_memory_MB": None if peak is None else peak / 1e6}), flush=True)


if __name__ == "__main__":
    run_process()
