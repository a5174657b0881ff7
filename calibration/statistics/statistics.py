"""Noise estimates, chi-square, information criteria and correlation of least-squares fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class NoiseRatioLimits:
    """Limits of the ratio of root mean square residuals to the noise.

    Attributes:
        model_error: ratio to the noise above which model error dominates. A smaller value reports model errors that are
            harmless for the parameters.
        curvature: ratio to an estimated noise below which the noise estimate contains curvature of the data. A larger
            value also reports correct estimates of few samples.
    """

    model_error: float = 3.0
    curvature: float = 0.3


NOISE_RATIOS = NoiseRatioLimits()
#: Interpolation matrix of each replicate from its samples to its points, shape (points, samples); None: no
#: interpolation.
Interpolations: TypeAlias = "Sequence[csr_array | None]"


def estimate_white_noise(samples: np.ndarray, abscissa: np.ndarray | None = None) -> float:
    """Estimate the standard deviation of white noise on a smooth curve from pseudo-residuals.

    A pseudo-residual is the deviation of a sample from the straight line through its neighbours, normalised to the
    variance of the noise. The estimate is the median absolute pseudo-residual divided by the 75 % normal quantile,
    which is robust against jumps. Lines over the index and over the abscissa give two estimates, and the smaller one is
    returned: unequal steps increase the first, a coarsely resolved abscissa the second. The estimate is at least the
    resolution of floating-point numbers. On a coarsely sampled curve it contains the curvature.

    Args:
        samples: values in order, shape (n,), n >= 3.
        abscissa: positions of the samples, shape (n,); None: equal steps.

    Source: Gasser, Sroka, Jennen-Steinmetz, Biometrika 73 (1986) 625.
    """
    weights = [np.full(samples.size - 2, 0.5)]
    if abscissa is not None:
        span, step = abscissa[2:] - abscissa[:-2], abscissa[1:-1] - abscissa[:-2]
        weight = np.divide(step, span, out=np.full(span.size, 0.5), where=span != 0)
        weights.append(np.where((weight >= 0) & (weight <= 1), weight, 0.5))
    deviations = []
    for weight in weights:
        distance = samples[1:-1] - (1 - weight) * samples[:-2] - weight * samples[2:]
        distance /= np.sqrt(1 + (1 - weight)**2 + weight**2)
        deviations.append(np.median(np.abs(distance)) / NormalDist().inv_cdf(0.75))
    return float(max(min(deviations), 1e-9 * np.abs(samples).max(), np.finfo(float).tiny))


def find_quantisation_step(samples: np.ndarray) -> float:
    """Return the quantisation step of a signal, in the unit of the samples; 0 if no step is found.

    The step is the smallest repeated difference, if all differences are integer multiples of it and more than one
    multiple occurs. The rounding error has the standard deviation step / sqrt(12). Noise estimates from differences
    miss this error if most neighbouring samples are equal.

    Args:
        samples: values in order, shape (n,).

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


def compute_sample_weighted_rms_noise(noise: np.ndarray, replicate: np.ndarray) -> float:
    """Return the root mean square of the noise over all samples; a replicate counts by its number of samples.

    Args:
        noise: standard deviation of each replicate, shape (R,).
        replicate: index of the replicate of each sample, shape (n,).
    """
    return float(np.sqrt(np.mean(np.asarray(noise)[replicate]**2)))


def get_effective_samples_and_variance_ratio(interpolation: csr_array | None, points: int) -> tuple[float, float]:
    """Return the effective number of independent samples of interpolated points, and their relative noise variance.

    Interpolated points are correlated, and interpolation reduces the variance of the noise. With the interpolation
    matrix W and C = W W', the effective number is (tr C)^2 / tr(C^2) and the relative variance is tr(C) / points.

    Args:
        interpolation: interpolation matrix W, shape (points, samples); None: the points are samples.
        points: number of points.

    Source: Bayley and Hammersley, Supplement to the J. of the Royal Statistical Society 8 (1946) 184.
    """
    if interpolation is None:
        return float(points), 1.0
    covariance = interpolation @ interpolation.T
    trace = float(covariance.trace())
    return trace**2 / float(covariance.multiply(covariance).sum()), trace / points


def compute_chi_square_and_effective_samples(residual: np.ndarray, replicate: np.ndarray, noise: np.ndarray,
                                             interpolations: Interpolations | None = None) -> tuple[float, float]:
    """Return (chi-square of the residuals, effective number of independent samples).

    Args:
        residual: model minus data, Pa, shape (n,).
        replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation of the samples of each replicate, Pa, shape (R,).
        interpolations: interpolation matrix of each replicate; None: all points are samples.
    """
    total = samples = 0.0
    for i, deviation in enumerate(noise):
        part = residual[replicate == i]
        count, variance = get_effective_samples_and_variance_ratio(None if interpolations is None
                                                                   else interpolations[i], part.size)
        total += float(part @ part) / (deviation**2 * variance) * count / part.size
        samples += count
    return float(total), float(samples)


def compute_aic_and_bic(squares: float, samples: float, unknowns: int) -> tuple[float, float]:
    """Return (AIC, BIC) for known noise: AIC = chi-square + 2 k and BIC = chi-square + k ln n.

    Args:
        squares: chi-square of the residuals plus that of priors (penalised likelihood).
        samples: effective number n of independent samples.
        unknowns: number k of free unknowns.

    Source: Burnham and Anderson, Model Selection and Multimodel Inference, 2002, sections 2.2 and 6.4.
    """
    return squares + 2.0 * unknowns, squares + unknowns * float(np.log(samples))


def compute_r_squared(data: np.ndarray, residual: np.ndarray) -> float:
    """Return the coefficient of determination R^2 = 1 - sum r^2 / sum (y - mean(y))^2.

    Args:
        data: measured values y, shape (n,).
        residual: model minus data r, shape (n,).

    Returns:
        R^2; of constant data, such as the set force of a creep test, 1 - sum r^2 / sum y^2.
    """
    total = float(np.sum((data - data.mean())**2)) or float(data @ data)
    return 1.0 - float(residual @ residual) / total


def compute_correlation_matrix(covariance: np.ndarray) -> np.ndarray:
    """Return the correlation matrix of a covariance matrix; off-diagonal entries of unknowns with variance 0 are 0."""
    deviation = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    outer = np.outer(deviation, deviation)
    result = np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0)
    np.fill_diagonal(result, 1.0)
    return np.clip(result, -1.0, 1.0)


def compute_median_sampling_interval_or_zero(times: Sequence[np.ndarray]) -> float:
    """Return the median interval between successive sampling times of all recordings, s.

    Equal times are left out. The result is 0 if no recording has two different times.

    Args:
        times: sampling times of each recording, s, shape (n,).
    """
    steps = np.concatenate([np.zeros(0), *(np.diff(time) for time in times)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
