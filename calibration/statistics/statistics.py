"""Noise, covariance, intervals and information criteria of a least-squares fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats
from scipy.sparse import csr_array

#: Residuals this many times the stated noise mean that the model, not the sensor, makes the error.
MODEL_ERROR_RATIO = 3.0
#: Residuals this many times an estimated noise mean that it was the curvature of the data, not noise.
CURVATURE_RATIO = 0.3
#: Residuals this many times the noise are not the noise any more, and the standard errors follow them.
RESIDUAL_RATIO = 1.1
#: Fewer replicates than this say nothing about their own scatter.
FEWEST_REPLICATES = 3
#: A scaled Hessian with a larger condition number has a direction that the data do not determine.
SINGULAR_CONDITION = 1e14
#: How each replicate's points come from its samples, shape (points, samples); None: they are its samples.
Interpolations = Sequence[csr_array | None]


def estimate_noise(samples: np.ndarray, abscissa: np.ndarray | None = None) -> float:
    """Standard deviation of white noise on a smooth curve, from each sample's distance to the line of its neighbours.

    The median keeps jumps out. The line is drawn over the number of the sample and over the abscissa, and the smaller
    estimate counts: uneven steps make the first too large, an abscissa of coarse steps the second. The floor is the
    resolution of floating point, so that exact synthetic data do not give zero. On a coarse curve the curvature counts
    as noise.

    Args:
        samples: values in order, shape (n,), n >= 3.
        abscissa: where they were taken, shape (n,); None: at even steps.

    Source: Gasser, Sroka, Jennen-Steinmetz, Biometrika 73 (1986) 625, pseudo-residuals.
    """
    shares = [np.full(samples.size - 2, 0.5)]
    if abscissa is not None:
        span, step = abscissa[2:] - abscissa[:-2], abscissa[1:-1] - abscissa[:-2]
        share = np.divide(step, span, out=np.full(span.size, 0.5), where=span != 0)
        shares.append(np.where((share >= 0) & (share <= 1), share, 0.5))
    deviations = []
    for share in shares:
        distance = samples[1:-1] - (1 - share) * samples[:-2] - share * samples[2:]
        distance /= np.sqrt(1 + (1 - share)**2 + share**2)
        deviations.append(np.median(np.abs(distance)) / stats.norm.ppf(0.75))
    return float(max(min(deviations), 1e-9 * np.abs(samples).max(), np.finfo(float).tiny))


def resolution(samples: np.ndarray) -> float:
    """Step of a quantised signal, in the unit of the samples; 0 where no step shows.

    The smallest difference that repeats is the step when every difference is a whole multiple of it and more than one
    multiple occurs. Its rounding error has the standard deviation step/sqrt(12), which second differences miss where
    neighbouring samples are mostly equal.

    Source: Bennett, Bell System Technical Journal 27 (1948) 446.
    """
    differences = np.abs(np.diff(samples))
    rounding = 8 * np.finfo(float).eps * np.abs(samples).max()
    sizes = np.sort(differences[differences > rounding])
    repeats = np.diff(sizes) <= rounding + 1e-6 * sizes[:-1]
    if not repeats.any():
        return 0.0
    step = float(sizes[np.argmax(repeats)])
    multiples = differences / step
    whole = np.round(multiples)
    return step if np.abs(multiples - whole).max() < 1e-3 and np.unique(whole).size > 1 else 0.0


def pooled_noise(noise: np.ndarray, replicate: np.ndarray) -> float:
    """One standard deviation for all samples: the root mean square over them.

    Args:
        noise: of each replicate, shape (R,). replicate: index of the replicate of each sample, shape (n,).
    """
    return float(np.sqrt(np.mean(np.asarray(noise)[replicate]**2)))


def effective_samples(interpolation: csr_array | None, points: int) -> tuple[float, float]:
    """Independent samples that interpolated points are worth, and the share of the noise's variance that they keep.

    Points between the same samples repeat each other, and a point between two samples averages them. With C = W W':
    (tr C)^2 / tr(C^2), and tr(C) / points.

    Source: Bayley and Hammersley, Supplement to the J. of the Royal Statistical Society 8 (1946) 184.
    """
    if interpolation is None:
        return float(points), 1.0
    covariance = interpolation @ interpolation.T
    trace = float(covariance.trace())
    return trace**2 / float(covariance.multiply(covariance).sum()), trace / points


def chi_square(residual: np.ndarray, replicate: np.ndarray, noise: np.ndarray,
               interpolations: Interpolations | None = None) -> tuple[float, float]:
    """Sum of squares of the residuals in units of their noise, and the number of independent samples in it.

    Args:
        residual: model minus data, Pa, shape (n,). replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation of each replicate's samples, Pa, shape (R,).
        interpolations: of each replicate; None: every point is a sample.
    """
    total = samples = 0.0
    for i, deviation in enumerate(noise):
        mine = residual[replicate == i]
        count, kept = effective_samples(None if interpolations is None else interpolations[i], mine.size)
        total += float(mine @ mine) / (deviation**2 * kept) * count / mine.size
        samples += count
    return float(total), float(samples)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the free unknowns and what it rests on.

    Attributes:
        covariance: shape (k, k).
        basis: ``"noise"`` (as stated), ``"residuals"`` (they exceed the noise) or ``"replicates"`` (their scatter).
        quantile: half width of a 95 % interval in standard errors.
        singular: unknowns that take part in a direction which the data do not determine, bool, shape (k,).
    """

    covariance: np.ndarray
    basis: str
    quantile: float
    singular: np.ndarray

    @property
    def standard_errors(self) -> np.ndarray:
        """Infinite where singular, shape (k,)."""
        errors = np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))
        return np.where(self.singular, np.inf, errors)


def uncertainty(jacobian: np.ndarray, residual: np.ndarray, replicate: np.ndarray, noise: np.ndarray | float,
                prior_precision: np.ndarray, jitter: np.ndarray | None = None,
                interpolations: Interpolations | None = None) -> Uncertainty:
    """Sandwich covariance of an unweighted least-squares estimate with priors, at its minimum.

    cov = A^-1 M A^-1 with A = J'J + s^2 P and M the variance of the gradient. Samples count with the noise of their
    own replicate, or with its residuals where these exceed the noise. Samples of one replicate err together: with
    stated jitter M holds that too; otherwise, from `FEWEST_REPLICATES` replicates on, M is the larger of this and of
    the scatter of the replicates' own gradients. Unknowns on a bound do not belong in here.

    Args:
        jacobian: d(stress)/d(unknown), shape (n, k).
        residual: model minus data, Pa, shape (n,).
        replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation of the samples of each replicate, Pa, shape (R,), or of all; s is their pooled value.
        prior_precision: 1/variance of each prior, 0 without, shape (k,).
        jitter: stress that one standard deviation of jitter makes, Pa, shape (n, number of kinds of jitter): applied
            to each replicate independently; no columns where fitted offsets carry it; None where none is stated.
        interpolations: of each replicate; None: every point is a sample.

    Source: Huber's sandwich with clusters, Liang and Zeger, Biometrika 73 (1986) 13; R/(R-1) for few clusters.
    """
    unknowns, count = jacobian.shape[1], int(replicate.max()) + 1
    noise = np.broadcast_to(np.asarray(noise, dtype=float), count)
    parts = [replicate == i for i in range(count)]
    weight = pooled_noise(noise, replicate)**2
    squares, samples = chi_square(residual, replicate, noise, interpolations)
    freedom = max(samples - unknowns, 1.0)
    basis, quantile, deviations = "noise", stats.norm.ppf(0.975), noise
    if squares > RESIDUAL_RATIO**2 * freedom:
        basis, quantile = "residuals", stats.t.ppf(0.975, freedom)
        own = np.array([chi_square(residual[part], np.zeros(part.sum(), int), noise[i:i + 1],
                                   None if interpolations is None else interpolations[i:i + 1])
                        for i, part in enumerate(parts)])
        deviations = noise * np.sqrt(np.maximum(own[:, 0] / own[:, 1] * samples / freedom, 1.0))
    spread = weight**2 * np.diag(prior_precision)
    for i, part in enumerate(parts):
        columns = jacobian[part]
        if interpolations is not None and interpolations[i] is not None:
            columns = interpolations[i].T @ columns
        spread = spread + deviations[i]**2 * columns.T @ columns
    for column in () if jitter is None else jitter.T:
        gradients = np.stack([jacobian[part].T @ column[part] for part in parts])
        spread = spread + gradients.T @ gradients

    root, singular = _inverse_root(jacobian.T @ jacobian + weight * np.diag(prior_precision))
    spread = root.T @ spread @ root
    if jitter is None and count >= FEWEST_REPLICATES and root.shape[1]:
        scores = _own_scores(jacobian, residual, parts) @ root
        spread = _larger(count / (count - 1) * scores.T @ scores, spread)
        basis, quantile = "replicates", stats.t.ppf(0.975, count - 1)
    # As a square, so that it is symmetric and positive semi-definite to the last digit.
    weights, axes = np.linalg.eigh(spread)
    half = root @ (axes * np.sqrt(np.clip(weights, 0.0, None)))
    return Uncertainty(half @ half.T, basis, float(quantile), singular)


def _inverse_root(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T with T T' the inverse of the Hessian, without the directions that nothing determines, and who is in those."""
    # Scaled to a unit diagonal, so that Pa beside exponents does not look singular.
    scale = np.sqrt(np.diag(hessian))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    flat = values <= values.max(initial=0.0) / SINGULAR_CONDITION
    singular = (np.abs(vectors[:, flat]) > 0.1).any(axis=1) if flat.any() else np.zeros(scale.size, bool)
    return vectors[:, ~flat] / np.sqrt(values[~flat]) / scale[:, None], singular


def _own_scores(jacobian: np.ndarray, residual: np.ndarray, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Gradient of each replicate with its share of the priors' gradient, shape (R, k).

    At a minimum the priors balance the data, so their gradient is known from the data's. A replicate carries as much
    of it as it has information: all of it for its own offset, an equal part for what equal replicates share.
    """
    scores = np.stack([jacobian[part].T @ residual[part] for part in parts])
    information = np.stack([np.sum(jacobian[part]**2, axis=0) for part in parts])
    total = information.sum(axis=0)
    shares = np.divide(information, total, out=np.zeros_like(information), where=total > 0)
    return scores - shares * scores.sum(axis=0)


def _larger(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The larger of two variances in each of their common principal directions; `other` is positive definite."""
    ratios, axes = linalg.eigh(one, other)
    dual = other @ axes
    return (dual * np.maximum(ratios, 1.0)) @ dual.T


def information_criteria(squares: float, samples: float, unknowns: int) -> tuple[float, float]:
    """AIC and BIC with the noise known: chi-square plus 2 k, plus k ln n.

    Args:
        squares: chi-square of the residuals, and of the priors where there are any: the likelihood is penalised then.
        samples: number of independent ones, n. unknowns: number of free ones, k.

    Source: Burnham and Anderson, Model Selection and Multimodel Inference, 2002, sections 2.2 and 6.4.
    """
    return squares + 2.0 * unknowns, squares + unknowns * float(np.log(samples))


def r_squared(data: np.ndarray, residual: np.ndarray) -> float:
    """Coefficient of determination about the mean of the data."""
    return 1.0 - float(residual @ residual / np.sum((data - data.mean())**2))


def correlation(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix; zero beside unknowns without variance, 1 on the diagonal."""
    deviation = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    outer = np.outer(deviation, deviation)
    result = np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0)
    np.fill_diagonal(result, 1.0)
    return np.clip(result, -1.0, 1.0)
