"""Stress relaxation: ramp and hold of a Prony series.

The isochoric stress of a Prony series decays after a sudden strain as

    S(t) / S(0) = 1 - Σ g_i (1 - exp(-t / τ_i)).

A fast ramp (0.02 s) followed by a hold approximates the sudden strain.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

TERMS = ((0.3, 0.5), (0.2, 5.0))


def run() -> Figure:
    prony = ts.Prony(tuple(ts.PronyTerm(g, tau) for g, tau in TERMS))
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e4), viscoelastic=prony)
    protocol = ts.Protocol.parse("ramp 2mm @100mm/s; hold 20s", points=5)
    experiment = ts.Experiment(ts.Specimen(0.015, 0.020), protocol, ts.Tool("plate"), friction="frictionless")
    recording = ts.simulate(ts.Model(experiment, material))
    start = int(np.argmax(recording.force))
    time, force = recording.time[start:] - recording.time[start], recording.force[start:]
    theory = 1 - sum(g * (1 - np.exp(-time / tau)) for g, tau in TERMS)
    assert np.allclose(force / force[0], theory, atol=0.02)

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.semilogx(time[1:], theory[1:], label="Prony series")
    axes.semilogx(time[1:], force[1:] / force[0], "o", markersize=4, label="finite elements")
    axes.set(xlabel="time after the ramp [s]", ylabel="force / largest force", title="Relaxation in a hold")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "relaxation.png")
