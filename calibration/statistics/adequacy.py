"""Does the model leave something in the residuals that is smooth, and where? Score tests, region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

#: A direction of which the fit absorbs all but this share of the squares cannot be tested.
ABSORBED = 1e-3
#: Directions with less than this share of the largest singular value are the others again.
INDEPENDENT = 1e-10


@dataclass(frozen=True, eq=False)
class Misfit:
    """What a score test finds in one region.

    Attributes:
        statistic: chi-square distributed where the model is right.
        freedom: its degrees of freedom: modes that the fit cannot absorb; 0 where it absorbs all of them.
        p: probability of a larger statistic where the model is right; 1 without freedom.
        amplitudes: of the modes, shape (q,): data = model + sum of amplitudes times modes, so positive where the model
            is too soft. Directions that the fit absorbs count as zero.
    """

    statistic: float
    freedom: int
    p: float
    amplitudes: np.ndarray


def misfit(residual: np.ndarray, design: np.ndarray, modes: np.ndarray) -> Misfit:
    """Score test of modes that the model lacks, at the optimum of the fit, without a second fit.

    With r = residual, A = design, M = modes: score S = M'r, information I = M'M - M'A (A'A)^-1 A'M, and S' I^-1 S is
    the statistic.

    Args:
        residual: model minus data in units of the noise, with the rows of the priors, shape (N,).
        design: Jacobian of all unknowns, nuisances included, with the rows of the priors, shape (N, k).
        modes: whitened as the residual is, zero outside their region and in the rows of the priors, shape (N, q).

    Source: Rao, Proc. Cambridge Philosophical Society 44 (1948) 50.
    """
    left, sizes, right = np.linalg.svd(modes, full_matrices=False)
    kept = sizes > INDEPENDENT * sizes.max(initial=0.0)
    left, sizes, right = left[:, kept], sizes[kept], right[kept]
    fitted = span(design)
    free = left - fitted @ (fitted.T @ left)
    shares, axes = np.linalg.eigh(free.T @ free)
    testable = shares > ABSORBED
    shares, axes = shares[testable], axes[:, testable]
    # Of the projected modes, so that what is left of the gradient at the optimum does not count.
    score = axes.T @ (free.T @ residual)
    statistic, freedom = float(np.sum(score**2 / shares)), int(shares.size)
    p = float(special.chdtrc(freedom, statistic)) if freedom else 1.0
    return Misfit(statistic, freedom, p, -right.T @ ((axes @ (score / shares)) / sizes))


def cosine_modes(position: np.ndarray, count: int) -> np.ndarray:
    """Cosines from the constant up: cos(k pi position), k = 0 to count - 1, shape (n, count).

    Args:
        position: in the region, from 0 at its first sample to 1 at its last, shape (n,).
        count: number of modes.
    """
    return np.cos(np.pi * np.outer(position, np.arange(count)))


def holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """P values adjusted for their number, same order: those below alpha are all right together at level alpha.

    Source: Holm, Scandinavian J. of Statistics 6 (1979) 65.
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return adjusted


def span(design: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span those of the design, which may be of any scale and dependent."""
    scale = np.sqrt(np.sum(design**2, axis=0))
    left, sizes, _ = np.linalg.svd(design / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return left[:, sizes > INDEPENDENT * sizes.max(initial=0.0)]
