"""A flat punch on a layer: finite elements against Hayes' solution.

Hayes, Keer, Herrmann and Mockros, J. Biomech. 5 (1972) 541: a rigid cylinder of radius a pressed without
friction by d into an elastic layer of thickness h that is bonded to a rigid base,

    F = 2 E a κ d / (1 - ν²),

with κ from their table; κ(a/h = 0.4) = 1.683 for ν = 0.5. Small displacements.
"""

import sys

from matplotlib.figure import Figure

import tissue_sim as ts

THICKNESS = 0.020
PUNCH_RADIUS = 0.4 * THICKNESS
#: Hayes' table, ν = 0.5, a/h = 0.4.
KAPPA = 1.683
DEPTH = 1e-3 * THICKNESS


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(8 * PUNCH_RADIUS, THICKNESS), ts.Protocol.ramp(DEPTH, points=3),
                               ts.Tool("flat", radius=PUNCH_RADIUS), friction="frictionless",
                               friction_base="bonded")
    recording = ts.simulate(ts.Model(experiment, material), resolution="accurate")
    hayes = 2 * material.E0 * PUNCH_RADIUS * KAPPA * recording.displacement / (1 - 0.5**2)
    assert abs(recording.force[-1] / hayes[-1] - 1) < 0.01

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(recording.displacement * 1e6, hayes * 1e3, label="Hayes et al. (1972)")
    axes.plot(recording.displacement * 1e6, recording.force * 1e3, "o", label="finite elements")
    axes.set(xlabel="depth [µm]", ylabel="force [mN]", title="Flat punch on a bonded layer, a/h = 0.4")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "flat_punch.png")
