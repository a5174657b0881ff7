"""Time and memory of a step of the 3D solid over mesh sizes, and of an iteration compared with FElupe.

    python -m benchmarks solid [--sizes 6000 20000 60000] [--element hex8 | hex27] [--peer-up-to 25000] [--json]

A bonded flat punch on the study's cylinder, K/mu = 1e4. FElupe (hexahedra of eight nodes with a constant pressure,
`SolidBodyNearlyIncompressible`) gets the same mesh, the same law with its tangent written out, and the same linear
solver, ours, which analyses the pattern once for either; forces are compared first. `iteration` is one that assembles
and factors; `test` the mean over all iterations of ten steps to the same tolerance, in which FElupe factors in each and
we do not. Processor and wall seconds, medians; `TISSUE_SIM_SPARSE=scipy` chooses SciPy's solver. On a busy machine only
the ratios of one run mean anything.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable

import felupe as fem
import numpy as np
from felupe_problem import reduced_polynomial

import tissue_sim as ts
from tissue_sim.fem.linear.sparse import SparseSolver, factorise_or_none, get_pardiso_or_scipy_name
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SolidMesh, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

MODULI = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", MODULI, ts.Bulk("bulk_ratio", 1e4))
ELEMENTS = {"hex8": HEX8P0, "hex27": HEX27P1}
#: Elements along a quarter of the edge, the smallest interval there, m, and its growth, by freedoms and element.
SIZES = {("hex8", 6000): (4, 1.1e-3, 1.55), ("hex8", 20000): (7, 0.65e-3, 1.35), ("hex8", 60000): (11, 0.5e-3, 1.25),
         ("hex27", 6000): (2, 3.5e-3, 2.8), ("hex27", 20000): (3, 1.7e-3, 1.8), ("hex27", 60000): (5, 1.0e-3, 1.55)}
#: Depth of a step, m: small, because FElupe does not halve steps and would invert the smallest elements.
DEPTH = 1e-4
#: Number of repetitions.
REPEATS = 3
#: Steps of this depth in a whole test.
STEPS = 10
#: Relative residual after each step, 1.
TOLERANCE = 1e-8
#: From FElupe's order of the corners to the places in ours.
_CORNERS = [0, 1, 3, 2, 4, 5, 7, 6]


def timed(work: Callable[[], object], repeats: int = REPEATS) -> tuple[float, float]:
    """Return the median CPU and wall time, s."""
    spent = []
    for _ in range(repeats):
        began = time.process_time(), time.perf_counter()
        work()
        spent.append((time.process_time() - began[0], time.perf_counter() - began[1]))
    cpu, wall = zip(*spent, strict=True)
    return statistics.median(cpu), statistics.median(wall)


def memory() -> float:
    """Return the peak memory of the process, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def ours(mesh: SolidMesh) -> tuple[SolidSolver, dict]:
    """Time a step from rest, and its parts."""
    before = memory()
    began = time.perf_counter()
    solver = SolidSolver(mesh, MATERIAL, {"base": "xyz"}, mesh.sets["face"], start=Pose((0.0, 0.0, 0.0)))
    made = time.perf_counter() - began
    began = time.process_time(), time.perf_counter()
    step = solver.step(Pose((0.0, 0.0, -DEPTH)))
    whole = time.process_time() - began[0], time.perf_counter() - began[1]
    if step.status is not StepStatus.CONVERGED:
        raise SystemExit(f"ours: {step.status.message}")
    free = solver.equations.matrix.free
    assembly = timed(solver.equations.assemble_and_get_least_volume_ratio)
    solver.equations.matrix.add_contact_stiffness(solver.contact.rates)
    factors = []

    def factor() -> None:
        factors[:] = [factorise_or_none(free, symmetric=True)]

    factorisation = timed(factor, 2)
    most, kept = memory() - before, SparseSolver()
    kept.factorise_or_none(free, symmetric=True)
    refactorisation = timed(lambda: kept.factorise_or_none(free, symmetric=True))
    solution = timed(lambda: factors[0].solve(np.ones(free.shape[0])))
    return solver, {
        "freedoms": int(free.shape[0]), "elements": len(mesh.connectivity), "entries": int(free.nnz),
        "force_N": step.force, "iterations": step.iterations, "making_s": made, "step_cpu_s": whole[0],
        "step_wall_s": whole[1], "assembly_s": assembly, "factor_s": factorisation,
        "factor_analysed_s": refactorisation, "solution_s": solution,
        "iteration_cpu_s": assembly[0] + refactorisation[0] + solution[0], "memory_MiB": most}


def our_test(mesh: SolidMesh) -> dict:
    """Time all steps, without the construction of the solver."""
    solver = SolidSolver(mesh, MATERIAL, {"base": "xyz"}, mesh.sets["face"], start=Pose((0.0, 0.0, 0.0)))
    began, iterations, force = time.process_time(), 0, 0.0
    for number in range(1, STEPS + 1):
        step = solver.step(Pose((0.0, 0.0, -number * DEPTH)), tolerance=TOLERANCE)
        if step.status is not StepStatus.CONVERGED:
            raise SystemExit(f"ours, step {number}: {step.status.message}")
        iterations, force = iterations + step.iterations, step.force
    spent = time.process_time() - began
    return {"cpu_s": spent, "iterations": iterations, "mean_iteration_cpu_s": spent / iterations, "force_N": force}


class _Peer:
    """The same problem in FElupe.

    Attributes:
        assemblies, solutions: processor seconds of those so far.
        system, prescribed: of the last iteration.
    """

    def __init__(self, mesh: SolidMesh):
        cells = mesh.connectivity[:, _CORNERS]
        region = fem.RegionHexahedron(fem.Mesh(mesh.nodes * 1e3, cells, "hexahedron"))
        self._field = fem.FieldContainer([fem.Field(region, dim=3)])
        self._body = fem.SolidBodyNearlyIncompressible(reduced_polynomial(**MODULI), self._field,
                                                       bulk=MATERIAL.bulk_modulus * 1e-6)
        self._members = [np.isin(np.arange(len(mesh.nodes)), mesh.sets[name]) for name in ("base", "face")]
        self._face, self._solver = mesh.sets["face"], _OurSolution()
        self.assemblies: list[float] = []
        self.solutions: list[float] = []

    def step(self, depth: float, tolerance: float) -> float:
        """Iterate by Newton's method to a depth, m; return the force, N."""
        field, body = self._field, self._body
        bounds = {"base": fem.Boundary(field[0], mask=self._members[0]),
                  "aside": fem.Boundary(field[0], mask=self._members[1], skip=(False, False, True)),
                  "down": fem.Boundary(field[0], mask=self._members[1], skip=(True, True, False), value=-1e3 * depth)}
        dof0, dof1 = fem.dof.partition(field, bounds)
        self.prescribed = fem.dof.apply(field, bounds, dof0)
        for iteration in range(20):
            began = time.process_time()
            right = body.assemble.vector(field)
            if iteration and np.linalg.norm(right.toarray()[dof1]) <= tolerance * np.linalg.norm(right.toarray()[dof0]):
                return -float(right.toarray().reshape(-1, 3)[self._face, 2].sum())
            self.system = fem.solve.partition(field, body.assemble.matrix(field), dof1, dof0, right)
            assembled = time.process_time()
            field += fem.solve.solve(*self.system, self.prescribed, solver=self._solver)
            self.assemblies.append(assembled - began)
            self.solutions.append(time.process_time() - assembled)
        raise SystemExit(f"FElupe does not come to {depth * 1e3:g} mm")


class _OurSolution:
    """Linear solver of this program for FElupe's matrices, whose sparsity pattern is constant."""

    def __init__(self) -> None:
        self._solver, self._pattern = SparseSolver(), (np.zeros(0, np.int32), np.zeros(0, np.int32))

    def __call__(self, matrix, right: np.ndarray) -> np.ndarray:
        from scipy import sparse

        taken = matrix.tocsc()
        taken.sort_indices()
        if not all(map(np.array_equal, (taken.indices, taken.indptr), self._pattern)):
            # Pardiso counts in 32 bits.
            self._pattern = taken.indices.astype(np.int32), taken.indptr.astype(np.int32)
        same = sparse.csc_array((taken.data, *self._pattern), shape=taken.shape)
        same.indices, same.indptr = self._pattern
        factor = self._solver.factorise_or_none(same, symmetric=True)
        assert factor is not None
        return factor.solve(np.asarray(right).ravel())


def peer(mesh: SolidMesh, expected: float) -> dict:
    """Time FElupe's iterations up to the same force, and the parts of one with the pattern analysed before."""
    problem = _Peer(mesh)
    force = problem.step(DEPTH, 1e-7)
    if abs(force / expected - 1.0) > 1e-6:
        raise SystemExit(f"FElupe finds {force:.8g} N where ours has {expected:.8g} N")
    began = time.process_time()
    if get_pardiso_or_scipy_name() == "pardiso":
        from pypardiso import spsolve

        # As its manual has it: the matrix is not said to be symmetric.
        fem.solve.solve(*problem.system, problem.prescribed,
                        solver=lambda matrix, right: spsolve(matrix, np.asarray(right).ravel()))
    else:
        fem.solve.solve(*problem.system, problem.prescribed)
    manual = time.process_time() - began
    assembly, solution = statistics.median(problem.assemblies), statistics.median(problem.solutions[1:])
    return {"iterations": len(problem.assemblies), "assembly_s": assembly, "manual_solution_s": manual,
            "solution_s": solution, "iteration_cpu_s": assembly + solution, "force_N": force}


def peer_test(mesh: SolidMesh, expected: float) -> dict:
    """Time all steps, without the construction of the problem."""
    problem = _Peer(mesh)
    began, force = time.process_time(), 0.0
    for number in range(1, STEPS + 1):
        force = problem.step(number * DEPTH, TOLERANCE)
    spent, iterations = time.process_time() - began, len(problem.solutions)
    if abs(force / expected - 1.0) > 1e-6:
        raise SystemExit(f"FElupe finds {force:.8g} N after {STEPS} steps where ours has {expected:.8g} N")
    return {"cpu_s": spent, "iterations": iterations, "mean_iteration_cpu_s": spent / iterations, "force_N": force}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[6000, 20000], choices=(6000, 20000, 60000))
    parser.add_argument("--element", choices=tuple(ELEMENTS), default="hex8")
    parser.add_argument("--peer-up-to", type=int, default=25000, help="freedoms; 0: no peer")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    about = {"machine": platform.processor() or platform.machine(), "python": sys.version.split()[0],
             "tissue_sim": ts.__version__, "felupe": fem.__version__, "linear_solver": get_pardiso_or_scipy_name()}
    print(json.dumps(about), flush=True)
    # Compile and load everything once.
    ours(create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, ELEMENTS[asked.element], smallest=6e-3, growth=3.0,
                                           largest=40e-3,
                                           around=2))
    for size in asked.sizes:
        around, smallest, growth = SIZES[asked.element, size]
        mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, ELEMENTS[asked.element], smallest=smallest,
                                                 growth=growth,
                                                 largest=15e-3,
                                                 around=around)
        _, row = ours(mesh)
        if asked.element == "hex8" and row["freedoms"] <= asked.peer_up_to:
            row["felupe"] = peer(mesh, row["force_N"])
            row["felupe_over_ours"] = {"iteration": row["felupe"]["iteration_cpu_s"] / row["iteration_cpu_s"],
                                       "iteration_as_in_its_manual": (row["felupe"]["assembly_s"] + row["felupe"][
                                           "manual_solution_s"]) / row["iteration_cpu_s"],
                                       "assembly": row["felupe"]["assembly_s"] / row["assembly_s"][0]}
            row["test"] = {"ours": our_test(mesh)}
            row["test"]["felupe"] = peer_test(mesh, row["test"]["ours"]["force_N"])
            row["test"] |= {f"felupe_over_ours_{name}": row["test"]["felupe"][name] / row["test"]["ours"][name]
                            for name in ("mean_iteration_cpu_s", "cpu_s")}
        print(json.dumps(row, indent=None if asked.json else 1), flush=True)


if __name__ == "__main__":
    main()
