"""Cost of Coulomb friction and one Prony term relative to the bonded elastic test, and largest depth of tests.

    python -m benchmarks friction [--json] [--repeats N] [--reach]

The peer is this program's own bonded elastic test on the same mesh, in turns, on one thread: CPU time of a step, from
the sample at rest to the last. ``--reach`` tells instead how deep plates and tools of every shape get.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, cpu_seconds, option_parser, show, spread, summary, table, verdict
from benchmarks.peers.work_precision import HEIGHT, MATERIAL, NEEDLE_RADIUS, RADIUS
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.mesh import Mesh

RELAXING = replace(MATERIAL, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
SPECIMEN = ts.Specimen(RADIUS, HEIGHT)
RESOLUTIONS = ("fast", "accurate")
#: CPU time of a step over that of the bonded elastic one.
RATIO_TARGET = 2.0
#: Samples of the test with ramp, hold and unloading.
SAMPLES = 150
#: Target: CPU time of this test on the fast mesh, s.
TEST_TARGET = 0.300
EDGE = 0.25e-3


def model(friction, *, needle=None, depth=10e-3, points=21, protocol=None, material=MATERIAL) -> ts.Model:
    """Return the cylinder between plates of equal friction, or under a needle with a bonded base."""
    base = friction if needle is None else "bonded"
    return ts.Model(ts.Experiment(SPECIMEN, protocol or ts.Protocol.ramp(depth, points), needle or ts.Tool(),
                                  friction=friction, friction_base=base), material)


def tests() -> dict[str, dict[str, ts.Model]]:
    """Return models by group and name; the first of each group is the reference of the others."""
    needle = ts.Tool("flat", NEEDLE_RADIUS, EDGE)
    plates = {"bonded": model("bonded"), **{f"mu = {mu:g}": model(mu) for mu in (0.1, 0.4, 0.7)}}
    needles = {"bonded": model("bonded", needle=needle), "mu = 0.7": model(0.7, needle=needle)}
    for group in (plates, needles):
        group |= {f"{name}, one Prony term": replace(group[name], material=RELAXING) for name in ("bonded", "mu = 0.7")}
    return {"plates": plates, "needle, edge radius 0.25 mm": needles}


def step_seconds(tested: ts.Model, mesh: Mesh) -> tuple[float, dict]:
    """Return the CPU time of a step without set-up and compilation, s, and the counts of the solver."""
    marks = []
    recording = ts.simulate(tested, mesh=mesh, progress=lambda *_: marks.append(time.process_time()))
    return (marks[-1] - marks[1]) / (len(marks) - 2), recording.metadata["solver"]


def costs(repeats: int) -> list[dict]:
    """Return the CPU time of a step of every test, in turns, over that of the bonded elastic test on the same mesh."""
    rows = []
    for group, models in tests().items():
        for resolution in RESOLUTIONS:
            mesh = build_mesh(next(iter(models.values())).experiment, resolution)
            spent: dict[str, list[float]] = {name: [] for name in models}
            solved = {name: step_seconds(tested, mesh)[1] for name, tested in models.items()}
            for _ in range(repeats):
                for name, tested in models.items():
                    spent[name].append(step_seconds(tested, mesh)[0])
            base = np.median(next(iter(spent.values())))
            rows += [{"test": group, "resolution": resolution, "interface": name, "step": summary(spent[name]),
                      "ratio": float(np.median(spent[name]) / base), "target": RATIO_TARGET,
                      "iterations": solved[name]["newton_iterations"], "cuts": solved[name]["cuts"],
                      "slipping_points": solved[name].get("slipping_points", 0)} for name in models]
    return rows


def whole_test(repeats: int) -> dict:
    """Time ramp, hold and unloading with friction and one Prony term on the fast mesh, from mesh to forces."""
    ramp, rest = 10e-3 * np.linspace(0.0, 1.0, 56), np.full(SAMPLES - 111, 10e-3)
    displacement = np.concatenate([ramp, rest, ramp[-2::-1]])
    time_s = np.concatenate([[0.0], np.cumsum(np.full(SAMPLES - 1, 10.0 / 0.248 / 55))])
    protocol = ts.Protocol(time_s, displacement)
    tested = model(0.7, protocol=protocol, material=RELAXING)
    solved = ts.simulate(tested).metadata["solver"]
    spent = summary(cpu_seconds(lambda: ts.simulate(tested, estimate_error=False), repeats))
    return {"samples": protocol.time.size, "iterations": solved["newton_iterations"], "cuts": solved["cuts"],
            "time": spent, "target_s": TEST_TARGET}


def reach_cases() -> Iterator[tuple[str, ts.Model]]:
    """Yield names and models of tests with their depths; steps of 0.5 mm."""
    for friction in ("frictionless", 0.05, 0.1, 0.2, 0.4, 0.7, 2.0, "stick", "bonded"):
        yield f"plates, {friction}", model(friction, depth=30e-3, points=61)
    down = np.linspace(0.0, 10e-3, 21)
    there_and_back = ts.Protocol(np.arange(42.0), [*down, *down[-2::-1], -1e-3])
    for friction in (0.05, 0.1, 0.2, 0.3, 0.4, 0.7, "stick"):
        yield f"plates and back, {friction}", model(friction, protocol=there_and_back)
        yield (f"punch and back, edge radius 1 mm, {friction}",
               model(friction, needle=ts.Tool("flat", NEEDLE_RADIUS, 1e-3), protocol=there_and_back))
    for edge in (0.0, 0.25e-3, 1e-3, 4e-3):
        for friction in ("bonded", "stick", 0.7, 0.4, 0.1, "frictionless"):
            if edge or friction in ("bonded", "stick"):
                yield (f"punch, edge radius {edge * 1e3:g} mm, {friction}",
                       model(friction, needle=ts.Tool("flat", NEEDLE_RADIUS, edge), depth=15e-3, points=31))
    for angle in (15.0, 30.0, 45.0, 60.0):
        for tip in (0.0, 0.5e-3):
            cone = ts.Tool("cone", NEEDLE_RADIUS, half_angle=np.radians(angle), tip_radius=tip)
            for friction in ("frictionless", 0.3, "stick"):
                yield (f"cone of {angle:g} degrees, tip radius {tip * 1e3:g} mm, {friction}",
                       model(friction, needle=cone, depth=10e-3))
    for shape in ("round", "sphere"):
        for friction in ("frictionless", 0.3, "stick"):
            yield (f"{shape} of radius 8 mm, {friction}",
                   model(friction, needle=ts.Tool(shape, NEEDLE_RADIUS), depth=12e-3, points=25))
    for ratio in (50.0, 1e2, 1e3, 1e4):
        material = replace(MATERIAL, bulk=ts.Bulk("bulk_ratio", ratio))
        yield f"plates, 0.7, K/mu {ratio:g}", model(0.7, depth=30e-3, points=61, material=material)
        yield (f"punch, edge radius 0.25 mm, 0.7, K/mu {ratio:g}",
               model(0.7, needle=ts.Tool("flat", NEEDLE_RADIUS, EDGE), depth=15e-3, points=31, material=material))


def reach() -> Iterator[dict]:
    """Yield the largest depth of each case of `reach_cases` on both meshes, and the forces."""
    for name, tested in reach_cases():
        protocol = tested.experiment.protocol
        row = {"case": name, "asked_mm": protocol.depth * 1e3, "back": bool(protocol.displacement[-1] < 0.0)}
        for resolution in RESOLUTIONS:
            started = time.process_time()
            try:
                recording, message = ts.simulate(tested, resolution=resolution), ""
            except ts.ConvergenceError as error:
                recording, message = error.recording, str(error)
            row[resolution] = {
                "cpu_s": time.process_time() - started, "message": message,
                "reached_mm": float(recording.displacement[-1] * 1e3) if recording else 0.0,
                "force_N": [float(force) for force in recording.force] if recording else [],
                "cuts": recording.metadata["solver"]["cuts"] if recording else None}
        yield row


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    if "reach" in result:
        def cell(found):
            force = f"{max(found['force_N'], default=0.0):.4g} N"
            return f"stops at {found['reached_mm']:g} mm: {force}" if found["message"] else force

        table(console, "How deep tests reach in samples of 0.5 mm: largest force", ["test", "asked for", *RESOLUTIONS],
              [[row["case"], f"{row['asked_mm']:g} mm{' and back' if row['back'] else ''}",
                *(cell(row[name]) for name in RESOLUTIONS)] for row in result["reach"]])
        return
    table(console, "A step of a curve of 21 points to 10 mm: CPU ms (smallest to largest)",
          ["test", "mesh", "interface", "linear solves", "cuts", "points that slip", "CPU", "to bonded elastic",
           "target"],
          [[row["test"], row["resolution"], row["interface"], str(row["iterations"]), str(row["cuts"]),
            str(row["slipping_points"]), spread(row["step"]), f"{row['ratio']:.2f}",
            verdict(row["ratio"] <= row["target"], f"{row['target']:g}")] for row in result["costs"]])
    whole = result["whole_test"]
    table(console, "Ramp, hold and unload, mu = 0.7, one Prony term, fast mesh: CPU ms (smallest to largest)",
          ["samples", "linear solves", "cuts", "CPU", "target"],
          [[str(whole["samples"]), str(whole["iterations"]), str(whole["cuts"]), spread(whole["time"], 0),
            verdict(whole["time"]["median_s"] <= whole["target_s"], f"{1e3 * whole['target_s']:g} ms")]])


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--reach", action="store_true", help="how deep tests reach, instead of times")
    arguments = parser.parse_args()
    result = about("friction")
    if arguments.reach:
        result["reach"] = list(reach())
    else:
        result |= {"costs": costs(arguments.repeats), "whole_test": whole_test(arguments.repeats)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
