"""Stress and volume change under a needle.

Soft tissue is nearly incompressible: with K/mu = 10⁴ the volume ratio J = det F stays close to 1 everywhere,
although the stretches are large. Mixed elements with a pressure field avoid locking. The picture shows the von
Mises stress.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts
from scenes.figures import draw_section


def run() -> Figure:
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    tool = ts.Tool("round", radius=8e-3)
    experiment = ts.Experiment(ts.Specimen(0.040, 0.050), ts.Protocol.ramp(0.008, points=9), tool, friction=0.3)
    recording = ts.simulate(ts.Model(experiment, material), fields=True)
    fields = recording.fields
    volume_ratio = np.average(fields.at_points("J"), weights=fields.weights)
    shortest, longest = fields.stretch_range()
    assert abs(volume_ratio - 1) < 1e-4
    assert shortest < 0.8 and longest > 1.1

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    draw_section(axes, fields, "von_mises", tool=tool)
    axes.set_title(f"{recording.force[-1]:.2f} N at 8 mm, stretches {shortest:.2f} to {longest:.2f}", fontsize=9)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "stress_section.png")
