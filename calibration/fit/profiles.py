"""Profile-likelihood intervals of single parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.fit.problem import GeneralisedProblem
from calibration.forward.contract import InfeasibleError
from calibration.statistics.uncertainty import ParameterUncertainty


@dataclass(frozen=True)
class ProfileSettings:
    """Settings of profile-likelihood intervals.

    Attributes:
        tolerance: tolerance of the square root of the rise at the end of an interval.
        max_points: maximum number of points on one side.
        first_fraction: additional first point for plots, as a fraction of the expected half width.
        gain: predicted decrease of the sum of squares at which a constrained minimum counts as found.
        extrapolated_gain: predicted decrease below which the quadratic approximation replaces a further evaluation.
        max_steps: maximum number of Gauss-Newton steps per constrained minimum.
        lower: decrease of the sum of squares below that of the estimate that indicates another minimum.
    """

    tolerance: float = 0.02
    max_points: int = 8
    first_fraction: float = 0.5
    gain: float = 5e-3
    extrapolated_gain: float = 0.2
    max_steps: int = 6
    lower: float = 0.1


_SETTINGS = ProfileSettings()


@dataclass(frozen=True, eq=False)
class ProfileSide:
    """One side of a profile likelihood, from the estimate outwards.

    Attributes:
        index: index of the parameter.
        side: -1 (lower side) or 1 (upper side).
        values: values of the parameter, SI, shape (k,).
        rises: rise of the sum of squares above its minimum, divided by the inflation, shape (k,).
        end: end of the interval, SI.
        note: reason why the interval ends early; empty otherwise.
        simulations: (test, resolution) -> number of simulations.
        cpu_s: processor time, s.
    """

    index: int
    side: int
    values: np.ndarray
    rises: np.ndarray
    end: float
    note: str
    simulations: dict[tuple[str, str], int]
    cpu_s: float


def compute_profile_side(problem: GeneralisedProblem, theta: np.ndarray, error: float, spread: ParameterUncertainty,
                         index: int, side: int) -> ProfileSide:
    """Compute one side of the profile likelihood of a parameter, up to a rise by the square of the quantile.

    For each value of the parameter the sum of squares is minimised over all others. Each minimisation starts from the
    quadratic approximation, so it mostly takes one evaluation. The square root of the rise is nearly linear in the
    parameter, which gives the next value by interpolation.

    Args:
        problem: least-squares problem.
        theta: unknowns at the minimum, SI, shape (p,).
        error: sum of squares at the minimum.
        spread: uncertainty at the minimum.
        index: index of the parameter.
        side: -1 or 1.

    Source: Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87.
    """
    spent = problem.solves.make_effort_since_now_function()
    space, quantile = problem.space, float(spread.quantile[index])
    bound = space.high[index] if side > 0 else space.low[index]
    deviation = spread.standard_errors[index]
    direction = spread.covariance[:, index] / spread.covariance[index, index]
    points, lower = [(0.0, 0.0)], []
    note = ""

    def compute_and_store_root_rise(distance: float) -> float:
        """Return the square root of the rise at a distance of the parameter from the estimate."""
        trial = np.clip(theta + side * distance * direction, space.low, space.high)
        trial[index] = theta[index] + side * distance
        lowest = _minimise_squares_with_fixed_parameter(problem, trial, index)
        rise = float(np.sqrt(max(lowest - error, 0.0) / spread.inflation))
        points.append((distance, rise))
        if lowest < error - _SETTINGS.lower * spread.inflation:
            lower.append(lowest)
        return rise

    limit = abs(bound - theta[index])
    distance, cut = quantile * deviation, False
    try:
        if _SETTINGS.first_fraction * distance < limit:
            compute_and_store_root_rise(_SETTINGS.first_fraction * distance)
        for _ in range(_SETTINGS.max_points):
            cut = distance >= limit
            rise = compute_and_store_root_rise(min(distance, limit))
            if cut and rise <= quantile:
                note = f"bound {bound:.6g}"
                break
            if abs(rise - quantile) < _SETTINGS.tolerance:
                break
            distance = _estimate_crossing_distance(points, quantile)
        else:
            note = "the end was not found; the interval may be wider"
    except InfeasibleError as failure:
        note = f"no solution beyond: {failure}"
    points.sort()
    distances, rises = np.array(points).T
    if lower and not note:
        note = f"a lower minimum lies on this side (sum of squares {min(lower):.6g}); increase fit.starts"
    if note.startswith("bound"):
        end = float(bound)
    elif note and len(points) == 1:
        # No simulation succeeded on this side.
        end = float(np.clip(theta[index] + side * quantile * deviation, space.low[index], space.high[index]))
        note = f"by the standard error alone; {note}"
    elif note and not lower:
        end = theta[index] + side * float(distances[-1])
    else:
        end = theta[index] + side * float(np.interp(quantile, rises, distances))
    return ProfileSide(index, side, theta[index] + side * distances, rises**2, float(end), note, *spent())


def _estimate_crossing_distance(points: list[tuple[float, float]], quantile: float) -> float:
    """Return the distance at which the square root of the rise is expected to equal the quantile.

    The distance is interpolated linearly between points on both sides of the quantile, or extrapolated.

    Args:
        points: distances from the estimate and square roots of the rise.
        quantile: target of the square root of the rise.
    """
    distances, rises = np.array(sorted(points)).T
    above = np.flatnonzero(rises >= quantile)
    if above.size and above[0] > 0:
        i = above[0]
        slope = (rises[i] - rises[i - 1])
        return float(distances[i - 1] + (quantile - rises[i - 1]) / slope * (distances[i] - distances[i - 1]))
    slope = (rises[-1] - rises[-2]) / (distances[-1] - distances[-2])
    step = (quantile - rises[-1]) / slope if slope > 0 else distances[-1]
    return float(distances[-1] + min(1.05 * step, 2.0 * distances[-1]))


def _minimise_squares_with_fixed_parameter(problem: GeneralisedProblem, trial: np.ndarray, index: int) -> float:
    """Return the smallest sum of squares with one parameter fixed, by Gauss-Newton.

    The decrease of the last step is predicted from the quadratic approximation without a further evaluation.

    Args:
        problem: least-squares problem.
        trial: first values of all parameters, SI, shape (p,).
        index: index of the fixed parameter.
    """
    space = problem.space
    others = np.array([i for i in range(trial.size) if i != index], dtype=int)
    best = np.inf
    for _ in range(_SETTINGS.max_steps):
        evaluation = problem.evaluate(trial)
        error = evaluation.penalised_sum_of_squares
        if not others.size or error > best:
            return min(error, best)
        residual, jacobian = evaluation.projected_residual_and_jacobian
        step = np.linalg.lstsq(jacobian[:, others], -residual, rcond=1e-12)[0]
        moved = trial.copy()
        moved[others] = np.clip(trial[others] + step, space.low[others], space.high[others])
        change = jacobian[:, others] @ (moved - trial)[others]
        gain = float(-2.0 * change @ residual - change @ change)
        best, trial = error, moved
        if gain < _SETTINGS.gain:
            return error - max(gain, 0.0)
        if gain < _SETTINGS.extrapolated_gain:
            return error - gain
    return best
