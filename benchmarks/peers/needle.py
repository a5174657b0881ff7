"""Needle: band factorisation against LAPACK, a Newton iteration against FElupe, and whole curves.

    python -m benchmarks needle [--json] [--repeats N]

All in one run on one thread, medians of CPU seconds. Stops with exit code 1 where the answers differ.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import time
from dataclasses import replace

import felupe as fem
import numpy as np
from felupe_problem import compression_curve, reduced_polynomial
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, against_lapack, cpu_seconds, option_parser, show, spread, summary, table, verdict
from benchmarks.peers.compression import PARAMETERS
from benchmarks.peers.work_precision import HEIGHT, MATERIAL, MODELS, NEEDLE_RADIUS, RADIUS, uniform_needle_mesh
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import Mesh, cylinder_mesh_refined_under_needle
from tissue_sim.mesh.elements import Q4P0, Q9P1

MODEL = MODELS["needle indentation"]
#: Resolution -> CPU seconds that a curve of 21 points to 10 mm may take.
CURVE_TARGETS = {"fast": 0.060, "accurate": 0.600}
#: FElupe's over our CPU time of one Newton iteration.
ITERATION_TARGET = 70.0
#: Depths compared with FElupe, m: the surface has not folded onto the shaft yet, which FElupe's problem leaves out.
PEER_DEPTHS = np.linspace(0.0, 2e-3, 9)[1:]


def band_meshes() -> dict[str, Mesh]:
    """Return needle meshes whose tangents have half bands from 44 to 75."""
    meshes = {"500 Q4/P0, uniform": uniform_needle_mesh((20, 25), Q4P0), "fast": build_mesh(MODEL.experiment, "fast")}
    for smallest in (0.65e-3, 0.3e-3):
        mesh = cylinder_mesh_refined_under_needle(RADIUS, HEIGHT, NEEDLE_RADIUS, Q9P1, growth=1.8, smallest=smallest,
                                                  largest=0.012)
        meshes[f"{len(mesh.connectivity)} Q9/P-1, graded"] = mesh
    return meshes


def factorisation(repeats: int) -> list[dict]:
    """Time the band Cholesky of the tangent at 5 mm, and LAPACK's `dpbtrf`.

    Raises:
        SystemExit: the factors solve differently.
    """
    rows = []
    for name, mesh in band_meshes().items():
        solver = build_solver_on_mesh(MODEL, mesh)
        for depth in MODEL.experiment.protocol.displacement[1:11]:
            if solver.step(depth).status is not StepStatus.CONVERGED:
                raise SystemExit(f"{name}: no convergence at {depth * 1e3:g} mm")
        rows.append({"mesh": name,
                     **against_lapack(name, solver.equations.assemble_committed_tangent(), repeats, solve=False)})
    return rows


class _Clocked(fem.Material):
    """Law that records the CPU time at each request of its tangent, one for each iteration of FElupe."""

    def __init__(self, law: fem.Material):
        self.marks: list[float] = []

        def hessian(x):
            self.marks.append(time.process_time())
            return law.hessian(x)

        super().__init__(law.gradient, hessian)


def iteration_meshes() -> dict[str, Mesh]:
    """Return the meshes on which an iteration is compared."""
    return {"80 Q9/P-1, fast": build_mesh(MODEL.experiment, "fast"),
            "80 Q4/P0, the same grading": build_mesh(MODEL.experiment, "fast", Q4P0),
            "500 Q4/P0, uniform": uniform_needle_mesh((20, 25), Q4P0),
            "500 Q9/P-1, uniform": uniform_needle_mesh((20, 25), Q9P1)}


def iterations(meshes: dict[str, Mesh], repeats: int, peer_repeats: int) -> list[dict]:
    """Time one Newton iteration (tangent, factor, solution, next residual) of a bonded punch here and in FElupe.

    Raises:
        SystemExit: the forces differ.
    """
    rows = []
    for name, mesh in meshes.items():
        pressure = {Q9P1.name: "P-1", Q4P0.name: "P0"}[mesh.element.name]
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
    """Time whole curves of 21 points to 10 mm, from mesh to forces."""
    rows = []
    for resolution, target in CURVE_TARGETS.items():
        solved = ts.simulate(MODEL, resolution=resolution).metadata["solver"]  # compiles
        spent = summary(cpu_seconds(lambda name=resolution: ts.simulate(
            MODEL, resolution=name, estimate_error=False), repeats))
        rows.append({"resolution": resolution, "elements": solved["mesh"]["elements"],
                     "iterations": solved["newton_iterations"], "time": spent, "target_s": target})
    return rows


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    table(console, "Band factorisation of the tangent at 5 mm: CPU ms",
          ["mesh", "freedoms", "half band", "ours (GFLOP/s)", "LAPACK dpbtrf", "ours / LAPACK"],
          [[row["mesh"], str(row["freedoms"]), str(row["half_band"]), f"{row['ours_ms']:.3f} "
            f"({row['ours_gflops']:.1f})", f"{row['lapack_ms']:.3f}", f"{row['ratio']:.2f}"]
           for row in result["factorisation"]])
    table(console, "One Newton iteration of a bonded punch: CPU ms (smallest to largest)",
          ["mesh", "FElupe", "ours", "ratio", "forces agree to", "target"],
          [[row["mesh"], spread(row["felupe"]), spread(row["ours"], 3), f"{row['ratio']:.1f}x",
            f"{row['largest_difference']:.1g}", verdict(row["ratio"] >= row["target"], f"{row['target']:g}x")]
           for row in result["iterations"]])
    table(console, "Needle curve, 21 points to 10 mm: CPU ms (smallest to largest)",
          ["resolution", "elements", "iterations", "CPU", "target"],
          [[row["resolution"], str(row["elements"]), str(row["iterations"]), spread(row["time"], 1),
            verdict(row["time"]["median_s"] <= row["target_s"], f"{1e3 * row['target_s']:g} ms")]
           for row in result["curves"]])


def main() -> None:
    arguments = option_parser(__doc__).parse_args()
    repeats = arguments.repeats
    result = about("needle", ["felupe"]) | {
        "factorisation": factorisation(20 * repeats),
        "iterations": iterations(iteration_meshes(), 20 * repeats, max(1, (repeats + 1) // 2)),
        "curves": curves(repeats)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
