"""Level and colour of a force sensor's noise: read off recordings before any fit, and used to whiten them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from calibration.statistics.statistics import resolution
from tissue_sim.errors import InputError

#: One recording: force in N, shape (n,); time in s, shape (n,), or None; labels of its segments, shape (n,), or None.
Signal = tuple[np.ndarray, np.ndarray | None, Sequence | np.ndarray | None]
#: Highest degree of a segment's trend. A relaxation 100 times shorter than its hold needs about this many.
MAX_DEGREE = 24
#: A trend has at most one degree in this many samples.
SAMPLES_PER_DEGREE = 4
#: A segment of fewer samples says nothing about the noise.
FEWEST_SAMPLES = 4
#: Correlation times that are tried: from this many median steps (a correlation of neighbours of 0.7 %) ...
SHORTEST = 0.2
#: ... to this share of the longest segment, beyond which trend and noise are one.
LONGEST = 0.25
#: How many of them before the best is refined.
GRID = 16
#: Numerical floor of the level, relative to the largest force and in N: exact synthetic data do not give zero.
FLOOR, LEAST = 1e-9, 1e-12


@dataclass(frozen=True)
class SensorNoise:
    """Gaussian noise of a sensor, with the autocorrelation exp(-lag / correlation_time).

    Attributes:
        deviation: standard deviation of every sample, N.
        correlation_time: s, or in samples where recordings have no time; 0 is white.
        source: where the deviation comes from: ``"stated"``, ``"estimated"`` or ``"resolution"`` (the sensor's step
            is coarser than the scatter).

    Raises:
        InputError: a deviation that is not positive, a negative correlation time.
    """

    deviation: float
    correlation_time: float = 0.0
    source: str = "stated"

    def __post_init__(self):
        if not 0 < self.deviation < np.inf:
            raise InputError(f"{self.deviation:g} N is not a noise level; give a number above zero", field="deviation")
        if not 0 <= self.correlation_time < np.inf:
            raise InputError(f"{self.correlation_time:g} s is not a correlation time; give 0 for white noise or a "
                             "number above zero", field="correlation_time")


def whiten(columns: np.ndarray, time: np.ndarray | None, noise: SensorNoise) -> np.ndarray:
    """Columns multiplied by L^-1, where L L' is the covariance of the noise, in O(n).

    Samples with one time stamp come from a clock that is coarser than the sampling: they count as spread evenly up to
    the next stamp.

    Args:
        columns: in N (per unit of whatever), shape (n,) or (n, k).
        time: s, not decreasing, shape (n,); None: the number of the sample. Not used for white noise.
        noise: of the sensor.

    Returns:
        The columns in units of the noise, same shape.

    Source: the process is Markov, so every sample needs its predecessor only (Gillespie, Phys. Rev. E 54 (1996) 2084).
    """
    columns = np.asarray(columns, dtype=float)
    if not noise.correlation_time:
        return columns / noise.deviation
    kept, fresh = _memory(spread_stamps(time, columns.shape[0]), noise.correlation_time)
    return _innovations(columns, kept, fresh) / noise.deviation


def estimate_shared_noise(recordings: Sequence[Signal], *, deviation: float | None = None,
                          correlation_time: float | None = None) -> SensorNoise:
    """One noise for all recordings of a sensor, from their scatter about smooth trends, without a model of the tissue.

    Every run of equal segment labels has a polynomial in time as its trend. Its degree, and whether the noise has a
    colour, are those with the least Schwarz criterion (BIC): each degree and the correlation time must raise the
    log-likelihood by half the logarithm of the number of samples of all recordings. Level and colour then follow
    from the restricted likelihood, so that what the trends absorb is counted. The level is at least the rounding error
    of the sensor's step. Correlation times up to a twentieth of the longest segment come out right in the mean; at a
    tenth the trends absorb up to a third of the variance, and slower noise cannot be told from a trend.

    Args:
        recordings: force, time and segment labels of each; without labels a recording is one segment, and corners in
            its force count as noise where the trend cannot follow them.
        deviation: N, where it is stated; only the colour is estimated then, from the shape of the autocorrelation, so
            that a level which is stated too high or too low makes no colour.
        correlation_time: s (in samples without time), where it is stated, 0 for white; only the level is estimated.

    Raises:
        InputError: no segment has `FEWEST_SAMPLES` samples, a stated value out of range.

    Source: Patterson and Thompson, Biometrika 58 (1971) 545 (restricted likelihood); Schwarz, Annals of Statistics 6
        (1978) 461; Bennett, Bell System Technical Journal 27 (1948) 446 (rounding).
    """
    if deviation is not None and correlation_time is not None:
        return SensorNoise(deviation, correlation_time)
    checked = SensorNoise(1.0 if deviation is None else deviation, correlation_time or 0.0)
    pieces = [piece for force, time, segment in recordings for piece in _pieces(force, time, segment)]
    if not pieces:
        raise InputError(f"no segment has {FEWEST_SAMPLES} samples, which is too few to estimate the noise from; "
                         "state it", field="noise.force_N")
    tau, degrees = _select(pieces, correlation_time)
    if correlation_time is None and tau:
        tau = _refine(pieces, degrees, tau)
    if deviation is not None:
        return replace(checked, correlation_time=tau)
    squares, freedom, _ = _restricted(pieces, degrees, tau)
    level = float(np.sqrt(squares / freedom))
    rounding = max(resolution(np.asarray(force, dtype=float)) for force, _, _ in recordings) / float(np.sqrt(12.0))
    floor = max(LEAST, *(FLOOR * float(np.abs(force).max()) for force, _, _ in recordings))
    if max(level, rounding) <= floor:  # Rounding of floating point has no colour.
        return replace(checked, deviation=floor, source="estimated")
    return SensorNoise(max(level, rounding), tau, "resolution" if rounding > level else "estimated")


@dataclass(frozen=True, eq=False)
class _Piece:
    """One segment of one recording: Legendre columns of the trend and the force last, (n, degrees + 2); time, (n,)."""

    columns: np.ndarray
    time: np.ndarray

    def triangle(self, tau: float) -> tuple[np.ndarray, float]:
        """R of the whitened columns, and log det of the correlation matrix. Leading parts of R are lower degrees."""
        if not tau:
            return np.asarray(np.linalg.qr(self.columns, mode="r")), 0.0
        kept, fresh = _memory(self.time, tau)
        whitened = np.asarray(np.linalg.qr(_innovations(self.columns, kept, fresh), mode="r"))
        return whitened, 2.0 * float(np.log(fresh).sum())


def _pieces(force: np.ndarray, time: np.ndarray | None, segment: Sequence | np.ndarray | None) -> list[_Piece]:
    force = np.asarray(force, dtype=float)
    time = spread_stamps(time, force.size)
    starts = [0] if segment is None else [0, *(np.flatnonzero(np.asarray(segment)[1:] != np.asarray(segment)[:-1]) + 1)]
    pieces = []
    for first, last in zip(starts, [*starts[1:], force.size], strict=True):
        if last - first < FEWEST_SAMPLES:
            continue
        t, degree = time[first:last], min(MAX_DEGREE, (last - first) // SAMPLES_PER_DEGREE)
        basis = legvander(2.0 * (t - t[0]) / (t[-1] - t[0]) - 1.0, degree)
        pieces.append(_Piece(np.column_stack([basis, force[first:last]]), t))
    return pieces


def _select(pieces: list[_Piece], stated: float | None) -> tuple[float, list[int]]:
    """Correlation time and degree of each segment's trend with the least BIC."""
    samples = sum(piece.time.size for piece in pieces)
    candidates = [0.0] if stated is None else [stated]
    if stated is None:
        steps = np.concatenate([np.diff(piece.time) for piece in pieces])
        longest = LONGEST * max(piece.time[-1] - piece.time[0] for piece in pieces)
        shortest = SHORTEST * float(np.median(steps))
        candidates += list(np.geomspace(shortest, longest, GRID)) if longest > shortest else []
    best: tuple[float, float, list] = (np.inf, 0.0, [])
    for tau in candidates:
        triangles, logarithms = zip(*(piece.triangle(tau) for piece in pieces), strict=True)
        # Sum of squared residuals of each segment for each degree, from 0 up.
        squares = [np.cumsum(R[:, -1][::-1]**2)[::-1][1:] for R in triangles]
        degrees = _degrees(squares, samples)
        total = sum(part[k] for part, k in zip(squares, degrees, strict=True))
        terms = sum(degrees) + (1 if tau and stated is None else 0)
        criterion = samples * np.log(max(total / samples, LEAST**2)) + sum(logarithms) + terms * np.log(samples)
        if criterion < best[0]:
            best = (criterion, float(tau), degrees)
    return best[1], best[2]


def _degrees(squares: list[np.ndarray], samples: int) -> list[int]:
    """Degree of each segment's trend with the least BIC, from the highest down; squares: of each, shape (degrees,)."""
    degrees = [part.size - 1 for part in squares]
    while True:
        freedom = samples - sum(k + 1 for k in degrees)
        total = sum(part[k] for part, k in zip(squares, degrees, strict=True))
        variance = max(total / freedom, LEAST**2)
        lower = [int(np.argmin((part / variance + np.arange(part.size) * np.log(samples))[:k + 1]))
                 for part, k in zip(squares, degrees, strict=True)]
        if lower == degrees:
            return degrees
        degrees = lower


def _restricted(pieces: list[_Piece], degrees: list[int], tau: float) -> tuple[float, int, float]:
    """Residual sum of squares, degrees of freedom, and the log-determinants of -2 log restricted likelihood."""
    squares, freedom, logarithm = 0.0, 0, 0.0
    for piece, degree in zip(pieces, degrees, strict=True):
        R, own = piece.triangle(tau)
        fixed = degree + 1
        squares += float(R[fixed:, -1] @ R[fixed:, -1])
        freedom += piece.time.size - fixed
        logarithm += own + 2.0 * float(np.log(np.abs(np.diag(R)[:fixed])).sum())
    return squares, freedom, logarithm


def _refine(pieces: list[_Piece], degrees: list[int], tau: float) -> float:
    """Correlation time with the largest restricted likelihood near a first guess."""
    from scipy.optimize import minimize_scalar  # on use: what is wrong in a file is said before scipy is there

    def criterion(logarithm: float) -> float:
        squares, freedom, determinants = _restricted(pieces, degrees, float(np.exp(logarithm)))
        return freedom * np.log(max(squares / freedom, LEAST**2)) + determinants

    # The restricted likelihood's optimum lies above the likelihood's that chose the guess.
    bounds = (np.log(tau / 2.0), np.log(3.0 * tau))
    return float(np.exp(minimize_scalar(criterion, bounds=bounds, method="bounded", options={"xatol": 1e-3}).x))


def spread_stamps(time: np.ndarray | None, samples: int) -> np.ndarray:
    """Times with repeated stamps spread evenly up to the next stamp; the number of the sample without times."""
    if time is None:
        return np.arange(samples, dtype=float)
    time = np.asarray(time, dtype=float)
    first = np.flatnonzero(np.diff(time, prepend=-np.inf) > 0)
    if first.size == samples:
        return time
    if first.size == 1:
        return np.arange(samples, dtype=float)
    # The last stamp has no next one: its samples take the mean interval between samples.
    step = (time[-1] - time[0]) / (first[-1] - first[0])
    end = time[-1] + step * (samples - first[-1])
    return np.interp(np.arange(samples), [*first, samples], [*time[first], end])


def _memory(time: np.ndarray, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of each sample with the one before (0 for the first), and the deviation of what is new in it."""
    lag = np.diff(time, prepend=-np.inf) / tau
    return np.exp(-lag), np.sqrt(-np.expm1(-2.0 * lag))


def _innovations(columns: np.ndarray, kept: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """What is new in each sample, in units of its deviation."""
    shape = (-1, *([1] * (columns.ndim - 1)))
    before = np.concatenate([np.zeros_like(columns[:1]), columns[:-1]])
    return (columns - kept.reshape(shape) * before) / fresh.reshape(shape)
