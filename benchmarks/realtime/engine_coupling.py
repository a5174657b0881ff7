"""Tissue under tools of MuJoCo and Newton: stability and work of the coupling.

    python -m benchmarks engine_coupling [--part PART ...] [--json]

- ``stability``: tools of 2 g to 1 kg on servos are held 5 mm in the needle test of the reference study.
- ``cycle``: tools move into an elastic tissue and back; the net work of the tissue must vanish.

MuJoCo and Newton must be installed (`tissue_sim[mujoco]`, `tissue_sim[newton]`).
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import importlib.util
from itertools import product

from benchmarks.measure import about, option_parser, show, table
from benchmarks.realtime import engine_tools
from benchmarks.realtime.engine_tools import ENGINES, MASSES, SERVOS, STEPS

#: Packages of the engines.
ENGINE_PACKAGES = ("mujoco", "newton")
#: Functions that measure the parts.
PARTS = {"stability": engine_tools.measure_stability, "cycle": engine_tools.measure_cycles}


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS), help="parts to measure")
    options = parser.parse_args()
    missing = [name for name in ENGINE_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise SystemExit(f"{' and '.join(missing)} must be installed; use pip install tissue_sim[mujoco,newton].")
    result = about("engine_coupling", ENGINE_PACKAGES)
    show(result | {part: PARTS[part]() for part in options.part}, draw, as_json=options.json)


def draw(result: dict, console) -> None:
    for part, draw_part in (("stability", draw_stability), ("cycle", draw_cycles)):
        if part in result:
            draw_part(result[part], console)


def draw_stability(rows: list[dict], console) -> None:
    found = {(row["engine"], row["mass"], row["servo"], row["step"]): row for row in rows}
    table(console, "variation of the held force, %, by servo, N/m, and step, ms; unstable in the air too: (air)",
          ["tool", *(f"{servo:g}, {1e3 * step:g}" for servo, step in product(SERVOS, STEPS))],
          [[f"{engine}, {1e3 * mass:g} g", *(_variation(found[engine, mass, servo, step])
                                             for servo, step in product(SERVOS, STEPS))]
           for engine, mass in product(ENGINES, MASSES)])


def _variation(row: dict) -> str:
    """Format the variation of a held force."""
    text = f"{100 * row['variation']:.2f}" if row["variation"] < 10.0 else "unstable"
    return f"{text} (air)" if row["air"] is not None and not row["air"] <= engine_tools.STABLE else text


def draw_cycles(rows: list[dict], console) -> None:
    table(console, "net work over loading work, %, of closed cycles in MuJoCo",
          ["tissue, inertia", "tool, g", "step, ms", "applied force", "force of the tissue at the same poses"],
          [[f"{row['tissue']}, {row['inertia']}", f"{1e3 * row['mass']:g}", f"{1e3 * row['step']:g}",
            f"{100 * row['net_work']:+.4f}", f"{100 * row['net_work_of_tissue']:+.4f}"] for row in rows])


if __name__ == "__main__":
    main()
