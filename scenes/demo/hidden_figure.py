"""Draw the fits of a diagnosis: measured and computed force of each test, and the residuals before and after."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.figures import write_figure_file

if TYPE_CHECKING:
    from calibration import DiagnosisResult

#: Colour of measurements.
MEASURED = "#7F7F7F"
#: Colour of the model without the diagnosed effects.
BEFORE = "#D55E00"
#: Colour of the model with the diagnosed effects.
AFTER = "#0072B2"
#: Number of time bins in which residuals are averaged for the drawing.
_BINS = 40


def write_before_and_after_figure(result: DiagnosisResult, path: Path) -> None:
    """Draw force and residuals of every test over time into an image file.

    Args:
        result: result of `calibration.diagnose`; its ``residuals.csv`` contains every sample.
        path: path of the image file.
    """
    from matplotlib.figure import Figure

    table = np.genfromtxt(result.output / "residuals.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    diagnosis = result.diagnosis
    tests = list(dict.fromkeys(region.test for region in diagnosis.regions))
    figure = Figure(figsize=(6.2 * len(tests), 7.0), layout="constrained")
    axes = figure.subplots(2, len(tests), squeeze=False, sharex="col", height_ratios=(1.25, 1.0))
    added = " and ".join(effect.title for effect in diagnosis.effects)
    models = [("model_before_N", "plain model", BEFORE, "--")]
    if diagnosis.effects:
        models.append(("model_after_N", f"model with {added}", AFTER, "-"))
    for (force, residual), test in zip(axes.T, tests, strict=True):
        rows_of_test = table[np.char.startswith(table["replicate"], f"{test}/")]
        recordings = [rows_of_test[rows_of_test["replicate"] == name]
                      for name in dict.fromkeys(rows_of_test["replicate"])]
        for number, rows in enumerate(recordings):
            force.plot(rows["time_s"], rows["measured_N"], ".", color=MEASURED, ms=3.5, alpha=0.7,
                       label=None if number else f"measured, {len(recordings)} recordings")
        noise = float(np.mean(rows_of_test["noise_N"]))
        residual.axhspan(-noise, noise, color=MEASURED, alpha=0.2, lw=0, label="± noise of a sample")
        for column, label, colour, dashes in models:
            first = recordings[0]
            force.plot(first["time_s"], first[column], color=colour, ls=dashes, lw=1.8, label=label)
            misfit = rows_of_test["measured_N"] - rows_of_test[column]
            residual.plot(*_average_in_time_bins(rows_of_test["time_s"], misfit), color=colour, ls=dashes, lw=1.8)
        force.set_title(test, loc="left", fontweight="bold")
        force.set_ylabel("force [N]")
        residual.set(xlabel="time [s]", ylabel="data − model [N]")
        residual.axhline(0.0, color="0.3", lw=0.8)
        largest = max(abs(limit) for limit in residual.get_ylim())
        residual.set_ylim(-1.1 * largest, 1.4 * largest)
        for each in (force, residual):
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
        force.legend(frameon=False, fontsize=9)
        residual.legend(frameon=False, fontsize=9, loc="upper right")
    sentences = diagnosis.message.replace(". ", ".\n").splitlines()
    figure.suptitle("\n".join(line for each in sentences for line in textwrap.wrap(each, 62 * len(tests))),
                    fontsize=11)
    write_figure_file(figure, path)


def _average_in_time_bins(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average samples of all recordings in equal time bins.

    Args:
        time: s, shape (n,).
        values: values to average, shape (n,).

    Returns:
        Centres of the bins, s, and mean values, each of shape (_BINS,). The mean of an empty bin is 0.
    """
    edges = np.linspace(time.min(), time.max(), _BINS + 1)
    bin_number = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, _BINS - 1)
    count = np.maximum(np.bincount(bin_number, minlength=_BINS), 1)
    return 0.5 * (edges[1:] + edges[:-1]), np.bincount(bin_number, values, minlength=_BINS) / count
