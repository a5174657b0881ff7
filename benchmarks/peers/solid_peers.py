"""Punch on a 3D solid and on MuJoCo's flex with the same nodes: force over depth against the truth, and times.

    python -m benchmarks solid_peers [--sizes 1800 3300 5800] [--figure FILE] [--json]

The study's cylinder with a bonded flat punch of 16 mm, 10 mm deep. The truth is the axisymmetric solver, `accurate`,
and to 5 mm the quadratic tetrahedra of another program in tests/reference. MuJoCo has linear tetrahedra and Saint
Venant-Kirchhoff's law: each hexahedron is cut into tetrahedra, the shear modulus at rest is the same, Poisson's ratio
is 0.49 and 0.45, which a neo-Hookean solid of ours has, too. Without MuJoCo its columns are left out, with a message.
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import sys
import time
from pathlib import Path

import numpy as np

import tissue_sim as ts
from benchmarks import ROOT
from benchmarks.measure import about, option_parser, show, table
from benchmarks.realtime.multirate import mesh_of
from calibration.targets.matching import make_target_test
from calibration.targets.runner import RUNNERS
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SolidMesh

DEPTHS = np.arange(1, 11) * 1e-3
STUDY = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
RATIOS = (0.49, 0.45)
#: Colours by the mesh, of those who tell few colours apart (Okabe and Ito).
COLOURS = ("#D55E00", "#009E73", "#0072B2", "#CC79A7")


def model(material: ts.Material) -> ts.Model:
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.040, 0.070), protocol=ts.Protocol.ramp(float(DEPTHS[-1]), len(DEPTHS) + 1),
        tool=ts.Tool("flat", radius=8e-3), friction="bonded")
    return ts.Model(experiment, material)


def nearly_as_the_peer(poisson: float) -> ts.Material:
    """Return neo-Hookean tissue with the study's initial shear modulus and this Poisson's ratio."""
    ratio = 2.0 * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson))
    return ts.Material("neo_hooke", {"C10": 0.5 * STUDY.mu0}, ts.Bulk("bulk_ratio", ratio))


def ours(material: ts.Material, mesh: SolidMesh) -> dict:
    """Return forces at the depths, N, and the largest and median CPU time of a step of 1 mm, s."""
    solver, forces, spent, before = make_solver(model(material), mesh=mesh), [], [], 0.0
    solver.step(ts.Pose.at_depth(1e-6))  # kernels
    for depth in DEPTHS.tolist():
        began = time.process_time()
        for parts in (1, 4, 16):
            ways = [before + (depth - before) * (k + 1) / parts for k in range(parts)]
            steps = [solver.step(ts.Pose.at_depth(way), tolerance=1e-6, max_iterations=40) for way in ways]
            step = steps[-1]
            if step.status is StepStatus.CONVERGED:
                break
        spent.append(time.process_time() - began)
        if step.status is not StepStatus.CONVERGED:
            break
        forces.append(step.force)
        before = depth
    return {"freedoms": 3 * len(mesh.nodes), "depths": DEPTHS[: len(forces)].tolist(), "forces": forces,
            "step_cpu_s": float(np.median(spent)), "ended": "" if len(forces) == len(DEPTHS) else step.status.message}


def mujoco(poisson: float, mesh: SolidMesh, seconds: float) -> dict | None:
    """Return the curve of MuJoCo, the CPU time of a time step, s, and the steps per depth; None without MuJoCo."""
    runner = RUNNERS.find("mujoco", "target")
    if missing := runner.describe_missing_program():
        print(f"MuJoCo is left out: {missing}", file=sys.stderr)
        return None
    curve = runner.run(make_target_test(model(STUDY).experiment, mesh, max_seconds=seconds),
                       ElasticConstants(2.0 * STUDY.mu0 * (1.0 + poisson), poisson))
    return {"version": curve.version, "freedoms": 3 * (len(mesh.nodes) - mesh.sets["base"].size), "poisson": poisson,
            "ended": curve.ended, "depths": curve.depths[1:].tolist(), "forces": curve.forces[1:, 2].tolist(),
            "steps": curve.steps[1:].tolist(), "step_cpu_s": curve.step_seconds}


def measure(size: int, asked) -> dict:
    """Compare on one mesh: the study's law, a law like that of the peer, and the peer."""
    mesh = mesh_of(size)
    row = {"mesh": size, "ours": ours(STUDY, mesh), "peer": []}
    for poisson in asked.poisson:
        found = mujoco(poisson, mesh, asked.seconds)
        if found is None:
            break
        row["peer"].append({**found, "ours": ours(nearly_as_the_peer(poisson), mesh)})
    return row


def truth() -> dict:
    """Return the true force over depth."""
    recording = ts.simulate(model(STUDY), resolution="accurate")
    other = np.loadtxt(ROOT / "tests" / "reference" / "punch_3d_on_axis_RP.csv", delimiter=",", comments="#")
    return {"depths": recording.displacement.tolist(), "forces": recording.force.tolist(),
            "other_depths": (1e-3 * other[:, 0]).tolist(), "other_forces": other[:, 1].tolist()}


def off(curve: dict, against: dict, depth: float) -> str:
    """Return the difference of a curve from another one at a depth, %, as text; a dash if the curve is shorter."""
    if not curve["depths"] or curve["depths"][-1] < 0.99 * depth:
        return "-"
    one, other = (np.interp(depth, [0.0, *each["depths"]], [0.0, *each["forces"]]) for each in (curve, against))
    return f"{100.0 * (one / other - 1.0):+.1f}"


def draw(result: dict, console) -> None:
    true, rows = result["truth"], []
    for row in result["meshes"]:
        for name, curve, like in [("ours, study's law", row["ours"], None), *(
                (f"MuJoCo, nu {peer['poisson']:g}", peer, peer["ours"]) for peer in row["peer"])]:
            rows.append([name, str(curve["freedoms"]), *(off(curve, true, depth) for depth in (1e-3, 5e-3, 1e-2)),
                         *((off(curve, like, depth) if like else "-") for depth in (1e-3, 5e-3)),
                         f"{1e3 * curve['step_cpu_s']:.0f}",
                         f"{np.median(curve['steps']):.0f}" if curve.get("steps") else "1", curve["ended"] or "10 mm"])
    table(console, "force off the truth, %, at 1, 5 and 10 mm; off ours with a law like it, at 1 and 5 mm; CPU ms of a "
          "step, and steps for a depth",
          ["", "freedoms", "1", "5", "10", "like, 1", "like, 5", "ms", "steps", "came to"], rows)


def picture(result: dict, path: Path) -> None:
    """Draw force over depth, and its error over the time of the first millimetre."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    forces, times = figure.subplots(1, 2, width_ratios=[3, 2])
    true = result["truth"]
    forces.plot(1e3 * np.array(true["depths"]), true["forces"], color="black", linewidth=2.5, label="truth")
    forces.plot(1e3 * np.array(true["other_depths"]), true["other_forces"], "o", color="black", fillstyle="none",
                label="another program, quadratic")
    for row, colour in zip(result["meshes"], COLOURS, strict=False):
        size = f"{row['ours']['freedoms']} freedoms"
        curves = [(row["ours"], "-", "s", f"ours, {size}")]
        curves += [(peer, "--" if peer["poisson"] == RATIOS[0] else ":", "v" if peer["poisson"] == RATIOS[0] else "^",
                    f"MuJoCo, nu {peer['poisson']:g}, {peer['freedoms']}") for peer in row["peer"]]
        for curve, line, mark, label in curves:
            if not curve["depths"]:
                continue
            forces.plot([0.0, *(1e3 * np.array(curve["depths"]))], [0.0, *curve["forces"]], line, color=colour,
                        label=label)
            # Where laws hardly differ.
            at = curve["depths"][0]
            error = abs(curve["forces"][0] / np.interp(at, true["depths"], true["forces"]) - 1.0)
            spent = curve["step_cpu_s"] * (curve["steps"][0] if curve.get("steps") else 1.0)
            times.loglog(1e3 * spent, 100.0 * error, mark, color=colour)
    forces.set(xlabel="depth [mm]", ylabel="force [N]", xlim=(0.0, 10.2), ylim=(0.0, None))
    forces.legend(fontsize=7)
    times.set(xlabel="CPU time of the first millimetre [ms]", ylabel="force off the truth there [%]",
              xticks=[30, 100, 300, 1000], yticks=[1, 3, 10, 30, 100])
    for axis in (times.xaxis, times.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    times.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1800, 3300, 5800], help="of `multirate.MESHES`")
    parser.add_argument("--poisson", type=float, nargs="+", default=list(RATIOS), help="MuJoCo's ratios")
    parser.add_argument("--seconds", type=float, default=120.0, help="that MuJoCo may take for a depth")
    parser.add_argument("--figure", type=Path, help="draw the curves into this file")
    asked = parser.parse_args()
    result = {**about("solid_peers"), "truth": truth(), "meshes": [measure(size, asked) for size in asked.sizes]}
    if asked.figure:
        picture(result, asked.figure)
    show(result, draw, as_json=asked.json)


if __name__ == "__main__":
    main()
