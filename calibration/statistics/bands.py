"""Bands for the curve of a new recording: pointwise, and for the whole of it at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

LEVEL = 0.95
#: Bisections of a half width, and drawn recordings for the whole band.
_HALVINGS, _DRAWS = 40, 2000
#: Degrees of freedom that Student's t is taken with.
_FREEDOMS = np.geomspace(1.0, 1e6, 200)
#: A scatter without an end to its degrees of freedom.
CERTAIN = np.inf


@dataclass(frozen=True, eq=False)
class Scatter:
    """A way in which recordings differ: columns times standard normal numbers, all divided by one estimated size.

    Attributes:
        columns: at the points, shape (k, m). freedom: of the size; inf where it is known.
    """

    columns: np.ndarray
    freedom: float = CERTAIN

    @property
    def variance(self) -> np.ndarray:
        """Shape (k,)."""
        return np.sum(self.columns**2, axis=1)


def prediction_bands(bias: np.ndarray, scatters: Sequence[Scatter], noise: np.ndarray,
                     samples: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Half widths about a curve that hold 95 % of new recordings: of their samples, and of all their samples at once.

    A sample is curve + bias + scatters + noise. Each part counts with the quantile of what is known of its size, and
    the squares of these half widths add up (Zou and Donner). With s the deviation of the sum, and t Student's with the
    freedom that has this quantile, h solves P(|bias + s t| <= h) = 0.95. The second answer is the first, times what
    95 % of drawn recordings need to stay inside.

    Args:
        bias: known distance of the recordings from the curve, shape (k,). scatters: independent of each other.
        noise: standard deviation of the samples, shape (k,). samples: of a recording for each point.

    Returns:
        Shapes (k,); not a number where anything is not.

    Source: Zou and Donner, Statistics in Medicine 27 (2008) 1693, of variances; simultaneous bands as in Montiel Olea
    and Plagborg-Moller, J. Appl. Econometrics 34 (2019) 1, section 3, drawn.
    """
    parts = np.array([noise**2, *(scatter.variance for scatter in scatters)])
    if not np.isfinite(parts.sum(axis=0) + bias).all():
        return np.full(bias.size, np.nan), np.full(bias.size, np.nan)
    quantiles = special.stdtrit([CERTAIN, *(scatter.freedom for scatter in scatters)], 0.5 + 0.5 * LEVEL)
    deviation = np.sqrt(parts.sum(axis=0))
    usual = np.sqrt(quantiles**2 @ parts) / deviation
    freedom = np.interp(-usual, -special.stdtrit(_FREEDOMS, 0.5 + 0.5 * LEVEL), _FREEDOMS)
    away = np.abs(bias) / deviation
    low, high = np.zeros(bias.size), away + usual
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        held = special.stdtr(freedom, middle - away) - special.stdtr(freedom, -middle - away) >= LEVEL
        low, high = np.where(held, low, middle), np.where(held, middle, high)
    half = high * deviation
    return half, half * _stretch(bias, scatters, noise, samples, half)


def _stretch(bias: np.ndarray, scatters: Sequence[Scatter], noise: np.ndarray, samples: float,
             half: np.ndarray) -> float:
    """How much wider than `half` the band is that 95 % of drawn recordings do not leave anywhere."""
    generator = np.random.default_rng(0)
    smooth = np.tile(bias, (_DRAWS, 1))
    for scatter in scatters:
        size = 1.0 if np.isinf(scatter.freedom) else np.sqrt(
            scatter.freedom / generator.chisquare(scatter.freedom, (_DRAWS, 1)))
        smooth += size * (generator.standard_normal((_DRAWS, scatter.columns.shape[1])) @ scatter.columns.T)
    # The extremes of the samples between two points, by the inverse of their distribution.
    least = 1.0 / max(samples, 1.0)
    high, low = (-special.ndtri(-np.expm1(least * np.log(generator.uniform(size=smooth.shape)))) for _ in range(2))
    reach = np.maximum(smooth + high * noise, low * noise - smooth)
    return max(float(np.quantile((reach / half).max(axis=1), LEVEL)), 1.0)
