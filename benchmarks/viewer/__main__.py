"""Viewer: CPU time of a frame, influence on the 1 kHz loop, age of the picture, and memory.

    python -m benchmarks viewer [--json] [--repeats 3] [--seconds 10] [--no-browser]

The needle in the study's specimen goes in and out all the time, cut open by 120 degrees, with three replicates; a
client in another process reads everything. The loop's ticks are counted with the page, without it (the same session
without a screen), and with the loop alone, in turns: who has no turn is stopped (SIGSTOP). It takes less than three
minutes, on a quiet machine.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import sys
import time
from contextlib import ExitStack

from benchmarks.measure import about, option_parser, show
from benchmarks.viewer.latency import pictures, readouts, sizes
from benchmarks.viewer.processes import ViewerProcess, looked_at, loop_alone, reading, stopped, viewing
from benchmarks.viewer.tables import ALONE, NO_SCREEN, PAGE, draw, targets
from benchmarks.viewer.worker import study

#: Of runs whose ticks are not compared, s.
SHORT = 3.0
#: A run's ticks are in the ring, which keeps 16 s.
LONGEST = 15.0


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def frames_of(case: str, viewer: ViewerProcess, found: dict) -> dict:
    """Return a row of the CPU times, without the frames."""
    return {"case": case, "elements": viewer.elements,
            **{name: value for name, value in found.items() if name != "shown"}}


def compare(rounds: int, seconds: float, in_browser: bool) -> dict:
    """Everything with the mesh `realtime`: CPU times, ticks, latencies; three cases in turns, every second turn
    backwards."""
    cpu, ticks, latencies, chromium = [], [], [], None
    say("start")
    with ExitStack() as stack:
        alone, count_alone = stack.enter_context(loop_alone(study().model))
        with stopped(alone):
            viewer = stack.enter_context(viewing("realtime"))
            cpu.append(frames_of("no client", viewer, viewer.run(SHORT, clients=0)))

        def loop() -> None:
            with stopped(viewer.loop):
                ticks.append({"case": ALONE, **count_alone(seconds)})

        def session() -> None:
            with stopped(alone):
                found = viewer.run(seconds, viewer="none", clients=0)
            ticks.append({"case": NO_SCREEN, **found["ticks"]})
            cpu.append(frames_of("no page", viewer, found))

        def page() -> None:
            with stopped(alone), reading(viewer.port) as messages:
                found = viewer.run(seconds)
                came, frames = messages(), found["shown"]
            ticks.append({"case": PAGE, **found["ticks"]})
            cpu.append(frames_of("moves", viewer, found))
            texts = [(message[1], message[4]) for message in came if message[4] is not None]
            latencies.append({"pictures": pictures(frames, came), "readouts": readouts(frames, texts),
                              **sizes(frames, came)})

        for number in range(rounds):
            say(f"round {number + 1} of {rounds}")
            for case in (loop, session, page)[:: -1 if number % 2 else 1]:
                case()
        with stopped(alone):
            with reading(viewer.port):
                cpu.append(frames_of("stands still", viewer, viewer.run(SHORT, motion="stands")))
            if in_browser:
                chromium = in_chromium(viewer, seconds)
    return {"cpu": cpu, "ticks": ticks, "latencies": latencies, "chromium": chromium}


def finer() -> list[dict]:
    """Measure CPU times with the mesh `fast`."""
    say("mesh fast")
    with viewing("fast") as viewer:
        unread = viewer.run(SHORT, clients=0)
        with reading(viewer.port):
            moves, stands = viewer.run(SHORT), viewer.run(SHORT, motion="stands")
        return [frames_of(*case) for case in (("no client", viewer, unread), ("moves", viewer, moves),
                                              ("stands still", viewer, stands))]


def in_chromium(viewer: ViewerProcess, seconds: float) -> dict | None:
    """CPU time, ticks and age of the read-outs while Chromium draws on the same processor; None without one."""
    say("Chromium")
    looked = looked_at(viewer.port, lambda: viewer.run(seconds))
    if looked is None:
        say("no Chromium or no Playwright: left out")
        return None
    found, seen = looked
    return {**frames_of("moves, in Chromium", viewer, found), "readouts": readouts(found["shown"], seen)}


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 1.0 <= seconds <= LONGEST:
        raise argparse.ArgumentTypeError(f"must be 1 to {LONGEST:g}")
    return seconds


def main() -> None:
    parser = option_parser(__doc__)
    parser.set_defaults(repeats=3)
    parser.add_argument("--seconds", type=_seconds, default=10.0, help="of each run whose ticks are counted (10)")
    parser.add_argument("--no-browser", action="store_true", help="leave Chromium out")
    arguments = parser.parse_args()
    began = time.perf_counter()
    result = about("viewer", ["viser"]) | compare(arguments.repeats, arguments.seconds, not arguments.no_browser)
    result["cpu"] += finer()
    result["targets"] = targets(result)
    result["wall_s"] = time.perf_counter() - began
    say(f"{result['wall_s']:.0f} s in all")
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
