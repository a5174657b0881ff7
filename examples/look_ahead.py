"""A planner tries several speeds on copies of a simulator and takes the fastest below a force limit.

`Simulator.clone()` gives an independent simulator at the same state. The tissue relaxes, so that a fast
insertion needs more force than a slow one. The original simulator does not move.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

TICK = 1e-3
#: Depths between which the needle is inserted, m.
START = 2e-3
GOAL = 6e-3
SPEEDS = (0.5e-3, 2e-3, 8e-3, 32e-3)
#: Largest force allowed, N.
LIMIT = 0.8


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.5, 0.5),)))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(GOAL, points=2),
                               ts.Tool("flat", radius=8e-3))
    simulator = ts.Simulator(ts.Model(experiment, material), inertia="off")
    simulator.warm_up()
    before = simulator.step(START, 2.0)
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes, largest = figure.subplots(), []
    for speed in SPEEDS:
        planned = simulator.clone()
        depths = np.arange(START, GOAL, speed * 20 * TICK)
        forces = [planned.step(depth, 20 * TICK).force for depth in depths]
        largest.append(max(forces))
        axes.plot(depths * 1e3, forces, label=f"{speed * 1e3:g} mm/s")
    assert largest == sorted(largest)
    allowed = [speed for speed, force in zip(SPEEDS, largest, strict=True) if force <= LIMIT]
    assert abs(simulator.step(START, TICK).force - before.force) < 0.01 * before.force
    axes.axhline(LIMIT, color="0.5", linestyle="--")
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title=f"Fastest allowed: {max(allowed) * 1e3:g} mm/s")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "look_ahead.png")
