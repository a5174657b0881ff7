"""A needle off the axis of a cylinder, in three dimensions: the side force.

On the axis of a cylinder a vertical needle feels no side force. Near the rim the tissue on the outer side is
softer, and the tool is pushed outwards. The side force grows with the offset.
"""

import sys

from matplotlib.figure import Figure

import tissue_sim as ts

OFFSETS = (0.0, 0.008, 0.016)


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e3))
    side, axial = [], []
    for offset in OFFSETS:
        experiment = ts.Experiment(ts.Specimen(0.030, 0.030), ts.Protocol.ramp(1.5e-3, points=2),
                                   ts.Tool("flat", radius=6e-3), friction="bonded",
                                   approach=ts.Approach(offset=offset, angle=0.0))
        recording = ts.simulate(ts.Model(experiment, material), solver="solid", resolution="realtime")
        side.append(float(recording.channel("Fx")[-1]))
        axial.append(float(recording.channel("Fz")[-1]))
    assert abs(side[0]) < 1e-6 * axial[0]
    assert 0 < abs(side[1]) < abs(side[2])

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot([1e3 * offset for offset in OFFSETS], [1e3 * force for force in side], "o-", label="side force")
    axes.set(xlabel="offset from the axis [mm]", ylabel="force along x [mN]",
             title=f"Axial force {axial[0]:.2f} to {axial[-1]:.2f} N")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "oblique_needle.png")
