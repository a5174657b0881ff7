"""Simulators on random motions with random traps: number of silently wrong forces.

    python -m benchmarks motions --axisymmetric 1600 --spatial 300 --multirate 100 --seed 1 [--clean] [--workers N]
                                 [--only TRAP] [--index K ...] [--json FILE]

Every motion is played on the axisymmetric simulator, on a coarse or reduced solid in space, or on a multirate tissue
whose bulk answers after a fixed simulated time, and every answer is compared with the true force: a closed form where
one exists, else a new simulator that follows the true path of the tool in fine steps (`motion_truth.py`); the whole
solid for reduced and multirate tissue. An answer is silently wrong if it is CONVERGED and its force is off by more
than 3 % of the motion's peak force and by more than this and the stated error together, if its stiffness is off by more
than 5 % and `stiffness_age` is zero, if a pose off the axis of an axisymmetric scene is not marked, or if
an input that must be refused is accepted.

Prints a table by solver and trap, then each silently wrong motion with its index; `--index K` with the same options
plays this motion alone. Exit code 1 if a motion is silently wrong.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

#: Threads of the linear algebra of each process.
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
#: Silently wrong motions that are described.
LISTED = 60
#: Names of the groups, each with a number of motions and a table of traps.
GROUPS = ("axisymmetric", "spatial", "multirate")


@dataclass(frozen=True)
class Task:
    """Motion of the generator, by its number.

    Attributes:
        group: one of `GROUPS`; index: in the group; seed: of the run.
        is_clean: without a trap; only: name of the trap, or None for a random one.
    """

    group: str
    index: int
    seed: int
    is_clean: bool
    only: str | None


@dataclass(frozen=True)
class Result:
    """Outcome of a motion.

    Attributes:
        trap, scene: names.
        outcome: the worst verdict; answered, valid: valid ticks with a CONVERGED answer, and all.
        counts: ticks by verdict.
        notes: the first wrong answers in words.
        largest_error: of CONVERGED forces, over the peak force.
        seconds: CPU time.
    """

    group: str
    index: int
    trap: str
    scene: str
    outcome: str
    answered: int
    valid: int
    counts: dict[str, int]
    notes: list[str]
    largest_error: float
    seconds: float


def motion_of(task: Task):
    """Return the motion of a task."""
    from benchmarks.motions.coupling import light_tool
    from benchmarks.motions.scenes import multirate_scene, spatial_scene
    from benchmarks.motions.space_traps import MULTIRATE, SPATIAL
    from benchmarks.motions.traps import AXISYMMETRIC, clean

    chance = np.random.default_rng([task.seed, GROUPS.index(task.group), task.index])
    if task.is_clean:
        scene = {"axisymmetric": lambda: None, "spatial": lambda: spatial_scene(chance),
                 "multirate": lambda: multirate_scene(chance)}[task.group]()
        return clean(chance, scene)
    table: dict = {"axisymmetric": {**AXISYMMETRIC, "light tool": (light_tool, 1.0)}, "spatial": SPATIAL,
                   "multirate": MULTIRATE}[task.group]
    if task.only is not None:
        return table[task.only][0](chance)
    weights = np.array([weight for _, weight in table.values()])
    name = list(table)[int(chance.choice(len(table), p=weights / weights.sum()))]
    return table[name][0](chance)


def play(task: Task) -> Result:
    """Draw, play and judge one motion."""
    from benchmarks.motions.coupling import Coupling, coupled
    from benchmarks.motions.judge import judged

    motion = motion_of(task)
    judgement = coupled(motion) if isinstance(motion, Coupling) else judged(motion)
    answered, valid = judgement.answered
    return Result(task.group, task.index, motion.trap, motion.scene.name, judgement.outcome, answered, valid,
                  {verdict.value: count for verdict, count in judgement.counts.items()}, judgement.notes,
                  judgement.largest_error, judgement.seconds)


@dataclass
class Row:
    """Sums of the motions of one trap."""

    motions: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    answered: int = 0
    valid: int = 0
    refused: int = 0
    late_off: int = 0
    seconds: float = 0.0

    def add(self, result: Result) -> None:
        """Count a motion."""
        self.motions += 1
        self.outcomes[result.outcome] = self.outcomes.get(result.outcome, 0) + 1
        self.answered, self.valid = self.answered + result.answered, self.valid + result.valid
        self.refused += result.counts.get("refused rightly", 0)
        self.late_off += result.counts.get("not converged, force off", 0)
        self.seconds += result.seconds

    def line(self, solver: str, trap: str) -> str:
        """Return a row of the table in Markdown."""
        def count(name: str) -> int:
            return self.outcomes.get(name, 0)

        fraction = 100.0 * self.answered / self.valid if self.valid else 100.0
        return (f"| {solver} | {trap} | {self.motions} | {count('right')} | {count('not converged')} | "
                f"{count('fault')} | {count('wrong, but within the error that the answer states')} | "
                f"{count('silently wrong')} | {fraction:.1f} | {self.refused} | {self.late_off} | {self.seconds:.0f} |")


HEADER = """| solver | trap | motions | right | not converged | faults | wrong within stated error | silently wrong | \
ticks answered, % | inputs refused rightly | LATE ticks whose force is off | CPU s |
|---|---|---|---|---|---|---|---|---|---|---|---|"""


def print_table(results: list[Result]) -> None:
    """Print rows by solver and trap, sums, and the motions that are silently wrong or faulty."""
    rows: dict[tuple[str, str], Row] = {}
    for result in results:
        solver = result.scene.split(",")[0]
        for key in ((solver, result.trap), (solver, "all"), ("all", "all")):
            rows.setdefault(key, Row()).add(result)
    print(HEADER)
    for solver, trap in sorted(rows, key=lambda key: (key[0] == "all", key[0], key[1] == "all", key[1])):
        print(rows[solver, trap].line(solver, trap))
    bad = [each for each in results if each.outcome in ("silently wrong", "fault")]
    for each in sorted(bad, key=lambda each: each.outcome)[::-1][:LISTED]:
        print(f"\n{each.outcome}: --{each.group} --index {each.index} ({each.trap}; {each.scene})")
        for note in each.notes:
            print(f"    {note}")


def played(tasks: list[Task], workers: int) -> Iterator[Result]:
    """Yield the results as they finish."""
    if workers <= 1:
        yield from map(play, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(play, tasks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for group in GROUPS:
        parser.add_argument(f"--{group}", type=int, default=0, nargs="?", const=1, help="number of motions")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--clean", action="store_true", help="motions without traps")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--only", help="name of the only trap")
    parser.add_argument("--index", type=int, nargs="*", help="play these motions alone")
    parser.add_argument("--json", type=Path, help="write every result to this file")
    parser.add_argument("--verbose", action="store_true", help="print each motion when it is done")
    arguments = parser.parse_args()
    tasks = [Task(group, index, arguments.seed, arguments.clean, arguments.only) for group in GROUPS
             if getattr(arguments, group)
             for index in (arguments.index if arguments.index is not None else range(getattr(arguments, group)))]
    began, results = time.time(), []
    for result in played(tasks, arguments.workers):
        results.append(result)
        if arguments.verbose:
            print(f"{result.group} {result.index} {result.trap} ({result.scene}): {result.outcome}, largest error "
                  f"{100 * result.largest_error:.2f} %, {result.seconds:.1f} s {result.notes}", flush=True)
    results.sort(key=lambda each: (GROUPS.index(each.group), each.index))
    print_table(results)
    print(f"\n{len(results)} motions, {sum(each.seconds for each in results):.0f} CPU s, {time.time() - began:.0f} s")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(each) for each in results], indent=1), encoding="utf-8")
    sys.exit(any(each.outcome == "silently wrong" for each in results))


if __name__ == "__main__":
    for name, number in THREADS.items():
        os.environ.setdefault(name, number)
    main()
