"""A load at the zero of the displacement: a preload, or a load cell that was not zeroed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Fraction of the largest displacement over which the start of the curve is fitted.
_START = 0.15
#: Fewest samples of that start.
_FEWEST = 6
#: A recording whose displacement begins farther from zero than this fraction of its range states its own zero.
_ELSEWHERE = 0.05
#: Load at zero as a fraction of the range, above which the moduli err by more than 4 %.
_FRACTION = 0.02
#: Load at zero in standard errors of its estimate.
_SIGNIFICANT = 6.0


class LoadAtZero(NamedTuple):
    """Load at the zero of the displacement, its fraction of the range, and the shift of contact that explains it.

    All three are negative where the load is against the direction of loading.
    """

    load: float
    fraction: float
    shift: float


def load_at_zero(motion: np.ndarray, load: np.ndarray) -> LoadAtZero | None:
    """Load at which the first loading begins, from a parabola through its start; None where it begins at zero.

    Args:
        motion, load: positive under load, the motion from its zero, in the order of time, shape (n,).
    """
    peak = int(np.argmax(motion)) + 1
    reach = float(np.ptp(motion))
    if peak < _FEWEST or not reach > 0 or not np.ptp(load) > 0 or abs(motion[0]) > _ELSEWHERE * reach:
        return None
    start = max(int(np.argmax(motion[:peak] > motion[0] + _START * (motion[peak - 1] - motion[0]))), _FEWEST)
    way, felt = motion[:start], load[:start]
    if np.unique(way).size < 4:
        return None
    coefficients = np.polynomial.polynomial.polyfit(way / reach, felt, 2)
    design = np.vander(way / reach, 3, increasing=True)
    gaps = felt - design @ coefficients
    variance = float(np.sum(gaps**2)) / max(start - 3, 1)
    covariance = variance * np.linalg.pinv(design.T @ design)
    range_of_load = float(np.ptp(load))
    at_zero, slope = float(coefficients[0]), float(np.polyfit(way, felt, 1)[0])
    if slope <= 0 or abs(at_zero) < max(_FRACTION * range_of_load, _SIGNIFICANT * float(np.sqrt(covariance[0, 0]))):
        return None
    return LoadAtZero(at_zero, at_zero / range_of_load, at_zero / slope)
