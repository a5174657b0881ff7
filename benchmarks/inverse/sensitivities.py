"""Cost of derivatives with respect to material, friction and sizes: CPU time with derivatives over without them.

The two run in turns on the same mesh. Printed are the whole extra cost per parameter, and the cost of one further
parameter (from the difference between all and one). ``--solid``: tests of the solid in space, with several materials,
weight and adhesion.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import statistics
from dataclasses import replace

import numpy as np

import tissue_sim as ts
from benchmarks.measure import about, cpu_seconds, option_parser, show, table, verdict
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.fem.solid import discretisation as solid

TARGET = 0.25
STUDY = {"C10": 1404.9, "C20": 699.4}
SPECIMEN = ts.Specimen(0.040, 0.070)
ELASTIC = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4))
FRICTION = ["experiment.friction", "experiment.friction_base"]
SIZES = ["experiment.specimen.radius", "experiment.specimen.height", "experiment.tool.radius"]
RELAXING = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4),
                       viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.1, 10.0))))


def cases():
    """Return tests with experiment, material and parameters."""
    ramp = ts.Protocol.ramp(10e-3, 21)
    cycle = ts.Protocol.parse("ramp 6mm; hold 20s; unload 2mm", points=21)
    law = ["C10", "C20"]
    time = [*law, *(f"viscoelastic.terms[{i}].{name}" for i in range(2) for name in ("g", "tau"))]
    yield "bonded ramp", ts.Experiment(SPECIMEN, ramp), ELASTIC, law
    yield "friction 0.1, ramp", ts.Experiment(SPECIMEN, ramp, friction=0.1, friction_base=0.1), ELASTIC, law
    yield ("coefficients of friction 0.1, ramp", ts.Experiment(SPECIMEN, ramp, friction=0.1, friction_base=0.1),
           ELASTIC, FRICTION)
    yield ("coefficients of friction 0.3, ramp, hold, unload",
           ts.Experiment(SPECIMEN, cycle, friction=0.3, friction_base=0.3), RELAXING, FRICTION)
    yield "sizes, plates, friction 0.1, ramp", ts.Experiment(
        SPECIMEN, ramp, friction=0.1, friction_base=0.1), ELASTIC, SIZES[:2]
    yield "sizes, needle, ramp", ts.Experiment(SPECIMEN, ramp, ts.Tool("flat", 8e-3)), ELASTIC, SIZES
    yield "sizes, round needle, friction 0.3, ramp", ts.Experiment(
        SPECIMEN, ramp, ts.Tool("round", 8e-3), friction=0.3), ELASTIC, SIZES
    yield "needle, ramp", ts.Experiment(SPECIMEN, ramp, ts.Tool("flat", 8e-3)), ELASTIC, law
    yield "bonded, ramp, hold, unload", ts.Experiment(SPECIMEN, cycle), RELAXING, time
    yield ("friction 0.3, ramp, hold, unload", ts.Experiment(SPECIMEN, cycle, friction=0.3, friction_base=0.3),
           RELAXING, time)


def cases_in_space():
    """Return the 3D tests with experiment, material and parameters."""
    heavy, placed = (ts.Specimen(0.04, 0.05, density=1040.0, gravity=9.81, height_is=height)
                     for height in ("moulded", "placed"))
    ramp, flat, law = ts.Protocol.ramp(4e-3, 5), ts.Tool("flat", 8e-3), ["C10", "C20"]
    lump = ts.Material("reduced_polynomial_2", {"C10": 2500.0, "C20": 500.0}, ts.Bulk("bulk_ratio", 1e3))
    prony = ts.Prony((ts.PronyTerm(0.3, 2.0),))
    ball = {"tool": ts.Tool("sphere", 8e-3), "friction": "frictionless"}
    yield "bonded needle", ts.Experiment(ts.Specimen(0.04, 0.05), ramp, flat), ELASTIC, law
    lumpy = replace(ELASTIC, regions={"lump": lump})
    yield ("two materials", ts.Experiment(ts.Specimen(0.04, 0.05), ramp, flat), lumpy,
           [*law, "regions.lump.C10", "regions.lump.C20"])
    yield ("coefficients of friction", ts.Experiment(ts.Specimen(0.04, 0.05), ramp, friction=0.3, friction_base=0.2),
           ELASTIC, FRICTION)
    yield "sizes, bonded needle", ts.Experiment(ts.Specimen(0.04, 0.05), ramp, flat), ELASTIC, SIZES
    yield ("sizes, round needle, friction 0.3",
           ts.Experiment(ts.Specimen(0.04, 0.05), ramp, ts.Tool("round", 8e-3), friction=0.3), ELASTIC, SIZES)
    yield "weight", ts.Experiment(heavy, ramp, flat), ELASTIC, law
    yield "weight, height as placed", ts.Experiment(placed, ramp, flat), ELASTIC, law
    yield ("weight, a Prony term", ts.Experiment(heavy, ramp, flat), replace(ELASTIC, viscoelastic=prony),
           [*law, "viscoelastic.terms[0].g", "viscoelastic.terms[0].tau"])
    yield ("ball, adhesion", ts.Experiment(ts.Specimen(0.04, 0.05), ramp, adhesion=ts.Adhesion(0.02, 0.5e-3), **ball),
           ELASTIC, law)
    yield ("ball, adhesion, weight", ts.Experiment(heavy, ramp, adhesion=ts.Adhesion(0.02, 0.5e-3), **ball), ELASTIC,
           law)


def solid_mesh(model: ts.Model, resolution: str):
    """Return a mesh with a second material region on one side of the tool."""
    mesh = solid.build_mesh(model.experiment, resolution)
    middle = mesh.nodes[mesh.connectivity].mean(axis=1)
    side = np.flatnonzero((middle[:, 0] > 0.0) & (middle[:, 2] > -0.02))
    return replace(mesh, regions=dict.fromkeys(model.material.regions, side))


def cost(name: str, experiment: ts.Experiment, material: ts.Material, names: list[str], resolution: str,
         repeats: int, in_space: bool) -> dict:
    """Return medians of alternating runs without, with one, and with all derivatives."""
    model = ts.Model(experiment, material)
    options = {"mesh": solid_mesh(model, resolution) if in_space else build_mesh(experiment, resolution),
               "solver": "solid" if in_space else "axisymmetric"}
    works = [lambda: ts.simulate(model, **options), lambda: ts.sensitivities(model, names[:1], **options),
             lambda: ts.sensitivities(model, names, **options)]
    for work in works:
        work()
    spent = [[cpu_seconds(work, 1)[0] for work in works] for _ in range(repeats)]
    plain, one, every = (statistics.median(times) for times in zip(*spent, strict=True))
    return {"test": name, "resolution": resolution, "parameters": len(names), "plain_s": plain, "with_s": every,
            "per_parameter": (every / plain - 1.0) / len(names),
            "one_more": (every - one) / (len(names) - 1) / plain}


def draw(result: dict, console) -> None:
    table(console, "A test with derivatives over one without, CPU (medians of alternating runs)",
          ["test", "mesh", "parameters", "plain, ms", "with them, ms", "extra per parameter", f"target {TARGET:g}",
           "one parameter more"],
          [[row["test"], row["resolution"], str(row["parameters"]), f"{row['plain_s'] * 1e3:.1f}",
            f"{row['with_s'] * 1e3:.1f}", f"{row['per_parameter']:.2f}",
            verdict(row["per_parameter"] <= TARGET, "").strip(), f"{row['one_more']:.2f}"] for row in result["costs"]])


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--solid", action="store_true", help="of the solid in space")
    arguments = parser.parse_args()
    result = about("sensitivities")
    tests, resolutions = (cases_in_space, ("realtime", "fast")) if arguments.solid else (cases, ("fast", "accurate"))
    result["costs"] = [cost(*case, resolution, arguments.repeats, arguments.solid) for case in tests()
                       for resolution in resolutions]
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
