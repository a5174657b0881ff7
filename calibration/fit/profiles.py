"""Profile-likelihood intervals: how far a parameter can move while all others follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.fit.problem import Problem
from calibration.forward.contract import InfeasibleError
from calibration.statistics.uncertainty import Uncertainty

#: The rise at the end of an interval is met within this, in units of its square root.
_NEAR, _MOST_POINTS = 0.02, 8
#: Half of the way is looked at too, for the picture.
_HALF = 0.5
#: A constrained minimum is found when a further step would lower the sum of squares by less than this.
_SETTLED, _MOST_STEPS = 5e-3, 6
#: A sum of squares this much below that of the estimate is another minimum.
_LOWER = 0.1


@dataclass(frozen=True, eq=False)
class ProfileSide:
    """One side of a profile, from the estimate outwards.

    Attributes:
        index: of the parameter. side: -1 or 1.
        values: SI, shape (k,). rises: of the sum of squares above the minimum, in units of its inflation, shape (k,).
        end: of the interval, SI. note: what cut it, empty where the rise was met.
        simulations: (test, resolution) -> simulations that were done. cpu_s: processor seconds.
    """

    index: int
    side: int
    values: np.ndarray
    rises: np.ndarray
    end: float
    note: str
    simulations: dict[tuple[str, str], int]
    cpu_s: float


def profile_side(problem: Problem, theta: np.ndarray, error: float, spread: Uncertainty, index: int,
                 side: int) -> ProfileSide:
    """Follow the profile of one parameter until it has risen by the square of the quantile.

    Args:
        problem: at its minimum. theta, error: that minimum. spread: its uncertainty. index: parameter. side: -1 or 1.

    Source: Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87; here each point starts from where the quadratic
    approximation puts the others, so that it mostly takes one solve.
    """
    spent = problem.solves.meter()
    space, quantile = problem.space, float(spread.quantile[index])
    bound = space.high[index] if side > 0 else space.low[index]
    deviation = spread.standard_errors[index]
    follow = spread.covariance[:, index] / spread.covariance[index, index]
    points, lower = [(0.0, 0.0)], []
    note = ""

    def rise_at(way: float) -> float:
        """Square root of the rise at a distance from the estimate, in its units."""
        trial = np.clip(theta + side * way * follow, space.low, space.high)
        trial[index] = theta[index] + side * way
        lowest = _constrained_minimum(problem, trial, index)
        rise = float(np.sqrt(max(lowest - error, 0.0) / spread.inflation))
        points.append((way, rise))
        if lowest < error - _LOWER * spread.inflation:
            lower.append(lowest)
        return rise

    limit = abs(bound - theta[index])
    way, cut = quantile * deviation, False
    try:
        if _HALF * way < limit:
            rise_at(_HALF * way)
        for _ in range(_MOST_POINTS):
            cut = way >= limit
            rise = rise_at(min(way, limit))
            if cut and rise <= quantile:
                note = f"bound {bound:.6g}"
                break
            if abs(rise - quantile) < _NEAR:
                break
            way = _crossing(points, quantile)
        else:
            note = "the rise was not met: the interval may be wider"
    except InfeasibleError as failure:
        note = f"no solution beyond: {failure}"
    points.sort()
    ways, rises = np.array(points).T
    if lower and not note:
        note = f"a lower minimum lies on this side (sum of squares {min(lower):.6g}): try more starts"
    if note.startswith("bound"):
        end = float(bound)
    elif note and len(points) == 1:
        # Nothing was simulated on this side.
        end = float(np.clip(theta[index] + side * quantile * deviation, space.low[index], space.high[index]))
        note = f"by the standard error alone; {note}"
    elif note and not lower:
        end = theta[index] + side * float(ways[-1])
    else:
        end = theta[index] + side * float(np.interp(quantile, rises, ways))
    return ProfileSide(index, side, theta[index] + side * ways, rises**2, float(end), note, *spent())


def _crossing(points: list[tuple[float, float]], quantile: float) -> float:
    """Where the root of the rise, nearly a straight line, should pass the quantile."""
    ways, rises = np.array(sorted(points)).T
    above = np.flatnonzero(rises >= quantile)
    if above.size and above[0] > 0:
        i = above[0]
        return float(ways[i - 1] + (quantile - rises[i - 1]) / (rises[i] - rises[i - 1]) * (ways[i] - ways[i - 1]))
    slope = (rises[-1] - rises[-2]) / (ways[-1] - ways[-2])
    step = (quantile - rises[-1]) / slope if slope > 0 else ways[-1]
    return float(ways[-1] + min(1.05 * step, 2.0 * ways[-1]))


def _constrained_minimum(problem: Problem, trial: np.ndarray, index: int) -> float:
    """Smallest sum of squares with one parameter held, by Gauss-Newton with its last gain predicted."""
    space = problem.space
    others = np.array([i for i in range(trial.size) if i != index], dtype=int)
    best = np.inf
    for _ in range(_MOST_STEPS):
        evaluation = problem.evaluate(trial)
        error = evaluation.error
        if not others.size or error > best:
            return min(error, best)
        residual, jacobian = evaluation.projected
        step = np.linalg.lstsq(jacobian[:, others], -residual, rcond=1e-12)[0]
        moved = trial.copy()
        moved[others] = np.clip(trial[others] + step, space.low[others], space.high[others])
        change = jacobian[:, others] @ (moved - trial)[others]
        gain = float(-2.0 * change @ residual - change @ change)
        best, trial = error, moved
        if gain < _SETTLED:
            return error - max(gain, 0.0)
        if gain < 0.2:
            # So near, the quadratic approximation is worth a solve.
            return error - gain
    return best
