"""A ball on a large block: finite elements against Hertz.

Frictionless contact of a rigid ball of radius R with an incompressible half space (Johnson, Contact Mechanics,
1985, section 4.2):

    F = 4/3 E* R^1/2 d^3/2,        E* = E / (1 - ν²).

The specimen is 16 contact radii wide and high, so that its finite size changes the force by a few per cent.
"""

import math
import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

BALL_RADIUS = 0.010
#: Largest depth, m: contact radius sqrt(R d) = 2.2 mm.
DEPTH = 0.5e-3


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e4))
    size = 16 * math.sqrt(BALL_RADIUS * DEPTH)
    experiment = ts.Experiment(ts.Specimen(size, size), ts.Protocol.ramp(DEPTH, points=9),
                               ts.Tool("sphere", radius=BALL_RADIUS), friction="frictionless")
    recording = ts.simulate(ts.Model(experiment, material), resolution="accurate")
    hertz = 4 / 3 * material.E0 / 0.75 * math.sqrt(BALL_RADIUS) * recording.displacement**1.5
    assert np.all(np.abs(recording.force[2:] / hertz[2:] - 1) < 0.05)

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(recording.displacement * 1e3, hertz * 1e3, label="Hertz")
    axes.plot(recording.displacement * 1e3, recording.force * 1e3, "o", label="finite elements")
    axes.set(xlabel="depth [mm]", ylabel="force [mN]", title="Ball of 10 mm, no friction")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "hertz_ball.png")
