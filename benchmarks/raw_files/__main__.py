"""Raw files of test machines with known moduli and random traps: correctness of import and calibration.

    python -m benchmarks raw_files --count 5000 --seed 1 [--clean] [--workers 2] [--only TRAP]
        [--areas AREA ...] [--json FILE]
    python -m benchmarks raw_files --seed 1 --index 17 --keep DIR     (one file again, with the same --areas and --only)
    python -m benchmarks raw_files --traps                            (names of the traps)

Each file goes through `calibration.import_files` and `calibration.calibrate` with the law neo_hooke, and flags for the
kind and the sizes where the file does not state them. What is counted:

    right                   a usable fit whose mu0 is within 5 % of the truth
    question                import asks (exit code 1), and the question names the trap
    refused, true reason    a refusal, or a fit that is not usable, whose message names the trap
    other question, refused, other reason    the same without a word of the trap
    crash                   an exception that is not an InputError or a ConvergenceError
    silently wrong          a usable fit whose mu0 is farther than 5 % from every modulus that the file supports

A file of a relaxing solid supports the modulus at once, that at rest, and that of its first loading; a file that
contradicts itself supports none. --clean makes files without traps, of seven machines and a plain table.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from benchmarks.raw_files.run import AREAS, OUTCOMES, RIGHT, TRAPS, WRONG, Result, run_file


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="files (default 1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of all files (default 1)")
    parser.add_argument("--index", type=int, metavar="K", help="only file K")
    parser.add_argument("--clean", action="store_true", help="files without traps")
    parser.add_argument("--areas", nargs="+", choices=AREAS, default=AREAS, metavar="AREA",
                        help=f"traps of these areas only: {', '.join(AREAS)}")
    parser.add_argument("--only", choices=tuple(TRAPS), metavar="TRAP", help="one trap in every file")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all results as JSON lines")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder in which the files and results stay")
    parser.add_argument("--traps", action="store_true", help="print the names of the traps")
    return parser


def run_all(chosen: argparse.Namespace) -> list[Result]:
    """Return all results in the order of their index."""
    indices = range(chosen.count) if chosen.index is None else [chosen.index]
    keep = None if chosen.keep is None else chosen.keep.resolve()
    one = partial(_quiet, chosen.seed, chosen.clean, chosen.only, tuple(chosen.areas), keep)
    if chosen.workers == 1:
        return [one(index) for index in indices]
    with ProcessPoolExecutor(chosen.workers) as pool:
        return list(pool.map(one, indices, chunksize=20))


def _quiet(seed: int, clean: bool, only: str | None, areas: tuple[str, ...], keep: Path | None, index: int) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run_file(seed, index, clean=clean, only=only, areas=areas, keep=keep)


def figures(results: Sequence[Result]) -> dict[str, Counter]:
    """Count the outcomes of each trap and of all files; a file with several traps counts for each."""
    found: dict[str, Counter] = {}
    for result in results:
        for name in ("all", *(("one reading is correct",) if result.wants_right else ("no modulus follows",)),
                     *(result.traps or (result.layout,))):
            counter = found.setdefault(name, Counter())
            counter[result.outcome] += 1
            counter["unsaid"] += bool(result.unsaid if name == "all" else name in result.unsaid)
    return found


def table(found: dict[str, Counter]) -> str:
    """Return the counts in Markdown, in the order of the registry of traps."""
    order = ["all", "one reading is correct", "no modulus follows", *TRAPS]
    names = sorted(found, key=lambda name: order.index(name) if name in order else len(order))
    lines = ["| trap | files | " + " | ".join(OUTCOMES) + " | right, trap not mentioned |",
             "|---" * (len(OUTCOMES) + 3) + "|"]
    for name in names:
        counts = found[name]
        files = sum(counts[outcome] for outcome in OUTCOMES)
        lines.append(f"| {name} | {files} | " + " | ".join(str(counts[outcome] or "") for outcome in OUTCOMES)
                     + f" | {counts['unsaid'] or ''} |")
    return "\n".join(lines)


def _line(result: Result) -> str:
    truths = ", ".join(f"{truth:.4g}" for truth in result.truths) or "none"
    mu0 = "-" if result.mu0 is None else f"{result.mu0:.4g}"
    return (f"{result.index}: {' + '.join(result.traps) or 'clean'}; {result.layout}, {result.kind}: {result.outcome}; "
            f"mu0 {mu0} Pa, truth {truths}; {result.said[:300]}")


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = options().parse_args(arguments)
    if chosen.traps:
        print("\n".join(f"{trap.area}: {name}" for name, trap in TRAPS.items()))
        return
    results = run_all(chosen)
    if chosen.json is not None:
        chosen.json.write_text("".join(json.dumps(result.to_json()) + "\n" for result in results), encoding="utf-8")
    print(table(figures(results)))
    shown = [result for result in results if result.outcome == WRONG or (chosen.clean and result.outcome != RIGHT)
             or chosen.index is not None]
    print("\n" + "\n".join(map(_line, shown)) if shown else "")
    sys.exit(1 if any(result.outcome == WRONG for result in results) else 0)


if __name__ == "__main__":
    main()
