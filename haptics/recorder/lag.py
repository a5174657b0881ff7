"""Measure the lag of the force behind the position from the reversal of a test on a stiff elastic object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim import Recording
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class LagSettings:
    """Settings of the profile likelihood of `estimate_force_lag`.

    Attributes:
        longest: largest magnitude of a lag that is tried, s.
        step: spacing of the lags that are tried, s; a parabola refines the minimum between them.
        degree: degree of the polynomial force(depth). A higher degree follows a more nonlinear elastic object.
        chi_square: 95 % quantile of the chi-square distribution with one degree of freedom, 1.
        loaded: fraction of the largest force above which a sample counts as loaded, 1.
        fewest: smallest number of loaded samples in loading and in unloading.
    """

    longest: float = 0.2
    step: float = 1e-3
    degree: int = 5
    chi_square: float = 3.84
    loaded: float = 0.05
    fewest: int = 40


#: Settings of every measurement.
_SETTINGS = LagSettings()


@dataclass(frozen=True)
class ForceLag:
    """Lag of the force behind the position.

    Attributes:
        value: lag, s; negative if the force is read earlier than the position.
        interval: lower and upper end of the 95 % confidence interval, s.
    """

    value: float
    interval: tuple[float, float]


def estimate_force_lag(recording: Recording) -> ForceLag:
    """Find the lag of the force for which loading and unloading give the same force at the same depth.

    Profile likelihood of the lag: for each trial lag the force is fitted by a polynomial of the shifted depth; the lag
    with the smallest sum of squared residuals is the estimate, and the curvature there gives the interval.

    The tested object must be elastic and stiff, such as steel on a spring. The hysteresis of tissue and the backlash of
    a stage have the same effect on the curve as a lag.

    Args:
        recording: time, displacement and force of loading and unloading, preferably fast.

    Returns:
        The lag and its 95 % interval.

    Raises:
        InputError: the recording has no unloading, too few loaded samples, or a lag outside of the tried range.
    """
    settings = _SETTINGS
    time, depth, force = recording.time, recording.displacement, recording.force
    is_loaded = np.abs(force) > settings.loaded * np.abs(force).max()
    deepest = int(np.argmax(depth))
    loading, unloading = np.count_nonzero(is_loaded[:deepest]), np.count_nonzero(is_loaded[deepest:])
    if loading < settings.fewest or unloading < settings.fewest:
        raise InputError(f"the recording must have at least {settings.fewest} samples under load in loading and in "
                         f"unloading; got {loading} and {unloading}. Use a faster sensor or a slower ramp",
                         file=recording.metadata.get("source"))
    lags = np.arange(-settings.longest, settings.longest + 0.5 * settings.step, settings.step)
    squares = np.array([_residual_sum_of_squares(time, depth, force, is_loaded, lag) for lag in lags])
    best = int(np.argmin(squares))
    if best in (0, lags.size - 1):
        raise InputError(f"the lag must be shorter than {settings.longest:g} s and the tested object elastic. Press on "
                         "a stiff elastic object", file=recording.metadata.get("source"))
    # Parabola through the three lowest sums: its minimum, and its rise by the chi-square quantile.
    below, lowest, above = squares[best - 1:best + 2]
    curvature = (below - 2 * lowest + above) / settings.step**2
    value = lags[best] + 0.5 * settings.step * (below - above) / (below - 2 * lowest + above)
    variance = lowest / (np.count_nonzero(is_loaded) - settings.degree - 2)
    half_width = float(np.sqrt(2 * settings.chi_square * variance / curvature))
    return ForceLag(float(value), (float(value - half_width), float(value + half_width)))


def _residual_sum_of_squares(time: np.ndarray, depth: np.ndarray, force: np.ndarray, is_loaded: np.ndarray,
                             lag: float) -> float:
    """Return the sum of squared residuals of a polynomial force(depth) with the depth shifted by a lag.

    Args:
        time: s, shape (n,).
        depth: m, shape (n,).
        force: N, shape (n,).
        is_loaded: mask of the fitted samples, shape (n,).
        lag: s.

    Returns:
        Sum of squares, N^2.
    """
    shifted = np.interp(time - lag, time, depth)[is_loaded]
    scaled = shifted / (np.abs(shifted).max() or 1.0)
    powers = scaled[:, None] ** np.arange(_SETTINGS.degree + 1)
    coefficients, *_ = np.linalg.lstsq(powers, force[is_loaded], rcond=None)
    residual = force[is_loaded] - powers @ coefficients
    return float(residual @ residual)
