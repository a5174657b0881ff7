"""Predictor of the next equilibrium: Lagrange extrapolation of earlier states by depth or by time."""

from __future__ import annotations

from collections.abc import Sequence

#: Number of stored states from which the predictor extrapolates.
KEPT = 3


def compute_extrapolation_weights(known: Sequence[float], depth: float, order: int) -> list[float]:
    """Return the weights with which Lagrange extrapolation combines the `KEPT` stored states.

    w_i = prod over j != i of (d - d_j) / (d_i - d_j). States closer together than a tenth of the step are omitted,
    because extrapolation would amplify their rounding errors.

    Args:
        known: depths (m) or times (s) of the states, the latest first.
        depth: depth or time to which the states are extrapolated, in the same unit.
        order: highest polynomial order; 0 returns the latest state.
    """
    weights = [0.0] * KEPT
    if depth in known:
        weights[known.index(depth)] = 1.0
        return weights
    # Plain loops: this function runs in every step, and generators take twice the time.
    chosen, least = [0], 0.1 * abs(depth - known[0])
    for i in range(1, len(known)):
        if len(chosen) > order:
            break
        for j in chosen:
            if abs(known[i] - known[j]) < least:
                break
        else:
            chosen.append(i)
    for i in chosen:
        weight = 1.0
        for j in chosen:
            if j != i:
                weight *= (depth - known[j]) / (known[i] - known[j])
        weights[i] = weight
    return weights
