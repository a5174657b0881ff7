"""Reduced solids compared with whole solids: error of the force and time of a step on random walks in their boxes.

    python -m benchmarks reduced [--quick] [--fine] [--json] [--folder FOLDER] [--figure FILE]

A needle that holds tissue and a ball with friction on the study's cylinder. The walks are smooth, up to 50 mm/s, 1000
poses a second, with lift-offs where the tool can; none of their states was among those that the solids were made of.
The whole solid is solved at every eighth pose. Times are CPU times of a step on one thread, the stiffness included;
the peer is LAPACK's `dpbtrf` of a matrix of 1016 equations and a half band of 44, in the same process.
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.linalg import lapack

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.reduction import reduce_solid
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.pose import rotate_pose_about_its_position

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
#: Length of a tick, s.
TICK = 1e-3
#: Ticks between two comparisons with the full solid.
WHOLE_EVERY = 8
#: Name -> tool, interface, box, resolution, modes; strokes and bulk modulus over mu0 where they are other than usual.
CASES = {
    "needle that holds, 16 modes": (ts.Tool("flat", radius=8e-3), "bonded", (3e-3, 4e-3, 0.087), "realtime", 16),
    "needle that holds, 24 modes": (ts.Tool("flat", radius=8e-3), "bonded", (3e-3, 4e-3, 0.087), "realtime", 24),
    "needle that holds, 40 modes": (ts.Tool("flat", radius=8e-3), "bonded", (3e-3, 4e-3, 0.087), "realtime", 40, 12,
                                    450.0),
    "ball on the axis, mu 0.3": (ts.Tool("round", radius=8e-3), 0.3, (0.0, 4e-3, 0.0), "realtime", 16),
    "ball aside, mu 0.3": (ts.Tool("round", radius=8e-3), 0.3, (3e-3, 4e-3, 0.0), "realtime", 64),
}
FINE = {"needle that holds, quadratic elements": (ts.Tool("flat", radius=8e-3), "bonded", (3e-3, 4e-3, 0.087), "fast",
                                                  24)}


def walk(box: ts.PoseBox, start: ts.Pose, seconds: float, seed: int, holds: bool) -> list[ts.Pose]:
    """Return the poses of a random walk with a largest speed of about 50 mm/s."""
    rng, count = np.random.default_rng(seed), round(seconds / TICK)
    clock = np.arange(count) * TICK

    def smooth(low: float, high: float, speed: float) -> np.ndarray:
        pause = max(0.05, 1.5 * (high - low) / speed)
        knots = rng.uniform(low, high, math.ceil(seconds / pause) + 2)
        knots[0] = min(max(0.0, low), high)
        return PchipInterpolator(np.arange(knots.size) * pause, knots)(clock)

    x, y = (smooth(-box.sideways, box.sideways, 0.03) for _ in range(2))
    depth = smooth(0.0 if holds else -0.2 * box.depth, box.depth, 0.03)
    angles = np.stack([smooth(-box.turn, box.turn, 1.0) for _ in range(3)], axis=1) / math.sqrt(3.0)
    x0, y0, z0 = start.position
    return [rotate_pose_about_its_position(ts.Pose((x0 + a, y0 + b, z0 - d), start.orientation), tuple(turn.tolist()))
            for a, b, d, turn in zip(x, y, depth, angles, strict=True)]


def factor_time() -> float:
    """Return the CPU time of LAPACK's band factorisation, s."""
    rng = np.random.default_rng(0)
    band = np.zeros((45, 1016), order="F")
    band[0] = 100.0
    band[1:] = rng.uniform(-1.0, 1.0, (44, 1016))
    times = []
    for _ in range(50):
        copy = band.copy(order="F")
        started = time.process_time()
        lapack.dpbtrf(copy, lower=1, overwrite_ab=1)
        times.append(time.process_time() - started)
    return float(np.median(times))


def measure(name: str, case: tuple, seconds: float, seeds: range, folder: Path | None) -> tuple[dict, tuple]:
    """Return one row of the table, and the forces of the last walk of the whole and the reduced solid."""
    tool, friction, sizes, resolution, modes, *more = case
    strokes, bulk_ratio = more or (None, None)
    box, holds = ts.PoseBox(*sizes), friction == "bonded"
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.040, 0.070), protocol=ts.Protocol.ramp(box.depth, points=2), tool=tool,
        friction=friction)
    model = ts.Model(experiment, MATERIAL)
    started = time.process_time()
    kept = None if folder is None else folder / f"{name.partition(',')[0].replace(' ', '_')}_{resolution}"
    reduced = reduce_solid(model, box, resolution=resolution, strokes=strokes, modes=modes, bulk_ratio=bulk_ratio,
                           folder=kept)
    offline = time.process_time() - started
    whole = training.make_full_order_solver(model, reduced.mesh)
    small = ReducedSolver(reduced, MATERIAL)
    small.enable_stiffness_output()
    start = experiment.tool_pose(0.0)
    times, missed, forces, jumps, lost, solves = [], [], [], [], 0, 0
    for seed in seeds:
        poses = walk(box, start, seconds, seed, holds)
        true = training.simulate_snapshots(whole, poses[::WHOLE_EVERY]).wrenches[:, :3]
        small.reset_to_first_touch()
        wrenches = []
        for pose in poses:
            began = time.process_time()
            step = small.step(pose, TICK)
            times.append(time.process_time() - began)
            lost += step.status is not ts.StepStatus.CONVERGED
            solves += step.iterations
            wrenches.append(step.wrench[:3])
        answers = np.array(wrenches)
        missed.append(answers[::WHOLE_EVERY] - true)
        forces.append(true)
        jumps.append(np.linalg.norm(np.diff(answers, axis=0), axis=1).max())
    error, force, ticks = np.concatenate(missed), np.concatenate(forces), 1e3 * np.array(times)
    rms = float(np.sqrt((force**2).sum(axis=1).mean()))
    of_force = 100.0 / rms
    row = {
        "case": name, "freedoms": reduced.report["freedoms"], "modes": reduced.report["modes"],
        "elements": f"{reduced.report['elements']} of {reduced.report['elements_of_all']}",
        "rms_percent": of_force * float(np.sqrt((error**2).sum(axis=1).mean())),
        "normal_percent": of_force * float(np.sqrt((error[:, 2] ** 2).mean())),
        "lateral_percent": of_force * float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        "largest_percent": of_force * float(np.linalg.norm(error, axis=1).max()), "rms_force_N": rms,
        "p50_ms": float(np.median(ticks)), "p99_ms": float(np.quantile(ticks, 0.99)),
        "p999_ms": float(np.quantile(ticks, 0.999)), "solves": solves / len(ticks),
        "not_converged": lost, "ticks": len(ticks), "largest_jump_N": float(max(jumps)), "offline_cpu_s": offline,
        "dpbtrf_ms": 1e3 * factor_time()}
    return row, (true, answers, np.array([pose.depth for pose in poses]))


def draw(name: str, curves: tuple, path: Path) -> None:
    """Draw the last walk of a case."""
    from matplotlib.figure import Figure

    true, answers, depth = curves
    clock = np.arange(len(answers)) * TICK
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    top, forces, error = figure.subplots(3, 1, sharex=True, height_ratios=[1, 2, 1])
    top.plot(clock, 1e3 * depth, color="0.3")
    top.set_ylabel("depth [mm]")
    for axis, (label, colour) in enumerate((("along x", "#D55E00"), ("along y", "#009E73"), ("along z", "#0072B2"))):
        forces.plot(clock, answers[:, axis], color=colour, linewidth=1, label=f"{label}, reduced")
        forces.plot(clock[::WHOLE_EVERY], true[:, axis], color=colour, linestyle="none", marker="o", markersize=2.5,
                    markevery=4, label=f"{label}, whole")
    forces.set_ylabel("force [N]")
    forces.margins(y=0.3)
    forces.legend(ncols=3, fontsize=8, frameon=False, loc="upper center")
    error.plot(clock[::WHOLE_EVERY], 1e3 * np.linalg.norm(answers[::WHOLE_EVERY] - true, axis=1), color="#CC79A7")
    error.set_ylabel("difference [mN]")
    error.set_xlabel("time [s]")
    for each in (top, forces, error):
        each.grid(alpha=0.3)
        each.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{name}: a random walk that it was not made of")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the first case, one short walk")
    parser.add_argument("--fine", action="store_true", help="quadratic elements, 12,000 freedoms")
    parser.add_argument("--folder", type=Path, help="where strokes are kept while they are made")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--figure", type=Path, help="draw the last walk of the first case")
    arguments = parser.parse_args()
    cases = FINE if arguments.fine else dict(list(CASES.items())[:1]) if arguments.quick else CASES
    seconds, seeds = (1.0, range(1)) if arguments.quick else (3.0, range(2))
    rows = []
    for name, case in cases.items():
        row, curves = measure(name, case, seconds, seeds, arguments.folder)
        if arguments.figure and not rows:
            draw(name, curves, arguments.figure)
        rows.append(row)
        if not arguments.json:
            print(", ".join(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}"
                            for key, value in row.items()), flush=True)
    if arguments.json:
        print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
