"""Mutation test: how many drawn faults in the source code do the tests find?

    python -m benchmarks mutants --count 120 --seed 1 [--fast] [--json]
    python -m benchmarks mutants --seed 1 --index 17                   (one mutant)
    python -m benchmarks mutants --seed 1 --results mutants.jsonl      (an interrupted run continues)
    python -m benchmarks mutants --seed 1 --list                       (only draw)

Mutants are drawn in turn from the packages and from six kinds of faults (sign, factor, index, unit, comparison,
removed guard). For each one, the test files nearest in the graph of imports run on a copy of the repository: the tests
of command two (README), then the slow ones, until a test fails that passes without the fault. The figures are lower
limits: tests of other files may find further faults, and some mutants compute the same results.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from benchmarks import ROOT
from benchmarks.mutants.drawing import KINDS, PACKAGES, Mutant, draw
from benchmarks.mutants.trial import (
    KILLED_FAST,
    KILLED_SLOW,
    OUT_OF_TIME,
    SURVIVED,
    Laboratory,
    TrialSettings,
    without_slow_tests,
)

#: Results, in the order of the columns.
RESULTS = (KILLED_FAST, KILLED_SLOW, SURVIVED, OUT_OF_TIME)
#: Longest printed source of an expression, characters.
WIDTH = 60


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=120, metavar="N", help="number of mutants (default 120)")
    parser.add_argument("--quick", action="store_true", help="24 mutants, one of each kind and package")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the draws (default 1)")
    parser.add_argument("--index", type=int, metavar="K", help="only mutant K")
    parser.add_argument("--fast", action="store_true", help="no slow tests")
    parser.add_argument("--list", action="store_true", help="print the mutants and run no tests")
    parser.add_argument("--results", type=Path, metavar="FILE",
                        help="JSON lines of finished trials; these are not repeated, new ones are added")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def describe(mutant: Mutant) -> str:
    """One line: file, line, kind and change."""
    before, after = (" ".join(text.split()) for text in (mutant.before, mutant.after))
    return f"{mutant.path}:{mutant.line}: {mutant.kind}: {before[:WIDTH]} -> {after[:WIDTH]}"


def as_row(index: int, mutant: Mutant) -> dict[str, object]:
    return {"index": index, **asdict(mutant), "names": list(mutant.names)}


def table(rows: list[dict]) -> str:
    """Markdown table: one line for each package and each kind."""
    lines = ["| | mutants | " + " | ".join(RESULTS) + " |", "|---" * (2 + len(RESULTS)) + "|"]
    groups = [(name, [row for row in rows if row["path"].startswith(f"{name}/")]) for name in PACKAGES]
    groups += [(kind, [row for row in rows if row["kind"] == kind]) for kind in KINDS]
    for name, group in [*groups, ("all", rows)]:
        counts = Counter(row["result"] for row in group)
        lines.append(f"| {name} | {len(group)} | " + " | ".join(str(counts[result]) for result in RESULTS) + " |")
    return "\n".join(lines)


def main() -> int:
    """Run the command line. Returns 0; surviving mutants are results, not errors."""
    chosen = options().parse_args()
    count = len(PACKAGES) * len(KINDS) if chosen.quick else chosen.count
    mutants = dict(enumerate(draw(ROOT, chosen.seed, count if chosen.index is None else chosen.index + 1)))
    if chosen.index is not None:
        mutants = {chosen.index: mutants[chosen.index]}
    if chosen.list:
        for index, mutant in mutants.items():
            print(json.dumps(as_row(index, mutant)) if chosen.json else f"{index}: {describe(mutant)}")
        return 0
    rows = []
    if chosen.results and chosen.results.exists():
        rows = [json.loads(line) for line in chosen.results.read_text(encoding="utf-8").splitlines()]
        rows = [row for row in rows if row["index"] in mutants]
    settings = without_slow_tests(TrialSettings()) if chosen.fast else TrialSettings()
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        laboratory = Laboratory(ROOT, Path(folder), settings)
        for index in sorted(set(mutants) - {row["index"] for row in rows}):
            outcome = laboratory.try_mutant(mutants[index])
            rows.append({**as_row(index, mutants[index]), **asdict(outcome)})
            print(f"{index}: {describe(mutants[index])}: {outcome.result} {outcome.test} ({outcome.seconds:.0f} s)",
                  file=sys.stderr, flush=True)
            if chosen.results:
                with chosen.results.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(rows[-1]) + "\n")
    rows.sort(key=lambda row: row["index"])
    if chosen.json:
        counts = Counter(row["result"] for row in rows)
        print(json.dumps({"benchmark": "mutants", "seed": chosen.seed, "settings": asdict(settings),
                          "counts": {result: counts[result] for result in RESULTS}, "mutants": rows}))
        return 0
    print(table(rows))
    print("\nSurvivors:\n")
    for row in rows:
        if row["result"] in (SURVIVED, OUT_OF_TIME):
            fields = {name: row[name] for name in Mutant.__dataclass_fields__}
            print(f"- {row['index']}: `{describe(Mutant(**fields))}`")
    return 0


if __name__ == "__main__":
    sys.exit(main())
