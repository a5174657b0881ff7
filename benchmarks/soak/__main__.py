"""Use server, loop and page like a careless user and an attacker, and verify all forces by replay.

    python -m benchmarks soak [--minutes 30] [--seed 1] [--json]

A hand moves through random aims at 1 kHz under random tools, while parameters change by up to twentyfold, states are
saved and restored, and the tissue is reset; poses and times that no scene holds, damaged packets, floods and garbage
arrive, the client pauses, and servers are interrupted and killed. Every second session is of the viewer: a loop at
1 kHz in a separate process under a page that is read, with aims, protocols, parameters, tools, pauses, resets,
nonsense, bytes that are no request, reloads and loops that are killed. When all have been played the logged motion is
stepped again without a budget, from a reset on, on all cores: what was called CONVERGED must be within 1 % + 0.02 N of
that. That takes a few times as long. Ctrl-C ends the play, another one the replay; what there is is summed up.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import table
from benchmarks.soak.page import PageSession, play
from benchmarks.soak.replay import score, score_page
from benchmarks.soak.scenes import MATERIAL
from benchmarks.soak.session import Session, run
from calibration.tasks.process_pool import ProcessPool

SESSION = 30.0
LARGEST = 100.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    played, results, count = [], [], max(1, round(arguments.minutes * 60.0 / SESSION))
    with tempfile.TemporaryDirectory() as folder:
        with suppress(KeyboardInterrupt):
            for number in range(count):
                played.append(one_session(number, np.random.default_rng([arguments.seed, number]), Path(folder),
                                          min(SESSION, arguments.minutes * 60.0)))
                print(f"session {number + 1} of {count} played", file=sys.stderr)
        with suppress(KeyboardInterrupt):
            for result in replayed(played):
                results.append(result)
                print(f"session {len(results)} of {len(played)}, {result['kind']}: {result['statuses']}, "
                      f"{result['wrong']} wrong", file=sys.stderr)
    summary = summarise(results)
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "summary": summary, "sessions": results}))
    else:
        for kind, figures in summary.items():
            table(Console(), kind, ("figure", "value"), [(key, f"{value}") for key, value in figures.items()])
    return 0


def one_session(number: int, rng: np.random.Generator, folder: Path, seconds: float) -> Session | PageSession:
    """Run one session, with a server if its number is even, else with the viewer."""
    material = folder / "soak.material.json"
    if not number:
        ts.write_material_file(ts.MaterialFile.of(MATERIAL), material)
    if number % 2 == 0:
        return run(rng, material, seconds)
    (calls := folder / f"calls{number}").mkdir()
    return play(rng, material, calls, seconds)


def replayed(sessions: Sequence[Session | PageSession]) -> Iterator[dict]:
    """Yield the replayed result of each session."""
    pool = ProcessPool(os.cpu_count() or 1)
    try:
        tasks = [pool.submit(score, (each, LARGEST)) if isinstance(each, Session)
                 else pool.submit(score_page, (each, math.inf)) for each in sessions]
        for task in tasks:
            yield task.result()
    finally:
        pool.abandon_tasks()


def summarise(results: list[dict]) -> dict:
    """Summarise all sessions of each kind."""
    servers, pages = ([one for one in results if one["kind"] == kind] for kind in ("server", "page"))
    summary = {}
    if servers:
        summary["server"] = {**_answers(servers), "requests_without_reply": sum(one["lost"] for one in servers),
                             "beyond_the_largest_force": sum(one["beyond"] for one in servers),
                             "ended_otherwise_than_asked": sum(
                                 one["exit_code"] != (0 if one["ended_by"] == "signal" else -9) for one in servers),
                             "words": [line for one in servers for line in one["words"]][:5]}
    if pages:
        summary["page"] = {**_answers(pages), "noticed_ms_largest": max((each for one in pages for each in
                                                                         one["noticed_ms"]), default=0.0),
                           **{name: sum(one[name] for one in pages) for name in
                              ("frames", "asked", "refused", "unanswered", "killed", "stale")},
                           "nonsense_taken": sorted({each for one in pages for each in one["taken"]})}
    return summary


def _answers(results: list[dict]) -> dict:
    """Summarise the answers of the tissue."""
    statuses, quiet = Counter(), Counter()
    for one in results:
        statuses.update(one["statuses"])
        quiet.update(one["quiet"])
    recoveries = [each for one in results for each in one["recoveries_ms"]]
    return {"sessions": len(results), "answers": sum(statuses.values()), "statuses": dict(statuses),
            "converged_without_faults_percent": round(100.0 * quiet["converged"] / max(1, sum(quiet.values())), 3),
            **{name: sum(one[name] for one in results) for name in ("compared", "wrong", "wrong_in_time")},
            "largest_difference_N": round(max(one["largest_difference_N"] for one in results), 4),
            "recovery_ms_median_p99_largest": [round(float(q), 1) for q in
                                               np.quantile(recoveries or [0.0], [0.5, 0.99, 1.0])]}


if __name__ == "__main__":
    sys.exit(main())
