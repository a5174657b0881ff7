"""By how much the force is read later than the position: what one clock cannot see, a reversal on something stiff
shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim import Recording
from tissue_sim.errors import InputError

#: Lags that are tried, s, and their step; the powers of the depth that the force of something stiff is made of.
_LONGEST, _STEP, _POWERS = 0.2, 1e-3, 5
#: Of a chi-square of one degree of freedom at 95 %.
_LIKELY = 3.84
#: Share of the largest force below which it may be out of contact.
_LOADED = 0.05
_FEWEST = 40


@dataclass(frozen=True)
class Lag:
    """How late a force is read.

    Attributes:
        value: s; negative: earlier than the position. interval: 95 %, s.
    """

    value: float
    interval: tuple[float, float]


def measure_lag(recording: Recording) -> Lag:
    """The lag at which the force of a way in and a way out is one curve of the depth.

    What was pressed has to be elastic and stiff, such as steel on a spring: the hysteresis of a tissue looks like a
    lag, and so does play of the stage. Profile likelihood of the lag, the force being a polynomial of the depth.

    Args:
        recording: with time, displacement and force, in and out again, best quickly.

    Raises:
        InputError: no way out, or too few samples under load.
    """
    time, depth, force = recording.time, recording.displacement, recording.force
    loaded = np.abs(force) > _LOADED * np.abs(force).max()
    deepest = int(np.argmax(depth))
    if np.count_nonzero(loaded[:deepest]) < _FEWEST or np.count_nonzero(loaded[deepest:]) < _FEWEST:
        raise InputError(f"a lag shows between a way in and a way out; record at least {_FEWEST} samples under load in "
                         "each", file=recording.metadata.get("source"))
    lags = np.arange(-_LONGEST, _LONGEST + 0.5 * _STEP, _STEP)
    squares = np.array([_misfit(time, depth, force, loaded, lag) for lag in lags])
    best = int(np.argmin(squares))
    if best in (0, lags.size - 1):
        raise InputError(f"the lag is longer than {_LONGEST:g} s, or what was pressed is not elastic; press something "
                         "stiff", file=recording.metadata.get("source"))
    # Between the three lowest, a parabola: its bottom, and where it has risen by what is likely.
    below, lowest, above = squares[best - 1:best + 2]
    curvature = (below - 2 * lowest + above) / _STEP**2
    value = lags[best] + 0.5 * _STEP * (below - above) / (below - 2 * lowest + above)
    variance = lowest / (np.count_nonzero(loaded) - _POWERS - 2)
    half = float(np.sqrt(2 * _LIKELY * variance / curvature))
    return Lag(float(value), (float(value - half), float(value + half)))


def _misfit(time: np.ndarray, depth: np.ndarray, force: np.ndarray, loaded: np.ndarray, lag: float) -> float:
    """Sum of squares that a curve of the depth, so much earlier, s, leaves of the force."""
    place = np.interp(time - lag, time, depth)[loaded]
    scaled = place / (np.abs(place).max() or 1.0)
    powers = scaled[:, None] ** np.arange(_POWERS + 1)
    coefficients, *_ = np.linalg.lstsq(powers, force[loaded], rcond=None)
    left = force[loaded] - powers @ coefficients
    return float(left @ left)
