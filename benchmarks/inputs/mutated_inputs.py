"""Test every reader of files and of the wire protocol with damaged and hostile input.

    python -m benchmarks mutated_inputs [--count 100000] [--seed 0] [--readers rig campaign ...] [--json]

Each reader works in a separate process with limited memory under supervision: an input without an answer within
`PATIENCE` is a hang. Prints a table in Markdown; the last one stands in docs/threats.md. Inputs that make a traceback
or a hang are kept, and named.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import select
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from benchmarks import child_environment

#: Time without an answer before a worker is replaced, s: two for the reading, the rest for a busy computer.
PATIENCE = 20.0
#: Memory limit of a worker, bytes.
MEMORY = 3_000_000_000
#: Readers with the most expensive inputs.
SLOW = ("import", "campaign", "protocol")
#: Fraction of the inputs that the expensive readers get.
SHARE = 0.3

#: How the bounds, and the door behind them, say what they have stopped.
WORDS = {"stopped": ("exceeds the CPU time", "exceeds the memory", "ends the process"),
         "faults": ("or its reader has an error", "look for odd names, numbers and nesting")}


@dataclass
class Row:
    """Outcomes of the inputs of one reader.

    `stopped` counts refusals by the limit of time or memory or by the end of the reading process, `faults` unexpected
    exceptions in the reader; `memory` is that of the largest process, MB."""

    reader: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    stopped: int = 0
    faults: int = 0
    tracebacks: int = 0
    hangs: int = 0
    slowest_s: float = 0.0
    memory_MB: float = 0.0
    kept: list[str] = field(default_factory=list)

    def line(self) -> str:
        return (f"| {self.reader} | {self.inputs} | {self.accepted} | {self.refused} | {self.tracebacks} | "
                f"{self.hangs} | {self.stopped} | {self.faults} | {self.slowest_s:.2f} | {self.memory_MB:.0f} |")


def work(name: str, seed: int, first: int, last: int, folder: Path) -> None:
    """Read the mutated inputs of one reader in a worker process, and print one JSON line for each."""
    from benchmarks.inputs.mutations import damaged
    from benchmarks.inputs.readers import REFUSALS, readers
    from tissue_sim import bounded
    from tissue_sim.errors import MESSAGE_LIMITS

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    every = readers(folder)
    sample, read = every[name]
    read(sample)  # which is sound
    others = [content for content, _ in every.values() if isinstance(content, bytes)]
    for number in range(first, last):
        chance = random.Random(f"{seed} {name} {number}")
        data = damaged(sample, chance, others)
        (folder / "now").write_bytes(data)
        began = time.perf_counter()
        what, said = "accepted", ""
        try:
            read(data)
        except REFUSALS as error:
            what = next((name for name, words in WORDS.items() if any(word in str(error) for word in words)), "refused")
            said = str(error)
            if len(str(error)) > MESSAGE_LIMITS.message or "\n" in str(error):
                what = f"more than a short sentence: {str(error)[:400]!r}"
        except Exception as error:
            what = f"{type(error).__name__}: {str(error)[:400]}"
        seconds = time.perf_counter() - began
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        child = bounded._PROCESS._child
        if child is not None:
            memory = max(memory, _highest(child.pid))
        memory = max(memory, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3)
        print(json.dumps([number, what, seconds, memory, said]), flush=True)


def _highest(process: int) -> float:
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM:")), 0.0)


def watch(name: str, seed: int, count: int, kept: Path) -> Row:
    """Run all inputs of one reader; replace a worker that hangs or dies."""
    row = Row(name)
    while row.inputs < count:
        with tempfile.TemporaryDirectory(prefix="mutated_") as folder:
            worker = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.inputs.mutated_inputs", "--work", name, "--seed", str(seed),
                 "--first", str(row.inputs), "--last", str(count), "--folder", folder],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=child_environment())
            assert worker.stdout is not None and worker.stderr is not None
            begun = False
            while row.inputs < count:
                ready, _, _ = select.select([worker.stdout], [], [], PATIENCE if begun else 120.0)
                line = worker.stdout.readline() if ready else b""
                if not line:
                    break
                begun = True
                _note(row, json.loads(line), Path(folder), kept)
            if row.inputs < count:
                alive = worker.poll() is None and not ready
                worker.kill()
                said = worker.stderr.read().decode("utf-8", "replace").strip().splitlines()
                if not begun:
                    raise SystemExit(f"{name}: its sound sample is not read: {said[-1] if said else 'no answer'}")
                row.inputs += 1
                row.hangs, row.tracebacks = row.hangs + alive, row.tracebacks + (not alive)
                _keep(row, row.inputs - 1, "hang" if alive else f"died: {said[-1:]}", Path(folder), kept)
            worker.wait()
    return row


def _note(row: Row, answer: list, folder: Path, kept: Path) -> None:
    number, what, seconds, memory, said = answer
    row.inputs = number + 1
    row.slowest_s, row.memory_MB = max(row.slowest_s, seconds), max(row.memory_MB, memory)
    if what in ("accepted", "refused", *WORDS):
        row.accepted += what == "accepted"
        row.refused += what != "accepted"
        row.stopped += what == "stopped"
        row.faults += what == "faults"
        if what in WORDS:
            row.kept.append(f"{row.reader} {number}: {what}: {said}")
    else:
        row.tracebacks += 1
        _keep(row, number, what, folder, kept)


def _keep(row: Row, number: int, what: str, folder: Path, kept: Path) -> None:
    # The worker is an input further by now, but each is generated from seed, reader and number.
    row.kept.append(f"{row.reader} {number}: {what}")
    if what == "hang":
        kept.mkdir(parents=True, exist_ok=True)
        (kept / f"{row.reader.replace(' ', '_')}_{number}").write_bytes((folder / "now").read_bytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000, help="inputs of all readers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="*")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "mutated_inputs")
    for hidden in ("--work", "--first", "--last", "--folder"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.work, arguments.seed, int(arguments.first), int(arguments.last), Path(arguments.folder))
        return
    from benchmarks.inputs.readers import names

    chosen = [name for name in names() if not arguments.readers or name in arguments.readers]
    shares = {name: SHARE if name.split()[0] in SLOW else 1.0 for name in chosen}
    each = arguments.count / sum(shares.values())
    if not arguments.json:
        print("| reader | inputs | accepted | refused | tracebacks | hangs | stopped | faults | slowest, s | "
              "memory, MB |")
        print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    rows = []
    for name in chosen:
        rows.append(watch(name, arguments.seed, -int(-each * shares[name] // 1), arguments.keep))
        if not arguments.json:
            print(rows[-1].line(), flush=True)
    total = Row("all", *(sum(getattr(row, key) for row in rows)
                         for key in ("inputs", "accepted", "refused", "stopped", "faults", "tracebacks", "hangs")),
                max(row.slowest_s for row in rows), max(row.memory_MB for row in rows))
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "rows": [asdict(row) for row in rows], "all": asdict(total)}))
    else:
        print(total.line())
    for row in rows:
        for each_kept in row.kept:
            print(each_kept, file=sys.stderr)
    sys.exit(bool(total.tracebacks or total.hangs))


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
