"""Covariance of the parameters of a generalised least-squares problem, with the nuisances marginalised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.statistics.uncertainty import COVARIANCE, ParameterUncertainty, get_inverse_root_and_undetermined_mask


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


_SETTINGS = MarginalCovarianceSettings()


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
    near = _SETTINGS.bound_distance * sizes
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

    factor = _SETTINGS.variance_factor
    slopes = ((np.log(compute_scaled_variances(kind, factor)) - np.log(compute_scaled_variances(kind, 1 / factor)))
              / (2 * np.log(factor)) for kind in range(len(problem.kinds)))
    squares = sum(slope**2 for slope in slopes)
    return problem.jitter.freedom / np.maximum(squares, 1e-9)
