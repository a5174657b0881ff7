"""Where an equilibrium is likely to be, from earlier ones: by the depth of the tool, or by time where tissue swings."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

#: Earlier states that are kept.
KEPT = 3


def extrapolation(known: Sequence[float], depth: float, order: int) -> list[float]:
    """Weights of Lagrange's extrapolation from the latest state through earlier ones, `KEPT` of them.

    States that lie closer together than a tenth of the step are left out: extrapolation would magnify their rounding,
    and far away it would be a wild guess.

    Args:
        known: depths (m) of the states, or times (s), the latest first.
        depth: where to, in the same.
        order: the highest one; 0: the latest state as it is.
    """
    weights = [0.0] * KEPT
    if depth in known:
        weights[known.index(depth)] = 1.0
        return weights
    chosen, least = [0], 0.1 * abs(depth - known[0])
    for i in range(1, len(known)):
        if len(chosen) <= order and all(abs(known[i] - known[j]) >= least for j in chosen):
            chosen.append(i)
    for i in chosen:
        weights[i] = prod([(depth - known[j]) / (known[i] - known[j]) for j in chosen if j != i])
    return weights
