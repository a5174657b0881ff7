"""Fraction of random models whose tests the solver completes, and a check of its equilibria.

    python -m benchmarks random_models [--seeds 1:401] [--resolution fast] [--quarter] [--resume FILE] [--json]
    python -m benchmarks random_models --identities [--seeds 1:101] ...
    python -m benchmarks random_models --motion --resolution realtime [--max-solves N] [--seeds 1:101] ...

A seed stands for one model (`random_model_generator`). Whoever does not reach the last sample has failed: it stopped,
was refused, took longer than 90 s of CPU, or ended in an exception. Every sample is checked by other means than the
solver's (`equilibrium_check`); that is counted apart. --quarter also takes steps a quarter as long and compares the
samples that both have. --identities checks what must hold of any solver instead, of the elastic models on an ideal rig;
--motion leads each through 2 s of irregular motion, tick by tick (`random_model_motion`), with --max-solves of at most
a maximum number of linear solutions per tick, compared with the same motion without a maximum.
With --resume a stopped run continues; a file contains the results of one state of the program.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measure import about, show
from benchmarks.random_models.generator import draw
from benchmarks.random_models.identities import identities
from benchmarks.random_models.motion import draw_motion, motion, motion_figures
from benchmarks.random_models.runs import run, run_quarter, stratum, warm_up
from benchmarks.random_models.tables import draw_identities, draw_runs, figures, identity_figures

RESOLUTIONS = ("fast", "accurate", "realtime")


class Lines:
    """Results of the seeds, in a file of JSON lines or in memory only.

    Attributes:
        known: seed -> result.
    """

    def __init__(self, path: Path | None, asked: dict):
        self._path, self.known = path, {}
        if path is None or not path.exists():
            return
        text = path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        if whole != text:  # the program was stopped while it wrote the last line
            path.write_text(whole, encoding="utf-8")
        for line in whole.splitlines():
            known = json.loads(line)
            if known["asked"] == asked:
                self.known[known["seed"]] = known

    def add(self, known: dict) -> None:
        self.known[known["seed"]] = known
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(known) + "\n")


def _seeds(text: str) -> range:
    first, colon, end = text.partition(":")
    if not (colon and first.isdigit() and end.isdigit() and int(first) < int(end)):
        raise argparse.ArgumentTypeError(f"{text}: give A:B, from A to one before B, such as 1:401")
    return range(int(first), int(end))


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=_seeds, default=range(1, 401), metavar="A:B",
                        help="from A to one before B (default 1:401)")
    parser.add_argument("--resolution", choices=RESOLUTIONS, default="fast", help="of the mesh (default fast)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on the output")
    parser.add_argument("--quarter", action="store_true", help="also with four times as many samples")
    parser.add_argument("--identities", action="store_true", help="instead: what must hold of any solver")
    parser.add_argument("--motion", action="store_true", help="instead: irregular motion in real time")
    parser.add_argument("--max-solves", type=int, metavar="N", help="of a tick of --motion (default: no bound)")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="of JSON lines, one a model")
    return parser


def _of(seed: int, asked: dict) -> dict:
    one = draw(seed)
    entry = {"asked": asked, "seed": seed, "stratum": stratum(one), "law": one.law, "motion": one.motion,
             "ratio": one.ratio, "extra": list(one.extra)}
    if asked["identities"]:
        return entry | {"identities": identities(one, asked["resolution"])}
    if asked["motion"]:
        return entry | motion(one, asked["resolution"], asked["max_solves"])
    entry |= run(one, asked["resolution"])
    return entry | {"quarter": run_quarter(one, asked["resolution"], entry)} if asked["quarter"] else entry


def _said(entry: dict) -> str:
    """Return one line of progress."""
    line = f"{entry['seed']} {entry['stratum']}, {entry['law']}{', ' * bool(entry['extra'])}{', '.join(entry['extra'])}"
    if "identities" in entry:
        return f"{line}: " + ", ".join(f"{name} {'' if one['passed'] else 'NOT '}({one['value']:.1e})"
                                       for name, one in entry["identities"].items())
    if "statuses" in entry:
        return (f"{line}: {entry['statuses']}, solves {entry['solves']}, {entry['tick_ms'][0]:.2f} ms, as new to "
                f"{entry['recovered']:.1e}{', '.join(entry['faults'])}")
    if "samples" not in entry:
        return f"{line}: {entry['status']}: {entry['message']}"
    faults = ", ".join(f"{fault['check']} {fault['value']:.1e}" for fault in entry["faults"])
    quarter = entry.get("quarter", {})
    finer = f"; finer {quarter.get('difference', quarter['status'])}" if quarter else ""
    return (f"{line}: {entry['status']}, {entry['samples']} of {entry['of']} samples, {entry['newton_iterations']} "
            f"solves, {entry['cpu_s']:.2f} s{finer}{'; not in equilibrium: ' * bool(faults)}{faults}")


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = options().parse_args(arguments)
    asked = {"resolution": chosen.resolution, "quarter": chosen.quarter, "identities": chosen.identities,
             "motion": chosen.motion, "max_solves": chosen.max_solves}
    lines = Lines(chosen.resume, asked)
    left = [seed for seed in chosen.seeds if seed not in lines.known]
    if left:
        warm_up()
    try:
        for seed in left:
            lines.add(_of(seed, asked))
            print(_said(lines.known[seed]), file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print("Stopped. With --resume the run continues from here.", file=sys.stderr)
    entries = [lines.known[seed] for seed in chosen.seeds if seed in lines.known]
    result = about("random_models") | asked | {"seeds": [chosen.seeds.start, chosen.seeds.stop]}
    if chosen.identities:
        show(result | {"figures": identity_figures(entries)}, draw_identities, as_json=chosen.json)
    elif chosen.motion:
        show(result | {"figures": motion_figures(entries)}, draw_motion, as_json=chosen.json)
    else:
        show(result | {"figures": figures(entries)}, draw_runs, as_json=chosen.json)


if __name__ == "__main__":
    main()
