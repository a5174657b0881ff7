"""Scores of a run in the benchmark of engines: force error, drift, force after release, penetration, time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.engines.jobs import JOBS, Job

#: Height of the tool above the surface from which it must feel no force, m.
CLEAR_HEIGHT = 1e-3
#: Duration before the end of a hold in which its force is averaged, s.
AVERAGED_TIME = 0.02
#: Fraction of the largest true force below which the lateral force is not evaluated, 1.
SMALLEST_FORCE = 0.02
#: Difference of depths that count as equal, m.
SAME_DEPTH = 1e-9


@dataclass(frozen=True)
class Scores:
    """Scores of one run; NaN where a score does not apply.

    Attributes:
        reached: fraction of the positions that the engine reached, 1.
        rms_error: root mean square of the force error over the largest true force, 1.
        largest_error: largest force error over the largest true force, 1.
        end_error: error of the normal force at the last of the deepest positions that were reached, relative to its
            true value, 1.
        lateral_error: error of the lateral force at this position over the largest true lateral force, 1.
        drift: change of the force from the end of the first hold to the end of the last one, relative, 1.
        force_in_air: largest force while the tool is at least `CLEAR_HEIGHT` above the surface, over the largest true
            force, 1.
        penetration: largest penetration of a node into the tool, m.
        step_seconds: CPU time of a step, s.
        time_ratio: CPU time over simulated time, 1.
    """

    reached: float
    rms_error: float
    largest_error: float
    end_error: float
    lateral_error: float
    drift: float
    force_in_air: float
    penetration: float
    step_seconds: float
    time_ratio: float


def compute_scores(run: dict[str, Any], truth: dict[str, Any]) -> Scores:
    """Compute the scores of a run against the true forces of its job.

    Args:
        run: row of the results; see `benchmarks.engines.run`.
        truth: ``positions``, m, and ``forces``, N, of the same job; in jobs with inertia at the same times.
    """
    job, forces = JOBS[run["job"]], np.array(run["forces"]).reshape(-1, 3)
    positions, times = job.make_motion()
    true, count = interpolate_truth(job, truth), len(forces)
    largest = float(np.linalg.norm(true, axis=1).max())
    if not count:
        return Scores(0.0, *[math.nan] * 8, run["step_seconds"])
    difference = np.linalg.norm(forces - true[:count], axis=1) / largest
    lateral = float(np.abs(true[:, 0]).max())
    end = int(np.flatnonzero(positions[:count, 2] <= positions[:count, 2].min() + SAME_DEPTH)[-1])
    in_air = positions[:count, 2] >= CLEAR_HEIGHT
    return Scores(
        reached=count / len(positions), rms_error=float(np.sqrt((difference**2).mean())),
        largest_error=float(difference.max()),
        end_error=float(forces[end, 2] / true[end, 2] - 1.0) if true[end, 2] > 0.0 else math.nan,
        lateral_error=(float((forces[end, 0] - true[end, 0]) / lateral) if lateral > SMALLEST_FORCE * largest
                       else math.nan),
        drift=_compute_drift(positions, times, forces),
        force_in_air=float(np.linalg.norm(forces[in_air], axis=1).max() / largest) if in_air.any() else math.nan,
        penetration=max(run["penetrations"], default=math.nan), step_seconds=run["step_seconds"],
        time_ratio=math.nan if times is None or not run["step"] else run["step_seconds"] / run["step"])


def interpolate_truth(job: Job, truth: dict[str, Any]) -> np.ndarray:
    """Return the true forces at the positions of a job, N, shape (n, 3), by path length, or by time with inertia."""
    positions, times = job.make_motion()
    known, forces = np.array(truth["positions"]), np.array(truth["forces"])
    if times is not None:
        at, stated = times, np.array(truth["times"])
    else:
        at, stated = compute_path_lengths(positions), compute_path_lengths(known)
    return np.column_stack([np.interp(at, stated, forces[:, axis]) for axis in range(3)])


def compute_path_lengths(positions: np.ndarray) -> np.ndarray:
    """Return the distance along the path from the first position, m, shape (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def _compute_drift(positions: np.ndarray, times: np.ndarray | None, forces: np.ndarray) -> float:
    """Return the relative change of the force between the ends of the first and the last hold at the deepest depth."""
    if times is None:
        return math.nan
    deepest = positions[:, 2] <= positions[:, 2].min() + SAME_DEPTH
    ends = np.flatnonzero(deepest & ~np.append(deepest[1:], False))
    if len(ends) < 2 or ends[-1] >= len(forces):
        return math.nan
    first, last = (forces[(times > times[end] - AVERAGED_TIME) & (times <= times[end]), 2].mean()
                   if len(forces) == len(times) else math.nan for end in (ends[0], ends[-1]))
    return float(last / first - 1.0)


