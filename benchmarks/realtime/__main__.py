"""Real time: CPU time and force error of a tick, parts of an iteration, irregular motion, loop, round trip.

    python -m benchmarks realtime [--json] [--figure FILE] [--quick] [--seconds 60] [--repeats N]

Ends with what must be shown, met or missed. It takes about ten minutes, on a quiet machine; --quick measures a little
of everything in about one. Stops with exit code 1 where the answers differ.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import math
import time
from pathlib import Path

from benchmarks.measure import about, option_parser, show
from benchmarks.realtime.diagram import plot
from benchmarks.realtime.iteration import iteration
from benchmarks.realtime.motion import irregular_motion
from benchmarks.realtime.processes import loops, round_trips, throughputs
from benchmarks.realtime.tables import draw
from benchmarks.realtime.targets import targets
from benchmarks.realtime.ticks import WAY, ConvergedSolutions, rows, say, work_precision

#: Number of simulators at the same time.
PROCESSES = 8
#: Duration of their stepping, s.
STEPPING = 5.0


def measured(arguments: argparse.Namespace) -> dict:
    """Return all measurements without the targets."""
    quick, repeats = arguments.quick, arguments.repeats
    seconds = arguments.seconds or (2.0 if quick else 60.0)
    solutions = ConvergedSolutions(20 * WAY if quick else WAY)
    return {"rows": rows(1 if quick else 10 * repeats, solutions),
            "work_precision": work_precision(1 if quick else 2 * repeats, solutions, few=quick),
            **iteration(40 if quick else 20 * repeats, 1 if quick else repeats),
            "irregular_motion": irregular_motion(seconds), "loop": loops(seconds),
            "throughput": throughputs(2 if quick else PROCESSES, 1.0 if quick else STEPPING),
            "round_trip": round_trips(200 if quick else 3000)}


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.01 <= seconds < math.inf:
        raise argparse.ArgumentTypeError("must be at least 0.01")
    return seconds


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--figure", type=Path, help="draw the work-precision diagram into this file")
    parser.add_argument("--quick", action="store_true", help="a little of everything")
    parser.add_argument("--seconds", type=_seconds, help="of irregular motion, and of each loop (default 60, quick 2)")
    arguments = parser.parse_args()
    began = time.perf_counter()
    result = about("realtime", ["felupe"]) | {"quick": arguments.quick} | measured(arguments)
    if arguments.figure:
        plot(result, arguments.figure)
    result["figure"] = str(arguments.figure or "")
    result["targets"] = targets(result)
    result["wall_s"] = time.perf_counter() - began
    say(f"{result['wall_s']:.0f} s in all")
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
