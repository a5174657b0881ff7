"""Which elements stand for all of a solid: energy-conserving sampling and weighting.

Source: Farhat, Avery, Chapman and Cortial, Int. J. Numer. Meth. Engng 98 (2014) 625; the sparse solution of the
non-negative least squares is that of Lawson and Hanson, ended early (Chapman et al., Int. J. Numer. Meth. Engng 109
(2017) 1623).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Most passes of the inner loop for one element that comes in.
_MOST_LEAVING = 1000


def sparse_weights(contributions: np.ndarray, tolerance: float, most: int | None = None,
                   progress: Callable[[int, float], None] | None = None) -> np.ndarray:
    """Non-negative weights of few elements whose weighted contributions add up to those of all.

    Args:
        contributions: of each element to each thing that has to be right, shape (things, elements).
        tolerance: norm of the error over that of the sum.
        most: elements at most.
        progress: called with the number of elements and the error so far.

    Returns:
        Weights, mostly 0, shape (elements,).
    """
    count = contributions.shape[1]
    most = count if most is None else min(most, count)
    goal = contributions.sum(axis=1)
    scale = float(np.linalg.norm(goal))
    if scale == 0.0:
        return np.ones(count)
    # Normal equations: the tolerance is far above what they lose.
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
        for _ in range(_MOST_LEAVING):
            places = np.flatnonzero(chosen)
            block = gram[np.ix_(places, places)]
            solution = np.linalg.lstsq(block, right[places], rcond=1e-12)[0] if len(places) < 3 else (
                np.linalg.solve(block + 1e-12 * np.trace(block) / len(places) * np.eye(len(places)), right[places]))
            if (solution > 0.0).all():
                weights[:] = 0.0
                weights[places] = solution
                break
            # As far towards it as all stay positive; those that reach zero leave.
            now, falls = weights[places], solution <= 0.0
            share = float(np.min(now[falls] / np.maximum(now[falls] - solution[falls], 1e-300)))
            weights[places] = now + share * (solution - now)
            leaves = places[weights[places] <= 1e-14 * weights.max(initial=1e-300)]
            weights[leaves], chosen[leaves] = 0.0, False
            if not leaves.size:
                break
