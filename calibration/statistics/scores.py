"""Score tests of many alternatives, with p values that account for their number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calibration.statistics.adequacy import SCORE_TEST


@dataclass(frozen=True)
class ScoreTestSimulationSettings:
    """Settings of the simulated p values of score tests of many alternative effects.

    Attributes:
        min_free_fraction: smallest fraction of the length of a change outside the span of the fit for which the change
            can be tested. A smaller value tests changes that the fit absorbs almost completely.
        draws: number of random draws of the scores; the standard error of a p value is sqrt(p / draws).
        seed: seed of the random draws, fixed so that results are reproducible.
    """

    min_free_fraction: float = 1e-3
    draws: int = 20_000
    seed: int = 1


DIRECTIONS = ScoreTestSimulationSettings()


@dataclass(frozen=True, eq=False)
class EffectDirection:
    """Change of the whitened residuals by an effect, projected onto the orthogonal complement of the fitted space.

    Attributes:
        basis: orthonormal basis of the projected change, shape (N, q); q = 0 if the fit can absorb the change.
        length: norm of the change before projection, in units of the noise.
        reach: norm of the projected change, in units of the noise: expected score of an effect of the trial size.
        positive: whether the effect has only one possible sign; used for q = 1 only.
    """

    basis: np.ndarray
    length: float
    reach: float
    positive: bool

    @property
    def degrees_of_freedom(self) -> int:
        """Number q of degrees of freedom of the score test: the number of columns of `basis`."""
        return int(self.basis.shape[1])

    @classmethod
    def from_whitened_change(cls, columns: np.ndarray, fitted: np.ndarray, *, positive: bool) -> EffectDirection:
        """Return the direction of whitened changes of the model, projected onto the complement of the fitted space.

        Args:
            columns: changes, zero in the rows of priors, shape (N, q).
            fitted: orthonormal basis of the fitted space including nuisances and priors, shape (N, k).
            positive: see `EffectDirection`.
        """
        free = columns - fitted @ (fitted.T @ columns)
        length = float(np.linalg.norm(columns))
        left, sizes, _ = np.linalg.svd(free, full_matrices=False)
        if columns.shape[1] == 1:
            # The singular vector has an arbitrary sign; the basis has the sign of the effect.
            left = free / (sizes[0] or 1.0)
        kept = sizes > max(DIRECTIONS.min_free_fraction * length / np.sqrt(columns.shape[1]),
                           SCORE_TEST.rank_tolerance * sizes.max(initial=0.0), 1e-12)
        return cls(left[:, kept], length, float(np.linalg.norm(sizes[kept])), positive)

    def compute_score_components(self, residual: np.ndarray) -> np.ndarray:
        """Return the score: components of data minus model along the basis, standard normal without the effect.

        Args:
            residual: whitened model minus data, shape (N,).

        Returns:
            Score, shape (q,).
        """
        return -(self.basis.T @ residual)

    def compute_p_value(self, score: np.ndarray) -> np.ndarray:
        """Return the p value of a score for this direction alone, without correction for the other directions.

        The p value is that of a one-sided normal test for a positive effect with q = 1, otherwise of a chi-square test
        with q degrees of freedom.

        Args:
            score: scores, shape (..., q).

        Returns:
            P values, shape (...).
        """
        if not self.degrees_of_freedom:
            return np.ones(score.shape[:-1])
        if self.positive and self.degrees_of_freedom == 1:
            return special.ndtr(-score[..., 0])
        return special.chdtrc(self.degrees_of_freedom, np.sum(score**2, axis=-1))


def compute_familywise_p_values(directions: Sequence[EffectDirection], scores: Sequence[np.ndarray], *,
                                seed: int = DIRECTIONS.seed, draws: int = DIRECTIONS.draws) -> np.ndarray:
    """Compute family-wise p values by simulation of the minimum p value (Westfall and Young).

    Without effects the scores of all directions are jointly normal with mean 0 and covariance B'B, where B contains all
    bases. For random scores from this distribution the smallest p value of all directions is computed. The family-wise
    p value of a direction is the fraction of draws whose smallest p value does not exceed that of the direction. The
    simulation accounts for the correlation of the directions, for one-sided effects, and for grids of parameters that
    are not identified without the effect.

    Args:
        directions: directions of the candidates.
        scores: score of each direction, shape (q,).
        seed: seed of the random numbers.
        draws: number of draws.

    Returns:
        P values, shape (directions,); at least 1/(draws + 1).

    Source: Westfall and Young, Resampling-Based Multiple Testing, 1993; Davies, Biometrika 74 (1987) 33 (nuisance
    parameters that exist only with the effect).
    """
    if not directions:
        return np.zeros(0)
    stacked = np.hstack([direction.basis for direction in directions])
    if not stacked.shape[1]:
        return np.ones(len(directions))
    # Random scores are drawn in the space of the directions, which is smaller than that of the samples.
    sizes, axes = np.linalg.eigh(stacked.T @ stacked)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    drawn = np.random.default_rng(seed).standard_normal((draws, sizes.size)) @ root.T
    ends = np.cumsum([0, *(direction.degrees_of_freedom for direction in directions)])
    smallest = np.min([direction.compute_p_value(drawn[:, first:last]) for direction, first, last in zip(
        directions, ends[:-1], ends[1:], strict=True)], axis=0)
    observed = np.array([float(direction.compute_p_value(score)) for direction,
                         score in zip(directions, scores, strict=True)])
    below = np.searchsorted(np.sort(smallest), observed, side="right")
    return (below + 1) / (draws + 1)


def compute_largest_principal_cosine(one: EffectDirection, other: EffectDirection) -> float:
    """Return the cosine of the smallest principal angle between two directions, 0 to 1; 1: indistinguishable."""
    if not (one.degrees_of_freedom and other.degrees_of_freedom):
        return 0.0
    return float(np.linalg.svd(one.basis.T @ other.basis, compute_uv=False)[0])
