"""Noise, covariance, intervals and information criteria of a least-squares fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

#: Residuals this many times the stated noise mean that the model, not the sensor, makes the error.
MODEL_ERROR_RATIO = 3.0
#: Fewer replicates than this say nothing about their own scatter.
FEWEST_REPLICATES = 3
#: A scaled Hessian with a larger condition number has a direction that the data do not determine.
SINGULAR_CONDITION = 1e14


def estimate_noise(samples: np.ndarray) -> float:
    """Standard deviation of white noise on a smooth curve, from its second differences.

    The second difference of white noise has six times its variance; the median keeps jumps out. The floor is the
    resolution of floating point, so that exact synthetic data do not give zero. On a coarse curve the curvature counts
    as noise.

    Args:
        samples: evenly sampled values, shape (n,), n >= 3.

    Source: von Neumann's successive differences; Gasser, Sroka, Jennen-Steinmetz, Biometrika 73 (1986) 625.
    """
    second = np.diff(samples, 2)
    deviation = np.median(np.abs(second)) / stats.norm.ppf(0.75) / np.sqrt(6.0)
    return float(max(deviation, 1e-9 * np.abs(samples).max(), np.finfo(float).tiny))


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


def uncertainty(jacobian: np.ndarray, residual: np.ndarray, replicate: np.ndarray, noise: float,
                prior_precision: np.ndarray, jitter: np.ndarray | None = None) -> Uncertainty:
    """Sandwich covariance of an unweighted least-squares estimate with priors.

    cov = A^-1 M A^-1 with A = J'J + s^2 P and M the variance of the gradient. M holds the larger of the noise and the
    residuals' variance. Samples of one replicate err together: M also holds the stated jitter between replicates or,
    where the residuals are model error and nothing is stated, the scatter of the replicates' own gradients.

    Args:
        jacobian: d(stress)/d(unknown), shape (n, k).
        residual: model minus data, Pa, shape (n,).
        replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation s of the stress, Pa.
        prior_precision: 1/variance of each prior, 0 without, shape (k,).
        jitter: stress that one standard deviation of jitter makes, Pa, shape (n, number of kinds of jitter): applied
            to each replicate independently.

    Source: Huber's sandwich with clusters, Liang and Zeger, Biometrika 73 (1986) 13; R/(R-1) for few clusters.
    """
    samples, unknowns = jacobian.shape
    count = int(replicate.max()) + 1
    residual_deviation = np.sqrt(residual @ residual / max(samples - unknowns, 1))
    model_error = residual_deviation > MODEL_ERROR_RATIO * noise
    hessian = jacobian.T @ jacobian + noise**2 * np.diag(prior_precision)
    spread = noise**4 * np.diag(prior_precision)
    basis, quantile = "noise", stats.norm.ppf(0.975)
    if model_error and jitter is None and count >= FEWEST_REPLICATES:
        columns, factor = residual[:, None], count / (count - 1)
        basis, quantile = "replicates", stats.t.ppf(0.975, count - 1)
    else:
        columns, factor = jitter, 1.0
        if residual_deviation > 1.1 * noise:
            basis, quantile = "residuals", stats.t.ppf(0.975, max(samples - unknowns, 1))
    spread += max(noise, residual_deviation)**2 * (jacobian.T @ jacobian)
    for column in () if columns is None else columns.T:
        gradients = np.stack([jacobian[replicate == r].T @ column[replicate == r] for r in range(count)])
        spread += factor * gradients.T @ gradients

    # Scaled to a unit diagonal, so that Pa beside exponents does not look singular.
    scale = np.sqrt(np.diag(hessian))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    flat = values <= values.max(initial=0.0) / SINGULAR_CONDITION
    singular = (np.abs(vectors[:, flat]) > 0.1).any(axis=1) if flat.any() else np.zeros(unknowns, bool)
    inverse = (vectors[:, ~flat] / values[~flat]) @ vectors[:, ~flat].T
    # As a square, so that it is symmetric and positive semi-definite to the last digit.
    weights, axes = np.linalg.eigh(spread / np.outer(scale, scale))
    root = inverse @ (axes * np.sqrt(np.clip(weights, 0.0, None))) / scale[:, None]
    return Uncertainty(root @ root.T, basis, float(quantile), singular)


def information_criteria(residual: np.ndarray, noise: float, unknowns: int) -> tuple[float, float]:
    """AIC and BIC with the noise known: chi-square plus 2 k, plus k ln n.

    Args:
        residual: Pa, shape (n,). noise: its standard deviation, Pa. unknowns: number of free ones, k.

    Source: Burnham and Anderson, Model Selection and Multimodel Inference, 2002, sections 2.2 and 6.4.
    """
    chi_square = float(residual @ residual / noise**2)
    return chi_square + 2.0 * unknowns, chi_square + unknowns * float(np.log(residual.size))


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
