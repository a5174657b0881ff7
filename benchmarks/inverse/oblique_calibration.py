"""Oblique, eccentric needle: moduli of a fit that assumes a vertical, central needle, and of one with the true pose.

    python -m benchmarks oblique_calibration [--json] [--depth-mm 8] [--offset-mm 5] [--tilt-deg 20]
        [--noise-n 0.02] [--quick]

The recordings are simulated in space on a mesh that is finer than those of the fits, with noise. `--quick` takes the
coarse mesh of the fit for them instead, to see that all runs.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import tissue_sim as ts
from calibration import calibrate
from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution, make_solver
from tissue_sim.mesh.solid_element import HEX27P1

TRUE = {"C10": 1404.9, "C20": 699.4}
#: Radius and height of the specimen, m.
SPECIMEN = (0.040, 0.070)
#: Radius of the needle, m.
RADIUS = 8e-3
#: Speed, m/s.
SPEED = 0.248e-3
#: Number of recordings.
REPLICATES = 3
#: Samples of a recording.
SAMPLES = 201
#: Between the two meshes of a fit, about 4,000 and 12,000 freedoms, and what is affordable.
FINER = Resolution(HEX27P1, 0.2, 1.9, 2.2, 3)
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
name = "needle"
kind = "needle_indentation"
recordings = ["needle_*.csv"]
tool = "flat"
tool_radius_mm = 8.0
{way}

[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
bulk_ratio = 10000.0
starts = 1

[noise]
force_N = {noise}
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
"""


def recordings(depth: float, approach: ts.Approach, noise: float, resolution: str) -> tuple[list[ts.Recording], int]:
    """Return noisy replicates of the motion of the needle, and the number of degrees of freedom of the solid."""
    protocol = ts.Protocol.ramp(depth, 9)
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(*SPECIMEN), protocol=protocol, tool=ts.Tool("flat", radius=RADIUS), approach=approach)
    model = ts.Model(experiment, ts.Material("reduced_polynomial_2", TRUE, ts.Bulk("bulk_ratio", 1e4)))
    mesh = make_solver(model, resolution=resolution).mesh
    true = ts.simulate(model, solver="solid", mesh=mesh)
    displacement = np.linspace(0.0, depth, SAMPLES)
    curve = np.polynomial.Polynomial.fit(true.displacement, true.force, 6)
    missed = abs(curve(true.displacement) - true.force).max()
    print(f"force at the end {true.force[-1]:.3f} N; between the samples to {missed:.0e} N", file=sys.stderr)
    force = curve(displacement)
    generator = np.random.default_rng(7)
    return [ts.Recording({"time": displacement / SPEED, "displacement": displacement,
                          "force": force + noise * generator.normal(size=SAMPLES)}) for _ in range(REPLICATES)
            ], true.metadata["solver"]["mesh"]["freedoms"]


def fitted(folder: Path, name: str, way: str, noise: float) -> dict:
    """Return the parameters, their standard errors and bias (%), and the cost of the fit."""
    (folder / f"{name}.toml").write_text(CAMPAIGN.format(way=way, noise=noise), encoding="utf-8")
    began = time.perf_counter()
    result, = calibrate([folder / f"{name}.toml"], folder / name)
    best = result.best
    return {"fit": name, "parameters": dict(best.parameters), "standard_errors": dict(best.standard_errors),
            "bias_percent": {key: 100.0 * (best.parameters[key] / value - 1.0) for key, value in TRUE.items()},
            "intervals95": {key: list(best.intervals95[key]) for key in TRUE}, "RMSE_N": best.RMSE_N,
            "wall_s": time.perf_counter() - began}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for flag, usual in (("--depth-mm", 8.0), ("--offset-mm", 5.0), ("--tilt-deg", 20.0), ("--noise-n", 0.02)):
        parser.add_argument(flag, type=float, default=usual)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    RESOLUTIONS["finer"] = FINER
    approach = ts.Approach(1e-3 * asked.offset_mm, math.radians(asked.tilt_deg))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made, freedoms = recordings(1e-3 * asked.depth_mm, approach, asked.noise_n,
                                    "realtime" if asked.quick else "finer")
        for number, recording in enumerate(made):
            ts.write_recording(recording, folder / f"needle_{number}.csv")
        rows = [fitted(folder, "upright_and_central", "", asked.noise_n),
                fitted(folder, "as_it_is", f'solver = "solid"\noffset_mm = {asked.offset_mm}\n'
                                           f'tilt_deg = {asked.tilt_deg}', asked.noise_n)]
    if asked.json:
        print(json.dumps({"freedoms_of_the_data": freedoms, "fits": rows}))
        return
    print(f"data from {freedoms} freedoms, {asked.offset_mm:g} mm off the axis, {asked.tilt_deg:g} degrees, "
          f"{asked.depth_mm:g} mm deep, noise {asked.noise_n} N")
    for row in rows:
        numbers = "; ".join(f"{key} = {row['parameters'][key]:.1f} +- {row['standard_errors'][key]:.1f} Pa, bias "
                            f"{row['bias_percent'][key]:+.2f} %" for key in TRUE)
        print(f"{row['fit']}: {numbers}; RMSE {row['RMSE_N']:.4f} N; {row['wall_s']:.0f} s")


if __name__ == "__main__":
    main()
