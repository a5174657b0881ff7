"""Ticks of a tool that moves to 10 mm and back at 50 mm/s: CPU time and force error of each.

Force errors are those against this program's own solution on a fine mesh, along the same path, at the same K/mu.
"""

import gc
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

import tissue_sim as ts
from benchmarks.peers.friction import EDGE, RELAXING, SPECIMEN
from benchmarks.peers.work_precision import HEIGHT, MATERIAL, MODELS, NEEDLE_RADIUS, RADIUS, REFERENCES
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.mesh import Mesh, cylinder_mesh, cylinder_mesh_refined_under_needle
from tissue_sim.mesh.elements import Q9P1
from tissue_sim.tool_force import ForceStatus

#: Motion of the tool in a tick, m.
WAY = 0.05e-3
#: Length of a tick, s.
DT = 1e-3
#: Relative residual of an equilibrium, 1.
TOLERANCE = 1e-6
DEEPEST = 10e-3
#: Depths, m, at which forces are compared.
COMPARED = (2e-3, 5e-3, 10e-3)
DIRECTIONS = ("loading", "unloading")
#: The name of the case that the diagram is of.
BONDED = "bonded face"
#: Of an independent Taylor-Hood solver with friction 0.7 and edge radius 0.25 mm, N at `COMPARED`
#: (tests/reference/punch_friction0.7_edge0.25mm_RP.csv).
FRICTION_REFERENCE = (0.3552, 0.929, 2.070)
#: Model of the needle.
NEEDLE = MODELS["needle indentation"]
#: Model of the plates.
PLATES = MODELS["bonded compression"]
RUBBING = ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(DEEPEST, 21), tool=ts.Tool("flat", NEEDLE_RADIUS, EDGE),
                                 friction=0.7, friction_wall=0.7), MATERIAL)
#: Growth, smallest and largest element (mm) of the meshes of the diagram, by growth from coarse to fine.
GRADINGS = ((1.6, 4.0, 12.0), (1.6, 1.3, 15.0), (1.6, 0.65, 12.0), (1.6, 0.3, 12.0),
            (2.0, 4.0, 18.0), (2.0, 1.3, 18.0), (2.0, 0.65, 15.0), (2.0, 0.3, 15.0),
            (2.5, 0.8, 18.0), (2.5, 0.5, 18.0), (2.5, 0.3, 12.0), (3.0, 0.8, 22.0), (3.0, 0.3, 22.0), (3.0, 0.3, 15.0))
#: Those of the points with at most 0.3 % of force error.
CLOSE = ((2.5, 0.3, 18.0), (2.5, 0.3, 15.0))
#: JSON key: force error, %.
ERROR = "force_error_percent"
#: JSON key: median CPU time, ms.
P50 = "cpu_ms_p50"
#: JSON key: 99th percentile of the CPU time, ms.
P99 = "cpu_ms_p99"
#: JSON key: 99.9th percentile of the CPU time, ms.
P999 = "cpu_ms_p999"
BONDED_TARGETS = {ERROR: 1.0, P50: 0.30, P99: 0.90, P999: 1.0}
RUBBING_TARGETS = {ERROR: 1.0, P50: 0.50, P99: 1.0}
CLOSE_TARGETS = {ERROR: 0.3, P50: 0.75, P99: 2.0}


@dataclass(frozen=True)
class Case:
    """Model and mesh of a simulator; cases of one name differ in the mesh only."""

    name: str
    model: ts.Model
    mesh: Mesh
    grading: str
    reference: tuple[float, ...] | None = None
    inertia: str = "off"
    targets: dict[str, float] = field(default_factory=dict)

    def simulator(self, mesh: Mesh | None = None) -> ts.Simulator:
        simulator = ts.Simulator(self.model, mesh=mesh or self.mesh, inertia=self.inertia, tolerance=TOLERANCE)
        simulator.warm_up()
        return simulator


@dataclass(frozen=True)
class Drive:
    """Result of loading and unloading, one value for each tick: force (N), CPU time (s), linear solves, status."""

    force: np.ndarray
    cpu: np.ndarray
    iterations: np.ndarray
    status: np.ndarray


def graded_needle_mesh(growth: float, smallest: float, largest: float) -> Mesh:
    """Return the needle's mesh of nine-node quadrilaterals; sizes in mm."""
    return cylinder_mesh_refined_under_needle(RADIUS, HEIGHT, NEEDLE_RADIUS, Q9P1, growth=growth,
                                              smallest=smallest * 1e-3,
                                              largest=largest * 1e-3)


def grading_name(growth: float, smallest: float, largest: float) -> str:
    return f"growth {growth:g}, {smallest:g} to {largest:g} mm"


def fine_mesh(model: ts.Model) -> Mesh:
    """Return the mesh of the converged reference."""
    if model.experiment.tool.is_plate:
        return cylinder_mesh(RADIUS, HEIGHT, (24, 30), Q9P1, grading=(50.0, 10.0))
    return graded_needle_mesh(1.3, 0.1, 6.0)


def cases() -> list[Case]:
    """Return all cases, with and without targets."""
    bonded, rubbing, plates = (Case(name, model, build_mesh(model.experiment, "realtime"), "realtime", forces)
                               for name, model, forces in (
                                   (BONDED, NEEDLE, REFERENCES["needle indentation"][0]),
                                   ("friction 0.7", RUBBING, FRICTION_REFERENCE),
                                   ("bonded plates", PLATES, REFERENCES["bonded compression"][0])))
    bonded = replace(bonded, targets=BONDED_TARGETS)
    return [bonded,
            *(replace(bonded, mesh=graded_needle_mesh(*grading), grading=grading_name(*grading), targets=CLOSE_TARGETS)
              for grading in CLOSE),
            replace(rubbing, targets={ERROR: RUBBING_TARGETS[ERROR]}),
            replace(rubbing, name=f"{rubbing.name}, one Prony term", model=replace(RUBBING, material=RELAXING),
                    reference=None, targets=RUBBING_TARGETS),
            replace(bonded, name=f"{bonded.name}, inertia", reference=None, inertia="auto", targets={}),
            plates]


def say(text: str) -> None:
    """Print progress."""
    print(f"realtime: {text}", file=sys.stderr, flush=True)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, as the 1 kHz loop does."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def percentiles(cpu: np.ndarray) -> dict[str, float]:
    """Return percentiles of CPU times, ms.

    Args:
        cpu: CPU time of each tick, s.
    """
    p50, p99, p999, most = np.quantile(cpu, (0.5, 0.99, 0.999, 1.0)) * 1e3
    return {P50: float(p50), P99: float(p99), P999: float(p999), "cpu_ms_max": float(most)}


def count_statuses(status: np.ndarray) -> dict[str, int]:
    counts = Counter(status.tolist())
    return {each.name.lower(): counts[each] for each in ForceStatus}


def drive(simulator: ts.Simulator, way: float = WAY) -> Drive:
    """Move the tool from touch to 10 mm and back at 50 mm/s, by `way` (m) in each tick."""
    count, dt = round(DEEPEST / way), way * DT / WAY
    ticks = []
    simulator.reset()
    with no_garbage_collection():
        for k in (*range(1, count + 1), *range(count - 1, -1, -1)):
            started = time.process_time()
            answer = simulator.step(k * way, dt)
            ticks.append((answer.force, time.process_time() - started, answer.iterations, int(answer.status)))
    force, cpu, iterations, status = (np.array(values) for values in zip(*ticks, strict=True))
    return Drive(force, cpu, iterations, status)


def compared_forces(driven: Drive) -> dict[str, np.ndarray]:
    """Return the forces at `COMPARED` during loading and during unloading from 10 mm.

    Raises:
        SystemExit: no equilibrium at one of them.
    """
    count = len(driven.force) // 2
    places = np.array([round(depth / DEEPEST * count) for depth in COMPARED])
    ticks = {"loading": places - 1, "unloading": 2 * count - places - 1}
    for direction, chosen in ticks.items():
        if (driven.status[chosen] != ForceStatus.CONVERGED).any():
            raise SystemExit(f"{direction}: no equilibrium at 2, 5 or 10 mm")
    return {direction: driven.force[chosen] for direction, chosen in ticks.items()}


def percent(forces: np.ndarray, expected: np.ndarray) -> list[float]:
    return (100.0 * (forces / np.asarray(expected) - 1.0)).tolist()


@dataclass(frozen=True)
class Converged:
    """Forces of the fine mesh at `COMPARED`, N, by direction, and their cost."""

    forces: dict[str, np.ndarray]
    elements: int
    step_m: float
    statuses: dict[str, int]


class ConvergedSolutions:
    """Solutions on the fine mesh, each computed at its first request.

    Args:
        way: from tick to tick, m. With inertia forces depend on the time step, so that only `WAY` compares.
    """

    def __init__(self, way: float):
        self._way, self._known = way, {}

    def of(self, case: Case) -> Converged | None:
        """None: not with such ticks."""
        if case.inertia != "off" and self._way != WAY:
            return None
        if case.name not in self._known:
            say(f"{case.name}: converged solution")
            mesh = fine_mesh(case.model)
            driven = drive(case.simulator(mesh), self._way)
            self._known[case.name] = Converged(compared_forces(driven), len(mesh.connectivity), self._way,
                                               count_statuses(driven.status))
        return self._known[case.name]


def in_turns(chosen: list[Case], rounds: int) -> list[list[Drive]]:
    """Run all cases in turns; the first round is not counted.

    Raises:
        SystemExit: forces differ from round to round.
    """
    simulators = [case.simulator() for case in chosen]
    first = [drive(simulator) for simulator in simulators]
    found: list[list[Drive]] = [[] for _ in chosen]
    for number in range(rounds):
        if number % 10 == 0:
            say(f"ticks of {len(chosen)} cases, round {number + 1} of {rounds}")
        for case, simulator, before, drives in zip(chosen, simulators, first, found, strict=True):
            drives.append(drive(simulator))
            if not np.array_equal(before.force, drives[-1].force):
                raise SystemExit(f"{case.name}: the same motion gave other forces")
    return found


def rows_of(case: Case, drives: list[Drive], converged: Converged | None) -> list[dict]:
    """Return a row for each direction; see `rows`."""
    solver = build_solver_on_mesh(case.model, case.mesh)
    forces, count = compared_forces(drives[0]), len(drives[0].force) // 2
    found = []
    for direction, ticks in zip(DIRECTIONS, (slice(0, count), slice(count, None)), strict=True):
        cpu = np.array([driven.cpu[ticks] for driven in drives])
        iterations = drives[0].iterations[ticks]
        # Each tick's median over the rounds: what is slow in every round, not what the computer did meanwhile.
        typical = np.median(cpu, axis=0)
        slowest = int(typical.argmax())
        depth = (slowest + 1 if direction == "loading" else count - 1 - slowest) * WAY * 1e3
        rounds = 1e3 * np.median(cpu, axis=1)
        row = {"case": f"{case.name}, {direction}", "grading": case.grading, "elements": len(case.mesh.connectivity),
               "freedoms": solver.equations.free, "half_band": solver.equations.half_band,
               "force_N": forces[direction].tolist(),
               ERROR: None if converged is None else percent(forces[direction], converged.forces[direction]),
               "reference_distance_percent": None, **percentiles(cpu), "ticks": cpu.size,
               "cpu_ms_p50_of_rounds": [float(rounds.min()), float(rounds.max())],
               "newton_mean": float(iterations.mean()), "newton_max": int(iterations.max()),
               "statuses": count_statuses(drives[0].status[ticks]),
               "worst_tick": {"depth_mm": depth, "cpu_ms": 1e3 * float(typical[slowest]),
                              "newton": int(iterations[slowest])}}
        if converged is not None:
            row["converged"] = {"elements": converged.elements, "step_mm": 1e3 * converged.step_m,
                                "force_N": converged.forces[direction].tolist(), "statuses": converged.statuses}
            if case.reference is not None and direction == "loading":
                row["reference_distance_percent"] = percent(converged.forces[direction], case.reference)
        row["targets"] = case.targets
        row["met"] = {name: largest(row, name) <= target for name, target in case.targets.items()}
        found.append(row)
    return found


def largest(row: dict, name: str) -> float:
    """Return the value that the target limits."""
    return float(np.abs(row[name]).max())


def rows(rounds: int, solutions: ConvergedSolutions) -> list[dict]:
    """Return every case in both directions: CPU time of a tick, Newton iterations, force errors, targets."""
    chosen = cases()
    found = in_turns(chosen, rounds)
    return [row for case, drives in zip(chosen, found, strict=True)
            for row in rows_of(case, drives, solutions.of(case))]


def work_precision(rounds: int, solutions: ConvergedSolutions, *, few: bool) -> list[dict]:
    """Return the largest force error over CPU time of a tick during loading, for meshes of every grading."""
    chosen = [Case(BONDED, NEEDLE, graded_needle_mesh(*grading), grading_name(*grading))
              for grading in (GRADINGS[::5] if few else GRADINGS)]
    points = []
    for case, drives in zip(chosen, in_turns(chosen, rounds), strict=True):
        row, _ = rows_of(case, drives, solutions.of(case))
        points.append({**row, "largest_error_percent": largest(row, ERROR)})
    return points
