"""Noise, information criteria and other figures of a least-squares fit."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: Residuals this many times the stated noise mean that the model, not the sensor, makes the error.
MODEL_ERROR_RATIO = 3.0
#: Residuals this many times an estimated noise mean that it was the curvature of the data, not noise.
CURVATURE_RATIO = 0.3
#: How each replicate's points come from its samples, shape (points, samples); None: they are its samples.
Interpolations: TypeAlias = "Sequence[csr_array | None]"


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
        deviations.append(np.median(np.abs(distance)) / NormalDist().inv_cdf(0.75))
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
