"""Difference between the live force and the model curve, with its likely causes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.viewer.trace import Trace

Pair = tuple[np.ndarray, np.ndarray]
#: Speed below which the tool counts as standing, m/s.
_STANDING_SPEED = 1e-5


@dataclass(frozen=True)
class LargestLiveModelDifference:
    """Largest difference between the live force and the model curve.

    Attributes:
        force: Live force minus model force, N.
        depth: Depth of the largest difference, m.
        speed: Median speed of the moving tool in the newest loading and unloading, m/s.
        late_fraction: Fraction of the points of these branches whose force late ticks extrapolated.
        inertia_fraction: Fraction of these points at which the inertia of the tissue was included.
    """

    force: float
    depth: float
    speed: float
    late_fraction: float
    inertia_fraction: float


def find_largest_live_model_difference(trace: Trace, grid: np.ndarray, live: Pair,
                                       model: Pair) -> LargestLiveModelDifference | None:
    """Compute the largest difference between the live force and the model curve.

    Args:
        trace: Motion and force of the run.
        grid: Depths, m, shape (n,).
        live: Live loading and unloading force on the grid, N, each of shape (n,), NaN where missing.
        model: Loading and unloading force of the model on the grid, N, each of shape (n,), NaN where missing.

    Returns:
        The difference; None if the curves do not overlap.
    """
    gaps = np.concatenate([live_force - model_force for live_force, model_force in zip(live, model, strict=True)])
    if not np.isfinite(gaps).any():
        return None
    worst = int(np.nanargmax(np.abs(gaps)))
    branches = [each for each in trace.get_newest_loading_and_unloading() if each is not None]
    speeds = np.concatenate([np.abs(np.diff(each.depth) / np.diff(each.time)) for each in branches]) \
        if branches else np.zeros(1)
    moving = speeds[speeds > _STANDING_SPEED]
    is_late, includes_inertia = (np.concatenate([getattr(each, name) for each in branches]) if branches
                                 else np.zeros(1) for name in ("is_late", "includes_inertia"))
    return LargestLiveModelDifference(float(gaps[worst]), float(grid[worst % grid.size]),
                                      float(np.median(moving)) if moving.size else 0.0,
                                      float(is_late.mean()), float(includes_inertia.mean()))


def select_forces_of_late_ticks_on_grid(trace: Trace, grid: np.ndarray) -> np.ndarray:
    """Return the forces of the newest loading and unloading that late ticks extrapolated.

    Args:
        trace: Motion and force of the run.
        grid: Equally spaced depths, m, shape (n,).

    Returns:
        Force at the grid depth nearest to each such point, N, shape (n,); NaN elsewhere.
    """
    forces = np.full(grid.size, np.nan)
    for branch in trace.get_newest_loading_and_unloading():
        if branch is not None:
            depth, force = branch.depth[branch.is_late], branch.force[branch.is_late]
            inside = (depth >= grid[0]) & (depth <= grid[-1])
            nearest = np.rint((depth[inside] - grid[0]) / (grid[1] - grid[0])).astype(int)
            forces[nearest] = force[inside]
    return forces
