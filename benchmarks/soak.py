"""Play with a server as a careless user and an attacker would, and replay all that was answered.

    python benchmarks/soak.py [--minutes 30] [--seed 1] [--json]

A hand moves through random aims at 1 kHz under random tools, while parameters change by up to twentyfold, states are
saved and restored, and the tissue is reset; poses and times that no scene holds, damaged packets, floods and garbage
arrive, the client pauses, and servers are interrupted and killed. Then the logged motion is stepped again without a
budget, from a reset on: what was called CONVERGED must be within 1 % + 0.02 N of that.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from measure import table
from rich.console import Console
from soak_replay import score
from soak_scenes import MATERIAL
from soak_session import run

import tissue_sim as ts

SESSION = 30.0
LARGEST = 100.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    results, count = [], max(1, round(arguments.minutes * 60.0 / SESSION))
    with tempfile.TemporaryDirectory() as folder:
        material = Path(folder) / "soak.material.json"
        ts.write_material_file(ts.MaterialFile.of(MATERIAL), material)
        for number in range(count):
            rng = np.random.default_rng([arguments.seed, number])
            session = run(rng, material, min(SESSION, arguments.minutes * 60.0))
            results.append(score(session, LARGEST))
            print(f"session {number + 1} of {count}: {results[-1]['statuses']}, {results[-1]['wrong']} wrong",
                  file=sys.stderr)
    summary = summarise(results)
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "summary": summary, "sessions": results}))
    else:
        table(Console(), "soak", ("figure", "value"), [(key, f"{value}") for key, value in summary.items()])
    return 0


def summarise(results: list[dict]) -> dict:
    """Over all sessions."""
    statuses, quiet = Counter(), Counter()
    for one in results:
        statuses.update(one["statuses"])
        quiet.update(one["quiet"])
    recoveries = [each for one in results for each in one["recoveries_ms"]]
    settled = quiet["converged"] / max(1, sum(quiet.values()))
    return {"sessions": len(results), "replies": sum(statuses.values()), "statuses": dict(statuses),
            "compared": sum(one["compared"] for one in results), "wrong": sum(one["wrong"] for one in results),
            "largest_difference_N": max(one["largest_difference_N"] for one in results),
            "converged_without_faults_percent": round(100.0 * settled, 3),
            "beyond_the_largest_force": sum(one["beyond"] for one in results),
            "requests_without_reply": sum(one["lost"] for one in results),
            "recovery_ms_median_p99_largest": [round(float(q), 1) for q in
                                               np.quantile(recoveries or [0.0], [0.5, 0.99, 1.0])],
            "ended_otherwise_than_asked": sum(one["exit_code"] != (0 if one["ended_by"] == "signal" else -9)
                                              for one in results),
            "words": [line for one in results for line in one["words"]][:5]}


if __name__ == "__main__":
    sys.exit(main())
