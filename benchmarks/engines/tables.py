"""Tables of the benchmark of engines, one for each job."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.engines.jobs import JOBS, MESHES
from benchmarks.engines.run import OWN_MESH
from benchmarks.engines.scoring import compute_scores
from benchmarks.measure import table


def list_rows(runs: list[dict[str, Any]], truths: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the runs with their scores."""
    return [{**run, "scores": asdict(compute_scores(run, truths[run["job"]]))} for run in runs]


def select_finest(rows: list[dict[str, Any]], job: str) -> list[dict[str, Any]]:
    """Return for each engine and kind of constants the run on the finest mesh with the smallest step."""
    sizes, best = [*MESHES, OWN_MESH], {}
    for row in rows:
        if row["job"] == job:
            key, rank = (row["engine"], row["is_matched"]), (sizes.index(row["mesh"]), -row["step"])
            if key not in best or rank > best[key][0]:
                best[key] = rank, row
    return [row for _, row in best.values()]


def select_finest_constants(constants: list[dict[str, Any]], is_bonded: bool) -> list[dict[str, Any]]:
    """Return for each engine the fitted constants on the finest mesh, of bonded tools or of tools in contact."""
    sizes = list(MESHES)
    best = {row["engine"]: row for row in sorted(constants, key=lambda row: sizes.index(row["mesh"]))
            if row["is_bonded"] == is_bonded}
    return list(best.values())


def draw_constants(constants: list[dict[str, Any]], console) -> None:
    """Print the force errors by depth before and after the fit of the constants."""
    depths = sorted({round(1e3 * depth, 6) for row in constants for depth in row["calibrated_depths"]})
    for is_bonded in (True, False):
        rows = [row for row in constants if row["is_bonded"] == is_bonded]
        if not rows:
            continue
        known = [depth for depth in depths if any(
            depth in np.round(1e3 * np.array(row["calibrated_depths"]), 6) for row in rows)]
        table(console, f"{'bonded flat punch' if is_bonded else 'ball with friction'}: force error, %, by depth, mm",
              ["engine", "mesh", "E, Pa", "nu", *(f"{depth:g}" for depth in known)],
              [[f"{row['engine']}, {name}", row["mesh"], f"{row[key]['young']:.0f}", f"{row[key]['poisson']:g}",
                *_list_errors(row, row[errors], known)]
               for row in rows for name, key, errors in (("constants at rest", "uncompensated", "uncompensated_errors"),
                                                         ("matched", "constants", "errors"))])


def _list_errors(row: dict[str, Any], errors: list[float], depths: list[float]) -> list[str]:
    """Format errors at depths, mm; a dash where the engine did not arrive."""
    found = {round(1e3 * depth, 6): error for depth, error in zip(row["calibrated_depths"], errors, strict=False)}
    return [f"{100.0 * found[depth]:+.1f}" if depth in found else "-" for depth in depths]


def draw_tables(result: dict[str, Any], console) -> None:
    """Print the fitted constants, and one table for each job: all runs, or the finest run of each engine."""
    if result["constants"]:
        draw_constants(result["constants"] if result["shows_all"] else [
            row for is_bonded in (True, False) for row in select_finest_constants(result["constants"], is_bonded)],
            console)
    for name, job in JOBS.items():
        rows = [row for row in result["rows"] if row["job"] == name]
        if not rows:
            continue
        if not result["shows_all"]:
            rows = select_finest(rows, name)
        columns = _list_columns(rows)
        table(console, f"{name}: {job.title}; errors in % of the largest true force",
              ["engine", "mesh", "step, ms", "reached, %", *(heading for heading, _, _ in columns), "ended"],
              [[_describe_engine(row), row["mesh"], f"{1e3 * row['step']:g}" if row["step"] else "static",
                f"{100.0 * row['scores']['reached']:.0f}",
                *(_format(row["scores"][key], factor) for _, key, factor in columns), _shorten(row["ended"])]
               for row in rows])


#: Heading, key of `Scores` and factor of each column.
COLUMNS = (("rms", "rms_error", 100.0), ("largest", "largest_error", 100.0), ("at the end", "end_error", 100.0),
           ("lateral", "lateral_error", 100.0), ("drift", "drift", 100.0), ("in air", "force_in_air", 100.0),
           ("penetration, mm", "penetration", 1e3), ("CPU ms a step", "step_seconds", 1e3),
           ("CPU over simulated time", "time_ratio", 1.0))


def _list_columns(rows: list[dict[str, Any]]) -> list[tuple[str, str, float]]:
    """Return the columns that have a number in a row."""
    return [column for column in COLUMNS if any(not math.isnan(row["scores"][column[1]]) for row in rows)]


def _describe_engine(row: dict[str, Any]) -> str:
    """Return the title of an engine with the state of its constants."""
    if row["constants"] is None:
        return row["title"]
    return f"{row['title']}, {'matched' if row['is_matched'] else 'constants at rest'}"


def _format(value: float, factor: float) -> str:
    """Format a score with three digits; a dash if it does not apply."""
    return "-" if math.isnan(value) else f"{factor * value:.3g}"


def _shorten(text: str) -> str:
    """Return a reason in one line of at most 60 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 60 else f"{line[:57]}..."
