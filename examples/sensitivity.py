"""Derivative of the force with the parameters of the material, against Euler's theorem.

The force of an elastic specimen is homogeneous of degree one in the moduli of its law: F(sC10, sC20) = s F(C10,
C20). By Euler's theorem

    C10 dF/dC10 + C20 dF/dC20 = F.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

PARAMETERS = {"C10": 1404.9, "C20": 699.4}


def run() -> Figure:
    material = ts.Material("reduced_polynomial_2", PARAMETERS, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, points=11),
                               ts.Tool("flat", radius=8e-3), friction="bonded")
    model = ts.Model(experiment, material)
    derivatives = ts.sensitivities(model)
    force = ts.simulate(model).force
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes, total = figure.subplots(), np.zeros_like(force)
    for name, value in PARAMETERS.items():
        column = next(index for index, path in enumerate(derivatives.names) if path.endswith(name))
        part = value * derivatives.values[:, column]
        total += part
        axes.plot(experiment.protocol.displacement * 1e3, part, label=f"{name} dF/d{name}")
    assert np.allclose(total, force, atol=2e-4 * force[-1])
    axes.plot(experiment.protocol.displacement * 1e3, force, "ko", markersize=4, label="force")
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title="Contribution of each parameter")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "sensitivity.png")
