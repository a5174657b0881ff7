"""Benchmark of engines: force on a tool in soft tissue, the same five jobs in every engine that is installed.

    python -m benchmarks engines [--engine NAME ...] [--job NAME ...] [--mesh NAME ...] [--add FILE.py ...]
        [--results FILE] [--scores] [--all] [--figure FOLDER] [--json]

A run that is in the file of results is not repeated, so that a stopped benchmark continues. ``--scores`` only shows
tables and figures of the stored runs. ``--add`` adds an engine: a Python file with an object ``ENGINE`` of a class
derived from `calibration.targets.runner.TargetRunner`; its name is that of the file.
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import runpy
import sys
from pathlib import Path

from benchmarks.engines.figures import draw_figures
from benchmarks.engines.jobs import JOBS, MESHES
from benchmarks.engines.run import Results, execute, get_or_compute_truth, list_constants, list_engines, list_runs
from benchmarks.engines.tables import draw_tables, list_rows
from benchmarks.measure import about, show
from calibration.targets.runner import RUNNERS

#: Results of the documentation.
RESULTS = Path(__file__).with_name("results.jsonl")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", nargs="+", metavar="NAME", help="engines (default: all that are installed)")
    parser.add_argument("--job", nargs="+", choices=list(JOBS), default=list(JOBS), help="jobs (default: all)")
    parser.add_argument("--mesh", nargs="+", choices=list(MESHES), default=list(MESHES), help="meshes (default: all)")
    parser.add_argument("--add", nargs="+", type=Path, default=[], metavar="FILE.py", help="files of further engines")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE",
                        help="file of results (default: that of the documentation)")
    parser.add_argument("--scores", action="store_true", help="show the stored runs without new ones")
    parser.add_argument("--all", action="store_true",
                        help="show all meshes and steps (default: the finest run of each engine)")
    parser.add_argument("--figure", type=Path, metavar="FOLDER", help="draw the pictures into this folder")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    return parser


def add_engine_of_file(path: Path) -> str:
    """Register the object ``ENGINE`` of a Python file under the name of the file, and return the name.

    Raises:
        SystemExit: the file has no such object.
    """
    found = runpy.run_path(str(path)).get("ENGINE")
    if found is None:
        raise SystemExit(f"{path} must define an object ENGINE of a class derived from TargetRunner.")
    RUNNERS.register(found, path.stem)
    return path.stem


def main() -> int:
    options = make_parser().parse_args()
    added = [add_engine_of_file(path) for path in options.add]
    known, results = list_engines(), Results(options.results)
    missing = {name: reason for name, engine in known.items() if (reason := engine.describe_missing_program())}
    engines = (options.engine or [name for name in known if name not in missing]) + [
        name for name in added if options.engine and name not in options.engine]
    for name in engines:
        if name not in known or name in missing:
            reason = missing.get(name, f"unknown; known: {', '.join(known)}")
            raise SystemExit(f"engine {name} cannot run: {reason}")
    for name, reason in missing.items():
        if not options.engine:
            print(f"{name} is left out: {reason}", file=sys.stderr)
    truths = {job: get_or_compute_truth(job, results) for job in options.job}
    runs = list(list_runs(engines, options.job, options.mesh))
    if not options.scores:
        finished = results.read()
        pending = [run for run in runs if run.key not in finished]
        for number, run in enumerate(pending, start=1):
            print(f"{number} of {len(pending)}: {run.engine}, {run.job}, {run.mesh}, step {1e3 * run.step:g} ms"
                  f"{'' if run.is_matched else ', constants at rest'}", file=sys.stderr, flush=True)
            results.append(execute(run, results))
    stored = results.read()
    rows = list_rows([stored[run.key] for run in runs if run.key in stored], truths)
    constants = list_constants(stored, engines)
    if options.figure is not None:
        draw_figures(rows, truths, constants, options.figure)
    show({**about("engines"), "shows_all": options.all, "constants": constants, "rows": rows}, draw_tables,
         as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
