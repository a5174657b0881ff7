"""Force over depth of a punch: the coupled tissue in MuJoCo, and the soft bodies of MuJoCo and Newton."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

import tissue_sim as ts
from benchmarks.peers.solid_peers import RATIOS, STUDY, truth
from benchmarks.realtime.engine_tools import NEEDLE, RESOLUTION, run_mujoco
from benchmarks.realtime.multirate import mesh_of
from calibration.targets.runner import RUNNERS, TargetTest
from tissue_sim.exports.elastic_constants import ElasticConstants

#: Name of the runner that presses the soft body of an engine, by the engine's name.
ENGINES = {"flex": "mujoco", "VBD": "newton"}
#: Depths of the soft bodies, m.
DEPTHS = np.arange(1, 21) * 0.5e-3
#: Depth at which Young's modulus of the soft bodies is fitted, m.
FIT_DEPTH = 2e-3
#: Mesh of the soft bodies, a key of `multirate.MESHES`.
MESH = 3300
#: Longest wall time of a soft body for a depth, s.
LONGEST = 60.0
#: Target of the coupled tool at the end, m.
LAST_TARGET = 11.5e-3
#: Time of the motion of the coupled tool, s.
PRESS_TIME = 3.0


def compute_engine_curve(engine: str, poisson: float, young: float) -> dict:
    """Return depths, m, forces, N, the cost of a step, and the reason for which the soft body of an engine ended."""
    positions = np.zeros((DEPTHS.size + 1, 3))
    positions[1:, 2] = -DEPTHS
    curve = RUNNERS.find(ENGINES[engine], "target").run(
        TargetTest(mesh_of(MESH), NEEDLE.experiment.tool, positions, is_bonded=True, max_seconds=LONGEST),
        ElasticConstants(young, poisson))
    return {"young": young, "poisson": poisson, "ended": curve.ended, "depths": curve.depths[1:].tolist(),
            "forces": curve.forces[1:, 2].tolist(), "steps": curve.steps[1:].tolist(),
            "step_cpu_s": curve.step_seconds}


def compute_coupled_curve() -> dict:
    """Return depths, m, and forces, N, of a tool of 200 g in MuJoCo that is pressed slowly by a servo."""
    simulator = ts.Simulator(NEEDLE, resolution=RESOLUTION)
    simulator.warm_up()
    motion = run_mujoco(simulator, 0.2, 2000.0, 2e-3, PRESS_TIME,
                        lambda time: (0.0, -LAST_TARGET * (0.5 - 0.5 * math.cos(math.pi * time / PRESS_TIME))))
    return {"depths": [-position[1] for position in motion.positions[:-1]],
            "forces": [force[1] for force in motion.applied], "ended": ""}


def measure_soft_bodies() -> list[dict]:
    """Return the curves with a name each; the first is the reference.

    The forces of the soft bodies at rest are proportional to Young's modulus, so that the best modulus at one depth
    follows from the force at this depth. The soft body is run again with this modulus.
    """
    reference = truth()
    curves = [{"name": "axisymmetric, accurate", **reference, "ended": ""},
              {"name": "coupled tissue in MuJoCo", **compute_coupled_curve()}]
    for engine, poisson in product(ENGINES, RATIOS):
        young = 2.0 * STUDY.mu0 * (1.0 + poisson)
        same = compute_engine_curve(engine, poisson, young)
        curves.append({"name": f"{engine}, nu {poisson:g}, same E", **same})
        if same["depths"] and same["depths"][-1] > 0.99 * FIT_DEPTH:
            ratio = get_force(reference, FIT_DEPTH) / get_force(same, FIT_DEPTH)
            curves.append({"name": f"{engine}, nu {poisson:g}, best E at {1e3 * FIT_DEPTH:g} mm",
                           **compute_engine_curve(engine, poisson, young * ratio)})
    return curves


def get_force(curve: dict, depth: float) -> float:
    """Return the force of a curve at a depth, N; NaN if the curve is shorter."""
    if not curve["depths"] or max(curve["depths"]) < 0.99 * depth:
        return math.nan
    order = np.argsort(curve["depths"])
    depths, forces = np.array(curve["depths"])[order], np.array(curve["forces"])[order]
    return float(np.interp(depth, [0.0, *depths], [0.0, *forces]))
