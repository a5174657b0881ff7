"""Linear algebra of a few dozen unknowns, where NumPy's checks take longer than the arithmetic."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import lapack


def size(vector: np.ndarray) -> float:
    """Euclidean norm of a vector."""
    return math.sqrt(vector @ vector)


def solution(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Of a linear system with one right-hand side, shape (n,), or several, (n, k).

    Raises:
        numpy.linalg.LinAlgError: the matrix is singular.
    """
    _, _, found, info = lapack.dgesv(matrix, right)
    if info:
        raise np.linalg.LinAlgError("a linear system on the modes is singular")
    return found


def bend(off: np.ndarray, before: float, now: float) -> float:
    """How far forces may be off after a linear change, N, by how far they were off after the last one; of both the work
    that they would do, J."""
    share = math.sqrt(now / before) if now > 0.0 and before > 0.0 else math.inf
    return size(off) * share * max(1.0, share)
