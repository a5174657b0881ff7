"""The picture of the demo: calibration, prediction, its error and the deformed section."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.figures import draw_section, save
from tissue_sim.material import Material
from tissue_sim.recording import Recording

if TYPE_CHECKING:
    from scenes.demo import Comparison

MEASURED, MODEL, ERROR = "#7F7F7F", "#0072B2", "#D55E00"


def draw_demo(calibrated_on: list[Recording], material: Material, comparison: Comparison, path: Path, *, noise: float,
              area: float, height: float) -> None:
    """Draw the demo's four panels into an image file.

    Args:
        calibrated_on: replicates of the lubricated test.
        material: the calibrated material.
        comparison: the bonded test, measured and predicted; the prediction carries its fields.
        path: image file.
        noise: standard deviation of the force, N.
        area: undeformed cross-section, m2.
        height: undeformed height, m.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.2), layout="constrained")
    panels = figure.subplots(2, 2, height_ratios=[1.35, 1])
    (calibration, prediction), (section, error) = panels
    law = material.energy_law

    depth = calibrated_on[0].displacement
    fitted = -law.nominal_stress(1 - depth / height, material.parameters) * area
    _points(calibration, calibrated_on)
    values = ", ".join(f"{name} {value:.4g}{' Pa' if law.units[name] == 'Pa' else ''}"
                       for name, value in material.parameters.items())
    calibration.plot(depth * 1e3, fitted, color=MODEL, linewidth=1.8, label=f"{law.title}\n{values}")
    calibration.set_title("Calibration: lubricated compression", loc="left", fontweight="bold")

    predicted = comparison.predicted
    _points(prediction, comparison.measured)
    prediction.plot(predicted.displacement * 1e3, predicted.force, color=MODEL, linewidth=1.8,
                    label="predicted by finite elements")
    prediction.set_title("Prediction: bonded compression", loc="left", fontweight="bold")
    top = 1.05 * max(predicted.force.max(), comparison.mean.max())
    for axes in (calibration, prediction):
        axes.set_ylabel("force [N]")
        axes.set_ylim(-0.02 * top, top)
        axes.legend(frameon=False, loc="upper left")

    share = noise / np.sqrt(len(comparison.measured))
    error.axhspan(-2 * share, 2 * share, color=MEASURED, alpha=0.25, linewidth=0,
                  label=f"± 2 standard errors of the mean of {len(comparison.measured)}")
    error.axhline(0, color="0.3", linewidth=0.8)
    error.plot(predicted.displacement * 1e3, comparison.error, color=ERROR, linewidth=1.2,
               label=f"predicted − measured, RMSE {np.sqrt(np.mean(comparison.error**2)):.3f} N")
    reach = 1.9 * max(3 * share, abs(comparison.error).max())
    error.set_ylim(-reach, reach)
    error.set_ylabel("error [N]")
    error.legend(frameon=False, loc="upper left")
    for axes in (calibration, prediction, error):
        axes.set_xlabel("displacement [mm]")
        axes.set_xlim(0, depth[-1] * 1e3)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    draw_section(section, predicted.fields, "von_mises")
    save(figure, path)


def _points(axes, recordings: list[Recording]) -> None:
    for number, recording in enumerate(recordings):
        axes.plot(recording.displacement * 1e3, recording.force, ".", color=MEASURED, markersize=3, alpha=0.7,
                  label=f"measured, {len(recordings)} replicates" if number == 0 else None)
