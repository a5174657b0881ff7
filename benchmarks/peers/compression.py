"""Bonded compression against FElupe, compile times, and the band Cholesky against LAPACK, in one thread.

    python -m benchmarks compression [--json] [--repeats N]

Compares forces first and stops with exit code 1 where they differ; then prints medians of CPU seconds.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import importlib.util
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from felupe_problem import compression_curve, reduced_polynomial
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, against_lapack, cpu_seconds, option_parser, show, summary, table, verdict
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1

PARAMETERS = {"C10": 1404.9, "C20": 699.4}
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(10e-3, 21)),
                 ts.Material("reduced_polynomial_2", PARAMETERS, ts.Bulk("bulk_ratio", 1e3)))
#: Laws whose first compile is timed: one of the invariants, one of the stretches.
COMPILED = {"reduced_polynomial_2": PARAMETERS, "ogden_1": {"mu1": 3225.9, "alpha1": 14.8}}
#: Target: wall time of a fresh process without compiled kernels, s.
COLD_LIMIT = 15.0
#: Target: wall time of a fresh process with compiled kernels, s.
WARM_LIMIT = 2.0


def felupe_routes() -> list[dict]:
    """Return variants in FElupe: (title, element of the program, pressure field, law, required agreement, target)."""
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
    """Compare curves of 21 points to 10 mm on 20 x 25 uniform elements, from mesh to forces.

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
    """Return the time in which a new process imports, compiles or loads the kernels, and simulates a test, s."""
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


def parts_of_an_iteration(repeats: int) -> list[dict]:
    """Return the times of element work, factorisation and solution, ms, and of LAPACK on the same matrix."""
    rows = []
    meshes = {name: build_mesh(MODEL.experiment, name) for name in ("fast", "accurate")}
    for element in (Q4P0, Q9P1):
        meshes[f"500 {element.name}"] = cylinder_mesh(0.04, 0.07, (20, 25), element)
    for name, mesh in meshes.items():
        solver = build_solver_on_mesh(MODEL, mesh)
        solver.step(5e-3)
        compared = against_lapack(name, solver.equations.assemble_committed_tangent(), repeats, solve=True)
        elements, launch = element_work(solver, repeats)
        rows.append({"mesh": name, "elements": len(mesh.connectivity), **compared, "element_work_ms": elements,
                     "launch_ms": launch})
    return rows


def element_work(solver: AxisymmetricSolver, repeats: int) -> tuple[float, float]:
    """Return the times of integration, condensation and assembly, and of one empty launch, ms."""
    spent = []
    for _ in range(repeats):
        # In turns, so that a busy machine slows both down alike.
        for passes in (0, 1):
            solver.equations.counts[newton.StepIntegerIndex.PASSES] = passes
            spent += cpu_seconds(lambda: solver.equations.solve_equilibrium(solver.depth, -1.0, 0), 1)
    empty, full = np.array(spent).reshape(-1, 2).T * 1e3
    return float(np.median(full - empty)), float(np.median(empty))


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    table(console, "Bonded compression, 21 points to 10 mm, 500 elements: CPU seconds (smallest to largest)",
          ["FElupe's route", "FElupe", "ours", "ratio", "forces agree to", "target"],
          [[row["route"], *(f"{t['median_s']:.3f} ({t['min_s']:.3f} to {t['max_s']:.3f})"
                            for t in (row["felupe"], row["ours"])), f"{row['ratio']:.1f}x",
            f"{row['largest_difference']:.1g}",
            "" if row["target"] is None else verdict(row["ratio"] >= row["target"], f"{row['target']:g}x")]
           for row in result["curves"]])
    table(console, "A fresh process simulates one test on the fast mesh: seconds",
          ["law", "start", "wall", "CPU", "target"],
          [[row["law"], row["start"], f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}",
            verdict(row["wall_s"] < row["target_s"], f"{row['target_s']:g} s")] for row in result["starts"]])
    table(console, "Parts of one iteration: CPU ms (GFLOP/s)",
          ["mesh", "freedoms", "half band", "launch", "element work", "factor and solve", "LAPACK dpbtrf, dpbtrs"],
          [[row["mesh"], str(row["freedoms"]), str(row["half_band"]), f"{row['launch_ms']:.2f}",
            f"{row['element_work_ms']:.2f}", f"{row['ours_ms']:.3f} ({row['ours_gflops']:.1f})",
            f"{row['lapack_ms']:.3f} ({row['lapack_gflops']:.1f})"] for row in result["iteration"]])


def main() -> None:
    arguments = option_parser(__doc__).parse_args()
    repeats = arguments.repeats
    result = about("compression", ["felupe"]) | {
        "curves": against_felupe(repeats, max(1, (repeats + 1) // 2)), "starts": start_times(min(3, repeats)),
        "iteration": parts_of_an_iteration(20 * repeats)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
