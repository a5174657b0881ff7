"""Level and autocorrelation of a force sensor's noise: estimation from recordings, and whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from calibration.statistics.statistics import find_quantisation_step
from tissue_sim.errors import InputError

#: One recording: force, N, shape (n,); time, s, shape (n,), or None; labels of the segments, shape (n,), or None.
Signal = tuple[np.ndarray, np.ndarray | None, Sequence | np.ndarray | None]


@dataclass(frozen=True)
class SensorNoiseSettings:
    """Settings of the estimate of the noise of a force sensor.

    Attributes:
        max_degree: highest polynomial degree of a segment's trend; a relaxation 100 times shorter than its hold needs
            about this degree.
        samples_per_degree: smallest number of samples per degree of a trend.
        shortest: shortest trial correlation time, in median sampling intervals; the correlation of neighbours is 0.7 %.
        longest: longest trial correlation time, as a fraction of the longest segment; slower noise cannot be
            distinguished from a trend.
        grid: number of trial correlation times before the best one is refined.
        relative_floor: smallest noise level relative to the largest force; exact synthetic data would give zero.
        floor: smallest noise level, N.
        min_samples: smallest number of samples of a segment from which the noise is estimated.
    """

    max_degree: int = 24
    samples_per_degree: int = 4
    shortest: float = 0.2
    longest: float = 0.25
    grid: int = 16
    relative_floor: float = 1e-9
    floor: float = 1e-12
    min_samples: int = 4


_SETTINGS = SensorNoiseSettings()


@dataclass(frozen=True)
class SensorNoise:
    """Gaussian noise of a sensor with the autocorrelation exp(-lag / correlation_time).

    Attributes:
        deviation: standard deviation of each sample, N.
        correlation_time: correlation time, s, or in samples for recordings without time; 0: white noise.
        source: origin of the deviation: ``"stated"``, ``"estimated"`` or ``"resolution"`` (the quantisation step of the
            sensor exceeds the scatter).

    Raises:
        InputError: the deviation is not positive, or the correlation time is negative.
    """

    deviation: float
    correlation_time: float = 0.0
    source: str = "stated"

    def __post_init__(self):
        if not 0 < self.deviation < np.inf:
            raise InputError(f"deviation must be positive; got {self.deviation:g} N", field="deviation")
        if not 0 <= self.correlation_time < np.inf:
            raise InputError(f"correlation_time must be 0 (white noise) or positive; got {self.correlation_time:g} s",
                             field="correlation_time")


@dataclass(frozen=True)
class ForceControlNoise:
    """Noise of both channels of a recording whose force is controlled.

    Attributes:
        displacement: standard deviation of the displacement, m.
        force: standard deviation of the force sensor, N. This noise does not change the force on the specimen.
    """

    displacement: float
    force: float


def whiten_columns(columns: np.ndarray, time: np.ndarray | None, noise: SensorNoise) -> np.ndarray:
    """Return columns multiplied by L^-1, where L L' is the covariance of the noise (Cholesky factor).

    The noise is an Ornstein-Uhlenbeck process. With rho_i = exp(-(t_i - t_{i-1}) / tau), row i of the result is
    (y_i - rho_i y_{i-1}) / (sigma sqrt(1 - rho_i^2)). Equal time stamps, from a clock coarser than the sampling, are
    spread evenly up to the next stamp.

    Args:
        columns: columns in N, or N per unit of a parameter, shape (n,) or (n, k).
        time: time of the samples, s, not decreasing, shape (n,); None: index of the sample. Unused for white noise.
        noise: noise of the sensor.

    Returns:
        Whitened columns in units of the noise, same shape.

    Source: Gillespie, Phys. Rev. E 54 (1996) 2084.
    """
    columns = np.asarray(columns, dtype=float)
    if not noise.correlation_time:
        return columns / noise.deviation
    spread_time = spread_time_stamps(time, columns.shape[0])
    correlation, deviation = _get_correlations_and_innovation_scales(spread_time, noise.correlation_time)
    return _compute_innovations(columns, correlation, deviation) / noise.deviation


def estimate_pooled_sensor_noise(recordings: Sequence[Signal], *, deviation: float | None = None,
                                 correlation_time: float | None = None) -> SensorNoise:
    """Estimate the common noise of the recordings of a sensor from their scatter about polynomial trends.

    Each segment has a polynomial in time as its trend. The Schwarz criterion (BIC) over all recordings selects the
    degrees and decides whether the noise is correlated. Level and correlation time then maximise the restricted
    likelihood, which accounts for the degrees of freedom of the trends. The level is at least the rounding error of the
    sensor's quantisation step. Correlation times up to 1/20 of the longest segment are estimated without bias; at 1/10
    the trends absorb up to a third of the variance, and slower noise cannot be distinguished from a trend.

    Args:
        recordings: force, time and segment labels of each recording. A recording without labels is one segment, and
            corners of its force that the trend cannot follow count as noise.
        deviation: stated standard deviation, N; only the correlation time is estimated then, from the shape of the
            autocorrelation and independently of this value. None: it is estimated.
        correlation_time: stated correlation time, s (in samples without time), 0 for white noise; only the level is
            estimated then. None: it is estimated.

    Raises:
        InputError: no segment has `SensorNoiseSettings.min_samples` samples, or a stated value is out of range.

    Source: Patterson and Thompson, Biometrika 58 (1971) 545 (restricted likelihood); Schwarz, Annals of Statistics 6
        (1978) 461; Bennett, Bell System Technical Journal 27 (1948) 446 (rounding).
    """
    if deviation is not None and correlation_time is not None:
        return SensorNoise(deviation, correlation_time)
    checked = SensorNoise(1.0 if deviation is None else deviation, correlation_time or 0.0)
    pieces = [piece for force, time, segment in recordings
              for piece in _split_recording_by_segment_labels(force, time, segment)]
    if not pieces:
        raise InputError(f"no segment has the {_SETTINGS.min_samples} samples that an estimate of the noise requires; "
                         "state noise.force_N", field="noise.force_N")
    tau, degrees = _select_correlation_time_and_degrees(pieces, correlation_time)
    if correlation_time is None and tau:
        tau = _refine_correlation_time(pieces, degrees, tau)
    if deviation is not None:
        return replace(checked, correlation_time=tau)
    squares, freedom, _ = _get_squares_freedom_and_log_determinant(pieces, degrees, tau)
    level = float(np.sqrt(squares / freedom))
    step = max(find_quantisation_step(np.asarray(force, dtype=float)) for force, _, _ in recordings)
    rounding = step / float(np.sqrt(12.0))
    floor = max(_SETTINGS.floor, *(_SETTINGS.relative_floor * float(np.abs(force).max())
                                   for force, _, _ in recordings))
    if max(level, rounding) <= floor:  # Rounding of floating point has no colour.
        return replace(checked, deviation=floor, source="estimated")
    return SensorNoise(max(level, rounding), tau, "resolution" if rounding > level else "estimated")


@dataclass(frozen=True, eq=False)
class _RecordingSegment:
    """Segment of a recording whose force is modelled as a polynomial trend in time plus noise.

    Attributes:
        columns: Legendre polynomials of the trend, and the force as the last column, shape (n, degrees + 2).
        time: time of the samples, s, shape (n,).
    """

    columns: np.ndarray
    time: np.ndarray

    def compute_whitened_r_factor_and_log_det(self, tau: float) -> tuple[np.ndarray, float]:
        """Return (R of the QR decomposition of the whitened columns, log determinant of the correlation matrix).

        Leading blocks of R are those of trends of lower degree.

        Args:
            tau: correlation time, s; 0: white noise.
        """
        if not tau:
            return np.asarray(np.linalg.qr(self.columns, mode="r")), 0.0
        correlation, deviation = _get_correlations_and_innovation_scales(self.time, tau)
        whitened = np.asarray(np.linalg.qr(_compute_innovations(self.columns, correlation, deviation), mode="r"))
        return whitened, 2.0 * float(np.log(deviation).sum())


def _split_recording_by_segment_labels(force: np.ndarray, time: np.ndarray | None,
                                       segment: Sequence | np.ndarray | None) -> list[_RecordingSegment]:
    """Return the segments of a recording, split where the label changes.

    Segments with fewer than `SensorNoiseSettings.min_samples` samples are omitted.
    """
    force = np.asarray(force, dtype=float)
    time = spread_time_stamps(time, force.size)
    starts = [0] if segment is None else [0, *(np.flatnonzero(np.asarray(segment)[1:] != np.asarray(segment)[:-1]) + 1)]
    pieces = []
    for first, last in zip(starts, [*starts[1:], force.size], strict=True):
        if last - first < _SETTINGS.min_samples:
            continue
        t = time[first:last]
        degree = min(_SETTINGS.max_degree, (last - first) // _SETTINGS.samples_per_degree)
        basis = legvander(2.0 * (t - t[0]) / (t[-1] - t[0]) - 1.0, degree)
        pieces.append(_RecordingSegment(np.column_stack([basis, force[first:last]]), t))
    return pieces


def _select_correlation_time_and_degrees(pieces: list[_RecordingSegment],
                                         stated: float | None) -> tuple[float, list[int]]:
    """Return (correlation time in s, list of the degrees of the segments' trends) with the smallest BIC.

    Args:
        pieces: segments of all recordings.
        stated: stated correlation time, s; None: it is selected.
    """
    samples = sum(piece.time.size for piece in pieces)
    candidates = [0.0] if stated is None else [stated]
    if stated is None:
        steps = np.concatenate([np.diff(piece.time) for piece in pieces])
        longest = _SETTINGS.longest * max(piece.time[-1] - piece.time[0] for piece in pieces)
        shortest = _SETTINGS.shortest * float(np.median(steps))
        candidates += list(np.geomspace(shortest, longest, _SETTINGS.grid)) if longest > shortest else []
    best: tuple[float, float, list] = (np.inf, 0.0, [])
    for tau in candidates:
        triangles, logarithms = zip(*(piece.compute_whitened_r_factor_and_log_det(tau) for piece in pieces),
                                    strict=True)
        # Sums of squared residuals of each segment for the degrees 0, 1, 2, ...
        squares = [np.cumsum(R[:, -1][::-1]**2)[::-1][1:] for R in triangles]
        degrees = _select_trend_degrees(squares, samples)
        total = sum(part[k] for part, k in zip(squares, degrees, strict=True))
        terms = sum(degrees) + (1 if tau and stated is None else 0)
        variance = max(total / samples, _SETTINGS.floor**2)
        criterion = samples * np.log(variance) + sum(logarithms) + terms * np.log(samples)
        if criterion < best[0]:
            best = (criterion, float(tau), degrees)
    return best[1], best[2]


def _select_trend_degrees(squares: list[np.ndarray], samples: int) -> list[int]:
    """Return the degree of each segment's trend with the smallest BIC, by fixed-point iteration from the highest.

    Args:
        squares: sums of squared residuals of each segment for each degree, shape (degrees,).
        samples: number of samples of all segments.
    """
    degrees = [part.size - 1 for part in squares]
    while True:
        freedom = samples - sum(k + 1 for k in degrees)
        total = sum(part[k] for part, k in zip(squares, degrees, strict=True))
        variance = max(total / freedom, _SETTINGS.floor**2)
        lower = [int(np.argmin((part / variance + np.arange(part.size) * np.log(samples))[:k + 1]))
                 for part, k in zip(squares, degrees, strict=True)]
        if lower == degrees:
            return degrees
        degrees = lower


def _get_squares_freedom_and_log_determinant(pieces: list[_RecordingSegment], degrees: list[int],
                                             tau: float) -> tuple[float, int, float]:
    """Return the terms of -2 log restricted likelihood: residual sum of squares, degrees of freedom, log determinants.

    Args:
        pieces: segments of all recordings.
        degrees: degree of each segment's trend.
        tau: correlation time, s.
    """
    squares, freedom, logarithm = 0.0, 0, 0.0
    for piece, degree in zip(pieces, degrees, strict=True):
        R, own = piece.compute_whitened_r_factor_and_log_det(tau)
        fixed = degree + 1
        squares += float(R[fixed:, -1] @ R[fixed:, -1])
        freedom += piece.time.size - fixed
        logarithm += own + 2.0 * float(np.log(np.abs(np.diag(R)[:fixed])).sum())
    return squares, freedom, logarithm


def _refine_correlation_time(pieces: list[_RecordingSegment], degrees: list[int], tau: float) -> float:
    """Return the correlation time that maximises the restricted likelihood near a first guess, s."""
    # Import on use: errors in input files are reported before scipy.optimize is loaded.
    from scipy.optimize import minimize_scalar

    def evaluate_likelihood_criterion(logarithm: float) -> float:
        """Return -2 log restricted likelihood, up to a constant, for the logarithm of a correlation time in s."""
        squares, freedom, determinants = _get_squares_freedom_and_log_determinant(
            pieces, degrees, float(np.exp(logarithm)))
        return freedom * np.log(max(squares / freedom, _SETTINGS.floor**2)) + determinants

    # The first guess maximises the likelihood, whose optimum is below that of the restricted likelihood.
    bounds = (np.log(tau / 2.0), np.log(3.0 * tau))
    return float(np.exp(minimize_scalar(evaluate_likelihood_criterion, bounds=bounds, method="bounded",
                                        options={"xatol": 1e-3}).x))


def spread_time_stamps(time: np.ndarray | None, samples: int) -> np.ndarray:
    """Return times in which equal stamps are spread evenly up to the next stamp.

    Args:
        time: time of the samples, s, shape (n,); None: no time.
        samples: number of samples n.

    Returns:
        Strictly increasing times, s, shape (n,); indices of the samples without times or with one time stamp only.
    """
    if time is None:
        return np.arange(samples, dtype=float)
    time = np.asarray(time, dtype=float)
    first = np.flatnonzero(np.diff(time, prepend=-np.inf) > 0)
    if first.size == samples:
        return time
    if first.size == 1:
        return np.arange(samples, dtype=float)
    # Samples of the last stamp are spread with the mean sampling interval.
    step = (time[-1] - time[0]) / (first[-1] - first[0])
    end = time[-1] + step * (samples - first[-1])
    return np.interp(np.arange(samples), [*first, samples], [*time[first], end])


def _get_correlations_and_innovation_scales(time: np.ndarray, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the correlation of each sample with its predecessor, and the relative deviation of its innovation.

    The correlation is rho = exp(-lag / tau), 0 for the first sample; the deviation is sqrt(1 - rho^2).
    """
    lag = np.diff(time, prepend=-np.inf) / tau
    return np.exp(-lag), np.sqrt(-np.expm1(-2.0 * lag))


def _compute_innovations(columns: np.ndarray, correlation: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return the innovations (y_i - rho_i y_{i-1}) / sqrt(1 - rho_i^2) of columns, shape of `columns`."""
    shape = (-1, *([1] * (columns.ndim - 1)))
    before = np.concatenate([np.zeros_like(columns[:1]), columns[:-1]])
    return (columns - correlation.reshape(shape) * before) / deviation.reshape(shape)
