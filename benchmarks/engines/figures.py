"""Pictures of the benchmark of engines: force and force error along each job, and error over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engines.jobs import JOBS, Job
from benchmarks.engines.scoring import compute_path_lengths, interpolate_truth
from benchmarks.engines.tables import select_finest, select_finest_constants

#: Colours that colour-blind readers can distinguish (Okabe and Ito), for the engines in their order.
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#000000", "#D55E00", "#E69F00", "#CC79A7", "#F0E442", "#999999")
#: Mesh -> marker.
MARKERS = {"coarse": "o", "middle": "s", "fine": "^", "own": "D"}
#: Limit of the axis of the force error, %.
LARGEST_SHOWN_ERROR = 60.0


def draw_figures(rows: list[dict[str, Any]], truths: dict[str, dict[str, Any]], constants: list[dict[str, Any]],
                 folder: Path) -> None:
    """Draw ``engines_forces.png``, ``engines_cost.png`` and, with fitted constants, ``engines_constants.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    if constants:
        _draw_constants(constants, folder / "engines_constants.png")
    engines = list(dict.fromkeys(row["engine"] for row in rows))
    colours = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(engines)}
    _draw_forces(rows, truths, colours, folder / "engines_forces.png")
    _draw_cost(rows, colours, folder / "engines_cost.png")


def _draw_forces(rows: list[dict[str, Any]], truths: dict[str, dict[str, Any]], colours: dict[str, str],
                 path: Path) -> None:
    """Draw normal force and force error along each job, of the finest runs."""
    from matplotlib.figure import Figure

    jobs = [job for job in JOBS.values() if any(row["job"] == job.name for row in rows)]
    figure = Figure(figsize=(11.0, 2.7 * len(jobs)), layout="constrained")
    axes = figure.subplots(len(jobs), 2, squeeze=False)
    for (left, right), job in zip(axes, jobs, strict=True):
        x, label = _get_abscissa(job)
        true = interpolate_truth(job, truths[job.name])
        largest = float(np.linalg.norm(true, axis=1).max())
        left.plot(x, true[:, 2], color="black", linewidth=3, alpha=0.35, label="truth")
        for row in select_finest(rows, job.name):
            forces = np.array(row["forces"]).reshape(-1, 3)
            name = row["title"] + ("" if row["is_matched"] else ", constants at rest")
            style = {"color": colours[row["engine"]], "linestyle": "-" if row["is_matched"] else ":", "linewidth": 1.2}
            left.plot(x[:len(forces)], forces[:, 2], label=name, **style)
            error = 100.0 * (forces[:, 2] - true[:len(forces), 2]) / largest
            right.plot(x[:len(forces)], error, **style)
        left.set(title=job.title, xlabel=label, ylabel="normal force [N]",
                 ylim=(-0.1 * largest, 1.6 * largest))
        right.set(xlabel=label, ylabel="error [% of largest force]", ylim=(-LARGEST_SHOWN_ERROR, LARGEST_SHOWN_ERROR))
        right.axhline(0.0, color="black", linewidth=0.8)
        right.grid(alpha=0.3)
        left.legend(fontsize=5.5, ncols=2)
    figure.savefig(path, dpi=130)


def _get_abscissa(job: Job) -> tuple[np.ndarray, str]:
    """Return the abscissa of a job and its label: path of the tool, mm, or time, s."""
    positions, times = job.make_motion()
    return (1e3 * compute_path_lengths(positions), "path of the tool [mm]") if times is None else (times, "time [s]")


def _draw_cost(rows: list[dict[str, Any]], colours: dict[str, str], path: Path) -> None:
    """Draw the rms force error over the CPU time of a step, all meshes and steps, one panel for each job."""
    from matplotlib.figure import Figure

    jobs = [job for job in JOBS.values() if any(row["job"] == job.name for row in rows)]
    figure = Figure(figsize=(3.3 * len(jobs), 3.6), layout="constrained")
    axes = figure.subplots(1, len(jobs), squeeze=False)[0]
    for panel, job in zip(axes, jobs, strict=True):
        named = set()
        for row in rows:
            if row["job"] != job.name or not row["forces"]:
                continue
            is_complete = row["scores"]["reached"] == 1.0
            panel.loglog(1e3 * row["step_seconds"], 100.0 * row["scores"]["rms_error"],
                         marker=MARKERS[row["mesh"]], color=colours[row["engine"]],
                         fillstyle="full" if is_complete and row["is_matched"] else "none", markersize=5,
                         label=row["title"] if row["title"] not in named else None)
            named.add(row["title"])
        panel.set(title=job.name, xlabel="CPU time of a step [ms]", ylabel="rms force error [%]")
        panel.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize=5.5)
    figure.savefig(path, dpi=130)


def _draw_constants(constants: list[dict[str, Any]], path: Path) -> None:
    """Draw the force error by depth before and after the fit of the constants, on the finest mesh of each engine."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    for panel, is_bonded in zip(figure.subplots(1, 2), (True, False), strict=True):
        for row, colour in zip(select_finest_constants(constants, is_bonded), COLOURS[3:], strict=False):
            depths, before = 1e3 * np.array(row["depths"]), 100.0 * np.array(row["uncompensated_errors"])
            panel.plot(1e3 * np.array(row["calibrated_depths"])[:len(before)], before, "v--", color=colour,
                       label=f"{row['version']}, {row['mesh']}, constants at rest")
            panel.plot(depths, 100.0 * np.array(row["errors"]), "o-", color=colour,
                       label=f"{row['version']}, {row['mesh']}, matched: E {row['constants']['young']:.0f} Pa, nu "
                       f"{row['constants']['poisson']:g}")
        panel.axhline(0.0, color="black", linewidth=0.8)
        panel.set(title="bonded flat punch" if is_bonded else "ball with friction 0.3", xlabel="depth [mm]",
                  ylabel="force error [%]")
        panel.grid(alpha=0.3)
        if panel.lines[:-1]:
            panel.legend(fontsize=6)
    figure.savefig(path, dpi=130)
