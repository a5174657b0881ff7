"""Prediction bands for the curve of a new recording: pointwise and simultaneous."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special


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


_SETTINGS = PredictionBandSettings()
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
    probability = 0.5 + 0.5 * _SETTINGS.level
    quantiles = special.stdtrit([KNOWN_VARIANCE, *(scatter.freedom for scatter in scatters)], probability)
    deviation = np.sqrt(parts.sum(axis=0))
    quantile = np.sqrt(quantiles**2 @ parts) / deviation
    freedom = np.interp(-quantile, -special.stdtrit(_FREEDOMS, probability), _FREEDOMS)
    shift = np.abs(bias) / deviation
    low, high = np.zeros(bias.size), shift + quantile
    for _ in range(_SETTINGS.bisections):
        middle = 0.5 * (low + high)
        wide = special.stdtr(freedom, middle - shift) - special.stdtr(freedom, -middle - shift) >= _SETTINGS.level
        low, high = np.where(wide, low, middle), np.where(wide, middle, high)
    half = high * deviation
    return half, half * _compute_simultaneous_band_factor(bias, scatters, noise, samples, half)


def _compute_simultaneous_band_factor(bias: np.ndarray, scatters: Sequence[ScatterComponent], noise: np.ndarray,
                                      samples: float, half: np.ndarray) -> float:
    """Return the factor by which the pointwise band widens so that it contains 95 % of whole recordings; at least 1."""
    generator = np.random.default_rng(0)
    smooth = np.tile(bias, (_SETTINGS.draws, 1))
    for scatter in scatters:
        size = 1.0 if np.isinf(scatter.freedom) else np.sqrt(
            scatter.freedom / generator.chisquare(scatter.freedom, (_SETTINGS.draws, 1)))
        smooth += size * (generator.standard_normal((_SETTINGS.draws, scatter.columns.shape[1])) @ scatter.columns.T)
    # Largest and smallest noise of the samples per point, drawn by inversion of the distribution of extremes.
    exponent = 1.0 / max(samples, 1.0)
    high, low = (-special.ndtri(-np.expm1(exponent * np.log(generator.uniform(size=smooth.shape)))) for _ in range(2))
    reach = np.maximum(smooth + high * noise, low * noise - smooth)
    return max(float(np.quantile((reach / half).max(axis=1), _SETTINGS.level)), 1.0)
