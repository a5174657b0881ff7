"""Uncertainty of the parameters of a least-squares problem: covariance, profile-likelihood intervals, and influence.

The covariance is that of a generalised least-squares problem with the nuisances marginalised. The influence is that of
single recordings and of the strain range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from scipy import special

from calibration.fit.fit import Fit, WindowFit
from calibration.fit.problem import GeneralisedProblem, LeastSquaresProblem, ProblemEvaluation
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.contract import InfeasibleError
from calibration.statistics.uncertainty import COVARIANCE, ParameterUncertainty, get_inverse_root_and_undetermined_mask
from tissue_sim.recording.recording import MIN_POINTS


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


_PROFILES = ProfileSettings()


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
        if lowest < error - _PROFILES.lower * spread.inflation:
            lower.append(lowest)
        return rise

    limit = abs(bound - theta[index])
    distance, cut = quantile * deviation, False
    try:
        if _PROFILES.first_fraction * distance < limit:
            compute_and_store_root_rise(_PROFILES.first_fraction * distance)
        for _ in range(_PROFILES.max_points):
            cut = distance >= limit
            rise = compute_and_store_root_rise(min(distance, limit))
            if cut and rise <= quantile:
                note = f"bound {bound:.6g}"
                break
            if abs(rise - quantile) < _PROFILES.tolerance:
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
    for _ in range(_PROFILES.max_steps):
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
        if gain < _PROFILES.gain:
            return error - max(gain, 0.0)
        if gain < _PROFILES.extrapolated_gain:
            return error - gain
    return best


@dataclass(frozen=True)
class OutlierTestAndWindowFitSettings:
    """Settings of the test for outlying recordings and of the fits in windows.

    Attributes:
        min_recordings: smallest number of recordings among which an outlier can be identified.
        level: significance level of the test for outlying recordings, over all recordings and parameters.
        min_deviation: smallest relative deviation of an outlying recording. A smaller value also names recordings
            without consequence for the parameters.
        window_gain: predicted decrease of the sum of squares at which the descent in a window ends; windows differ by
            little.
        window_solves: maximum number of evaluations in a window; more are needed only if the window does not determine
            the parameters.
    """

    min_recordings: int = 3
    level: float = 0.05
    min_deviation: float = 0.05
    window_gain: float = 1e-4
    window_solves: int = 30


_INFLUENCE = OutlierTestAndWindowFitSettings()
#: Fractions of the largest displacement for which the parameters are estimated again.
WINDOWS = (0.4, 0.6, 0.8)


def add_influence_to_fit(fit: Fit, problem: LeastSquaresProblem, evaluation: ProblemEvaluation) -> Fit:
    """Return the fit with the influence of recordings and windows, and with a warning for outlying recordings."""
    influence = estimate_without_each_recording_in_one_step(problem, evaluation)
    odd = find_outlying_recordings(influence, fit)
    single = len(odd) == 1
    words = [f"{', '.join(odd)} disagree{'s' if single else ''} with the other recordings: without "
             f"{'it' if single else 'the first of them'} "
             f"{_describe_parameter_changes(fit, influence[odd[0]])}"] if odd else []
    return replace(fit, influence=influence, odd_recordings=odd,
                   windows=fit_displacement_windows(problem, evaluation.theta),
                   warnings=[*fit.warnings, *words], message="; ".join([fit.message, *words]))


def _describe_parameter_changes(fit: Fit, without: Mapping[str, float]) -> str:
    """Describe the parameters without a recording, such as ``C10 is 1400 instead of 1600 Pa``."""
    changes = (
        f"{fit.symbols[name]} is {value:.4g} instead of {fit.parameters[name]:.4g} "
        f"{fit.get_unit_or_empty_if_dimensionless(name)}"
        for name, value in without.items() if _is_parameter_changed_above_rounding(fit.parameters[name], value))
    return ", ".join(map(str.rstrip, changes))


def estimate_without_each_recording_in_one_step(problem: LeastSquaresProblem,
                                                evaluation: ProblemEvaluation) -> dict[str, dict[str, float]]:
    """Estimate the parameters without each recording by one linear step from the estimate (deletion diagnostics).

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.

    Returns:
        Recording -> name -> value of the free parameters without it, SI; for tests with at least three recordings.

    Source: Cook and Weisberg, Residuals and Influence in Regression, 1982, section 3.4.
    """
    residual, design = evaluation.full_residual_and_jacobian
    free, sizes = len(problem.space.free), np.linalg.norm(design, axis=0)
    design = design / np.where(sizes > 0, sizes, 1.0)
    found: dict[str, dict[str, float]] = {}
    if not free:
        return found
    for rows, curve, (number, _) in zip(problem.rows, problem.measured, problem.places, strict=True):
        if len(problem.tests[number].measured) < _INFLUENCE.min_recordings:
            continue
        rest, gap = np.delete(design, np.r_[rows], axis=0), np.delete(residual, np.r_[rows])
        root, _ = get_inverse_root_and_undetermined_mask(rest.T @ rest)
        step = -(root @ (root.T @ (rest.T @ gap)))[:free] / np.where(sizes > 0, sizes, 1.0)[:free]
        values = np.clip(evaluation.theta[:free] + step, problem.space.low, problem.space.high)
        found[curve.name] = dict(zip(problem.space.free, values.tolist(), strict=True))
    return found


def find_outlying_recordings(influence: Mapping[str, Mapping[str, float]], fit: Fit) -> list[str]:
    """Return the names of recordings whose parameters disagree with those of the other recordings.

    The value of a recording is the jackknife pseudo-value n theta - (n - 1) theta_(-i). It is compared with mean
    and scatter of the other recordings by Student's t with Bonferroni's correction.

    Args:
        influence: recording -> parameters without it, from `estimate_without_each_recording_in_one_step`.
        fit: fit of all recordings.

    Source: Tukey, Annals of Mathematical Statistics 29 (1958) 614; Cook and Weisberg, Residuals and Influence in
    Regression, 1982 (deleted residual).
    """
    # Recordings of one test are compared, for the parameters that they influence.
    asked: dict[tuple[str, str], list[str]] = {}
    for name, parameters in influence.items():
        for parameter, value in parameters.items():
            if _is_parameter_changed_above_rounding(fit.parameters[parameter], value):
                asked.setdefault((name.rpartition("/")[0], parameter), []).append(name)
    asked = {place: names for place, names in asked.items() if len(names) >= _INFLUENCE.min_recordings}
    questions, odd = sum(map(len, asked.values())), []
    for (_, parameter), names in asked.items():
        count = len(names)
        quantile = -special.stdtrit(count - 2, 0.5 * _INFLUENCE.level / questions)
        without = np.array([influence[name][parameter] for name in names])
        value = fit.parameters[parameter]
        # Deviations are relative to the largest parameter of the same unit, since a small modulus contributes little.
        size = max(abs(fit.parameters[name]) for name in influence[names[0]] if fit.units[name] == fit.units[parameter])
        own = count * value - (count - 1) * without
        for i, name in enumerate(names):
            others = np.delete(own, i)
            deviation, scatter = own[i] - others.mean(), others.std(ddof=1) * np.sqrt(1.0 + 1.0 / others.size)
            limit = max(quantile * scatter, _INFLUENCE.min_deviation * size)
            if abs(deviation) > limit and name not in odd:
                odd.append(name)
    return odd


def _is_parameter_changed_above_rounding(value: float, without: float) -> bool:
    """Return whether a parameter without a recording differs from its value by more than rounding (1e-9)."""
    return abs(without - value) > 1e-9 * abs(value)


def fit_displacement_windows(problem: LeastSquaresProblem, theta: np.ndarray) -> list[WindowFit]:
    """Estimate the parameters from the samples up to fractions of the largest displacement, smallest fraction first.

    The last window contains all samples. The list is empty if a test is path-dependent.

    Args:
        problem: least-squares problem.
        theta: unknowns at the minimum, SI, shape (k,).
    """
    if any(test.has_reversals_or_holds for test in problem.tests):
        return []
    free = len(problem.space.free)

    def make_window_record(fraction: float, values: np.ndarray) -> WindowFit:
        """Return the record of a window from its fitted unknowns `values`; nothing is fitted here."""
        return WindowFit(share=fraction, parameters=dict(zip(problem.space.free, values[:free].tolist(), strict=True)))

    found = []
    for fraction in WINDOWS:
        narrow = problem.with_samples_up_to_displacement_fraction(fraction)
        if min(curve.force.size for curve in narrow.measured) < MIN_POINTS or narrow.samples <= theta.size:
            continue
        descent = minimise_from_start(narrow, theta, corrected=True, enough=_INFLUENCE.window_gain,
                                      max_solves=_INFLUENCE.window_solves)
        if descent.converged:
            found.append(make_window_record(fraction, descent.theta))
    return [*found, make_window_record(1.0, theta)]


@dataclass(frozen=True)
class MarginalCovarianceSettings:
    """Settings of the covariance with marginalised nuisances.

    Attributes:
        bound_distance: distance to a bound at which a parameter counts as on the bound, relative to its scale.
        variance_factor: factor of the jitter's variance in the central difference of logarithms. A value nearer to 1
            has more rounding errors, a larger one a larger truncation error.
    """

    bound_distance: float = 1e-6
    variance_factor: float = 1.2


_COVARIANCE = MarginalCovarianceSettings()


def compute_marginal_uncertainty(problem: GeneralisedProblem, evaluation: ProblemEvaluation) -> ParameterUncertainty:
    """Compute the covariance of the parameters at the minimum of the sum of squares.

    With the Jacobian J of the problem after elimination of the nuisances, the covariance is (J'J)^-1, which equals that
    of generalised least squares with the nuisances marginalised. If the residuals exceed the noise, the covariance is
    multiplied by chi-square per degree of freedom. With an estimated jitter the quantiles are those of Student's t.

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.

    Source: Golub and Pereyra, Inverse Problems 19 (2003) R1, section 2; Aitken, Proc. R. Soc. Edinburgh 55 (1935) 42.
    """
    space = problem.space
    _, jacobian = evaluation.projected_residual_and_jacobian
    sizes = problem.compute_unknown_scales(evaluation.theta)
    near = _COVARIANCE.bound_distance * sizes
    on_bound = (evaluation.theta - space.low <= near) | (space.high - evaluation.theta <= near)
    scaled = jacobian * sizes
    information = scaled.T @ scaled
    freedom = max(problem.samples + evaluation.prior_residual.size - len(space.free), 1)
    chi_square = evaluation.penalised_sum_of_squares
    inflation, basis, quantile = 1.0, "noise", np.full(len(space.free), special.ndtri(0.975))
    if chi_square > COVARIANCE.residual_ratio**2 * freedom:
        inflation, basis = chi_square / freedom, "residuals"
    inside = np.flatnonzero(~on_bound)
    covariance = np.zeros_like(information)
    root, undetermined = get_inverse_root_and_undetermined_mask(information[np.ix_(inside, inside)])
    covariance[np.ix_(inside, inside)] = inflation * root @ root.T * np.outer(sizes[inside], sizes[inside])
    errors = np.where(on_bound, np.nan, np.sqrt(np.diag(covariance)))
    errors[inside[undetermined]] = np.inf
    if problem.jitter.freedom and inside.size:
        basis = "residuals" if basis == "residuals" else "replicates"
        quantile[inside] = special.stdtrit(_satterthwaite_degrees_of_freedom(problem, evaluation, sizes, inside), 0.975)
    ratio = float(np.sqrt(np.mean(evaluation.residual**2)))
    # The log determinant is part of the likelihood: it differs between laws with different estimates of the jitter.
    criteria = evaluation.penalised_sum_of_squares + evaluation.covariance_log_determinant, float(problem.samples)
    return ParameterUncertainty(covariance, errors, on_bound, basis, quantile, float(inflation), ratio, criteria, sizes,
                                information)


def _satterthwaite_degrees_of_freedom(problem: GeneralisedProblem, evaluation: ProblemEvaluation, sizes: np.ndarray,
                                      inside: np.ndarray) -> np.ndarray:
    """Return Satterthwaite's degrees of freedom of the parameters' variances for an estimated jitter.

    Each variance component s_k of the jitter has the relative variance 2 / f with its degrees of freedom f. The
    variance v of a parameter has the logarithmic derivatives d ln v / d ln s_k, hence f / sum_k (d ln v / d ln s_k)^2
    degrees of freedom.

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.
        sizes: scales of the parameters, SI, shape (p,).
        inside: indices of the parameters that are not on a bound.

    Returns:
        Degrees of freedom, shape of `inside`.

    Source: Satterthwaite, Biometrics Bulletin 2 (1946) 110, as in Kenward and Roger, Biometrics 53 (1997) 983.
    """
    rates = (evaluation.rates * sizes)[:, inside]
    priors = (evaluation.prior_rates * sizes)[:, inside]
    # The columns of one kind of jitter are every len(kinds)-th of the first columns.
    own = len(problem.places) * len(problem.kinds)

    def compute_scaled_variances(kind: int, factor: float) -> np.ndarray:
        """Return the variances of the scaled parameters with the variance of one kind of jitter times `factor`."""
        columns = evaluation.columns.copy()
        columns[:, kind:own:len(problem.kinds)] *= np.sqrt(factor)
        cross = columns.T @ rates
        absorbed = cross.T @ np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns, cross)
        # The lower limit keeps the logarithm finite in undetermined directions.
        information = rates.T @ rates - absorbed + priors.T @ priors
        return np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 1e-300)

    factor = _COVARIANCE.variance_factor
    slopes = ((np.log(compute_scaled_variances(kind, factor)) - np.log(compute_scaled_variances(kind, 1 / factor)))
              / (2 * np.log(factor)) for kind in range(len(problem.kinds)))
    squares = sum(slope**2 for slope in slopes)
    return problem.jitter.freedom / np.maximum(squares, 1e-9)
