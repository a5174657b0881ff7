"""Draw the result of the demonstration: calibration, predictions, prediction errors, and the needle section."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenes.demo.comparison import PredictionWithMeasuredReplicates
from scenes.figures import draw_section, draw_tool_edge_closeup, write_figure_file
from tissue_sim.experiment.kinds.indentation import NEEDLE
from tissue_sim.material.material import Material
from tissue_sim.recording.recording import Recording
from tissue_sim.specimen import Specimen

#: Colour of measurements.
MEASURED = "#7F7F7F"
#: Colour of the fitted curve and of the needle prediction.
MODEL = "#0072B2"
#: Colour of the bonded prediction.
SECOND = "#D55E00"


def write_demo_figure(calibrated_on: list[Recording], material: Material, needle: PredictionWithMeasuredReplicates,
                      bonded: PredictionWithMeasuredReplicates, path: Path, *,
                      noise: float, specimen: Specimen) -> None:
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


def _draw_measured_samples(axes, recordings: list[Recording]) -> None:
    """Draw the samples of replicates as grey points."""
    for number, recording in enumerate(recordings):
        axes.plot(recording.displacement * 1e3, recording.force, ".", color=MEASURED, markersize=3, alpha=0.7,
                  label=f"measured, {len(recordings)} replicates" if number == 0 else None)
