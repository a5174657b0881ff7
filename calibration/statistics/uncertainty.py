"""What an estimate is worth: the covariance of its unknowns, whatever weights they were fitted with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from calibration.statistics.statistics import Interpolations, chi_square, pooled_noise

#: Residuals this many times the noise are not the noise any more, and the standard errors follow them.
RESIDUAL_RATIO = 1.1
#: Fewer replicates than this say nothing about their own scatter.
FEWEST_REPLICATES = 3
#: A scaled Hessian with a larger condition number has a direction that the data do not determine.
SINGULAR_CONDITION = 1e14


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the free unknowns and what it rests on; what a bound holds counts as fixed.

    Attributes:
        covariance: SI, shape (k, k); zero beside those on a bound.
        standard_errors: shape (k,); NaN on a bound, inf in a direction that nothing determines.
        on_bound: shape (k,), bool.
        basis: ``"noise"`` (as stated), ``"residuals"`` (they exceed it) or ``"replicates"`` (their scatter).
        quantile: half widths of the 95 % intervals in standard errors, shape (k,).
        inflation: factor of all variances because the residuals exceed the noise, at least 1.
        ratio: root mean square of the residuals, each in units of its noise.
        criteria: sum of squares and number of independent samples of `information_criteria`.
        sizes: whole changes of the unknowns, shape (k,). information: of the unknowns in units of these, shape (k, k).
    """

    covariance: np.ndarray
    standard_errors: np.ndarray
    on_bound: np.ndarray
    basis: str
    quantile: np.ndarray
    inflation: float
    ratio: float
    criteria: tuple[float, float]
    sizes: np.ndarray
    information: np.ndarray


def sandwich(jacobian: np.ndarray, residual: np.ndarray, replicate: np.ndarray, noise: np.ndarray | float,
             prior_precision: np.ndarray, jitter: np.ndarray | None = None,
             interpolations: Interpolations | None = None, on_bound: np.ndarray | None = None,
             repeats: float = 1.0) -> Uncertainty:
    """Sandwich covariance of an unweighted least-squares estimate with priors, at its minimum.

    cov = A^-1 M A^-1 with A = J'J + s^2 P and M the variance of the gradient. Samples count with the noise of their
    own replicate, or with its residuals where these exceed the noise. Samples of one replicate err together: with
    stated jitter M holds that too; otherwise, from `FEWEST_REPLICATES` replicates on, M is the larger of this and of
    the scatter of the replicates' own gradients.

    Args:
        jacobian: d(stress)/d(unknown), shape (n, k).
        residual: model minus data, Pa, shape (n,).
        replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation of the samples of each replicate, Pa, shape (R,), or of all; s is their pooled value.
        prior_precision: 1/variance of each prior, 0 without, shape (k,).
        jitter: stress that one standard deviation of jitter makes, Pa, shape (n, number of kinds of jitter): applied
            to each replicate independently; no columns where fitted offsets carry it; None where none is stated.
        interpolations: of each replicate; None: every point is a sample.
        on_bound: unknowns that count as fixed, bool, shape (k,); None: none.
        repeats: samples that say the same, where smooth residuals exceed the noise: a factor of their variance.

    Source: Huber's sandwich with clusters, Liang and Zeger, Biometrika 73 (1986) 13; R/(R-1) for few clusters.
    """
    on_bound = np.zeros(jacobian.shape[1], bool) if on_bound is None else on_bound
    inside = ~on_bound
    jacobian, prior_precision = jacobian[:, inside], np.asarray(prior_precision)[inside]
    unknowns, count = jacobian.shape[1], int(replicate.max()) + 1
    noise = np.broadcast_to(np.asarray(noise, dtype=float), count)
    parts = [replicate == i for i in range(count)]
    weight = pooled_noise(noise, replicate)**2
    squares, samples = chi_square(residual, replicate, noise, interpolations)
    freedom = max(samples - unknowns, 1.0)
    basis, quantile, deviations = "noise", special.ndtri(0.975), noise
    if squares > RESIDUAL_RATIO**2 * freedom:
        basis, quantile = "residuals", special.stdtrit(freedom, 0.975)
        own = np.array([chi_square(residual[part], np.zeros(part.sum(), int), noise[i:i + 1],
                                   None if interpolations is None else interpolations[i:i + 1])
                        for i, part in enumerate(parts)])
        deviations = noise * np.sqrt(repeats * np.maximum(own[:, 0] / own[:, 1] * samples / freedom, 1.0))
    spread = weight**2 * np.diag(prior_precision)
    for i, part in enumerate(parts):
        columns, interpolation = jacobian[part], None if interpolations is None else interpolations[i]
        if interpolation is not None:
            columns = interpolation.T @ columns
        spread = spread + deviations[i]**2 * columns.T @ columns
    for column in () if jitter is None else jitter.T:
        gradients = np.stack([jacobian[part].T @ column[part] for part in parts])
        spread = spread + gradients.T @ gradients

    hessian = jacobian.T @ jacobian + weight * np.diag(prior_precision)
    # Scaled to a unit diagonal, so that Pa beside exponents does not look singular.
    scale = np.sqrt(np.diag(hessian))
    scale = np.where(scale > 0, scale, 1.0)
    root, singular = inverse_root(hessian / np.outer(scale, scale))
    root = root / scale[:, None]
    spread = root.T @ spread @ root
    if jitter is None and count >= FEWEST_REPLICATES and root.shape[1]:
        scores = _own_scores(jacobian, residual, parts) @ root
        spread = _larger(count / (count - 1) * scores.T @ scores, spread)
        basis, quantile = "replicates", special.stdtrit(count - 1, 0.975)
    # As a square, so that it is symmetric and positive semi-definite to the last digit.
    weights, axes = np.linalg.eigh(spread)
    half = root @ (axes * np.sqrt(np.clip(weights, 0.0, None)))
    covariance = np.zeros((inside.size, inside.size))
    covariance[np.ix_(inside, inside)] = half @ half.T
    information = np.zeros_like(covariance)
    information[np.ix_(inside, inside)] = hessian / weight
    errors = np.where(on_bound, np.nan, np.sqrt(np.clip(np.diag(covariance), 0.0, None)))
    errors[inside] = np.where(singular, np.inf, errors[inside])
    return Uncertainty(covariance, errors, on_bound, basis, np.full(inside.size, quantile), 1.0,
                       float(np.sqrt(squares / samples)), (squares, samples), np.ones(inside.size), information)


def inverse_root(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T with T T' the inverse of a scaled Hessian, without directions that nothing determines, and who is in those."""
    values, vectors = np.linalg.eigh(hessian)
    flat = values <= values.max(initial=0.0) / SINGULAR_CONDITION
    return vectors[:, ~flat] / np.sqrt(values[~flat]), (np.abs(vectors[:, flat]) > 0.1).any(axis=1)


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


