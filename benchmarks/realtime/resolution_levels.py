"""Force error and time of a tick of the meshes for real time.

    python -m benchmarks resolution_levels [--json]

Errors are against the accurate axisymmetric mesh in the same steps, from 2 to 10 mm (tips: 6 mm), over the force there;
those that `tissue_sim.fem.axisymmetric.resolutions` and `tissue_sim.fem.solid.discretisation` state are at least the
largest ones of their kind. The mesh `solid` is the three-dimensional `realtime`. Ticks are those by which
`Simulator.warm_up` chooses, inertia counted, without a budget: CPU time in which 99 of 100 end.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import math
import statistics

import numpy as np

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, table
from tissue_sim.fem.axisymmetric.resolutions import list_realtime_levels_finest_first
from tissue_sim.realtime.simulator import measure_tick_time_or_infinity

SPECIMEN = ts.Specimen(0.040, 0.070)
MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
RADIUS = 8e-3
#: Kind, and what its tests have of their own.
KINDS = {
    "plates": {"bonded": {}, "friction 0.3": {"friction": 0.3, "friction_base": 0.3}},
    "flat tools": {"bonded": {"tool": ts.Tool("flat", RADIUS)},
                   "friction 0.7, edge 0.25 mm": {"tool": ts.Tool("flat", RADIUS, 0.25e-3), "friction": 0.7},
                   "stick, edge 1 mm": {"tool": ts.Tool("flat", RADIUS, 1e-3), "friction": "stick"},
                   "frictionless, edge 1 mm": {"tool": ts.Tool("flat", RADIUS, 1e-3), "friction": "frictionless"}},
    "tips": {"ball, stick": {"tool": ts.Tool("sphere", RADIUS), "friction": "stick"},
             "ball, friction 0.3": {"tool": ts.Tool("sphere", RADIUS), "friction": 0.3},
             "cone of 70 degrees, frictionless": {"tool": ts.Tool("cone", RADIUS, half_angle=math.radians(70.0)),
                                                  "friction": "frictionless"}},
}
DEEPEST = {"plates": 10e-3, "flat tools": 10e-3, "tips": 6e-3}
#: Smallest compared depth, m.
SHALLOWEST = 2e-3
#: Distance of the compared depths, m.
SAMPLE = 0.25e-3


def _force(model: ts.Model, resolution: str, solver: str = "axisymmetric") -> np.ndarray:
    """Return the forces of a test up to its end or its first failure, N."""
    try:
        return ts.simulate(model, resolution=resolution, solver=solver, estimate_error=False).force
    except ts.ConvergenceError as error:
        return error.recording.force


def measure(kind: str, name: str, overrides: dict, repeats: int) -> list[dict]:
    """Return a row for each level."""
    deepest = DEEPEST[kind]
    protocol = ts.Protocol.ramp(deepest, round(deepest / SAMPLE) + 1)
    model = ts.Model(ts.Experiment(SPECIMEN, protocol, **overrides), MATERIAL)
    seen = protocol.displacement >= SHALLOWEST
    exact = _force(model, "accurate")
    rows = []
    for level in list_realtime_levels_finest_first(model.experiment):
        force = _force(model, level.resolution)
        reached = seen[: force.size]
        simulator = ts.Simulator(model, resolution=level.resolution, inertia="on")
        simulator.warm_up()
        ticks = []
        for _ in range(repeats):
            ticks.append(measure_tick_time_or_infinity(simulator, deepest, lifts=model.experiment.friction != "bonded"))
            simulator.reset()
        rows.append({"kind": kind, "test": name, "resolution": level.resolution,
                     "elements": len(simulator.mesh.connectivity), "stated": level.force_error,
                     "error": float(np.abs(force[reached] / exact[: force.size][reached] - 1.0).max()),
                     "reached_mm": 1e3 * float(protocol.displacement[force.size - 1]),
                     "tick_s": statistics.median(ticks)})
    return [*rows, measure_solid(kind, name, model, exact, seen)]


def measure_solid(kind: str, name: str, model: ts.Model, exact: np.ndarray, seen: np.ndarray) -> dict:
    """Return the row of the three-dimensional mesh, without the time of its ticks."""
    force = _force(model, "realtime", "solid")
    common = min(force.size, exact.size)
    reached = seen[:common]
    simulator = ts.Simulator(model, solver="solid")
    return {"kind": kind, "test": name, "resolution": "solid", "elements": len(simulator.mesh.connectivity),
            "stated": simulator.force_error,
            "error": float(np.abs(force[:common][reached] / exact[:common][reached] - 1.0).max()),
            "reached_mm": 1e3 * float(model.experiment.protocol.displacement[common - 1]), "tick_s": None}


def draw(result: dict, console) -> None:
    table(console, "Meshes for real time: largest error of the force, and CPU time of a tick (p99, inertia counted)",
          ["tool", "test", "mesh", "elements", "error, %", "stated, %", "to, mm", "tick, ms"],
          [[row["kind"], row["test"], row["resolution"], str(row["elements"]), f"{100 * row['error']:.2f}",
            f"{100 * row['stated']:.2g}" + (" (missed)" if row["error"] > row["stated"] else ""),
            f"{row['reached_mm']:.3g}", "-" if row["tick_s"] is None else f"{1e3 * row['tick_s']:.2f}"]
           for row in result["rows"]])


def main() -> None:
    options = option_parser(__doc__).parse_args()
    rows = [row for kind, tests in KINDS.items() for name, overrides in tests.items()
            for row in measure(kind, name, overrides, options.repeats)]
    show(about("realtime_ladder") | {"rows": rows}, draw, as_json=options.json)


if __name__ == "__main__":
    main()
