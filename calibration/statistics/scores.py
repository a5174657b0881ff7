"""Score tests of many directions at once, with a probability that counts how many were looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calibration.statistics.adequacy import INDEPENDENT

#: A direction of which the fit absorbs all but this share of its length cannot be tested.
ABSORBED = 1e-3
#: Draws of the noise, and the seed of them: the same answer each time.
DRAWS, SEED = 20_000, 1


@dataclass(frozen=True, eq=False)
class Direction:
    """What an effect of its trial size would add to the data, with all that the fit could absorb taken out.

    Attributes:
        basis: orthonormal, shape (N, q); empty where the fit absorbs all of it.
        length: of the change, with what is absorbed, in units of the noise.
        reach: of what is left of it, in units of the noise: the deviations that an effect of the trial size would show.
        positive: whether only one sign is possible; of a direction with q = 1 alone.
    """

    basis: np.ndarray
    length: float
    reach: float
    positive: bool

    @property
    def freedom(self) -> int:
        return int(self.basis.shape[1])

    @classmethod
    def of(cls, columns: np.ndarray, fitted: np.ndarray, *, positive: bool) -> Direction:
        """The direction of whitened changes of the model.

        Args:
            columns: shape (N, q), zero in the rows of priors. fitted: orthonormal columns that span what is fitted,
                nuisances and priors included, shape (N, k). positive: see `Direction`.
        """
        free = columns - fitted @ (fitted.T @ columns)
        length = float(np.linalg.norm(columns))
        left, sizes, _ = np.linalg.svd(free, full_matrices=False)
        if columns.shape[1] == 1:
            # Its sign is that of the effect.
            left = free / (sizes[0] or 1.0)
        kept = sizes > max(ABSORBED * length / np.sqrt(columns.shape[1]), INDEPENDENT * sizes.max(initial=0.0), 1e-12)
        return cls(left[:, kept], length, float(np.linalg.norm(sizes[kept])), positive)

    def score(self, residual: np.ndarray) -> np.ndarray:
        """Deviations that the data show along it, shape (q,); residual: model minus data, whitened, shape (N,)."""
        return -(self.basis.T @ residual)

    def p(self, score: np.ndarray) -> np.ndarray:
        """Probability of a score as large by chance, for this direction alone; shape (..., q) -> (...)."""
        if not self.freedom:
            return np.ones(score.shape[:-1])
        if self.positive and self.freedom == 1:
            return special.ndtr(-score[..., 0])
        return special.chdtrc(self.freedom, np.sum(score**2, axis=-1))


def family_probability(directions: Sequence[Direction], scores: Sequence[np.ndarray], *, seed: int = SEED,
                       draws: int = DRAWS) -> np.ndarray:
    """For each direction the probability that chance alone makes any of them as improbable as it is.

    The scores of all directions follow one normal distribution when nothing is hidden; its draws carry grids over what
    does not exist in the absence of an effect, bounds, and the choice among effects.

    Args:
        directions: of the candidates. scores: of each, shape (q,).

    Returns:
        Shape (directions,); at least 1/(draws + 1).

    Source: Davies, Biometrika 74 (1987) 33, for why a table would not do; Westfall and Young, Resampling-Based Multiple
    Testing (1993), for the least of several p values.
    """
    if not directions:
        return np.zeros(0)
    stacked = np.hstack([direction.basis for direction in directions])
    if not stacked.shape[1]:
        return np.ones(len(directions))
    # The noise only matters as far as the directions span it.
    sizes, axes = np.linalg.eigh(stacked.T @ stacked)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    drawn = np.random.default_rng(seed).standard_normal((draws, sizes.size)) @ root.T
    ends = np.cumsum([0, *(direction.freedom for direction in directions)])
    least = np.min([direction.p(drawn[:, first:last]) for direction, first, last in zip(
        directions, ends[:-1], ends[1:], strict=True)], axis=0)
    observed = np.array([float(direction.p(score)) for direction, score in zip(directions, scores, strict=True)])
    below = np.searchsorted(np.sort(least), observed, side="right")
    return (below + 1) / (draws + 1)


def alike(one: Direction, other: Direction) -> float:
    """How far one direction is the other's twin: the cosine of the angle between them, 0 to 1."""
    if not (one.freedom and other.freedom):
        return 0.0
    return float(np.linalg.svd(one.basis.T @ other.basis, compute_uv=False)[0])
