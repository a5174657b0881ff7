"""What the minimum is worth: covariance of the parameters, and how far their profiles rise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibration.inverse_fem.problem import Evaluation, Problem
from calibration.statistics import RESIDUAL_RATIO

#: A parameter this near to its bound, relative to its size, is on it.
ON_BOUND = 1e-6
#: A direction whose scaled information is below this share of the largest is not determined.
SINGULAR = 1e-14


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Generalised least squares at the minimum; what a bound holds counts as fixed.

    Attributes:
        covariance: of the free parameters, SI, shape (p, p); zero beside those on a bound.
        standard_errors: shape (p,); NaN on a bound, inf in a direction that nothing determines.
        on_bound: shape (p,), bool.
        basis: ``"noise"``, ``"residuals"`` (they exceed the noise) or ``"replicates"`` (the jitter is estimated).
        quantile: half width of a 95 % interval in standard errors.
        inflation: factor of all variances because the residuals exceed the noise, at least 1.
        ratio: root mean square of the whitened residuals.
        sizes: whole changes of the parameters, see `ParameterSpace.sizes`, shape (p,).
        information: of the parameters in units of their sizes, shape (p, p).
    """

    covariance: np.ndarray
    standard_errors: np.ndarray
    on_bound: np.ndarray
    basis: str
    quantile: float
    inflation: float
    ratio: float
    sizes: np.ndarray
    information: np.ndarray


def assess_uncertainty(problem: Problem, evaluation: Evaluation) -> Uncertainty:
    """The uncertainty of the parameters where the sum of squares is smallest.

    The nuisances are marginalised: the projected Jacobian J holds what they cannot make up for, and the covariance is
    (J'J)^-1. Where the residuals exceed the noise it is multiplied with chi-square per degree of freedom.

    Source: Golub and Pereyra, Inverse Problems 19 (2003) R1, section 2; Aitken's generalised least squares.
    """
    space = problem.space
    _, jacobian = evaluation.projected
    sizes = space.sizes(space.values(evaluation.theta))
    near = ON_BOUND * sizes
    on_bound = (evaluation.theta - space.low <= near) | (space.high - evaluation.theta <= near)
    scaled = jacobian * sizes
    information = scaled.T @ scaled
    freedom = max(problem.samples + evaluation.prior_residual.size - len(space.free), 1)
    chi_square = evaluation.error
    inflation, basis, quantile = 1.0, "noise", stats.norm.ppf(0.975)
    if problem.jitter.freedom:
        basis, quantile = "replicates", stats.t.ppf(0.975, problem.jitter.freedom)
    if chi_square > RESIDUAL_RATIO**2 * freedom:
        inflation, basis = chi_square / freedom, "residuals"
    inside = np.flatnonzero(~on_bound)
    covariance = np.zeros_like(information)
    errors = np.where(on_bound, np.nan, 0.0)
    if inside.size:
        values, vectors = np.linalg.eigh(information[np.ix_(inside, inside)])
        flat = values <= SINGULAR * max(values.max(), 1e-300)
        root = vectors[:, ~flat] / np.sqrt(values[~flat])
        own = inflation * root @ root.T * np.outer(sizes[inside], sizes[inside])
        covariance[np.ix_(inside, inside)] = own
        errors[inside] = np.sqrt(np.diag(own))
        loose = (np.abs(vectors[:, flat]) > 0.1).any(axis=1) if flat.any() else np.zeros(inside.size, bool)
        errors[inside[loose]] = np.inf
    ratio = float(np.sqrt(np.mean(evaluation.residual**2)))
    return Uncertainty(covariance, errors, on_bound, basis, float(quantile), float(inflation), ratio, sizes,
                       information)
