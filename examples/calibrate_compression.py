"""From recordings to a material with uncertainty.

Three virtual recordings of lubricated compression with sensor noise are fitted by least squares. The 95 %
interval of the estimate, 1.96 standard errors, must contain the true parameter.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import calibration
import tissue_sim as ts

TRUE_C10 = 1400.0
#: Standard deviation of the sensor noise, N.
NOISE = 0.02
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "lubricated_compression"
recordings = ["plates_*.csv"]
[fit]
laws = ["neo_hooke"]
[noise]
force_N = 0.02
"""


def run() -> Figure:
    law, specimen = ts.find_law("neo_hooke"), ts.Specimen(0.040, 0.070)
    displacement = np.linspace(0.0, 0.010, 101)
    exact = -specimen.area * law.nominal_stress(1 - displacement / specimen.height, {"C10": TRUE_C10})
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    with tempfile.TemporaryDirectory() as folder:
        for number in (1, 2, 3):
            force = exact + np.random.default_rng(number).normal(0.0, NOISE, exact.size)
            ts.write_recording(ts.Recording({"displacement": displacement, "force": force}),
                               Path(folder, f"plates_{number}.csv"))
            axes.plot(displacement * 1e3, force, ".", markersize=2, color="0.6")
        campaign = Path(folder, "study.toml")
        campaign.write_text(CAMPAIGN, encoding="utf-8")
        result, = calibration.calibrate([campaign], Path(folder, "results"), figures=False)
    value, error = result.best.parameters["C10"], result.best.standard_errors["C10"]
    assert abs(value - TRUE_C10) < 1.96 * error
    fitted = -specimen.area * law.nominal_stress(1 - displacement / specimen.height, {"C10": value})
    axes.plot(displacement * 1e3, fitted, color="#0072B2")
    axes.set(xlabel="displacement [mm]", ylabel="force [N]", title=f"C10 = {value:.1f} ± {1.96 * error:.1f} Pa")
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "calibrate_compression.png")
