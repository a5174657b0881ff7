"""One Newton iteration: its parts, LAPACK's factorisation of a fixed matrix, and FElupe's iteration, in one run."""

import numpy as np

from benchmarks.measure import against_lapack, cpu_seconds
from benchmarks.peers.needle import iterations
from benchmarks.peers.work_precision import uniform_needle_mesh
from benchmarks.realtime.ticks import DT, NEEDLE, TOLERANCE, WAY, no_garbage_collection, say
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import Mesh
from tissue_sim.mesh.elements import Q4P0

#: The mesh whose ratios stand for all: 1016 equations, half band 44.
STANDARD = "500 Q4/P0, uniform"
#: Depth, m, of the measured iteration: the tissue touches the shaft.
DEPTH = 5e-3
#: Parts of an iteration, in the order in which it does them; they add up to it.
PARTS = {"launch_ms": "start from Python", "tangent_ms": "element work with tangent", "contact_ms": "contact, twice",
         "factor_ms": "factor", "solve_ms": "solve", "residual_ms": "element work, residual only"}


def meshes() -> dict[str, Mesh]:
    return {STANDARD: uniform_needle_mesh((20, 25), Q4P0), "realtime": build_mesh(NEEDLE.experiment, "realtime")}


def brought_to(depth: float, name: str, mesh: Mesh) -> AxisymmetricSolver:
    """Return a solver after ticks to a depth.

    Raises:
        SystemExit: it did not get there.
    """
    solver = build_solver_on_mesh(NEEDLE, mesh)
    for k in range(1, round(depth / WAY) + 1):
        if solver.step(k * WAY, DT, tolerance=TOLERANCE).status is not StepStatus.CONVERGED:
            raise SystemExit(f"{name}: no convergence at {k * WAY * 1e3:g} mm")
    return solver


def parts(name: str, mesh: Mesh, repeats: int) -> dict:
    """Return median CPU times of an iteration, of its parts, and of LAPACK's `dpbtrf` of the tangent, ms.

    An iteration is tangent, factor, solution and next residual. Its tangent is measured without what follows, the
    contact as what is gone without it; factor and solution stand alone; the rest is the next residual, with the update
    of what was eliminated.
    """
    solver = brought_to(DEPTH, name, mesh)
    lower, counts = solver.equations.assemble_committed_tangent(), solver.equations.counts
    contacts = int(counts[newton.StepIntegerIndex.CONTACTS])
    # (passes, linear solves, contact edges); at a tolerance that nothing meets the state stays as it was.
    kinds = {"iteration": (1, 1, contacts), "tangent": (1, 0, contacts), "bare": (1, 0, 0), "launch": (0, 0, contacts)}
    rounds = []
    with no_garbage_collection():
        for _ in range(repeats):
            spent = []
            for passes, solves, edges in kinds.values():
                counts[newton.StepIntegerIndex.PASSES], counts[newton.StepIntegerIndex.CONTACTS] = passes, edges
                # After the first of them caches hold what belongs to it.
                spent.append(np.median(cpu_seconds(lambda solves=solves: solver.step(
                    DEPTH + WAY, DT, tolerance=-1.0, max_iterations=solves), 8)[1:]))
            counts[newton.StepIntegerIndex.PASSES], counts[newton.StepIntegerIndex.CONTACTS] = 1, contacts
            alone, both = (against_lapack(name, lower, 5, solve=solve) for solve in (False, True))
            rounds.append([*1e3 * np.array(spent), alone["ours_ms"], both["ours_ms"], alone["lapack_ms"]])
    rounds = np.array(rounds)
    whole, tangent, bare, launch, factor, both, dpbtrf = np.median(rounds, axis=0).tolist()
    contact, solve = tangent - bare, both - factor
    found = {"launch_ms": launch, "tangent_ms": bare - launch, "contact_ms": 2 * contact, "factor_ms": factor,
             "solve_ms": solve, "residual_ms": whole - tangent - contact - factor - solve}
    return {"mesh": name, "elements": len(mesh.connectivity), "freedoms": solver.equations.free,
            "half_band": solver.equations.half_band,
            "iteration_ms": whole, **found, "share_percent": {part: 100 * found[part] / whole for part in PARTS},
            "dpbtrf_ms": dpbtrf, "over_dpbtrf": float(np.median(rounds[:, 0] / rounds[:, -1]))}


def iteration(repeats: int, peer_repeats: int) -> dict:
    """Return ``iteration_over_dpbtrf`` and ``felupe_over_iteration`` of the mesh `STANDARD`, with details.

    FElupe's problem is a bonded punch without wall contact, which it lacks; see `needle.iterations`.
    """
    say("one iteration")
    chosen = meshes()
    rows = [parts(name, mesh, repeats) for name, mesh in chosen.items()]
    standard = next(row for row in rows if row["mesh"] == STANDARD)
    say("one iteration of FElupe")
    peers = iterations(chosen, repeats, peer_repeats)
    return {"iteration_over_dpbtrf": standard["over_dpbtrf"],
            "felupe_over_iteration": next(row["ratio"] for row in peers if row["mesh"] == STANDARD),
            "iteration_mesh": STANDARD, "iteration": rows, "felupe": peers}
