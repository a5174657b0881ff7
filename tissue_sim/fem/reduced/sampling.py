"""Hyper-reduction by energy-conserving sampling and weighting (ECSW).

The reduced forces Phi' f = sum over all elements of Phi_e' f_e are approximated by a weighted sum over few elements,
sum of w_e Phi_e' f_e with w_e >= 0, which keeps the stiffness symmetric and the energy consistent (Farhat, Avery,
Chapman and Cortial, Int. J. Numer. Meth. Engng 98 (2014) 625). The sparse weights are a non-negative least-squares
solution by the active-set method of Lawson and Hanson with early termination (Chapman et al., Int. J. Numer. Meth.
Engng 109 (2017) 1623).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Maximum number of passes of the inner loop per element that enters the active set.
_MAX_INNER_PASSES = 1000


def compute_sparse_weights(contributions: np.ndarray, tolerance: float, most: int | None = None,
                           progress: Callable[[int, float], None] | None = None) -> np.ndarray:
    """Compute sparse non-negative weights w that satisfy |G w - G 1| <= tolerance |G 1|.

    Args:
        contributions: matrix G, contribution of each element to each reduced force, shape (forces, elements).
        tolerance: relative error of the weighted sum.
        most: maximum number of elements with a positive weight; None: no limit.
        progress: called with the number of chosen elements and the relative error after each iteration.

    Returns:
        Weights, mostly 0, shape (elements,).
    """
    count = contributions.shape[1]
    most = count if most is None else min(most, count)
    goal = contributions.sum(axis=1)
    scale = float(np.linalg.norm(goal))
    if scale == 0.0:
        return np.ones(count)
    # The normal equations lose half of the digits; the tolerance is far above this loss.
    gram, right = contributions.T @ contributions, contributions.T @ goal
    weights, chosen = np.zeros(count), np.zeros(count, dtype=bool)
    while True:
        slope = right - gram @ weights
        error = float(np.sqrt(max(scale**2 - weights @ (right + slope), 0.0))) / scale
        if progress:
            progress(int(chosen.sum()), error)
        slope[chosen] = -np.inf
        best = int(np.argmax(slope))
        if error <= tolerance or chosen.sum() >= most or not slope[best] > 0.0:
            return weights
        chosen[best] = True
        for _ in range(_MAX_INNER_PASSES):
            active = np.flatnonzero(chosen)
            block = gram[np.ix_(active, active)]
            solution = np.linalg.lstsq(block, right[active], rcond=1e-12)[0] if len(active) < 3 else (
                np.linalg.solve(block + 1e-12 * np.trace(block) / len(active) * np.eye(len(active)), right[active]))
            if (solution > 0.0).all():
                weights[:] = 0.0
                weights[active] = solution
                break
            # Go towards the solution until the first weight reaches zero; its element leaves the active set.
            now, falls = weights[active], solution <= 0.0
            step = float(np.min(now[falls] / np.maximum(now[falls] - solution[falls], 1e-300)))
            weights[active] = now + step * (solution - now)
            leaving = active[weights[active] <= 1e-14 * weights.max(initial=1e-300)]
            weights[leaving], chosen[leaving] = 0.0, False
            if not leaving.size:
                break
