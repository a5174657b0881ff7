"""A load at the zero of the displacement: a preload, or a load cell that was not zeroed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Fractions of the largest displacement over which the start of the curve is fitted, and the degree of the polynomial.
#: A longer start is fitted where a shorter one is too noisy to show `_FRACTION`. For neo-Hookean curves up to a stretch
#: of 2 or down to 0.6 these polynomials err by at most 0.8 % of the range at zero.
_STARTS = ((0.15, 2), (0.3, 2), (0.6, 2), (1.0, 3))
#: Fewest samples of that start.
_FEWEST = 6
#: A recording whose displacement begins farther from zero than this fraction of its range states its own zero.
_ELSEWHERE = 0.05
#: Load at zero as a fraction of the range, above which the moduli err by more than 4 %.
_FRACTION = 0.02
#: Motion between neighbours of a hold, as a fraction of the range, and fewest of its samples.
_STILL = 1e-3
_HOLD = 5
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
    """Load at which the first loading begins, from a polynomial through its start; None where it begins at zero.

    Args:
        motion, load: positive under load, the motion from its zero, in the order of time, shape (n,).
    """
    peak = _before_relaxation(motion, load, int(np.argmax(motion)) + 1)
    reach = float(np.ptp(motion))
    if peak < _FEWEST or not reach > 0 or not np.ptp(load) > 0 or abs(motion[0]) > _ELSEWHERE * reach:
        return None
    range_of_load = float(np.ptp(load))
    for fraction, degree in _STARTS:
        limit = motion[0] + fraction * (motion[peak - 1] - motion[0])
        start = peak if fraction == 1.0 else max(int(np.argmax(motion[:peak] > limit)), _FEWEST)
        way, felt = motion[:start], load[:start]
        if np.unique(way).size < degree + 2:
            continue
        at_zero, error = _intercept(way / reach, felt, degree)
        slope = float(np.polyfit(way, felt, 1)[0])
        if slope > 0 and abs(at_zero) >= max(_FRACTION * range_of_load, _SIGNIFICANT * error):
            return LoadAtZero(at_zero, at_zero / range_of_load, at_zero / slope)
        if _SIGNIFICANT * error <= _FRACTION * range_of_load:
            return None
    return None


def _before_relaxation(motion: np.ndarray, load: np.ndarray, end: int) -> int:
    """Number of samples up to the first hold of the motion in which the load relaxes; `end` without such a hold.

    From there on the load is no function of the motion alone, and no curve through it shows the load at zero.
    """
    still = np.abs(np.diff(motion[:end])) < _STILL * float(np.ptp(motion))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        lost = float(np.median(load[first:first + 2]) - np.median(load[last - 1:last + 1]))
        if last - first >= _HOLD and lost > _FRACTION * float(np.ptp(load)):
            return first + 1
    return end


def _intercept(way: np.ndarray, felt: np.ndarray, degree: int) -> tuple[float, float]:
    """Value at zero of a least-squares polynomial, and its standard error."""
    design = np.vander(way, degree + 1, increasing=True)
    coefficients = np.linalg.lstsq(design, felt, rcond=None)[0]
    gaps = felt - design @ coefficients
    variance = float(np.sum(gaps**2)) / max(way.size - degree - 1, 1)
    return float(coefficients[0]), float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0]))
