"""Tissue under tools of MuJoCo and Newton: stability, work, forces on a robot arm, and the engine's own soft body.

    python -m benchmarks engine_coupling [--part PART ...] [--figure PATH] [--json]

- ``stability``: tools of 2 g to 1 kg on servos are held 5 mm in the needle test of the reference study.
- ``cycle``: tools move into an elastic tissue and back; the net work of the tissue must vanish.
- ``arm``: an arm in MuJoCo presses, shears and leaves a solid; its forces are compared with those of the same path
  without coupling. It takes about half an hour.
- ``soft_body``: force over depth of the coupled tissue, of MuJoCo's flex and of Newton's VBD.

MuJoCo and Newton must be installed (`tissue_sim[mujoco]`, `tissue_sim[newton]`).
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import importlib.util
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.measure import about, option_parser, show, table
from benchmarks.realtime import engine_arm, engine_soft_body, engine_tools
from benchmarks.realtime.engine_tools import ENGINES, MASSES, SERVOS, STEPS

#: Packages of the engines.
ENGINE_PACKAGES = ("mujoco", "newton")
#: Functions that measure the parts.
PARTS = {"stability": engine_tools.measure_stability, "cycle": engine_tools.measure_cycles,
         "arm": engine_arm.measure_arm, "soft_body": engine_soft_body.measure_soft_bodies}
#: Depths of the table of the soft bodies, mm.
TABLE_DEPTHS = (0.5, 1, 2, 3, 4, 5, 7.5, 10)
#: Colours that colour-blind readers can distinguish (Okabe and Ito).
COLOURS = ("#0072B2", "#D55E00", "#E69F00", "#009E73", "#CC79A7")


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS), help="parts to measure")
    parser.add_argument("--figure", type=Path, metavar="PATH", help="draw the parts arm and soft_body into this file")
    parser.add_argument("--specimen", nargs="+", choices=[test.name for test in engine_arm.TESTS],
                        help="specimens of the part arm; all if not given")
    parser.add_argument("--seconds", type=float, default=engine_arm.SECONDS,
                        help="simulated time of the part arm, s; the holds become longer")
    options = parser.parse_args()
    if not options.seconds > engine_arm.MOTION_TIME:
        parser.error(f"--seconds must be more than {engine_arm.MOTION_TIME:g}; got {options.seconds:g}.")
    if options.figure and not {"arm", "soft_body"} <= set(options.part):
        parser.error("--figure needs the parts arm and soft_body.")
    missing = [name for name in ENGINE_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise SystemExit(f"{' and '.join(missing)} must be installed; use pip install tissue_sim[mujoco,newton].")
    arguments = {"arm": {"specimens": options.specimen, "seconds": options.seconds}}
    result = about("engine_coupling", ENGINE_PACKAGES) | {
        part: PARTS[part](**arguments.get(part, {})) for part in options.part}
    if options.figure:
        draw_figure(result["arm"], result["soft_body"], options.figure)
    show(result, draw, as_json=options.json)


def draw(result: dict, console) -> None:
    for part, draw_part in (("stability", draw_stability), ("cycle", draw_cycles), ("arm", draw_arm),
                            ("soft_body", draw_soft_bodies)):
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


def draw_arm(rows: list[dict], console) -> None:
    table(console, "force on the arm against the whole solid on the same path, % of the peak force",
          ["specimen, tissue", "steps", "depth, mm", "peak, N", "compared", "rms", "largest", "not converged",
           "wall ms of a step"],
          [[f"{row['specimen']}, {row['tissue']}", str(row["steps"]), f"{1e3 * row['depth']:.2f}",
            f"{row['peak_force']:.3f}", str(row["compared"]), f"{100 * row['rms_error']:.2f}",
            f"{100 * row['largest_error']:.2f}",
            str(row["not_converged"]), f"{1e3 * row['step_wall_s']:.1f}"] for row in rows])
    for row in rows:
        for warning in row["warnings"]:
            console.print(f"{row['specimen']}, {row['tissue']}: {warning}")


def compute_force_errors(curves: list[dict], depths: np.ndarray) -> list[np.ndarray]:
    """Return the error of the force of each curve against the first at depths in m, 1."""
    forces = [np.array([engine_soft_body.get_force(curve, depth) for depth in depths]) for curve in curves]
    return [each / forces[0] - 1.0 for each in forces]


def draw_soft_bodies(curves: list[dict], console) -> None:
    errors = compute_force_errors(curves, 1e-3 * np.array(TABLE_DEPTHS))
    table(console, "force error, %, by depth, mm", ["", "E, Pa", *(f"{depth:g}" for depth in TABLE_DEPTHS),
                                                         "ended", "steps", "CPU ms of a step"],
          [[curve["name"], f"{curve['young']:.0f}" if "young" in curve else "-",
            *("-" if np.isnan(error) else f"{100 * error:+.1f}" for error in row), curve["ended"] or "10 mm",
            f"{np.median(curve['steps']):.0f}" if curve.get("steps") else "-",
            f"{1e3 * curve['step_cpu_s']:.0f}" if "step_cpu_s" in curve else "-"]
           for curve, row in zip(curves[1:], errors[1:], strict=True)])


def draw_figure(rows: list[dict], curves: list[dict], path: Path) -> None:
    """Draw force over time of the arm, and force and its error over depth of the engines."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 3.8), layout="constrained")
    arm, forces, errors = figure.subplots(1, 3)
    rows = [row for row in rows if row["specimen"] == rows[0]["specimen"]]
    peak = rows[0]["peak_force"]
    for axis, name, colour in ((2, "z", COLOURS[0]), (0, "x", COLOURS[1])):
        arm.plot(rows[0]["offline_times"], np.array(rows[0]["offline_forces"])[:, axis], color="0.75", linewidth=6,
                 label=f"F{name}, offline")
        for row, line in zip(rows, ("-", "--", ":"), strict=False):
            arm.plot(row["times"], np.array(row["forces"])[:, axis], line, color=colour,
                     label=f"F{name}, {row['tissue']}")
    arm.set(xlabel="time [s]", ylabel="force on the arm [N]", ylim=(-0.27 * peak, 1.7 * peak),
            title="Arm in MuJoCo, coupled and offline")
    arm.legend(fontsize=7, frameon=False, ncols=2, loc="upper center")
    depths = np.linspace(0.5e-3, 10e-3, 96)
    # Curves of one soft body with different Young's moduli have one colour.
    groups = [", ".join(curve["name"].split(", ")[:2]) for curve in curves]
    colours = dict(zip(dict.fromkeys(groups), ("black", *COLOURS), strict=False))
    for curve, group, error in zip(curves, groups, compute_force_errors(curves, depths), strict=True):
        colour = colours[group]
        line = {"color": colour, "linestyle": "--" if "best" in curve["name"] else "-"}
        order = np.argsort(curve["depths"])
        forces.plot(1e3 * np.array(curve["depths"])[order], np.array(curve["forces"])[order],
                    label=None if "best" in curve["name"] else curve["name"], **line)
        if curve is not curves[0]:
            errors.plot(1e3 * depths, 100.0 * error, **line)
        if curve["ended"]:
            forces.plot(1e3 * curve["depths"][-1], curve["forces"][-1], "x", color=colour)
    forces.plot([], [], "--", color="0.5", label="dashed: best E at 2 mm")
    forces.plot(1e3 * np.array(curves[0]["other_depths"]), curves[0]["other_forces"], "o", color="black",
                fillstyle="none", label="another program, quadratic tetrahedra")
    forces.set(xlabel="depth [mm]", ylabel="force [N]", xlim=(0.0, 10.0), ylim=(0.0, 3.3),
               title="Punch; x: no equilibrium deeper")
    forces.legend(fontsize=7, frameon=False, loc="upper left")
    errors.axhline(0.0, color="black", linewidth=0.8)
    errors.set(xlabel="depth [mm]", ylabel="force error [%]", xlim=(0.0, 10.0), title="Error against the accurate mesh")
    errors.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
