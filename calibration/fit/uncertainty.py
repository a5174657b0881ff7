"""What the minimum of a generalised least-squares problem is worth: the covariance of its parameters."""

from __future__ import annotations

import numpy as np
from scipy import special

from calibration.fit.problem import Evaluation, Problem
from calibration.statistics.uncertainty import RESIDUAL_RATIO, Uncertainty, inverse_root

#: A parameter this near to its bound, relative to its size, is on it.
ON_BOUND = 1e-6
#: Factor of a variance of the jitter for a derivative.
_MORE = 1.2


def assess_uncertainty(problem: Problem, evaluation: Evaluation) -> Uncertainty:
    """The uncertainty of the parameters where the sum of squares is smallest.

    The nuisances are marginalised: the projected Jacobian J holds what they cannot make up for, and the covariance is
    (J'J)^-1. Where the residuals exceed the noise it is multiplied with chi-square per degree of freedom.

    Source: Golub and Pereyra, Inverse Problems 19 (2003) R1, section 2; Aitken's generalised least squares.
    """
    space = problem.space
    _, jacobian = evaluation.projected
    sizes = problem.sizes(evaluation.theta)
    near = ON_BOUND * sizes
    on_bound = (evaluation.theta - space.low <= near) | (space.high - evaluation.theta <= near)
    scaled = jacobian * sizes
    information = scaled.T @ scaled
    freedom = max(problem.samples + evaluation.prior_residual.size - len(space.free), 1)
    chi_square = evaluation.error
    inflation, basis, quantile = 1.0, "noise", np.full(len(space.free), special.ndtri(0.975))
    if chi_square > RESIDUAL_RATIO**2 * freedom:
        inflation, basis = chi_square / freedom, "residuals"
    inside = np.flatnonzero(~on_bound)
    covariance = np.zeros_like(information)
    root, loose = inverse_root(information[np.ix_(inside, inside)])
    covariance[np.ix_(inside, inside)] = inflation * root @ root.T * np.outer(sizes[inside], sizes[inside])
    errors = np.where(on_bound, np.nan, np.sqrt(np.diag(covariance)))
    errors[inside[loose]] = np.inf
    if problem.jitter.freedom and inside.size:
        basis = "residuals" if basis == "residuals" else "replicates"
        quantile[inside] = special.stdtrit(_freedom(problem, evaluation, sizes, inside), 0.975)
    ratio = float(np.sqrt(np.mean(evaluation.residual**2)))
    # Laws may come to another jitter, so that the determinant of the covariance counts.
    criteria = evaluation.error + evaluation.log_determinant, float(problem.samples)
    return Uncertainty(covariance, errors, on_bound, basis, quantile, float(inflation), ratio, criteria, sizes,
                       information)


def _freedom(problem: Problem, evaluation: Evaluation, sizes: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Degrees of freedom of the variances of some parameters where the jitter is an estimate, shape (len(inside),).

    The jitter's variances are known to a relative variance of 2 / freedom each, and a parameter's variance follows them
    by its logarithmic derivative: offsets that the samples tell do not matter.

    Source: Satterthwaite, Biometrics Bulletin 2 (1946) 110, as in Kenward and Roger, Biometrics 53 (1997) 983.
    """
    rates = (evaluation.rates * sizes)[:, inside]
    priors = (evaluation.prior_rates * sizes)[:, inside]
    # The columns of all recordings for one kind of jitter stand at a stride.
    own = len(problem.places) * len(problem.kinds)

    def variances(kind: int, factor: float) -> np.ndarray:
        columns = evaluation.columns.copy()
        columns[:, kind:own:len(problem.kinds)] *= np.sqrt(factor)
        cross = columns.T @ rates
        taken = cross.T @ np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns, cross)
        # A direction that nothing determines has no variance here, and no freedom to be asked for.
        return np.maximum(np.diag(np.linalg.pinv(rates.T @ rates - taken + priors.T @ priors, hermitian=True)), 1e-300)

    squares = sum(((np.log(variances(kind, _MORE)) - np.log(variances(kind, 1 / _MORE))) / (2 * np.log(_MORE)))**2
                  for kind in range(len(problem.kinds)))
    return problem.jitter.freedom / np.maximum(squares, 1e-9)
