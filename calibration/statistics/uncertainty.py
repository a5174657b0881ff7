"""Covariance of least-squares estimates that is valid for any weights (sandwich estimator), and prediction bands.

The bands for the curve of a new recording are pointwise or simultaneous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from calibration.statistics.statistics import (
    Interpolations,
    compute_chi_square_and_effective_samples,
    compute_sample_weighted_rms_noise,
)


@dataclass(frozen=True)
class PredictionBandSettings:
    """Settings of prediction bands.

    Attributes:
        level: probability that a band contains a new sample, or a new recording.
        bisections: number of bisection steps for a half width; each step halves the error.
        draws: number of random recordings for the simultaneous band. A larger value reduces the random error of its
            width.
    """

    level: float = 0.95
    bisections: int = 40
    draws: int = 2000


_BANDS = PredictionBandSettings()
#: Degrees of freedom at which quantiles of Student's t are tabulated.
_FREEDOMS = np.geomspace(1.0, 1e6, 200)
#: Degrees of freedom of a known variance.
KNOWN_VARIANCE = np.inf


@dataclass(frozen=True, eq=False)
class ScatterComponent:
    """Component of the scatter between recordings: columns times standard normal numbers with an estimated scale.

    Attributes:
        columns: deviation of the curve per standard normal number, shape (k points, m).
        freedom: degrees of freedom of the estimated scale; inf if the scale is known.
    """

    columns: np.ndarray
    freedom: float = KNOWN_VARIANCE

    @property
    def variance(self) -> np.ndarray:
        """Variance of the component at each point of the curve, shape (k,)."""
        return np.sum(self.columns**2, axis=1)


def compute_prediction_band_half_widths(bias: np.ndarray, scatters: Sequence[ScatterComponent], noise: np.ndarray,
                                        samples: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Compute the half widths of the pointwise and the simultaneous 95 % prediction band about a curve.

    A new sample is curve + bias + sum of scatters + noise. Let q_i be the 97.5 % quantile of Student's t with the
    degrees of freedom of component i, and s_i its standard deviation. The half width without bias is
    sqrt(sum q_i^2 s_i^2) (Zou and Donner). It defines an effective number of degrees of freedom of t for the total
    standard deviation s. The pointwise half width h solves P(|bias + s t| <= h) = 0.95. The simultaneous half width is
    c h, where c is the 95 % quantile of the largest deviation relative to h over random recordings.

    Args:
        bias: known deviation of recordings from the curve, shape (k,).
        scatters: independent components of the scatter.
        noise: standard deviation of the noise of samples, shape (k,).
        samples: number of samples of a recording per point.

    Returns:
        Pointwise and simultaneous half width, shapes (k,); NaN if any input is not finite.

    Source: Zou and Donner, Statistics in Medicine 27 (2008) 1693 (method of variance estimates recovery); Montiel Olea
    and Plagborg-Moller, J. Appl. Econometrics 34 (2019) 1, section 3 (simultaneous bands by simulation).
    """
    parts = np.array([noise**2, *(scatter.variance for scatter in scatters)])
    if not np.isfinite(parts.sum(axis=0) + bias).all():
        return np.full(bias.size, np.nan), np.full(bias.size, np.nan)
    probability = 0.5 + 0.5 * _BANDS.level
    quantiles = special.stdtrit([KNOWN_VARIANCE, *(scatter.freedom for scatter in scatters)], probability)
    deviation = np.sqrt(parts.sum(axis=0))
    quantile = np.sqrt(quantiles**2 @ parts) / deviation
    freedom = np.interp(-quantile, -special.stdtrit(_FREEDOMS, probability), _FREEDOMS)
    shift = np.abs(bias) / deviation
    low, high = np.zeros(bias.size), shift + quantile
    for _ in range(_BANDS.bisections):
        middle = 0.5 * (low + high)
        wide = special.stdtr(freedom, middle - shift) - special.stdtr(freedom, -middle - shift) >= _BANDS.level
        low, high = np.where(wide, low, middle), np.where(wide, middle, high)
    half = high * deviation
    return half, half * _compute_simultaneous_band_factor(bias, scatters, noise, samples, half)


def _compute_simultaneous_band_factor(bias: np.ndarray, scatters: Sequence[ScatterComponent], noise: np.ndarray,
                                      samples: float, half: np.ndarray) -> float:
    """Return the factor by which the pointwise band widens so that it contains 95 % of whole recordings; at least 1."""
    generator = np.random.default_rng(0)
    smooth = np.tile(bias, (_BANDS.draws, 1))
    for scatter in scatters:
        size = 1.0 if np.isinf(scatter.freedom) else np.sqrt(
            scatter.freedom / generator.chisquare(scatter.freedom, (_BANDS.draws, 1)))
        smooth += size * (generator.standard_normal((_BANDS.draws, scatter.columns.shape[1])) @ scatter.columns.T)
    # Largest and smallest noise of the samples per point, drawn by inversion of the distribution of extremes.
    exponent = 1.0 / max(samples, 1.0)
    high, low = (-special.ndtri(-np.expm1(exponent * np.log(generator.uniform(size=smooth.shape)))) for _ in range(2))
    reach = np.maximum(smooth + high * noise, low * noise - smooth)
    return max(float(np.quantile((reach / half).max(axis=1), _BANDS.level)), 1.0)


@dataclass(frozen=True)
class CovarianceSettings:
    """Limits of the covariance of least-squares estimates.

    Attributes:
        residual_ratio: ratio of residuals to noise above which the residuals determine the standard errors. A value of
            1 would inflate half of all fits with a correct noise.
        min_replicates: smallest number of replicates from which their scatter is estimated. With fewer, the estimated
            scatter is mostly chance.
        singular_condition: condition number of the scaled Hessian above which a direction counts as undetermined by the
            data; about the reciprocal of the floating-point precision.
    """

    residual_ratio: float = 1.1
    min_replicates: int = 3
    singular_condition: float = 1e14


COVARIANCE = CovarianceSettings()


@dataclass(frozen=True, eq=False)
class ParameterUncertainty:
    """Covariance of the free unknowns and related quantities; unknowns on a bound count as fixed.

    Attributes:
        covariance: covariance matrix, SI, shape (k, k); zero rows and columns for unknowns on a bound.
        standard_errors: standard errors, SI, shape (k,); NaN on a bound, inf in an undetermined direction.
        on_bound: whether each unknown is on a bound, bool, shape (k,).
        basis: source of the variance: ``"noise"``, ``"residuals"`` (larger than the noise) or ``"replicates"`` (scatter
            between replicates).
        quantile: half widths of the 95 % intervals in standard errors, shape (k,).
        inflation: factor of all variances because the residuals exceed the noise, at least 1.
        ratio: root mean square of the residuals in units of their noise.
        criteria: chi-square and effective number of samples for `compute_aic_and_bic`.
        sizes: scale of each unknown, SI, shape (k,).
        information: Fisher information of the unknowns in units of `sizes`, shape (k, k).
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


def compute_cluster_robust_uncertainty(jacobian: np.ndarray, residual: np.ndarray, replicate: np.ndarray,
                                       noise: np.ndarray | float,
                                       prior_precision: np.ndarray, jitter: np.ndarray | None = None,
                                       interpolations: Interpolations | None = None, on_bound: np.ndarray | None = None,
                                       repeats: float = 1.0) -> ParameterUncertainty:
    """Return the uncertainty of a least-squares estimate with priors, by the cluster-robust sandwich covariance.

    At the minimum, cov = A^-1 M A^-1 with A = J'J + s^2 P, where J is the Jacobian, P the diagonal prior precision, s
    the pooled noise and M the variance of the gradient. Samples contribute to M with the noise of their replicate, or
    with its residuals if they exceed the noise. The errors of one replicate are correlated: stated jitter adds its
    variance to M; otherwise, for at least `CovarianceSettings.min_replicates` replicates, M is at least the
    scatter of the replicates' gradients, with the factor R / (R - 1) for few clusters.

    Args:
        jacobian: derivatives of the stress with respect to the unknowns, shape (n, k).
        residual: model minus data, Pa, shape (n,).
        replicate: index of the replicate of each sample, shape (n,).
        noise: standard deviation of the samples of each replicate, Pa, shape (R,), or one value.
        prior_precision: inverse variance of each prior, 0 without a prior, shape (k,).
        jitter: change of the stress per standard deviation of each kind of jitter, Pa, shape (n, kinds), independent
            between replicates; no columns if fitted offsets represent the jitter; None: no jitter is stated.
        interpolations: interpolation matrix of each replicate; None: all points are samples.
        on_bound: unknowns that count as fixed, bool, shape (k,); None: no unknown.
        repeats: factor of the variance of smooth residuals that exceed the noise: the number of samples per independent
            sample.

    Source: Liang and Zeger, Biometrika 73 (1986) 13.
    """
    on_bound = np.zeros(jacobian.shape[1], bool) if on_bound is None else on_bound
    inside = ~on_bound
    jacobian, prior_precision = jacobian[:, inside], np.asarray(prior_precision)[inside]
    unknowns, count = jacobian.shape[1], int(replicate.max()) + 1
    noise = np.broadcast_to(np.asarray(noise, dtype=float), count)
    parts = [replicate == i for i in range(count)]
    weight = compute_sample_weighted_rms_noise(noise, replicate)**2
    squares, samples = compute_chi_square_and_effective_samples(residual, replicate, noise, interpolations)
    freedom = max(samples - unknowns, 1.0)
    basis, quantile, deviations = "noise", special.ndtri(0.975), noise
    if squares > COVARIANCE.residual_ratio**2 * freedom:
        basis, quantile = "residuals", special.stdtrit(freedom, 0.975)
        own = np.array([compute_chi_square_and_effective_samples(residual[part], np.zeros(part.sum(), int),
                                                                 noise[i:i + 1],
                                                                 None if interpolations is None
                                                                 else interpolations[i:i + 1])
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
    # A unit diagonal makes the condition number independent of the units of the unknowns.
    scale = np.sqrt(np.diag(hessian))
    scale = np.where(scale > 0, scale, 1.0)
    root, singular = get_inverse_root_and_undetermined_mask(hessian / np.outer(scale, scale))
    root = root / scale[:, None]
    spread = root.T @ spread @ root
    if jitter is None and count >= COVARIANCE.min_replicates and root.shape[1]:
        scores = _compute_replicate_scores_with_priors(jacobian, residual, parts) @ root
        spread = _combine_larger_principal_variances(count / (count - 1) * scores.T @ scores, spread)
        basis, quantile = "replicates", special.stdtrit(count - 1, 0.975)
    # The product of a factor with its transpose is symmetric and positive semidefinite in floating point.
    weights, axes = np.linalg.eigh(spread)
    half = root @ (axes * np.sqrt(np.clip(weights, 0.0, None)))
    covariance = np.zeros((inside.size, inside.size))
    covariance[np.ix_(inside, inside)] = half @ half.T
    information = np.zeros_like(covariance)
    information[np.ix_(inside, inside)] = hessian / weight
    errors = np.where(on_bound, np.nan, np.sqrt(np.clip(np.diag(covariance), 0.0, None)))
    errors[inside] = np.where(singular, np.inf, errors[inside])
    return ParameterUncertainty(covariance, errors, on_bound, basis, np.full(inside.size, quantile), 1.0,
                                float(np.sqrt(squares / samples)), (squares, samples), np.ones(inside.size),
                                information)


def get_inverse_root_and_undetermined_mask(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a root of the pseudo-inverse of a scaled Hessian, and a mask of the unknowns in undetermined directions.

    Args:
        hessian: Hessian with unit diagonal, shape (k, k).

    Returns:
        T with T T' = pseudo-inverse, shape (k, rank), and whether each unknown is part of an undetermined direction,
        bool, shape (k,).
    """
    values, vectors = np.linalg.eigh(hessian)
    flat = values <= values.max(initial=0.0) / COVARIANCE.singular_condition
    return vectors[:, ~flat] / np.sqrt(values[~flat]), (np.abs(vectors[:, flat]) > 0.1).any(axis=1)


def _compute_replicate_scores_with_priors(jacobian: np.ndarray, residual: np.ndarray,
                                          parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the gradient of each replicate including its part of the priors' gradient, shape (R, k).

    At the minimum the gradients of priors and data cancel, so the priors' gradient is minus that of the data. It is
    distributed to the replicates in proportion to their information on each unknown.
    """
    scores = np.stack([jacobian[part].T @ residual[part] for part in parts])
    information = np.stack([np.sum(jacobian[part]**2, axis=0) for part in parts])
    total = information.sum(axis=0)
    weights = np.divide(information, total, out=np.zeros_like(information), where=total > 0)
    return scores - weights * scores.sum(axis=0)


def _combine_larger_principal_variances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return a matrix with the larger of two variances in each of their common (generalised) principal directions.

    Args:
        one: symmetric positive semidefinite matrix, shape (k, k).
        other: symmetric positive definite matrix, shape (k, k).
    """
    ratios, axes = linalg.eigh(one, other)
    dual = other @ axes
    return (dual * np.maximum(ratios, 1.0)) @ dual.T
