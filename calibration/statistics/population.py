"""Specimens as a population: mean and scatter of a material's parameters between specimens that were each measured.

Each specimen's estimate x_i errs by the covariance V_i of its own fit and comes from a population of mean m and scatter
between specimens W: x_i ~ N(m, W + V_i). W and m are estimated by restricted maximum likelihood, which is the Laplace
approximation of the mixed-effects model where each fit is nearly linear; intervals are those of few specimens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from tissue_sim.errors import InputError

#: Fewer specimens than this have no scatter that could be told.
FEWEST_SPECIMENS = 2
LEVEL = 0.95
#: Shares at which the distribution of a spread is taken.
_MIDDLES = (np.arange(400) + 0.5) / 400


@dataclass(frozen=True, eq=False)
class Population:
    """Parameters of a population, of which n specimens were measured, p parameters each.

    Attributes:
        order: names of the parameters. specimens: names of the specimens.
        estimates, errors: of each specimen alone, and their standard errors, shape (n, p).
        mean: of the population, shape (p,). mean_covariance: of its estimate, shape (p, p). mean_intervals: 95 %, shape
            (p, 2). mean_moves: of the mean with the errors that all specimens share, shape (p, h).
        between: covariance between specimens, shape (p, p). spread: its standard deviations, shape (p,).
        spread_intervals: 95 %, shape (p, 2).
        next_specimen: 95 % interval for the parameters of a specimen that was not measured, shape (p, 2).
        shrunken, shrunken_errors: each specimen as it and the others tell it, shape (n, p).
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
                        covariances: np.ndarray, common: np.ndarray | None = None) -> Population:
    """The population from which specimens come that were fitted one by one.

    Args:
        order: names of the parameters. specimens: names.
        estimates: of each specimen, shape (n, p). covariances: of each estimate, shape (n, p, p).
        common: how estimates move with errors that all specimens share, each of a standard deviation of 1, shape (n, p,
            h); these are no part of `covariances`. None: there are none.

    Raises:
        InputError: fewer than two specimens, shapes that do not fit, or a specimen whose parameters are not all
            determined.

    Sources: restricted likelihood, Harville, J. American Statistical Association 72 (1977) 320; interval of the spread,
    Viechtbauer, Statistics in Medicine 26 (2007) 37; of the mean and the next specimen, the same pivot as a generalised
    one, Iyer, Wang and Mathew, J. American Statistical Association 99 (2004) 1060.
    """
    x, V = np.array(estimates, dtype=float), np.array(covariances, dtype=float)
    n, p = len(specimens), len(order)
    if n < FEWEST_SPECIMENS:
        raise InputError(f"{n} specimen says nothing about the scatter between specimens; give at least "
                         f"{FEWEST_SPECIMENS}", field="specimen")
    if x.shape != (n, p) or V.shape != (n, p, p):
        raise InputError(f"shapes {x.shape} and {V.shape}, expected {(n, p)} and {(n, p, p)}", field="estimates")
    variances = np.diagonal(V, axis1=1, axis2=2)
    if not (np.isfinite(x).all() and np.isfinite(V).all() and (variances > 0).all()):
        first = int(np.argmin((np.isfinite(x) & np.isfinite(variances) & (variances > 0)).all(axis=1)))
        raise InputError(f"the fit of {specimens[first]} does not determine {', '.join(order)}", field="specimen")
    # In units of each parameter's own size: moduli in Pa and exponents stand beside each other.
    scale = np.sqrt(np.mean(x**2, axis=0) + variances.mean(axis=0))
    x, V = x / scale, V / np.outer(scale, scale)
    shared = np.zeros((n, p, 0)) if common is None else np.asarray(common) / scale[:, None]
    W = _between(x, V)
    total = np.linalg.inv(W + V)
    mean_covariance = np.linalg.inv(total.sum(axis=0))
    mean = mean_covariance @ np.einsum("npq,nq->p", total, x)
    moved = mean_covariance @ np.einsum("npq,nqh->ph", total, shared)
    together = moved @ moved.T
    variances, spread = np.diagonal(V, axis1=1, axis2=2), np.sqrt(np.diag(W))
    intervals = [_intervals(x[:, j], variances[:, j], together[j, j]) for j in range(p)]
    mean_intervals, spread_intervals, next_specimen = (np.array([each[k] for each in intervals]) for k in range(3))
    gain = W @ total
    shrunken = mean + np.einsum("npq,nq->np", gain, x - mean)
    # That of the mean's own error is in it.
    left = np.eye(p) - gain
    theirs = gain @ shared + left @ moved
    shrunken_variances = np.diagonal(W - gain @ W + left @ mean_covariance @ left.transpose(0, 2, 1)
                                     + theirs @ theirs.transpose(0, 2, 1), axis1=1, axis2=2)
    both = scale[:, None]
    return Population(
        tuple(order), tuple(specimens), x * scale, np.sqrt(variances + np.sum(shared**2, axis=2)) * scale, mean * scale,
        (mean_covariance + together) * np.outer(scale, scale), mean_intervals * both, moved * both,
        W * np.outer(scale, scale), spread * scale, spread_intervals * both, next_specimen * both, shrunken * scale,
        np.sqrt(np.maximum(shrunken_variances, 0.0)) * scale)


def _between(x: np.ndarray, V: np.ndarray) -> np.ndarray:
    """Covariance between specimens by restricted maximum likelihood.

    Over a triangular root of it, which makes it a covariance whatever the root is.
    """
    p = x.shape[1]
    lower = np.tril_indices(p)

    def twice_unlikely(entries):
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
    found = optimize.minimize(twice_unlikely, np.linalg.cholesky(scatter)[lower], jac=True, method="L-BFGS-B",
                              options={"ftol": 1e-13, "gtol": 1e-9, "maxiter": 1000})
    root = np.zeros((p, p))
    root[lower] = found.x
    return root @ root.T


def _intervals(x: np.ndarray, v: np.ndarray, together: float):
    """Interval of the mean, of the spread and of the next specimen; of one parameter.

    The squares of x about their mean, weighted with the true spread, are chi-square distributed: that inverted is a
    distribution of the spread, and the mean and the next specimen are normal at each of its values.

    Args:
        x, v: estimates and their variances, shape (n,). together: variance of the mean by what all share.
    """
    low, high = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    # The squares fall as the spread grows, so the ends change places.
    ends = tuple(_spread_at(x, v, float(special.chdtri(x.size - 1, 1 - share))) for share in (high, low))
    spread = np.array([_spread_at(x, v, wanted) for wanted in special.chdtri(x.size - 1, 1 - _MIDDLES)])
    weight = 1.0 / (v + spread[:, None]**2)
    centre, variance = weight @ x / weight.sum(axis=1), 1.0 / weight.sum(axis=1) + together
    mean, following = (tuple(_quantile(centre, np.sqrt(variances), share) for share in (low, high))
                       for variances in (variance, variance + spread**2))
    return mean, ends, following


def _quantile(centres: np.ndarray, deviations: np.ndarray, share: float) -> float:
    """Of normal distributions mixed in equal parts."""
    reach = 40.0 * deviations.max() + np.ptp(centres)
    return float(optimize.brentq(lambda value: special.ndtr((value - centres) / deviations).mean() - share,
                                 centres.min() - reach, centres.max() + reach))


def _spread_at(x: np.ndarray, v: np.ndarray, wanted: float) -> float:
    """Spread at which the weighted squares of x about their mean are `wanted`; 0 where they are less without any."""
    def squares(variance: float) -> float:
        weight = 1.0 / (v + variance)
        return float(np.sum(weight * (x - np.sum(weight * x) / np.sum(weight))**2))

    if squares(0.0) <= wanted:
        return 0.0
    # The squares are at most those about the plain mean, over this variance.
    top = float(np.sum((x - x.mean())**2)) / wanted
    return float(np.sqrt(optimize.brentq(lambda variance: squares(variance) - wanted, 0.0, top, xtol=1e-14 * top)))
