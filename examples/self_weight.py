"""Sag of a soft cylinder under its own weight.

A column of density ρ on a frictionless base carries the weight of the tissue above each slice. For small
strains its top sinks by

    sag = ρ g H² / (2 E).

The finite strains of the law make the exact sag smaller, because the material stiffens in compression.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts
from tissue_sim.closed_form.column import Column

PARAMETERS = {"C10": 1404.9, "C20": 699.4}
DENSITY = 1040.0
GRAVITY = 9.81


def run() -> Figure:
    law = ts.find_law("reduced_polynomial_2")
    modulus = 6 * PARAMETERS["C10"]
    heights = np.linspace(0.005, 0.070, 14)
    sags = [Column(ts.Specimen(0.040, height, density=DENSITY, gravity=GRAVITY)).settle(law, PARAMETERS).sag
            for height in heights]
    linear = DENSITY * GRAVITY * heights**2 / (2 * modulus)
    assert abs(sags[0] / linear[0] - 1) < 0.01
    assert abs(sags[-1] - 2.780e-3) < 1e-6

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(heights * 1e3, linear * 1e3, "--", label="small strain")
    axes.plot(heights * 1e3, np.array(sags) * 1e3, label="reduced polynomial N = 2")
    axes.set(xlabel="height [mm]", ylabel="sag [mm]", title="Silicone of E = 8.4 kPa under its own weight")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "self_weight.png")
