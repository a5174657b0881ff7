"""Multirate simulation: cost of condensing the bulk of a solid, and error of contact on a frozen bulk.

    python -m benchmarks multirate [--quick] [--json]

A round tip of 8 mm with mu = 0.3 goes down into the study's cylinder, is dragged aside, lifted off, put down again and
dragged on round a corner, all at 50 mm/s. The bulk is linearised in this process and its models and tangents come after
fixed times that are stated (`DelayedBulkLink`), so that the same run gives the same forces on any computer. It is
compared with solving the whole solid at every other pose; normal and lateral errors are over the largest force of their
kind. Times are CPU times with one thread.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import math
import time
from itertools import pairwise

import numpy as np
from delayed_bulk import DelayedBulkLink

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, table
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.fem.linear.sparse import SparseSolver, get_pardiso_or_scipy_name
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(5e-3, 3), friction=0.3,
                               tool=ts.Tool("round", radius=8e-3)), MATERIAL)
#: Smallest element, elements around a quarter, growth and largest element of the meshes, m.
MESHES = {1800: (2.4e-3, 3, 2.0, 16e-3), 3300: (1.6e-3, 4, 1.8, 15.2e-3), 5800: (1.2e-3, 5, 1.7, 13e-3)}
#: Where the tool goes, mm, at SPEED, m/s, in ticks, s; the whole is solved at every SPARSE-th of them.
CORNERS = ((0, 0, 0.5), (0, 0, -3), (10, 0, -3), (10, 0, 1), (7, 0, 1), (4, 0, -2.5), (4, 6, -2.5), (-3, 0, -3),
           (-3, 0, 0.5))
#: Speed of the tool, m/s.
SPEED = 0.05
#: Length of a tick, s.
TICK = 1e-3
#: Ticks between two comparisons with the full solid.
SPARSE = 2
#: After how long a model comes, and a tangent, s; None: each model has its own.
DELAYS = ((0.016, None), (0.033, None), (0.066, None), (0.004, 0.020), (0.006, 0.033), (0.010, 0.066))


def mesh_of(size: int):
    smallest, around, growth, largest = MESHES[size]
    return create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=smallest, growth=growth,
                                             largest=largest,
                                             around=around)


def path() -> list[Pose]:
    """Return the poses of the ticks."""
    corners, poses = np.array(CORNERS) * 1e-3, []
    for start, end in pairwise(corners):
        count = max(1, round(float(np.linalg.norm(end - start)) / (SPEED * TICK)))
        poses += [Pose(tuple((start + (end - start) * k / count).tolist())) for k in range(count)]
    return poses


def cpu(function, repeats: int = 3) -> float:
    """Return the shortest CPU time of a call, s."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        times.append(time.process_time() - began)
    return min(times)


def condensation(size: int, repeats: int) -> dict:
    """Return the CPU time of the factorisation and of the condensation, s."""
    bulk = SolidLineariser(make_solver(MODEL, mesh=mesh_of(size)))
    solver, equations, sparse = bulk.solver, bulk.solver.equations, SparseSolver()
    solver.step(Pose((0.0, 0.0, -1e-3)), tolerance=1e-6, max_iterations=40)
    assemble = cpu(equations.assemble_and_get_least_volume_ratio, repeats)
    equations.matrix.update_free_part()
    matrix = equations.matrix.free
    near = np.argsort(bulk._compute_gaps(Pose((0.0, 0.0, -1e-3))))
    near = near[np.isin(near, bulk._meets)]
    row = {"freedoms": matrix.shape[0], "assembly": assemble}
    for name, symmetric in (("factor", True), ("not symmetric", False)):
        sparse.factorise_or_none(matrix, symmetric=symmetric)
        row[name] = cpu(lambda s=symmetric: sparse.factorise_or_none(matrix, symmetric=s), repeats)
    for nodes in (100, near.size):
        interface = np.sort(bulk._rows[near[:nodes]].ravel())
        began = time.process_time()
        sparse.factorise_condensed_or_none(matrix, interface)
        name = "100 nodes" if nodes == 100 else "all"
        row[f"first, {name}"] = time.process_time() - began
        row[f"condensed, {name}"] = cpu(lambda i=interface: sparse.factorise_condensed_or_none(matrix, i), repeats)
    return row | {"nodes": near.size, "iterate": iterate(size)}


def iterate(size: int) -> float:
    """Return the median CPU time of a model that reuses the tangent, s, during a drag."""
    bulk, times = SolidLineariser(make_solver(MODEL, mesh=mesh_of(size))), []
    link = DelayedBulkLink(bulk, 8e-3, math.inf)
    tissue = MultiRateTissue(MODEL, link=link)
    tissue.warm_up()
    for pose in path()[:140]:
        seen, models = link.linearising, tissue.models
        tissue.step(pose, TICK)
        if link.linearising > seen and models > 3:
            times.append(link.linearising - seen)
    return float(np.median(times))


def synchronous(size: int, poses: list[Pose]) -> dict[int, np.ndarray]:
    """Return the forces of the whole solid, N, by the number of the pose."""
    solver, forces = make_solver(MODEL, mesh=mesh_of(size)), {}
    for number in range(0, len(poses), SPARSE):
        step = solver.step(poses[number], tolerance=1e-6, max_iterations=40)
        if step.status is StepStatus.CONVERGED:
            forces[number] = np.array(step.wrench[:3])
    return forces


def two_rates(size: int, delay: float, tangent: float | None, poses: list[Pose], exact: dict[int, np.ndarray]) -> dict:
    """Compare the multirate simulator with the forces of the whole solid."""
    bulk = SolidLineariser(make_solver(MODEL, mesh=mesh_of(size)))
    tissue = MultiRateTissue(MODEL, link=DelayedBulkLink(bulk, delay, tangent))
    tissue.warm_up()
    answers, times, seen = [], [], tissue._link.linearising
    for pose in poses:
        began = time.process_time()
        answers.append(tissue.step(pose, TICK))
        # Without the linearisation, which belongs to another process.
        times.append(time.process_time() - began - (tissue._link.linearising - seen))
        tissue.prepare()
        seen = tissue._link.linearising
    numbers = sorted(exact)
    expected = np.array([exact[number] for number in numbers])
    wrong = np.array([answers[number].wrench[:3] for number in numbers]) - expected
    kinds = {"normal": (np.abs(wrong[:, 2]), np.abs(expected[:, 2])),
             "lateral": (np.hypot(*wrong[:, :2].T), np.hypot(*expected[:, :2].T))}
    row = {"freedoms": size, "delay": delay, "tangent": tangent, "models": tissue.models}
    for name, (error, force) in kinds.items():
        row[f"{name} rms"], row[f"{name} max"] = np.sqrt((error**2).mean()) / force.max(), error.max() / force.max()
    steps = np.linalg.norm(np.diff([answer.wrench[:3] for answer in answers], axis=0), axis=1)
    physical = max(np.linalg.norm(expected[k + 1] - expected[k]) for k in range(len(numbers) - 1)) / SPARSE
    return row | {"p50": np.median(times), "p99": np.quantile(times, 0.99), "largest step": steps.max(),
                  "largest step of the solid": physical,
                  "not converged": sum(answer.status is not ts.ForceStatus.CONVERGED for answer in answers)}


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="drag on the smallest mesh only")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(MESHES), choices=list(MESHES))
    options = parser.parse_args()
    poses = path()
    costs = [condensation(size, options.repeats) for size in options.sizes]
    rows = []
    for size in options.sizes[:1] if options.quick else options.sizes:
        exact = synchronous(size, poses)
        rows += [two_rates(size, *delays, poses, exact) for delays in DELAYS]
    show(about("multirate", ("pypardiso",) if get_pardiso_or_scipy_name() == "pardiso" else ()) | {
        "library": get_pardiso_or_scipy_name(), "costs_s": costs, "drag": rows}, draw, as_json=options.json)


def draw(result: dict, console) -> None:
    costs, rows = result["costs_s"], result["drag"]
    table(console, f"CPU ms with {result['library']}", list(costs[0]), [
        [f"{value:.0f}" if name in ("freedoms", "nodes") else f"{1e3 * value:.1f}" for name, value in row.items()]
        for row in costs])
    table(console, "errors in %, times in CPU ms, steps in N", list(rows[0]),
          [[_shown(name, value) for name, value in row.items()] for row in rows])


def _shown(name: str, value: float | None) -> str:
    if name in ("freedoms", "models", "not converged"):
        return f"{value:.0f}"
    if value is None:
        return "own"
    if name in ("delay", "tangent", "p50", "p99"):
        return f"{1e3 * value:.2f}"
    return f"{value:.4f}" if name.startswith("largest") else f"{100 * value:.2f}"


if __name__ == "__main__":
    main()
