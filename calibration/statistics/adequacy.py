"""Score tests for smooth misfit in the residuals of a fit, region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special


@dataclass(frozen=True)
class ScoreTestTolerances:
    """Numerical tolerances of Rao's score tests: which modes and directions count as independent.

    Attributes:
        min_free_fraction: smallest fraction of a mode's squared norm outside the span of the design for which the mode
            can be tested. A smaller value tests modes that the fit absorbs almost completely.
        rank_tolerance: smallest ratio of a singular value to the largest one for which a direction counts as linearly
            independent.
    """

    min_free_fraction: float = 1e-3
    rank_tolerance: float = 1e-10


SCORE_TEST = ScoreTestTolerances()


@dataclass(frozen=True, eq=False)
class RegionScoreTest:
    """Result of Rao's score test for a smooth misfit in one region.

    Attributes:
        statistic: test statistic; chi-square distributed if the model is correct.
        freedom: degrees of freedom: number of modes outside the span of the design; 0: nothing can be tested.
        p: probability of a larger statistic if the model is correct; 1 for 0 degrees of freedom.
        amplitudes: estimated amplitudes of the modes, shape (q,): data = model + modes @ amplitudes, so positive values
            mean that the model is too soft. Components in the span of the design are zero.
    """

    statistic: float
    freedom: int
    p: float
    amplitudes: np.ndarray


def compute_rao_score_test(residual: np.ndarray, design: np.ndarray, modes: np.ndarray) -> RegionScoreTest:
    """Compute Rao's score test for modes that the model lacks, at the optimum of the fit.

    With r = residual, A = design, M = modes, the score is S = M'r, its information is I = M'M - M'A (A'A)^-1 A'M, and
    the statistic is S' I^-1 S. No fit with the modes is required.

    Args:
        residual: model minus data in units of the noise, including the rows of the priors, shape (N,).
        design: Jacobian of all unknowns including nuisances, with the rows of the priors, shape (N, k).
        modes: whitened modes, zero outside their region and in the rows of the priors, shape (N, q).

    Source: Rao, Proc. Cambridge Philosophical Society 44 (1948) 50.
    """
    left, sizes, right = np.linalg.svd(modes, full_matrices=False)
    kept = sizes > SCORE_TEST.rank_tolerance * sizes.max(initial=0.0)
    left, sizes, right = left[:, kept], sizes[kept], right[kept]
    fitted = compute_orthonormal_basis(design)
    free = left - fitted @ (fitted.T @ left)
    fractions, axes = np.linalg.eigh(free.T @ free)
    testable = fractions > SCORE_TEST.min_free_fraction
    fractions, axes = fractions[testable], axes[:, testable]
    # The projected modes are orthogonal to the design, so a remaining gradient of the fit does not enter the score.
    score = axes.T @ (free.T @ residual)
    statistic, freedom = float(np.sum(score**2 / fractions)), int(fractions.size)
    p = float(special.chdtrc(freedom, statistic)) if freedom else 1.0
    return RegionScoreTest(statistic, freedom, p, -right.T @ ((axes @ (score / fractions)) / sizes))


def make_cosine_modes(position: np.ndarray, count: int) -> np.ndarray:
    """Return the cosine modes cos(k pi x) for k = 0 to count - 1, shape (n, count).

    Args:
        position: positions x in a region, 0 at its first sample and 1 at its last, shape (n,).
        count: number of modes.
    """
    return np.cos(np.pi * np.outer(position, np.arange(count)))


def adjust_p_values_by_holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Adjust p values for multiple tests by Holm's step-down method.

    With p_(1) <= ... <= p_(n), the adjusted value of p_(i) is the maximum of min((n - j + 1) p_(j), 1) over j <= i.
    Rejection of all hypotheses with an adjusted p value below alpha keeps the family-wise error rate below alpha.

    Args:
        p_values: p values of the tests, shape (n,).

    Returns:
        Adjusted p values in the same order, shape (n,).

    Source: Holm, Scandinavian J. of Statistics 6 (1979) 65.
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return adjusted


def compute_orthonormal_basis(design: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the column space of a matrix, shape (N, rank).

    Args:
        design: matrix whose columns may have different scales and be linearly dependent, shape (N, k).
    """
    scale = np.sqrt(np.sum(design**2, axis=0))
    left, sizes, _ = np.linalg.svd(design / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return left[:, sizes > SCORE_TEST.rank_tolerance * sizes.max(initial=0.0)]
