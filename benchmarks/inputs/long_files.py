"""Time to read a long recording relative to `numpy.loadtxt` in the same run, and memory of the largest process.

    python -m benchmarks long_files [--json] [--repeats N] [--rows N]

Each file is read in a new process, whose imports do not count; the peer reads the same columns of the same file.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np
from rich.console import Console

from benchmarks.measure import about, option_parser, show, table

_PEER = """
import numpy as np
def read(path):
    return np.loadtxt(path, delimiter={delimiter!r}, skiprows={lines}, usecols=(0, 1, 2){converters}).shape[0]
"""
_OURS = """
import tissue_sim as ts
def read(path):
    return ts.read_recording(path, {options}).time.size
"""
_MEASURED = """
import json, resource, sys, time
began = time.perf_counter()
rows = read(sys.argv[1])
taken = time.perf_counter() - began
most = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
print(json.dumps([rows, taken, most * 1e-3]))
"""


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    arguments = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        own, german = write(Path(folder), arguments.rows)
        for name, path, delimiter, lines, options in (
                ("our own columns", own, ",", 1, ""),
                ("named columns", own, ",", 1, "columns={'time': 'time', 'displacement': 'displacement', "
                                               "'force': 'force'}"),
                ("named columns, semicolons, decimal commas", german, ";", 2,
                 "columns={'time': 'Zeit', 'displacement': 'Weg', 'force': 'Kraft'}"),
                ("understood (format = table)", german, ";", 2, "format='table'")):
            converters = "" if delimiter == "," else ", converters=lambda cell: float(cell.replace(',', '.'))"
            ours, peers = [], []
            for _ in range(arguments.repeats):
                ours.append(measured(_OURS.format(options=options), path))
                peers.append(measured(_PEER.format(delimiter=delimiter, lines=lines, converters=converters), path))
            assert {rows for rows, _, _ in (*ours, *peers)} == {arguments.rows}
            seconds = median(taken for _, taken, _ in ours)
            results.append({"file": name, "MB": path.stat().st_size / 1e6, "seconds": seconds,
                            "over_loadtxt": seconds / median(taken for _, taken, _ in peers),
                            "memory_MB": max(most for _, _, most in ours)})
    show({**about("long_files"), "rows": arguments.rows, "results": results}, draw, as_json=arguments.json)
    return 0


def draw(result: dict, console: Console) -> None:
    table(console, f"{result['rows']} rows", ("file", "MB", "s", "over numpy.loadtxt", "memory, MB"),
          [(each["file"], f"{each['MB']:.0f}", f"{each['seconds']:.2f}", f"{each['over_loadtxt']:.2f}",
            f"{each['memory_MB']:.0f}") for each in result["results"]])


def write(folder: Path, rows: int) -> tuple[Path, Path]:
    """Write the same test in the program's columns, and in the layout of a German program with two more columns."""
    rng = np.random.default_rng(3)
    time, way, force = 1e-3 * np.arange(rows), 5.0 * rng.random(rows), rng.random(rows)
    own, german = folder / "own.csv", folder / "german.csv"
    with own.open("w", encoding="utf-8") as file:
        file.write("time [s],displacement [mm],force [N]\n")
        file.writelines(f"{a!r},{b!r},{c!r}\n" for a, b, c in zip(time.tolist(), way.tolist(), force.tolist(),
                                                                 strict=True))
    with german.open("w", encoding="utf-8") as file:
        file.write("Zeit;Weg;Kraft;Temperatur;Spannung\ns;mm;N;°C;MPa\n")
        file.writelines(f"{a:.3f};{b:.6f};{c:.5f};20.5;{c:.4f}\n".replace(".", ",")
                        for a, b, c in zip(time, way, force, strict=True))
    return own, german


def measured(program: str, path: Path) -> tuple[int, float, float]:
    """Return the number of rows, the time (s), and the memory of the largest process (MB)."""
    done = subprocess.run([sys.executable, "-c", program + _MEASURED, str(path)], capture_output=True, text=True,
                          check=True)
    rows, taken, most = json.loads(done.stdout)
    return rows, taken, most


if __name__ == "__main__":
    sys.exit(main())
