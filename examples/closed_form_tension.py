"""Uniaxial tension of incompressible laws, and their small-strain modulus.

With the principal stretches (λ, λ^-1/2, λ^-1/2) of an incompressible bar the nominal stress of a law W is

    P(λ) = dW/dλ,        neo-Hooke, W = C10 (I1 - 3):   P = 2 C10 (λ - λ^-2).

All laws below have the same initial shear modulus mu0. For an incompressible solid dP/dλ at λ = 1 is E0 = 3
mu0.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

#: Initial shear modulus, Pa.
MU0 = 2800.0
LAWS = {"neo_hooke": {"C10": MU0 / 2}, "mooney_rivlin": {"C10": 0.3 * MU0, "C01": 0.2 * MU0},
        "reduced_polynomial_2": {"C10": MU0 / 2, "C20": 700.0}, "ogden_1": {"mu1": MU0, "alpha1": 8.0}}


def run() -> Figure:
    stretch = np.linspace(1.0, 1.6, 121)
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    for name, parameters in LAWS.items():
        law = ts.find_law(name)
        step = 1e-5
        modulus = (law.nominal_stress(1 + step, parameters) - law.nominal_stress(1 - step, parameters)) / (2 * step)
        assert abs(modulus / (3 * MU0) - 1) < 1e-6
        axes.plot(stretch, law.nominal_stress(stretch, parameters) / 1e3, label=name)
    neo_hooke = ts.find_law("neo_hooke").nominal_stress(stretch, LAWS["neo_hooke"])
    assert np.allclose(neo_hooke, MU0 * (stretch - stretch**-2))
    axes.set(xlabel="stretch", ylabel="nominal stress [kPa]", title="Four laws with E0 = 8.4 kPa")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "closed_form_tension.png")
