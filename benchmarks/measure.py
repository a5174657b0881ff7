"""Common parts of the benchmarks: CPU time, machine, comparison with LAPACK, options and tables."""

import argparse
import functools
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy.linalg import lapack

import tissue_sim as ts
from benchmarks import MARKDOWN, ROOT
from tissue_sim.fem.linear import band
from tissue_sim.fem.linear.band import make_cholesky_functions
from tissue_sim.fem.taichi.origins import allocate_array
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


def cpu_seconds(work: Callable[[], object], repeats: int) -> list[float]:
    """Return the CPU time of each of `repeats` calls, s."""
    spent = []
    for _ in range(repeats):
        started = time.process_time()
        work()
        spent.append(time.process_time() - started)
    return spent


def summary(spent: list[float]) -> dict:
    return {"median_s": statistics.median(spent), "min_s": min(spent), "max_s": max(spent), "repeats": len(spent)}


@functools.cache
def band_kernels() -> tuple[Callable, Callable]:
    """Return kernels that factorise a band matrix and solve with the factor, a number of times each."""
    ti = get_initialised_taichi()
    init, solve = make_cholesky_functions()
    numbers = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    def factor(passes: ti.i32, table: numbers):
        for _ in range(passes):
            init(table, 0, 0)

    @ti.kernel
    def substitute(passes: ti.i32, table: numbers):
        for _ in range(passes):
            solve(table)

    return factor, substitute


def against_lapack(name: str, lower: np.ndarray, repeats: int, *, solve: bool) -> dict:
    """Compare the band Cholesky with LAPACK on the same matrix, in turns: CPU ms and GFLOP/s.

    Args:
        name: of the matrix, for the message.
        lower: lower band, shape (half band + 1, size).
        repeats: number of measurements of each median.
        solve: whether one solution with the factor is part of the time.

    Raises:
        SystemExit: the solutions differ.
    """
    factor, substitute = band_kernels()
    lower = np.asfortranarray(lower)
    half_band, size = lower.shape[0] - 1, lower.shape[1]
    blocks, right = band.pack_lapack_band_to_blocks(lower), np.random.default_rng(0).normal(size=size)
    rows = len(blocks)
    matrix, inverse = allocate_array(blocks.shape), allocate_array((rows, band.BLOCK))
    x = allocate_array((rows, band.BLOCK))
    offsets = band.make_band_table(matrix, matrix, matrix, matrix, inverse, x)

    def restore():
        matrix[:] = blocks
        x.ravel()[:size] = right

    def ours(passes):
        factor(passes, offsets)
        if solve:
            substitute(passes, offsets)

    def theirs(matrix, x):
        done, _ = lapack.dpbtrf(matrix, lower=1, overwrite_ab=1)
        if solve:
            lapack.dpbtrs(done, x, lower=1, overwrite_b=1)

    restore()
    factor(1, offsets)
    substitute(1, offsets)
    done, failed = lapack.dpbtrf(lower, lower=1)
    expected, _ = lapack.dpbtrs(done, right, lower=1)
    difference = float(abs(x.ravel()[:size] - expected).max() / abs(expected).max())
    if failed or not difference < 1e-6:
        raise SystemExit(f"{name}: our band Cholesky differs from LAPACK's solution by {difference:.2g} relative")
    spent = []
    for _ in range(repeats):
        # A launch without work is subtracted; the matrix is restored outside the measured time.
        for passes in (0, 1):
            restore()
            spent += cpu_seconds(functools.partial(ours, passes), 1)
        spent += cpu_seconds(functools.partial(theirs, lower.copy(order="F"), right.copy()), 1)
    empty, full, peer = (float(np.median(part)) * 1e3 for part in np.array(spent).reshape(-1, 3).T)
    work = size * half_band * (half_band + 4 * solve) * 1e-6
    return {"freedoms": size, "half_band": half_band, "difference": difference, "ours_ms": full - empty,
            "lapack_ms": peer, "ratio": (full - empty) / peer, "ours_gflops": work / (full - empty),
            "lapack_gflops": work / peer}


def machine() -> dict:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.system(), "load_average": load}


def option_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark: ``--json`` and ``--repeats``."""
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--repeats", type=_repeats, default=5, help="repetitions (at least 1, default 5)")
    return parser


def _repeats(text: str) -> int:
    repeats = int(text)
    if repeats < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return repeats


def about(name: str, peers: Sequence[str] = ()) -> dict:
    """Return the head of a result: name, date, machine, versions."""
    return {"benchmark": name, "date": date.today().isoformat(), "machine": machine(),
            "versions": {"Python": platform.python_version(), "tissue_sim": ts.__version__,
                         **{each: version(each) for each in (*peers, "taichi", "numpy", "scipy")}}}


class MarkdownConsole(Console):
    """Console that prints tables in Markdown and text without markup."""

    def print(self, *parts: Any, **_: Any) -> None:
        for part in parts:
            if not isinstance(part, Table):
                print(Text.from_markup(str(part)).plain + "\n")
                continue
            cells = [[Text.from_markup(str(cell)).plain.replace("|", "\\|").replace("\n", " ") for cell in
                      (column.header, *column.cells)] for column in part.columns]
            ruler = ["---" if column.justify == "left" else "---:" for column in part.columns]
            header, *rows = ([column[i] for column in cells] for i in range(len(part.rows) + 1))
            title = Text.from_markup(str(part.title)).plain.rstrip(".") if part.title else ""
            print((f"**{title}**\n\n" if title else "")
                  + "\n".join("| " + " | ".join(row) + " |" for row in (header, ruler, *rows)) + "\n")


def commit() -> str:
    """Return the short hash of the commit, "and changes" if files other than pages differ; "unknown" without git."""
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        is_changed = git("status", "--porcelain", "-uno", "--", ".", ":(exclude)docs")
        return git("rev-parse", "--short", "HEAD") + (" and changes" if is_changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def show(result: dict, draw: Callable[[dict, Console], None], *, as_json: bool) -> None:
    """Print the result as one JSON object, or as tables with date, machine and versions.

    Tables are in Markdown, with the commit, if the environment variable `MARKDOWN` is set.
    """
    if as_json:
        print(json.dumps(result))
        return
    markdown = MARKDOWN in os.environ
    console = MarkdownConsole() if markdown else Console(width=None if sys.stdout.isatty() else 150)
    found = result["machine"]
    console.print(f"{result['date']}, {found['cpu']}, {found['cores']} cores, load {found['load_average']}; "
                  + (f"commit {commit()}, " if markdown else "")
                  + ", ".join(f"{name} {number}" for name, number in result["versions"].items()))
    draw(result, console)


def table(console: Console, title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table whose first column is text and whose others are numbers."""
    drawn = Table(title=title, title_justify="left")
    for i, header in enumerate(headers):
        drawn.add_column(header, justify="left" if i == 0 else "right")
    for row in rows:
        drawn.add_row(*row)
    console.print(drawn)


def verdict(good: bool, target: str) -> str:
    return f"{target} {'met' if good else 'missed'}"


def spread(time: dict, digits: int = 2) -> str:
    """Format a `summary` in ms: median (smallest to largest)."""
    low, middle, high = (1e3 * time[name] for name in ("min_s", "median_s", "max_s"))
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
