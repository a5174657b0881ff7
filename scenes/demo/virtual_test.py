"""The main job on a virtual specimen: measure three tests, calibrate on one, predict the others."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

import tissue_sim as ts
from scenes.demo.comparison import Comparison
from scenes.demo.figure import draw_demo
from scenes.demo.specimen import BULK_RATIO, DEPTH, PHANTOM, SPECIMEN
from tissue_sim.atomic_write import write_text
from tissue_sim.experiment.kinds.compression import BONDED, LUBRICATED
from tissue_sim.experiment.kinds.indentation import NEEDLE
from tissue_sim.experiment.kinds.kind import TestKind

#: Of the force sensor, N.
FORCE_NOISE = 0.02
REPLICATES, SAMPLES = 3, 101
LAWS = ("neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1")

CAMPAIGN = """# Lubricated compression of the virtual specimen; the other tests are kept from the calibration.
[[specimen]]
name = "virtual phantom"
shape = "cylinder"
radius_mm = {radius_mm}
height_mm = {height_mm}

[[test]]
name = "lubricated"
kind = "lubricated_compression"
recordings = ["measured/lubricated_compression_*.csv"]

[fit]
method = "analytical"
laws = {laws}
bulk_ratio = {bulk_ratio}

[noise]
force_N = {force_N}
"""


def run_demo(output: Path, *, overwrite: bool = False, console=None, seed: int = 0) -> dict:
    """Measure, calibrate, predict; write everything into `output` and say where.

    Args:
        output: folder of the results.
        overwrite: write into a folder that is not empty.
        console: a rich console for what happens; none: silent.
        seed: seed of the sensor noise.

    Returns:
        Paths ``figure``, ``report``, ``campaign``, ``material_file``; ``law``, ``parameters``; of the needle
        ``prediction_rmse_N`` and, at the deepest sample, ``prediction_error_N``; the same and the forces of every
        predicted test in ``predictions``; ``noise_N``, ``wall_s``.

    Raises:
        InputError: `output` is not empty and `overwrite` is not set.
    """
    import calibration

    started = time.perf_counter()
    output = Path(output)
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not overwrite:
        raise ts.InputError("the folder is not empty; name another one or add --overwrite", file=output)
    say = console.print if console else lambda *_, **__: None
    # Fresh sensor noise for every replicate of every test.
    seeds = iter(np.random.SeedSequence(seed).generate_state(3 * REPLICATES).tolist())

    say("1 measuring the virtual specimen (a machine's first run compiles the solver, some 10 s) ...")
    measured = {kind: _measure(kind, output / "measured", seeds) for kind in (LUBRICATED, BONDED, NEEDLE)}

    say(f"2 calibrating {len(LAWS)} laws on the lubricated test ...")
    campaign = output / "campaign.toml"
    write_text(campaign, CAMPAIGN.format(radius_mm=SPECIMEN.radius * 1e3, height_mm=SPECIMEN.height * 1e3,
                                         laws=json.dumps(LAWS), bulk_ratio=BULK_RATIO, force_N=FORCE_NOISE))
    (result,) = calibration.calibrate([campaign], output / "calibration", overwrite=overwrite)
    material_file = output / "calibration" / str(result.best.material_file)

    say("3 predicting the needle and the bonded test, which the calibration never saw ...")
    material = ts.load_material(material_file)
    needle, bonded = (_predict(kind, measured[kind], material, output) for kind in (NEEDLE, BONDED))

    figure = output / "prediction.png"
    draw_demo(measured[LUBRICATED], material, needle, bonded, figure, noise=FORCE_NOISE, specimen=SPECIMEN)
    answer = {
        "figure": str(figure), "report": str(output / "calibration" / "report.html"), "campaign": str(campaign),
        "material_file": str(material_file), "law": material.law, "parameters": dict(material.parameters),
        "prediction_rmse_N": needle.rmse, "prediction_error_N": float(needle.error[-1]),
        "predictions": [{"test": one.kind.name, "predicted_N": float(one.predicted.force[-1]),
                         "measured_N": float(one.mean[-1]), "error_N": float(one.error[-1]), "RMSE_N": one.rmse}
                        for one in (needle, bonded)],
        "noise_N": FORCE_NOISE, "wall_s": time.perf_counter() - started,
    }
    say(f"\nBest law: {material.energy_law.title}. At {DEPTH * 1e3:.0f} mm, with a sensor noise of {FORCE_NOISE} N:",
        markup=False)
    for one in (needle, bonded):
        say(f"{one.kind.title.lower():>20}: predicted {one.predicted.force[-1]:.3f} N, measured {one.mean[-1]:.3f} N; "
            f"RMSE over the curve {one.rmse:.3f} N", markup=False, soft_wrap=True)
    for name in ("figure", "report", "material_file"):
        say(f"{name.replace('_', ' '):>20}: {answer[name]}", markup=False, soft_wrap=True)
    return answer


def _measure(kind: TestKind, folder: Path, seeds) -> list[ts.Recording]:
    """Three replicates of a test as the virtual rig reports them, written as recordings."""
    truth = ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="virtual phantom")
    experiment = kind.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH, SAMPLES))
    true = ts.simulate(ts.Model(experiment, truth), resolution="accurate", estimate_error=False)
    replicates = []
    for number in range(1, REPLICATES + 1):
        rig = ts.Rig(force_noise=FORCE_NOISE, seed=next(seeds))
        replicate = rig.measure(true).with_metadata(name=f"{kind.name}_{number}", kind=kind.name, virtual=True)
        ts.write_recording(replicate, folder / f"{kind.name}_{number}.csv")
        replicates.append(replicate)
    return replicates


def _predict(kind: TestKind, measured: list[ts.Recording], material: ts.Material, output: Path) -> Comparison:
    """The same motion with the calibrated material, written as a recording."""
    protocol = ts.Protocol(measured[0].time, measured[0].displacement)
    experiment = kind.experiment(specimen=SPECIMEN, protocol=protocol)
    predicted = ts.simulate(ts.Model(experiment, material), resolution="accurate", fields=kind is NEEDLE,
                            estimate_error=False)
    ts.write_recording(predicted, output / f"predicted_{kind.name}.csv")
    return Comparison(kind, measured, predicted)
