"""Starting values of an inverse fit."""

from __future__ import annotations

from itertools import combinations_with_replacement, cycle

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace

#: Starting values of exponents in the order of their use. Moduli need no such list: the fit rescales them at once.
EXPONENTS = (2.0, 8.0, -4.0, 15.0, -10.0, 4.0, -2.0)
#: Factors of single parameters in further starts.
FACTORS = (3.0, 1.0 / 3.0, 10.0, 0.1)
#: Starting value of the first modulus, Pa; that of modulus i is smaller by 1 / i.
_MODULUS = 1000.0


def list_starts_with_varied_exponents(space: ParameterSpace, count: int) -> list[np.ndarray]:
    """Return starting values of a law: those that the campaign states, then others spread around them.

    Args:
        space: parameter space of the law.
        count: maximum number of starts.

    Returns:
        Free parameters inside their bounds, SI, each of shape (p,).
    """
    exponents = [each.name for each in space.free_parameters if each.is_dimensionless_law_parameter]
    grids = [grid for grid in combinations_with_replacement(EXPONENTS, len(exponents))
             if len(set(grid)) == len(grid)] or [()]
    # Exponents of different signs come before those of equal signs.
    grids.sort(key=lambda grid: (len({np.sign(e) for e in grid}) < min(len(grid), 2),
                                 sum(EXPONENTS.index(e) for e in grid)))
    found: list[np.ndarray] = []
    moduli = [each.name for each in space.free_parameters if each.is_modulus]
    for turns, grid in enumerate(cycle(grids)):
        factors = [1.0] * len(space.free)
        if turns >= len(grids) and len(space.free) > 1:
            step = turns // len(grids) - 1
            place = step % len(space.free)
            factors[place] = FACTORS[step // len(space.free) % len(FACTORS)]
        guess = dict(zip(exponents, grid, strict=True))
        guess |= {name: _MODULUS / (1 + i) for i, name in enumerate(moduli)}
        values = [space.start.get(name, guess.get(name, 1.0)) for name in space.free]
        theta = np.clip(np.array(values) * factors, space.low, space.high)
        if not any(np.allclose(theta, other) for other in found):
            found.append(theta)
        if len(found) >= count or turns > 50 * count:
            return found
    return found
