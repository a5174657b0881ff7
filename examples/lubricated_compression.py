"""Compression between frictionless plates: finite elements against the closed form.

Without friction a cylinder of radius R and height H deforms homogeneously. At the displacement d its axial
stretch is λ = 1 - d/H, and the force is F = -π R² P(λ) with the nominal stress P of the law.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts


def run() -> Figure:
    specimen = ts.Specimen(radius=0.040, height=0.070)
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(specimen, ts.Protocol.ramp(depth=0.010, points=11), ts.Tool("plate"),
                               friction="frictionless")
    recording = ts.simulate(ts.Model(experiment, material))
    law = ts.find_law(material.law)
    exact = -specimen.area * law.nominal_stress(1 - recording.displacement / specimen.height, material.parameters)
    assert np.allclose(recording.force[1:], exact[1:], rtol=1e-3)

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(recording.displacement * 1e3, exact, label="closed form")
    axes.plot(recording.displacement * 1e3, recording.force, "o", label="finite elements")
    axes.set(xlabel="displacement [mm]", ylabel="force [N]", title=f"{recording.force[-1]:.3f} N at 10 mm")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "lubricated_compression.png")
