"""Population of specimens: mean and between-specimen covariance of material parameters (random-effects model).

The estimate x_i of specimen i has the covariance V_i of its fit, and the specimens come from a population with mean
m and between-specimen covariance W: x_i ~ N(m, W + V_i). Restricted maximum likelihood estimates W and m, which is the
Laplace approximation of the nonlinear mixed-effects model if each fit is nearly linear. The intervals are valid for few
specimens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from tissue_sim.errors import InputError


@dataclass(frozen=True)
class PopulationSettings:
    """Settings of the population of specimens.

    Attributes:
        min_specimens: smallest number of specimens for an estimate of the between-specimen covariance.
        level: confidence level of the intervals.
    """

    min_specimens: int = 2
    level: float = 0.95


POPULATION = PopulationSettings()
#: Probabilities at which the distribution of a spread is tabulated: midpoints of 400 equal cells.
_PROBABILITIES = (np.arange(400) + 0.5) / 400


@dataclass(frozen=True, eq=False)
class PopulationEstimate:
    """Estimated population of p parameters from n specimens.

    Attributes:
        order: names of the parameters.
        specimens: names of the specimens.
        estimates: estimates of each specimen alone, shape (n, p).
        errors: standard errors of `estimates`, shape (n, p).
        mean: population mean, shape (p,).
        mean_covariance: covariance of the estimated mean, shape (p, p).
        mean_intervals: 95 % intervals of the mean, shape (p, 2).
        mean_moves: change of the mean per standard deviation of each error that all specimens share, shape (p, h).
        between: between-specimen covariance W, shape (p, p).
        spread: between-specimen standard deviations, shape (p,).
        spread_intervals: 95 % intervals of the spread, shape (p, 2).
        next_specimen: 95 % prediction intervals of the parameters of a further specimen, shape (p, 2).
        shrunken: best linear predictions of the specimens' parameters (shrinkage estimates), shape (n, p).
        shrunken_errors: standard errors of `shrunken`, shape (n, p).
    """

    order: tuple[str, ...]
    specimens: tuple[str, ...]
    estimates: np.ndarray
    errors: np.ndarray
    mean: np.ndarray
    mean_covariance: np.ndarray
    mean_intervals: np.ndarray
    mean_moves: np.ndarray
    between: np.ndarray
    spread: np.ndarray
    spread_intervals: np.ndarray
    next_specimen: np.ndarray
    shrunken: np.ndarray
    shrunken_errors: np.ndarray

    @property
    def mean_errors(self) -> np.ndarray:
        """Standard errors of the mean, shape (p,)."""
        return np.sqrt(np.diag(self.mean_covariance))


def estimate_population(order: Sequence[str], specimens: Sequence[str], estimates: np.ndarray,
                        covariances: np.ndarray, common: np.ndarray | None = None) -> PopulationEstimate:
    """Estimate the population of specimens that were fitted individually.

    With the weights Omega_i = (W + V_i)^-1 the mean is m = (sum Omega_i)^-1 sum Omega_i x_i. The shrinkage estimate of
    specimen i is m + W Omega_i (x_i - m).

    Args:
        order: names of the p parameters.
        specimens: names of the n specimens.
        estimates: estimates of each specimen, shape (n, p).
        covariances: covariance of each estimate, shape (n, p, p).
        common: change of the estimates per standard deviation of each of h errors that all specimens share, shape
            (n, p, h); not included in `covariances`. None: no shared errors.

    Raises:
        InputError: fewer than two specimens, arrays of wrong shape, or a specimen with undetermined parameters.

    Source: Harville, J. American Statistical Association 72 (1977) 320 (restricted likelihood); Viechtbauer, Statistics
    in Medicine 26 (2007) 37 (interval of the spread); Iyer, Wang and Mathew, J. American Statistical Association 99
    (2004) 1060 (generalised pivot for the mean and a further specimen).
    """
    x, V = np.array(estimates, dtype=float), np.array(covariances, dtype=float)
    n, p = len(specimens), len(order)
    if n < POPULATION.min_specimens:
        raise InputError(f"a population must have at least {POPULATION.min_specimens} specimens; got {n}. Add "
                         "specimens, or fit the specimens without a population", field="specimen")
    if x.shape != (n, p) or V.shape != (n, p, p):
        raise InputError(f"estimates and covariances must have the shapes {(n, p)} and {(n, p, p)}; got {x.shape} and "
                         f"{V.shape}", field="estimates")
    variances = np.diagonal(V, axis1=1, axis2=2)
    determined = np.isfinite(x) & np.isfinite(V).all(axis=2) & (variances > 0)
    if not determined.all():
        first = int(np.argmin(determined.all(axis=1)))
        undetermined = ", ".join(name for name, known in zip(order, determined[first], strict=True) if not known)
        raise InputError(f"the fit of {specimens[first]} must determine {undetermined}; got no finite estimate with a "
                         "positive variance. Leave the specimen out, or fix these parameters", field="specimen")
    # Scaled to the size of each parameter: moduli in Pa and exponents differ by orders of magnitude.
    scale = np.sqrt(np.mean(x**2, axis=0) + variances.mean(axis=0))
    x, V = x / scale, V / np.outer(scale, scale)
    shared = np.zeros((n, p, 0)) if common is None else np.asarray(common) / scale[:, None]
    W = _estimate_between_covariance_by_reml(x, V)
    total = np.linalg.inv(W + V)
    mean_covariance = np.linalg.inv(total.sum(axis=0))
    mean = mean_covariance @ np.einsum("npq,nq->p", total, x)
    moved = mean_covariance @ np.einsum("npq,nqh->ph", total, shared)
    together = moved @ moved.T
    variances, spread = np.diagonal(V, axis1=1, axis2=2), np.sqrt(np.diag(W))
    intervals = [_compute_intervals_of_one_parameter(x[:, j], variances[:, j], together[j, j]) for j in range(p)]
    mean_intervals, spread_intervals, next_specimen = (np.array([each[k] for each in intervals]) for k in range(3))
    gain = W @ total
    shrunken = mean + np.einsum("npq,nq->np", gain, x - mean)
    # Prediction error variance, including the error of the estimated mean.
    remainder = np.eye(p) - gain
    common_error = gain @ shared + remainder @ moved
    shrunken_variances = np.diagonal(W - gain @ W + remainder @ mean_covariance @ remainder.transpose(0, 2, 1)
                                     + common_error @ common_error.transpose(0, 2, 1), axis1=1, axis2=2)
    both = scale[:, None]
    return PopulationEstimate(
        tuple(order), tuple(specimens), x * scale, np.sqrt(variances + np.sum(shared**2, axis=2)) * scale, mean * scale,
        (mean_covariance + together) * np.outer(scale, scale), mean_intervals * both, moved * both,
        W * np.outer(scale, scale), spread * scale, spread_intervals * both, next_specimen * both, shrunken * scale,
        np.sqrt(np.maximum(shrunken_variances, 0.0)) * scale)


def _estimate_between_covariance_by_reml(x: np.ndarray, V: np.ndarray) -> np.ndarray:
    """Estimate the between-specimen covariance W by restricted maximum likelihood, shape (p, p).

    The unknowns are the entries of a lower triangular L with W = L L', so that W is positive semidefinite.

    Args:
        x: scaled estimates, shape (n, p).
        V: scaled covariances, shape (n, p, p).
    """
    p = x.shape[1]
    lower = np.tril_indices(p)

    def evaluate_reml_criterion_and_gradient(entries):
        """Return -2 log restricted likelihood, up to a constant, and its gradient with respect to the entries of L."""
        root = np.zeros((p, p))
        root[lower] = entries
        total = np.linalg.inv(root @ root.T + V)
        of_all = total.sum(axis=0)
        of_mean = np.linalg.inv(of_all)
        weighted = np.einsum("npq,nq->np", total, x - of_mean @ np.einsum("npq,nq->p", total, x))
        value = np.linalg.slogdet(of_all)[1] - np.linalg.slogdet(total)[1].sum() + np.sum(
            weighted * np.linalg.solve(total, weighted[..., None])[..., 0])
        slope = of_all - (total @ of_mean @ total).sum(axis=0) - weighted.T @ weighted
        return value, (2 * slope @ root)[lower]

    scatter = np.cov(x, rowvar=False).reshape(p, p) + V.mean(axis=0)
    start = np.linalg.cholesky(scatter)[lower]
    found = optimize.minimize(evaluate_reml_criterion_and_gradient, start, jac=True, method="L-BFGS-B",
                              options={"ftol": 1e-13, "gtol": 1e-9, "maxiter": 1000})
    root = np.zeros((p, p))
    root[lower] = found.x
    return root @ root.T


def _compute_intervals_of_one_parameter(x: np.ndarray, v: np.ndarray, together: float):
    """Return three 95 % intervals for one parameter: of the mean, of the spread, and of a further specimen.

    For the true spread s the statistic Q(s) = sum w_i (x_i - m)^2 with w_i = 1 / (v_i + s^2) is chi-square distributed
    with n - 1 degrees of freedom. Its inversion gives a generalised fiducial distribution of s; given s, the mean and a
    further specimen are normally distributed.

    Args:
        x: estimates, shape (n,).
        v: variances of the estimates, shape (n,).
        together: variance of the mean by errors that all specimens share.
    """
    low, high = (1 - POPULATION.level) / 2, (1 + POPULATION.level) / 2
    # Q decreases with the spread, so the upper quantile of Q gives the lower end.
    ends = tuple(_solve_spread_for_q_statistic(x, v, float(special.chdtri(x.size - 1, 1 - level)))
                 for level in (high, low))
    spread = np.array([_solve_spread_for_q_statistic(x, v, statistic)
                       for statistic in special.chdtri(x.size - 1, 1 - _PROBABILITIES)])
    weight = 1.0 / (v + spread[:, None]**2)
    centre, variance = weight @ x / weight.sum(axis=1), 1.0 / weight.sum(axis=1) + together
    mean, following = (tuple(_compute_normal_mixture_quantile(centre, np.sqrt(variances), level)
                             for level in (low, high))
                       for variances in (variance, variance + spread**2))
    return mean, ends, following


def _compute_normal_mixture_quantile(centres: np.ndarray, deviations: np.ndarray, level: float) -> float:
    """Return the quantile of a mixture of normal distributions with equal weights.

    Args:
        centres: means of the distributions, shape (k,).
        deviations: standard deviations, shape (k,).
        level: probability of the quantile.
    """
    reach = 40.0 * deviations.max() + np.ptp(centres)
    return float(optimize.brentq(lambda value: special.ndtr((value - centres) / deviations).mean() - level,
                                 centres.min() - reach, centres.max() + reach))


def _solve_spread_for_q_statistic(x: np.ndarray, v: np.ndarray, statistic: float) -> float:
    """Return the spread s at which the statistic Q(s) has a value; 0 if Q(0) is smaller.

    For Q(s) see `_compute_intervals_of_one_parameter`.

    Args:
        x: estimates, shape (n,).
        v: variances of the estimates, shape (n,).
        statistic: value of Q.
    """
    def evaluate_q_statistic_at_variance(variance: float) -> float:
        """Return Q for a between-specimen variance s^2."""
        weight = 1.0 / (v + variance)
        return float(np.sum(weight * (x - np.sum(weight * x) / np.sum(weight))**2))

    if evaluate_q_statistic_at_variance(0.0) <= statistic:
        return 0.0
    # Upper bound: Q(s) <= sum (x_i - mean(x))^2 / s^2.
    top = float(np.sum((x - x.mean())**2)) / statistic
    return float(
        np.sqrt(optimize.brentq(lambda variance: evaluate_q_statistic_at_variance(variance) - statistic, 0.0, top,
                                xtol=1e-14 * top)))
