"""Forces of a needle, one step a millisecond, against the quasi-static solution.

`Simulator.step(pose, dt)` solves the equilibrium at the end of the step, with the mass of the tissue. At a slow
motion (2 mm/s) the inertial force is small, and the force follows the quasi-static curve of `simulate`.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

SPEED = 2e-3
TICK = 1e-3
TICKS = 2000


def run() -> Figure:
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(SPEED * TICK * TICKS, points=5),
                               ts.Tool("flat", radius=8e-3), friction="bonded")
    model = ts.Model(experiment, material)
    simulator = ts.Simulator(model)
    simulator.warm_up()
    answers = [simulator.step(SPEED * TICK * tick, TICK) for tick in range(1, TICKS + 1)]
    assert all(answer.status is ts.ForceStatus.CONVERGED for answer in answers)
    forces = np.array([answer.force for answer in answers])
    quasi_static = ts.simulate(model, resolution="accurate")
    assert abs(forces[-1] / quasi_static.force[-1] - 1) < 0.02

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(SPEED * TICK * np.arange(1, TICKS + 1) * 1e3, forces, label="simulator, 1 kHz")
    axes.plot(quasi_static.displacement * 1e3, quasi_static.force, "o", label="quasi-static, accurate mesh")
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title="Bonded needle of 8 mm radius")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "realtime_needle.png")
