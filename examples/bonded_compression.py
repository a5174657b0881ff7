"""Bonded plates make a specimen stiffer than its material.

Glued faces cannot widen. For small strains of an incompressible cylinder with the shape factor S = R / (2 H)
the apparent modulus is (Gent and Lindley, Proc. Inst. Mech. Eng. 173 (1959) 111)

    E_apparent = E (1 + 2 S²).

The formula assumes a parabolic displacement over the height. It is compared with finite elements for discs and
cylinders.
"""

import math
import sys

from matplotlib.figure import Figure

import tissue_sim as ts

RADIUS = 0.020
#: Compressive strain at which the apparent modulus is taken.
STRAIN = 0.002
HEIGHTS = (0.010, 0.014, 0.020, 0.030)


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e5))
    shape_factors, ratios = [RADIUS / (2 * height) for height in HEIGHTS], []
    for height in HEIGHTS:
        experiment = ts.Experiment(ts.Specimen(RADIUS, height), ts.Protocol.ramp(STRAIN * height, points=2),
                                   ts.Tool("plate"), friction="bonded")
        force = ts.simulate(ts.Model(experiment, material)).force[-1]
        ratios.append(force / (math.pi * RADIUS**2 * STRAIN * material.E0))
    theory = [1 + 2 * factor**2 for factor in shape_factors]
    assert all(abs(found / expected - 1) < 0.08 for found, expected in zip(ratios, theory, strict=True))

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(shape_factors, theory, label="Gent and Lindley")
    axes.plot(shape_factors, ratios, "o", label="finite elements")
    axes.set(xlabel="shape factor R / (2 H)", ylabel="apparent modulus / E", title="Cylinder between bonded plates")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "bonded_compression.png")
