"""Estimate the load at zero displacement: a preload, or a load cell that was not zeroed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class PreloadSettings:
    """Settings of `estimate_load_at_zero_displacement`.

    Attributes:
        starts: fractions of the largest displacement over which the start of the curve is fitted, each with the degree
            of the polynomial. A longer start is used if a shorter one is too noisy to show `fraction`. For neo-Hookean
            curves up to a stretch of 2 or down to 0.6 these polynomials err by at most 0.8 % of the range at zero.
        fewest: fewest samples of that start.
        start_offset: largest first displacement, as a fraction of the range. A recording that starts farther from zero
            has a known zero.
        fraction: load at zero, as a fraction of the range, above which the moduli err by more than 4 %.
        still: largest motion between neighbouring samples of a hold, as a fraction of the range.
        hold: fewest samples of a hold.
        significant: load at zero in standard errors of its estimate, above which the load is significant.
    """

    starts: tuple[tuple[float, int], ...] = ((0.15, 2), (0.3, 2), (0.6, 2), (1.0, 3))
    fewest: int = 6
    start_offset: float = 0.05
    fraction: float = 0.02
    still: float = 1e-3
    hold: int = 5
    significant: float = 6.0


#: Settings that the functions of this module use.
_SETTINGS = PreloadSettings()


class LoadAtZeroAndContactShift(NamedTuple):
    """Load at zero displacement of a recording that starts under load.

    All values are negative for a load against the direction of loading.

    Attributes:
        load: load, N.
        fraction: load as a fraction of the range of the load.
        shift: distance between contact and zero displacement, m, if the load is a preload.
    """

    load: float
    fraction: float
    shift: float


def estimate_load_at_zero_displacement(motion: np.ndarray, load: np.ndarray) -> LoadAtZeroAndContactShift | None:
    """Estimate the load at the start of the first loading from a polynomial; None if the load starts at zero.

    Args:
        motion: displacement, m, positive under load, in the order of time, shape (n,).
        load: force, N, positive under load, shape (n,).
    """
    peak = _count_samples_before_relaxing_hold(motion, load, int(np.argmax(motion)) + 1)
    reach = float(np.ptp(motion))
    if (peak < _SETTINGS.fewest or not reach > 0 or not np.ptp(load) > 0
            or abs(motion[0]) > _SETTINGS.start_offset * reach):
        return None
    range_of_load = float(np.ptp(load))
    for fraction, degree in _SETTINGS.starts:
        limit = motion[0] + fraction * (motion[peak - 1] - motion[0])
        start = peak if fraction == 1.0 else max(int(np.argmax(motion[:peak] > limit)), _SETTINGS.fewest)
        x, y = motion[:start], load[:start]
        if np.unique(x).size < degree + 2:
            continue
        at_zero, error = _fit_polynomial_intercept(x / reach, y, degree)
        slope = float(np.polyfit(x, y, 1)[0])
        if slope > 0 and abs(at_zero) >= max(_SETTINGS.fraction * range_of_load, _SETTINGS.significant * error):
            return LoadAtZeroAndContactShift(at_zero, at_zero / range_of_load, at_zero / slope)
        if _SETTINGS.significant * error <= _SETTINGS.fraction * range_of_load:
            return None
    return None


def _count_samples_before_relaxing_hold(motion: np.ndarray, load: np.ndarray, end: int) -> int:
    """Return the number of samples before the first hold in which the load relaxes; `end` without such a hold.

    After a relaxation the load is not a function of the motion alone, and a polynomial does not show the load at zero.
    """
    still = np.abs(np.diff(motion[:end])) < _SETTINGS.still * float(np.ptp(motion))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        lost = float(np.median(load[first:first + 2]) - np.median(load[last - 1:last + 1]))
        if last - first >= _SETTINGS.hold and lost > _SETTINGS.fraction * float(np.ptp(load)):
            return first + 1
    return end


def _fit_polynomial_intercept(x: np.ndarray, y: np.ndarray, degree: int) -> tuple[float, float]:
    """Return the value at zero of a least-squares polynomial, and its standard error."""
    design = np.vander(x, degree + 1, increasing=True)
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    gaps = y - design @ coefficients
    variance = float(np.sum(gaps**2)) / max(x.size - degree - 1, 1)
    return float(coefficients[0]), float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0]))
