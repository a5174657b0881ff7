"""Speed under the needle: band factorisation against LAPACK, a Newton iteration against FElupe, whole curves.

    python benchmarks/needle.py [--json] [--repeats N]

All in one run on one thread, medians of CPU seconds. Stops with exit code 1 where the answers differ.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import platform
import sys
import time
from dataclasses import replace
from datetime import date
from importlib.metadata import version

import felupe as fem
import numpy as np
from compression import PARAMETERS, cpu_seconds, machine, summary
from felupe_problem import compression_curve, reduced_polynomial
from rich.console import Console
from rich.table import Table
from scipy.linalg import lapack
from work_precision import HEIGHT, MATERIAL, MODELS, NEEDLE_RADIUS, RADIUS, uniform_needle_mesh

import tissue_sim as ts
from tissue_sim.discretisation import build_mesh, build_solver
from tissue_sim.fem import band
from tissue_sim.fem.axisymmetric import AxisymmetricSolver
from tissue_sim.fem.elements import Q4P0, Q9P1
from tissue_sim.fem.newton import StepStatus
from tissue_sim.fem.runtime import initialise
from tissue_sim.mesh import Mesh, needle_mesh

MODEL = MODELS["needle indentation"]
#: Resolution -> CPU seconds that a curve of 21 points to 10 mm may take.
CURVE_TARGETS = {"fast": 0.060, "accurate": 0.600}
#: FElupe's over our CPU time of one Newton iteration.
ITERATION_TARGET = 70.0
#: Depths compared with FElupe, m: the surface has not folded onto the shaft yet, which FElupe's problem leaves out.
PEER_DEPTHS = np.linspace(0.0, 2e-3, 9)[1:]


def band_meshes() -> dict[str, Mesh]:
    """Needle meshes whose tangents have half bands from 44 to 75."""
    meshes = {"500 Q4/P0, uniform": uniform_needle_mesh((20, 25), Q4P0), "fast": build_mesh(MODEL.experiment, "fast")}
    for smallest in (0.65e-3, 0.3e-3):
        mesh = needle_mesh(RADIUS, HEIGHT, NEEDLE_RADIUS, Q9P1, growth=1.8, smallest=smallest, largest=0.012)
        meshes[f"{len(mesh.connectivity)} Q9/P-1, graded"] = mesh
    return meshes


def factorisation(repeats: int) -> list[dict]:
    """Band Cholesky of the tangent at 5 mm, ours and LAPACK's `dpbtrf` in turns.

    Raises:
        SystemExit: the factors solve differently.
    """
    ti = initialise()
    factorise, solve = band.functions()
    block = ti.types.vector(band.BLOCK, ti.f64)
    one, three = ti.types.ndarray(dtype=block, ndim=1), ti.types.ndarray(dtype=block, ndim=3)
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.kernel
    def factor(passes: ti.i32, matrix: three, inverse: reals, rows: ti.i32, width: ti.i32):
        for _ in range(passes):
            factorise(matrix, inverse, rows, width)

    @ti.kernel
    def substitute(passes: ti.i32, matrix: three, inverse: reals, x: one, rows: ti.i32, width: ti.i32):
        for _ in range(passes):
            solve(matrix, inverse, x, rows, width)

    rows = []
    for name, mesh in band_meshes().items():
        solver = build_solver(MODEL, mesh)
        for depth in MODEL.experiment.protocol.displacement[1:11]:
            if solver.step(depth).status is not StepStatus.CONVERGED:
                raise SystemExit(f"{name}: no convergence at {depth * 1e3:g} mm")
        lower = np.asfortranarray(solver.tangent())
        half_band, size = lower.shape[0] - 1, lower.shape[1]
        blocks, right = band.pack(lower), np.random.default_rng(0).normal(size=size)
        shape = blocks.shape[:2]
        inverse, x = np.zeros(shape[0] * band.BLOCK), np.zeros((shape[0], band.BLOCK))
        x.ravel()[:size] = right
        ours = blocks.copy()
        factor(1, ours, inverse, *shape)
        substitute(1, ours, inverse, x, *shape)
        theirs, failed = lapack.dpbtrf(lower, lower=1)
        expected, _ = lapack.dpbtrs(theirs, right, lower=1)
        difference = float(abs(x.ravel()[:size] - expected).max() / abs(expected).max())
        if failed or not difference < 1e-6:
            raise SystemExit(f"{name}: our band Cholesky differs from LAPACK's solution by {difference:.2g} relative")
        spent = []
        for _ in range(repeats):
            # A launch without work is taken off; fresh copies, made outside the clock.
            for passes in (0, 1):
                spent.append(_timed(factor, passes, blocks.copy(), inverse, *shape))
            spent.append(_timed(lapack.dpbtrf, lower.copy(order="F"), lower=1, overwrite_ab=1))
        empty, full, peer = (float(np.median(part)) * 1e3 for part in np.array(spent).reshape(-1, 3).T)
        rows.append({"mesh": name, "freedoms": size, "half_band": half_band, "difference": difference,
                     "ours_ms": full - empty, "lapack_ms": peer, "ratio": (full - empty) / peer,
                     "ours_gflops": size * half_band**2 * 1e-6 / (full - empty)})
    return rows


def _timed(work, *arguments, **options) -> float:
    """CPU seconds of one call."""
    return cpu_seconds(lambda: work(*arguments, **options), 1)[0]


class _Clocked(fem.Material):
    """A law that notes the CPU time whenever FElupe asks for its tangent, which it does once an iteration."""

    def __init__(self, law: fem.Material):
        self.marks: list[float] = []

        def hessian(x):
            self.marks.append(time.process_time())
            return law.hessian(x)

        super().__init__(law.gradient, hessian)


def iterations(repeats: int, peer_repeats: int) -> list[dict]:
    """One Newton iteration (tangent, factor, solution, next residual) of a bonded punch, ours and FElupe's.

    Raises:
        SystemExit: the forces differ.
    """
    meshes = {"80 Q9/P-1, fast": (build_mesh(MODEL.experiment, "fast"), "P-1"),
              "80 Q4/P0, the same grading": (build_mesh(MODEL.experiment, "fast", Q4P0), "P0"),
              "500 Q4/P0, uniform": (uniform_needle_mesh((20, 25), Q4P0), "P0"),
              "500 Q9/P-1, uniform": (uniform_needle_mesh((20, 25), Q9P1), "P-1")}
    rows = []
    for name, (mesh, pressure) in meshes.items():
        solver = AxisymmetricSolver(mesh, MATERIAL, {"base": "rz"}, {"face": "rz"})
        forces = []
        for depth in PEER_DEPTHS:
            step = solver.step(depth)
            if step.status is not StepStatus.CONVERGED:
                raise SystemExit(f"{name}: no convergence at {depth * 1e3:g} mm")
            forces.append(step.force)
        # A tolerance that nothing meets: the step gives up after its one iteration and leaves the state alone.
        further = PEER_DEPTHS[-1] + PEER_DEPTHS[0]
        ours = summary(cpu_seconds(lambda solver=solver, further=further: solver.step(
            further, tolerance=-1.0, max_iterations=1), repeats))
        # Under FElupe's plate lies the face only.
        pressed = replace(mesh, sets={**mesh.sets, "top": mesh.sets["face"]})
        spent = []
        for _ in range(peer_repeats):
            law = _Clocked(reduced_polynomial(**PARAMETERS))
            theirs = compression_curve(pressed, law, MATERIAL.bulk_modulus, PEER_DEPTHS, pressure=pressure)
            spent += list(np.diff(law.marks))
        difference = float(abs(theirs / forces - 1).max())
        if not difference <= 1e-5:
            raise SystemExit(f"{name}: the forces differ by {difference:.2g} relative: the times are not comparable")
        peer = summary(spent)
        ratio = peer["median_s"] / ours["median_s"]
        rows.append({"mesh": name, "largest_difference": difference, "ours": ours, "felupe": peer, "ratio": ratio,
                     "target": ITERATION_TARGET})
    return rows


def curves(repeats: int) -> list[dict]:
    """Whole curves of 21 points to 10 mm, from mesh to forces."""
    rows = []
    for resolution, target in CURVE_TARGETS.items():
        solved = ts.simulate(MODEL, resolution=resolution).metadata["solver"]  # compiles
        spent = summary(cpu_seconds(lambda name=resolution: ts.simulate(MODEL, resolution=name), repeats))
        rows.append({"resolution": resolution, "elements": solved["mesh"]["elements"],
                     "iterations": solved["newton_iterations"], "time": spent, "target_s": target})
    return rows


def draw(result: dict, console: Console) -> None:
    """The result as tables."""
    found = result["machine"]
    console.print(f"{result['date']}, {found['cpu']}, {found['cores']} cores, load {found['load_average']}; "
                  + ", ".join(f"{name} {number}" for name, number in result["versions"].items()))

    def table(title, headers, rows):
        drawn = Table(title=title, title_justify="left")
        for i, header in enumerate(headers):
            drawn.add_column(header, justify="left" if i == 0 else "right")
        for row in rows:
            drawn.add_row(*row)
        console.print(drawn)

    def spread(time, digits=2):
        low, middle, high = (1e3 * time[name] for name in ("min_s", "median_s", "max_s"))
        return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"

    def verdict(good, target):
        return f"{target} {'met' if good else 'missed'}"

    table("Band factorisation of the tangent at 5 mm: CPU ms",
          ["mesh", "freedoms", "half band", "ours (GFLOP/s)", "LAPACK dpbtrf", "ours / LAPACK"],
          [[row["mesh"], str(row["freedoms"]), str(row["half_band"]), f"{row['ours_ms']:.3f} "
            f"({row['ours_gflops']:.1f})", f"{row['lapack_ms']:.3f}", f"{row['ratio']:.2f}"]
           for row in result["factorisation"]])
    table("One Newton iteration of a bonded punch: CPU ms (smallest to largest)",
          ["mesh", "FElupe", "ours", "ratio", "forces agree to", "target"],
          [[row["mesh"], spread(row["felupe"]), spread(row["ours"], 3), f"{row['ratio']:.1f}x",
            f"{row['largest_difference']:.1g}", verdict(row["ratio"] >= row["target"], f"{row['target']:g}x")]
           for row in result["iterations"]])
    table("Needle curve, 21 points to 10 mm: CPU ms (smallest to largest)",
          ["resolution", "elements", "iterations", "CPU", "target"],
          [[row["resolution"], str(row["elements"]), str(row["iterations"]), spread(row["time"], 1),
            verdict(row["time"]["median_s"] <= row["target_s"], f"{1e3 * row['target_s']:g} ms")]
           for row in result["curves"]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions (at least 1, default 5)")
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        parser.error("--repeats must be at least 1")
    result = {"benchmark": "needle", "date": date.today().isoformat(), "machine": machine(),
              "versions": {"Python": platform.python_version(), "tissue_sim": ts.__version__,
                           **{name: version(name) for name in ("felupe", "taichi", "numpy", "scipy")}},
              "factorisation": factorisation(20 * arguments.repeats),
              "iterations": iterations(20 * arguments.repeats, max(1, (arguments.repeats + 1) // 2)),
              "curves": curves(arguments.repeats)}
    if arguments.json:
        print(json.dumps(result))
    else:
        draw(result, Console(width=None if sys.stdout.isatty() else 150))


if __name__ == "__main__":
    main()
