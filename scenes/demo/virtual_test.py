"""Measure three tests of a virtual specimen, calibrate a material on one test, and predict the other two."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import tissue_sim as ts
from scenes.demo.specimen import BULK_RATIO, DEPTH, PHANTOM, SPECIMEN, VirtualReplicateAndErrorSettings
from scenes.figures import draw_section, draw_tool_edge_closeup, write_figure_file
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.experiment.kinds.standard_tests import BONDED, LUBRICATED, NEEDLE
from tissue_sim.files import write_text

#: Recordings and errors of the virtual measurements.
MEASUREMENT = VirtualReplicateAndErrorSettings(replicates=3, samples=101, force_noise=0.02)
#: Material laws that are calibrated.
LAWS = ("neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1")
#: Colour of measurements.
MEASURED = "#7F7F7F"
#: Colour of the fitted curve and of the needle prediction.
MODEL = "#0072B2"
#: Colour of the bonded prediction.
SECOND = "#D55E00"

#: Template of the campaign file.
CAMPAIGN = """# Lubricated compression of the virtual specimen; the calibration does not use the other tests.
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


@dataclass(frozen=True, eq=False)
class PredictionWithMeasuredReplicates:
    """Predicted force curve of a test and its measured replicates.

    Attributes:
        kind: kind of the test.
        measured: replicates, all at the same displacements.
        predicted: prediction with the calibrated material at these displacements.
    """

    kind: TestKind
    measured: list[ts.Recording]
    predicted: ts.Recording

    @property
    def mean_measured_force(self) -> np.ndarray:
        """Mean measured force, N, shape (samples,)."""
        return np.mean([recording.force for recording in self.measured], axis=0)

    @property
    def prediction_minus_mean_measured_force(self) -> np.ndarray:
        """Predicted force less mean measured force, N, shape (samples,)."""
        return self.predicted.force - self.mean_measured_force

    @property
    def force_prediction_rmse(self) -> float:
        """Root mean square of `prediction_minus_mean_measured_force` over the curve, N."""
        return float(np.sqrt(np.mean(self.prediction_minus_mean_measured_force**2)))


def run_demo(output: Path, *, overwrite: bool = False, console=None, seed: int = 0) -> dict:
    """Measure the virtual tests, calibrate, predict, and write all files into a folder.

    Args:
        output: folder of the results.
        overwrite: whether to write into a folder that is not empty.
        console: rich console for the messages; None: no messages.
        seed: seed of the sensor noise.

    Returns:
        Dictionary with the paths ``figure``, ``report``, ``campaign`` and ``material_file``; the best ``law`` and its
        ``parameters``; for the needle ``prediction_rmse_N`` and, at the deepest sample, ``prediction_error_N``; the
        same errors and the forces of each predicted test in ``predictions``; ``noise_N``; and the duration ``wall_s``,
        s.

    Raises:
        InputError: `output` is not empty and `overwrite` is False.
    """
    import calibration

    started = time.perf_counter()
    output = Path(output)
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not overwrite:
        raise ts.InputError("the folder must be empty; choose another folder or add --overwrite", file=output)
    say = console.print if console else lambda *_, **__: None
    # A different seed for each replicate of each test.
    seeds = iter(np.random.SeedSequence(seed).generate_state(3 * MEASUREMENT.replicates).tolist())

    say("1 measuring the virtual specimen (the first run on a computer compiles the solver, about 10 s) ...")
    measured = {kind: _simulate_and_write_recordings(kind, output / "measured", seeds)
                for kind in (LUBRICATED, BONDED, NEEDLE)}

    say(f"2 calibrating {len(LAWS)} laws on the lubricated test ...")
    campaign = output / "campaign.toml"
    write_text(campaign, CAMPAIGN.format(radius_mm=SPECIMEN.radius * 1e3, height_mm=SPECIMEN.height * 1e3,
                                         laws=json.dumps(LAWS), bulk_ratio=BULK_RATIO, force_N=MEASUREMENT.force_noise))
    (result,) = calibration.calibrate([campaign], output / "calibration", overwrite=overwrite)
    material_file = output / "calibration" / str(result.best.material_file)

    say("3 predicting the needle test and the bonded test, which the calibration did not use ...")
    material = ts.load_material(material_file)
    needle, bonded = (_simulate_and_write_prediction(kind, measured[kind], material, output)
                      for kind in (NEEDLE, BONDED))

    figure = output / "prediction.png"
    write_demo_figure(measured[LUBRICATED], material, needle, bonded, figure, noise=MEASUREMENT.force_noise,
                      specimen=SPECIMEN)
    answer = {
        "figure": str(figure), "report": str(output / "calibration" / "report.html"), "campaign": str(campaign),
        "material_file": str(material_file), "law": material.law, "parameters": dict(material.parameters),
        "prediction_rmse_N": needle.force_prediction_rmse,
        "prediction_error_N": float(needle.prediction_minus_mean_measured_force[-1]),
        "predictions": [{"test": one.kind.name, "predicted_N": float(one.predicted.force[-1]),
                         "measured_N": float(one.mean_measured_force[-1]),
                         "error_N": float(one.prediction_minus_mean_measured_force[-1]),
                         "RMSE_N": one.force_prediction_rmse}
                        for one in (needle, bonded)],
        "noise_N": MEASUREMENT.force_noise, "wall_s": time.perf_counter() - started,
    }
    say(f"\nBest law: {material.energy_law.title}. At {DEPTH * 1e3:.0f} mm, with a sensor noise of "
        f"{MEASUREMENT.force_noise} N:", markup=False)
    for one in (needle, bonded):
        say(f"{one.kind.title.lower():>20}: predicted {one.predicted.force[-1]:.3f} N, "
            f"measured {one.mean_measured_force[-1]:.3f} N; "
            f"RMSE over the curve {one.force_prediction_rmse:.3f} N", markup=False, soft_wrap=True)
    for name in ("figure", "report", "material_file"):
        say(f"{name.replace('_', ' '):>20}: {answer[name]}", markup=False, soft_wrap=True)
    return answer


def _simulate_and_write_recordings(kind: TestKind, folder: Path, seeds) -> list[ts.Recording]:
    """Simulate a test, and write its replicates as recordings of the virtual rig.

    Args:
        kind: kind of the test.
        folder: folder of the recordings.
        seeds: iterator of seeds of the sensor noise; one is used per replicate.

    Returns:
        The replicates.
    """
    truth = ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="virtual phantom")
    experiment = kind.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH, MEASUREMENT.samples))
    true = ts.simulate(ts.Model(experiment, truth), resolution="accurate", estimate_error=False)
    replicates = []
    for number in range(1, MEASUREMENT.replicates + 1):
        rig = ts.Rig(force_noise=MEASUREMENT.force_noise, seed=next(seeds))
        replicate = rig.measure(true).with_metadata(name=f"{kind.name}_{number}", kind=kind.name, virtual=True)
        ts.write_recording(replicate, folder / f"{kind.name}_{number}.csv")
        replicates.append(replicate)
    return replicates


def _simulate_and_write_prediction(kind: TestKind, measured: list[ts.Recording], material: ts.Material,
                                   output: Path) -> PredictionWithMeasuredReplicates:
    """Simulate the measured motion with the calibrated material, and write the recording.

    Args:
        kind: kind of the test.
        measured: replicates of the test; the first gives the motion.
        material: calibrated material.
        output: folder of the recording.
    """
    protocol = ts.Protocol(measured[0].time, measured[0].displacement)
    experiment = kind.experiment(specimen=SPECIMEN, protocol=protocol)
    predicted = ts.simulate(ts.Model(experiment, material), resolution="accurate", fields=kind is NEEDLE,
                            estimate_error=False)
    ts.write_recording(predicted, output / f"predicted_{kind.name}.csv")
    return PredictionWithMeasuredReplicates(kind, measured, predicted)


def write_demo_figure(calibrated_on: list[ts.Recording], material: ts.Material,
                      needle: PredictionWithMeasuredReplicates, bonded: PredictionWithMeasuredReplicates, path: Path, *,
                      noise: float, specimen: ts.Specimen) -> None:
    """Draw calibration, predictions, errors and the deformed section into six panels of an image file.

    Args:
        calibrated_on: replicates of the lubricated test.
        material: calibrated material.
        needle: comparison of the needle test; its prediction contains the fields of the solution.
        bonded: comparison of the bonded test.
        path: path of the image file.
        noise: standard deviation of the force sensor, N.
        specimen: tested specimen.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.4), layout="constrained")
    calibration, *predictions, section, fold, error = figure.subplots(2, 3).ravel()
    law = material.energy_law

    depth = calibrated_on[0].displacement
    fitted = -law.nominal_stress(1 - depth / specimen.height, material.parameters) * specimen.area
    _draw_measured_samples(calibration, calibrated_on)
    values = ", ".join(f"{name} {value:.4g}{' Pa' if law.units[name] == 'Pa' else ''}"
                       for name, value in material.parameters.items())
    calibration.plot(depth * 1e3, fitted, color=MODEL, linewidth=1.8, label=f"{law.title}\n{values}")
    calibration.set_title("Calibration: lubricated compression", loc="left", fontweight="bold")

    standard_error = noise / np.sqrt(len(needle.measured))
    error.axhspan(-2 * standard_error, 2 * standard_error, color=MEASURED, alpha=0.25, linewidth=0,
                  label=f"± 2 standard errors of the mean of {len(needle.measured)}")
    error.axhline(0, color="0.3", linewidth=0.8)
    for axes, test, colour in zip(predictions, (needle, bonded), (MODEL, SECOND), strict=True):
        _draw_measured_samples(axes, test.measured)
        axes.plot(test.predicted.displacement * 1e3, test.predicted.force, color=colour, linewidth=1.8,
                  label="predicted by finite elements")
        axes.set_title(f"Prediction: {test.kind.title.lower()}", loc="left", fontweight="bold")
        error.plot(test.predicted.displacement * 1e3, test.prediction_minus_mean_measured_force, color=colour,
                   linewidth=1.2, label=f"{test.kind.title.lower()}, RMSE {test.force_prediction_rmse:.3f} N")
    limit = 2.2 * max(3 * standard_error, abs(needle.prediction_minus_mean_measured_force).max(),
                      abs(bonded.prediction_minus_mean_measured_force).max())
    error.set_ylim(-limit, limit)
    error.set_title("Predicted − measured", loc="left", fontweight="bold")
    for axes in (calibration, *predictions, error):
        axes.set_ylabel("force [N]")
        axes.set_xlabel("displacement [mm]")
        axes.set_xlim(0, depth[-1] * 1e3)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, loc="upper left", fontsize=9)
    tool = NEEDLE.require_tool()
    draw_section(section, needle.predicted.fields, "von_mises", tool=tool)
    draw_tool_edge_closeup(fold, needle.predicted.fields, "von_mises", tool)
    write_figure_file(figure, path)


def _draw_measured_samples(axes, recordings: list[ts.Recording]) -> None:
    """Draw the samples of replicates as grey points."""
    for number, recording in enumerate(recordings):
        axes.plot(recording.displacement * 1e3, recording.force, ".", color=MEASURED, markersize=3, alpha=0.7,
                  label=f"measured, {len(recordings)} replicates" if number == 0 else None)
