"""The picture of the demo with something hidden: each test and what a model misses in it, before and after."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.figures import save

if TYPE_CHECKING:
    from calibration import DiagnosisResult

MEASURED, BEFORE, AFTER = "#7F7F7F", "#D55E00", "#0072B2"
#: Residuals are drawn as means of so many bins over a recording.
_BINS = 40


def draw_before_and_after(result: DiagnosisResult, path: Path) -> None:
    """Draw force and residuals of every test over time into an image file.

    Args:
        result: of `calibration.diagnose`, whose ``residuals.csv`` has every sample. path: of the picture.
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
    for (force, gap), test in zip(axes.T, tests, strict=True):
        mine = table[np.char.startswith(table["replicate"], f"{test}/")]
        recordings = [mine[mine["replicate"] == name] for name in dict.fromkeys(mine["replicate"])]
        for number, rows in enumerate(recordings):
            force.plot(rows["time_s"], rows["measured_N"], ".", color=MEASURED, ms=3.5, alpha=0.7,
                       label=None if number else f"measured, {len(recordings)} recordings")
        noise = float(np.mean(mine["noise_N"]))
        gap.axhspan(-noise, noise, color=MEASURED, alpha=0.2, lw=0, label="± noise of a sample")
        for column, label, colour, dashes in models:
            first = recordings[0]
            force.plot(first["time_s"], first[column], color=colour, ls=dashes, lw=1.8, label=label)
            gap.plot(*_means(mine["time_s"], mine["measured_N"] - mine[column]), color=colour, ls=dashes, lw=1.8)
        force.set_title(test, loc="left", fontweight="bold")
        force.set_ylabel("force [N]")
        gap.set(xlabel="time [s]", ylabel="data − model [N]")
        gap.axhline(0.0, color="0.3", lw=0.8)
        reach = max(abs(limit) for limit in gap.get_ylim())
        gap.set_ylim(-1.1 * reach, 1.4 * reach)
        for each in (force, gap):
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
        force.legend(frameon=False, fontsize=9)
        gap.legend(frameon=False, fontsize=9, loc="upper right")
    sentences = diagnosis.message.replace(". ", ".\n").splitlines()
    figure.suptitle("\n".join(line for each in sentences for line in textwrap.wrap(each, 62 * len(tests))),
                    fontsize=11)
    save(figure, path)


def _means(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over bins of time of samples of all recordings."""
    edges = np.linspace(time.min(), time.max(), _BINS + 1)
    place = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, _BINS - 1)
    count = np.maximum(np.bincount(place, minlength=_BINS), 1)
    return 0.5 * (edges[1:] + edges[:-1]), np.bincount(place, values, minlength=_BINS) / count
