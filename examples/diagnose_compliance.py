"""Diagnosis of a machine that deforms: the missing effect and its size.

A test machine of compliance c moves its crosshead by c F more than it deforms the specimen. A fit that ignores
the compliance gives a modulus that is too small. Loading, hold and unloading separate the compliance from drift
and relaxation, and a second test with small forces separates it from errors of the height. `diagnose` names the
effect and estimates c.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import calibration
import tissue_sim as ts

COMPLIANCE = 0.1e-3  # m/N
NOISE = 0.003  # standard deviation, N
MOTION = "ramp 5mm @0.25mm/s; hold 10s; unload"
#: Test: tool, and the lines of the campaign that describe it.
TESTS = {"plates": (ts.Tool("plate"), 'kind = "bonded_compression"'),
         "needle": (ts.Tool("flat", radius=4e-3), 'kind = "needle_indentation"\ntool = "flat"\ntool_radius_mm = 4.0')}
CAMPAIGN = """
fit = { method = "inverse_fem", laws = ["neo_hooke"], bulk_ratio = 10000.0, starts = 1, start = { C10 = 1500.0 } }
specimen = [{ radius_mm = 20.0, height_mm = 30.0 }]
"""


def run() -> Figure:
    material = ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e4))
    text = CAMPAIGN
    with tempfile.TemporaryDirectory() as folder:
        for name, (tool, lines) in TESTS.items():
            experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol.parse(MOTION, points=31), tool)
            true = ts.simulate(ts.Model(experiment, material, ts.Rig(compliance=COMPLIANCE)), resolution="accurate")
            for seed in (1, 2, 3):
                noise = np.random.default_rng(seed).normal(0.0, NOISE, true.force.size)
                noisy = replace(true, channels={**true.channels, "force": true.force + noise})
                ts.write_recording(noisy, Path(folder, f"{name}_{seed}.csv"))
            text += f'[[test]]\nname = "{name}"\nrecordings = ["{name}_*.csv"]\n{lines}\n'
        Path(folder, "study.toml").write_text(text, encoding="utf-8")
        result, = calibration.diagnose([Path(folder, "study.toml")], Path(folder, "findings"), figures=False)
    found = result.diagnosis
    assert found.verdict == "NAMED"
    assert abs(found.fit_after.parameters["rig.compliance"] / COMPLIANCE - 1) < 0.05
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    fits = {"stiff machine": found.fit_before, "with compliance": found.fit_after}
    axes.bar(list(fits), [fit.parameters["C10"] for fit in fits.values()])
    axes.axhline(1400.0, color="black", linestyle="--", label="true value")
    axes.set(ylabel="C10 [Pa]", ylim=(1250, 1450), title=f"Found: {found.effects[0].title}")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "diagnose_compliance.png")
