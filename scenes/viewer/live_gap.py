"""By how much what was felt differs from the model's curve, and what may be the reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.viewer.trace import Trace

Pair = tuple[np.ndarray, np.ndarray]
#: A slower tool stands, m/s.
_STANDS = 1e-5


@dataclass(frozen=True)
class LiveGap:
    """Felt minus model where it is largest.

    Attributes:
        force: N. depth: where, m.
        speed: of the tool where it moved in the newest way in and out, median, m/s.
        late: share of their points whose force was carried on by late ticks.
        inertial: share of them at which the mass of the tissue counted.
    """

    force: float
    depth: float
    speed: float
    late: float
    inertial: float


def live_gap(trace: Trace, grid: np.ndarray, live: Pair, model: Pair) -> LiveGap | None:
    """The gap between two curves on a grid of depths (m, shape (n,)), load and unload in N; None where they do not
    overlap."""
    gaps = np.concatenate([felt - there for felt, there in zip(live, model, strict=True)])
    if not np.isfinite(gaps).any():
        return None
    worst = int(np.nanargmax(np.abs(gaps)))
    branches = [each for each in trace.branches() if each is not None]
    speeds = np.concatenate([np.abs(np.diff(each.depth) / np.diff(each.time)) for each in branches]) \
        if branches else np.zeros(1)
    moving = speeds[speeds > _STANDS]
    late, inertial = (np.concatenate([getattr(each, name) for each in branches]) if branches else np.zeros(1)
                      for name in ("late", "inertial"))
    return LiveGap(float(gaps[worst]), float(grid[worst % grid.size]), float(np.median(moving)) if moving.size else 0.0,
                   float(late.mean()), float(inertial.mean()))


def late_forces(trace: Trace, grid: np.ndarray) -> np.ndarray:
    """Forces of the newest way in and out that late ticks carried on, N, at the nearest depth of a grid (m, shape
    (n,)); NaN elsewhere."""
    forces = np.full(grid.size, np.nan)
    for branch in trace.branches():
        if branch is not None:
            depth, force = branch.depth[branch.late], branch.force[branch.late]
            inside = (depth >= grid[0]) & (depth <= grid[-1])
            nearest = np.rint((depth[inside] - grid[0]) / (grid[1] - grid[0])).astype(int)
            forces[nearest] = force[inside]
    return forces
