"""Linear algebra for a few dozen unknowns, where the argument checks of NumPy take longer than the arithmetic."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import lapack


def euclidean_norm(vector: np.ndarray) -> float:
    """Return the Euclidean norm of a vector."""
    return math.sqrt(vector @ vector)


def solve_dense_system_or_raise(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a dense linear system by LU factorisation (LAPACK gesv).

    Args:
        matrix: square matrix, shape (n, n).
        right: one right-hand side, shape (n,), or several, shape (n, k).

    Raises:
        numpy.linalg.LinAlgError: the matrix is singular.
    """
    _, _, found, info = lapack.dgesv(matrix, right)
    if info:
        raise np.linalg.LinAlgError("the tangent stiffness of the reduced solid is singular")
    return found


def estimate_nonlinear_residual(remainder: np.ndarray, previous_work: float, work: float) -> float:
    """Estimate the norm of the residual after a linear step from the residual after the previous linear step, N.

    The remainder of a linearisation grows with the square of the step, at least with its first power. With the work
    W = du' K du of a step du, the estimate is |r| s max(1, s) with s = sqrt(W / W_previous).

    Args:
        remainder: difference between the nonlinear and the linear forces after the previous step, N, shape (n,).
        previous_work: work of the previous step, J.
        work: work of the present step, J.

    Returns:
        Estimated norm of the residual, N; infinite if either work is not positive.
    """
    ratio = math.sqrt(work / previous_work) if work > 0.0 and previous_work > 0.0 else math.inf
    return euclidean_norm(remainder) * ratio * max(1.0, ratio)
