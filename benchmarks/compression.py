"""Bonded compression against FElupe, compile times, and the band Cholesky against LAPACK: all in one run, one thread.

    python benchmarks/compression.py [--json] [--repeats N]

Compares forces first and stops with exit code 1 where they differ; then prints medians of CPU seconds.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import importlib.util
import json
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from felupe_problem import compression_curve, reduced_polynomial
from rich.console import Console
from rich.table import Table
from scipy.linalg import lapack

import tissue_sim as ts
from tissue_sim.discretisation import build_mesh, build_solver
from tissue_sim.fem import band, newton
from tissue_sim.fem.axisymmetric import AxisymmetricSolver
from tissue_sim.fem.elements import Q4P0, Q9P1
from tissue_sim.fem.runtime import initialise
from tissue_sim.mesh import cylinder_mesh

PARAMETERS = {"C10": 1404.9, "C20": 699.4}
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(10e-3, 21)),
                 ts.Material("reduced_polynomial_2", PARAMETERS, ts.Bulk("bulk_ratio", 1e3)))
#: Laws whose first compile is timed: one of the invariants, one of the stretches.
COMPILED = {"reduced_polynomial_2": PARAMETERS, "ogden_1": {"mu1": 3225.9, "alpha1": 14.8}}
COLD_LIMIT, WARM_LIMIT = 15.0, 2.0


def cpu_seconds(work, repeats: int) -> list[float]:
    """CPU seconds of each of `repeats` calls."""
    spent = []
    for _ in range(repeats):
        started = time.process_time()
        work()
        spent.append(time.process_time() - started)
    return spent


def summary(spent: list[float]) -> dict:
    return {"median_s": statistics.median(spent), "min_s": min(spent), "max_s": max(spent), "repeats": len(spent)}


def felupe_routes() -> list[dict]:
    """Ways to solve it with FElupe: (title, our element, its pressure, its law, agreement asked for, target)."""
    laws = {"analytical tangent": reduced_polynomial(**PARAMETERS)}
    if importlib.util.find_spec("tensortrax"):
        import felupe.constitution.tensortrax as automatic

        yeoh = automatic.models.hyperelastic.yeoh
        laws["its own Yeoh law"] = automatic.Hyperelastic(yeoh, C10=PARAMETERS["C10"] * 1e-6,
                                                          C20=PARAMETERS["C20"] * 1e-6, C30=0.0)
    kinds = [("Q4/P0, condensed", Q4P0, "P0", 1e-6, 60.0), ("Q4/P0, three fields", Q4P0, "P0 mixed", 1e-6, 60.0),
             ("Q9/Q1", Q9P1, "Q1", 1e-3, 20.0), ("Q9/P-1, three fields", Q9P1, "P-1", 1e-6, None)]
    return [{"route": f"{title}, {name}", "element": element, "pressure": pressure, "law": law, "agreement": agreement,
             "target": target} for title, element, pressure, agreement, target in kinds for name, law in laws.items()]


def against_felupe(repeats: int, peer_repeats: int) -> list[dict]:
    """Curves of 21 points to 10 mm on 20 x 25 uniform elements; both sides from mesh to forces.

    Raises:
        SystemExit: the forces differ.
    """
    meshes = {element.name: cylinder_mesh(0.04, 0.07, (20, 25), element) for element in (Q4P0, Q9P1)}
    depths = MODEL.experiment.protocol.displacement[1:]
    routes = felupe_routes()

    def theirs(route):
        return compression_curve(meshes[route["element"].name], route["law"], MODEL.material.bulk_modulus, depths,
                                 pressure=route["pressure"])

    ours = {}
    for name, mesh in meshes.items():
        recording = ts.simulate(MODEL, mesh=mesh)  # compiles
        spent = cpu_seconds(lambda mesh=mesh: ts.simulate(MODEL, mesh=mesh), repeats)
        ours[name] = {"forces": recording.force[1:], "time": summary(spent),
                      "iterations": recording.metadata["solver"]["newton_iterations"]}
    rows = []
    for route in routes:
        mine = ours[route["element"].name]
        difference = float(abs(theirs(route) / mine["forces"] - 1).max())  # warms FElupe up too
        if not difference <= route["agreement"]:
            raise SystemExit(f"{route['route']}: the forces differ by {difference:.2g} relative, more than "
                             f"{route['agreement']:g}: the times are not comparable")
        peer = summary(cpu_seconds(lambda route=route: theirs(route), peer_repeats))
        rows.append({"element": route["element"].name, "route": route["route"], "largest_difference": difference,
                     "ours": mine["time"], "ours_iterations": mine["iterations"], "felupe": peer,
                     "ratio": peer["median_s"] / mine["time"]["median_s"], "target": route["target"]})
    return rows


_START = """
import json, sys, time
import tissue_sim as ts
law, parameters = json.loads(sys.argv[1])
model = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(10e-3, 21)), ts.Material(law, parameters))
ts.simulate(model)
print(time.process_time())
"""


def start_times(repeats: int) -> list[dict]:
    """Seconds of a fresh process that imports, compiles (cold) or loads (warm) the kernels, and simulates a test."""
    root = str(Path(ts.__file__).resolve().parents[1])
    path = os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)
    rows = []
    for law, parameters in COMPILED.items():
        with tempfile.TemporaryDirectory() as cache:
            runs = []
            for _ in range(1 + repeats):
                started = time.perf_counter()
                done = subprocess.run([sys.executable, "-c", _START, json.dumps([law, parameters])], check=True,
                                      capture_output=True, text=True, encoding="utf-8",
                                      env={**os.environ, "PYTHONPATH": path, "TISSUE_SIM_CACHE": cache})
                runs.append((time.perf_counter() - started, float(done.stdout)))
        for name, part, limit in (("cold", runs[:1], COLD_LIMIT), ("warm", runs[1:], WARM_LIMIT)):
            wall, cpu = (statistics.median(values) for values in zip(*part, strict=True))
            rows.append({"law": law, "start": name, "wall_s": wall, "cpu_s": cpu, "target_s": limit})
    return rows


def band_cholesky(repeats: int) -> list[dict]:
    """Parts of an iteration, in ms: element work, factorisation and solution; LAPACK on the same matrix."""
    ti = initialise()
    factorise, solve = band.functions()
    block = ti.types.vector(band.BLOCK, ti.f64)
    one, three = ti.types.ndarray(dtype=block, ndim=1), ti.types.ndarray(dtype=block, ndim=3)
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.kernel
    def run(passes: ti.i32, matrix: three, inverse: reals, x: one, rows: ti.i32, width: ti.i32):
        for _ in range(passes):
            factorise(matrix, inverse, rows, width)
            solve(matrix, inverse, x, rows, width)

    def median_ms(prepare, work):
        spent = []
        for _ in range(repeats):
            prepared = prepare()
            started = time.process_time()
            work(*prepared)
            spent.append(time.process_time() - started)
        return 1e3 * statistics.median(spent)

    rows = []
    meshes = {name: build_mesh(MODEL.experiment, name) for name in ("fast", "accurate")}
    for element in (Q4P0, Q9P1):
        meshes[f"500 {element.name}"] = cylinder_mesh(0.04, 0.07, (20, 25), element)
    for name, mesh in meshes.items():
        solver = build_solver(MODEL, mesh)
        solver.step(5e-3)
        lower = solver.tangent()
        half_band, size = lower.shape[0] - 1, lower.shape[1]
        blocks, right = band.pack(lower), np.random.default_rng(0).normal(size=size)
        padded = np.zeros((blocks.shape[0], band.BLOCK))
        padded.ravel()[:size] = right
        inverse = np.zeros(padded.size)
        x = padded.copy()
        run(1, blocks.copy(), inverse, x, *blocks.shape[:2])
        factor, _ = lapack.dpbtrf(lower, lower=1)
        expected, _ = lapack.dpbtrs(factor, right, lower=1)
        difference = float(abs(x.ravel()[:size] - expected).max() / abs(expected).max())
        if not difference < 1e-6:
            raise SystemExit(f"{name}: our band Cholesky differs from LAPACK's solution by {difference:.2g} relative")

        def ours(passes, blocks=blocks, inverse=inverse, padded=padded):
            return median_ms(lambda: (blocks.copy(), padded.copy()),
                             lambda a, b: run(passes, a, inverse, b, *blocks.shape[:2]))

        def factor_and_solve(a, b):
            factor, _ = lapack.dpbtrf(a, lower=1, overwrite_ab=1)
            lapack.dpbtrs(factor, b, lower=1, overwrite_b=1)

        lapack_ms = median_ms(lambda lower=lower, right=right: (np.array(lower, order="F"), right.copy()),
                              factor_and_solve)
        elements, launch = element_work(solver, repeats)
        ours_ms = ours(1) - ours(0)
        rows.append({"mesh": name, "elements": len(mesh.connectivity), "freedoms": size, "half_band": half_band,
                     "difference": difference, "ours_ms": ours_ms, "lapack_ms": lapack_ms,
                     "ours_gflops": size * half_band * (half_band + 4) * 1e-6 / ours_ms,
                     "lapack_gflops": size * half_band * (half_band + 4) * 1e-6 / lapack_ms,
                     "element_work_ms": elements, "launch_ms": launch})
    return rows


def element_work(solver: AxisymmetricSolver, repeats: int) -> tuple[float, float]:
    """Integration, condensation and assembly of residual and tangent once, and one empty launch, both in ms."""
    spent = []
    for _ in range(repeats):
        # In turns, so that a busy machine slows both down alike.
        for passes in (0, 1):
            solver._counts[newton.PASSES] = passes
            spent += cpu_seconds(lambda: solver._launch(solver.depth, -1.0, 0.0, 0), 1)
    empty, full = np.array(spent).reshape(-1, 2).T * 1e3
    return float(np.median(full - empty)), float(np.median(empty))


def machine() -> dict:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.system(), "load_average": load}


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

    def verdict(good, target):
        return f"{target} {'met' if good else 'missed'}"

    table("Bonded compression, 21 points to 10 mm, 500 elements: CPU seconds (smallest to largest)",
          ["FElupe's route", "FElupe", "ours", "ratio", "forces agree to", "target"],
          [[row["route"], *(f"{t['median_s']:.3f} ({t['min_s']:.3f} to {t['max_s']:.3f})"
                            for t in (row["felupe"], row["ours"])), f"{row['ratio']:.1f}x",
            f"{row['largest_difference']:.1g}",
            "" if row["target"] is None else verdict(row["ratio"] >= row["target"], f"{row['target']:g}x")]
           for row in result["curves"]])
    table("A fresh process simulates one test on the fast mesh: seconds", ["law", "start", "wall", "CPU", "target"],
          [[row["law"], row["start"], f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}",
            verdict(row["wall_s"] < row["target_s"], f"{row['target_s']:g} s")] for row in result["starts"]])
    table("Parts of one iteration: CPU ms (GFLOP/s)",
          ["mesh", "freedoms", "half band", "launch", "element work", "factor and solve", "LAPACK dpbtrf, dpbtrs"],
          [[row["mesh"], str(row["freedoms"]), str(row["half_band"]), f"{row['launch_ms']:.2f}",
            f"{row['element_work_ms']:.2f}", f"{row['ours_ms']:.3f} ({row['ours_gflops']:.1f})",
            f"{row['lapack_ms']:.3f} ({row['lapack_gflops']:.1f})"] for row in result["iteration"]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions (at least 1, default 5)")
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        parser.error("--repeats must be at least 1")
    result = {"benchmark": "compression", "date": date.today().isoformat(), "machine": machine(),
              "versions": {"Python": platform.python_version(), "tissue_sim": ts.__version__,
                           **{name: version(name) for name in ("felupe", "taichi", "numpy", "scipy")}},
              "curves": against_felupe(arguments.repeats, max(1, (arguments.repeats + 1) // 2)),
              "starts": start_times(min(3, arguments.repeats)), "iteration": band_cholesky(20 * arguments.repeats)}
    if arguments.json:
        print(json.dumps(result))
    else:
        draw(result, Console(width=None if sys.stdout.isatty() else 150))


if __name__ == "__main__":
    main()
