"""Hidden-effect study: effects are hidden in virtual recordings, and the diagnosis must name them.

    python -m benchmarks hidden_effects [--quick] [--json] [--protocol full ramps] [--rooms hidden other none ...]
        [--effects NAME ...] [--classes "3 to 10" "> 10"] [--one-size] [--seeds 1 3] [--none 380] [--shard 1/4]
        [--workers N | --dask ADDRESS] [--folder FOLDER]
    python -m benchmarks hidden_effects --scores [--sealed]      figures of what has been run under this hash
    python -m benchmarks hidden_effects --freeze                 compute sizes and testable effects again
    python -m benchmarks hidden_effects --cases                  what is hidden, as a table for docs/hidden_effects.md

A run that was killed continues where it stopped. Seeds below 1000 are for development; `--sealed` takes unused seeds
from 1000 on, records them in benchmarks/hidden_effects/ledger.jsonl, and needs a clean working tree. Figures
accumulate only under one hash of the diagnosis, its thresholds and the frozen table of sizes.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path

from benchmarks import ROOT
from benchmarks.hidden_effects.run import ROOMS, SEALED_FROM, Planned, Results, code_hash, plan, run_one
from benchmarks.hidden_effects.scoring import outcome
from benchmarks.hidden_effects.sizes import CLASSES, freeze
from benchmarks.hidden_effects.tables import cases_in_words, draw, figures
from benchmarks.hidden_effects.truth import CACHE, PROTOCOLS
from benchmarks.measure import about, show
from calibration.tasks.executors import Workers, open_task_executor

LEDGER = Path(__file__).with_name("ledger.jsonl")
#: Runs with nothing hidden of which none may alarm, for a rate below 1 % (Wilson).
ENOUGH = 380


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="four effects at two sizes, one seed")
    parser.add_argument("--protocol", nargs="+", choices=tuple(PROTOCOLS), default=list(PROTOCOLS))
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), metavar="ROOM",
                        help=f"of {', '.join(ROOMS)} (default all)")
    parser.add_argument("--effects", nargs="+", default=[], metavar="NAME", help="hide only these")
    parser.add_argument("--classes", nargs="+", choices=tuple(CLASSES), default=[], metavar="CLASS",
                        help=f"of projected signals, of {', '.join(CLASSES)} (default all)")
    parser.add_argument("--one-size", action="store_true", help="of each class one size, drawn by the seed")
    parser.add_argument("--seeds", nargs=2, type=int, default=[1, 1], metavar=("FIRST", "COUNT"))
    parser.add_argument("--none", type=int, default=None, metavar="N", help="runs with nothing hidden, for white and "
                        f"for correlated noise; {ENOUGH} without an alarm show a rate below 1 %% (default: COUNT)")
    parser.add_argument("--shard", default="1/1", metavar="I/N", help="of the runs, every N-th from the I-th on")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--dask", metavar="ADDRESS", help="a dask cluster instead")
    parser.add_argument("--folder", type=Path, default=CACHE / "runs", help=f"of the results (default {CACHE}/runs)")
    parser.add_argument("--sealed", action="store_true", help=f"unused seeds from {SEALED_FROM} on")
    parser.add_argument("--scores", action="store_true", help="only score what has been run")
    parser.add_argument("--freeze", action="store_true", help="only compute the table of sizes again, and write it")
    parser.add_argument("--cases", action="store_true", help="only print what is hidden")
    return parser


def shard_of(text: str) -> tuple[int, int]:
    """Parse a shard: ``2/8`` gives (2, 8).

    Raises:
        SystemExit: no such shard.
    """
    first, _, count = text.partition("/")
    if not (first.isdigit() and count.isdigit() and 1 <= int(first) <= int(count)):
        raise SystemExit(f"--shard {text}: give I/N with I from 1 to N, such as 1/4")
    return int(first), int(count)


def check_seeds(seeds: Sequence[int], digest: str, *, sealed: bool, ledger: Path = LEDGER) -> None:
    """Refuse seeds outside their documented range, and record the use of sealed seeds before any run.

    Raises:
        SystemExit: a sealed seed below `SEALED_FROM` or noted under another hash, a development seed from there on, or
            a working tree that differs from its commit.
    """
    if not sealed:
        if max(seeds) >= SEALED_FROM:
            raise SystemExit(f"seeds from {SEALED_FROM} on are sealed: run them once, with --sealed")
        return
    if min(seeds) < SEALED_FROM:
        raise SystemExit(f"seeds below {SEALED_FROM} are for development; thresholds were set on them")
    noted = [json.loads(line) for line in ledger.read_text(encoding="utf-8").splitlines()] if ledger.exists() else []
    ours = {"hash": digest, "first": min(seeds), "last": max(seeds)}
    for entry in noted:
        if {name: entry[name] for name in ours} == ours:
            return
        # Under one hash figures accumulate.
        if entry["hash"] != digest and entry["first"] <= max(seeds) and min(seeds) <= entry["last"]:
            raise SystemExit(f"seeds {entry['first']} to {entry['last']} were run under the hash {entry['hash'][:12]} "
                             f"on {entry['date']}; take fresh ones from {max(one['last'] for one in noted) + 1} on")
    changed = subprocess.run(["git", "status", "--porcelain", "calibration", "tissue_sim", "benchmarks",
                              f":(exclude)benchmarks/hidden_effects/{LEDGER.name}"], cwd=ROOT, capture_output=True,
                             text=True, check=True).stdout
    if changed.strip():
        raise SystemExit(f"the working tree differs from its commit; commit first, so that the figures have a code:\n"
                         f"{changed}")
    with ledger.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps({**ours, "date": date.today().isoformat()}) + "\n")


def run_all(planned: Sequence[Planned], results: Results, digest: str, workers: Workers, *, quiet: bool) -> None:
    """Run the planned cases without a result, and print one line for each."""
    done = {run["name"] for run in results.read()}
    left = [one for one in planned if one.name not in done]

    def keep(index: int, run: dict) -> None:
        results.add(run)
        if not quiet:
            said = run.get("failure") or f"{outcome(run)}: {run['verdict']} {', '.join(run['indistinguishable'])}"
            print(f"{index + 1}/{len(left)} {run['name']} -> {said} ({run['wall_s']:.0f} s)", flush=True)

    with open_task_executor(workers) as tasks:
        tasks.run(run_one, [(one, digest) for one in left], keep)


def main(arguments: Sequence[str] | None = None) -> None:
    asked = options().parse_args(arguments)
    if asked.freeze:
        freeze(list(PROTOCOLS))
        return
    if asked.cases:
        print(cases_in_words())
        return
    digest, shard = code_hash(), shard_of(asked.shard)
    results = Results(asked.folder, digest, sealed=asked.sealed, shard=shard)
    if not asked.scores:
        seeds = list(range(asked.seeds[0], asked.seeds[0] + asked.seeds[1]))
        planned = plan(asked.protocol, asked.rooms, seeds, effects=asked.effects, empty=asked.none, quick=asked.quick,
                       classes=asked.classes, one_size=asked.one_size)
        check_seeds([one.seed for one in planned], digest, sealed=asked.sealed)
        workers = Workers(asked.workers, asked.dask)
        try:
            run_all(planned[shard[0] - 1::shard[1]], results, digest, workers, quiet=asked.json)
        except KeyboardInterrupt:
            print("Stopped. Started again, the study continues from here.", file=sys.stderr)
    found = about("hidden_effects") | {"hash": digest, "seeds": "sealed" if asked.sealed else "development",
                                       "figures": figures(results.read())}
    show(found, draw, as_json=asked.json)


if __name__ == "__main__":
    main()
