"""Tests of the residuals of a fit: smooth misfit, many alternatives, and a common signal of several recordings.

Score tests look for smooth misfit region by region, and for many alternatives with p values that account for their
number.

A rough misfit of the model is counted as noise by a noise estimate, and it is orthogonal to smooth modes. Repetition
reveals it: the mean of the recordings is compared with their scatter in the same window or at the same frequency
(everywhere, in a window, or as a wave), so the test requires neither the level nor the spectrum of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special


@dataclass(frozen=True)
class CommonSignalSettings:
    """Settings of the search for a common signal.

    Attributes:
        narrowest: width of the narrowest windows, samples.
        min_windows: number of the widest windows per recording; wider signals are smooth and have other tests.
        min_waves: smallest number of periods per segment; longer periods are smooth and have other tests.
        half_bandwidth: number of frequencies on either side over which the scatter of a frequency is averaged.
        min_samples: smallest number of samples of a segment that is tested for waves.
        significance: p value, corrected for the number of tests, below which a window or wave is reported instead of
            a signal everywhere.
    """

    narrowest: int = 2
    min_windows: int = 8
    min_waves: int = 3
    half_bandwidth: int = 10
    min_samples: int = 32
    significance: float = 1e-4


_COMMON_SIGNAL = CommonSignalSettings()


@dataclass(frozen=True)
class CommonSignal:
    """Most significant common signal of several recordings.

    Attributes:
        p: p value, corrected for the number of windows and frequencies (Bonferroni).
        first: first sample of the window, or of the segment with the wave; 0 for a signal everywhere.
        last: last sample.
        waves: number of periods in the segment; 0: the signal is no wave.
    """

    p: float
    first: int
    last: int
    waves: float = 0.0


def compute_f_ratio_and_freedoms(residuals: np.ndarray) -> tuple[float, int, int]:
    """Compute the F ratio of one-way analysis of variance: squared mean over recordings against their scatter.

    F = R sum_j m_j^2 / (sum_ij (r_ij - m_j)^2 / (R - 1)), with the mean m_j over R recordings. Its expectation is 1
    without a common signal.

    Args:
        residuals: whitened residuals r of the recordings at the same positions, shape (R, n).

    Returns:
        The ratio and its degrees of freedom, n and (R - 1) n.
    """
    count, size = residuals.shape
    mean = residuals.mean(axis=0)
    scatter = float(np.sum((residuals - mean)**2)) / (count - 1)
    return count * float(mean @ mean) / max(scatter, 1e-300), size, (count - 1) * size


def get_most_significant_common_signal(residuals: np.ndarray, segments: Sequence[slice]) -> CommonSignal:
    """Return the most significant common signal of several recordings, also if it is not significant (large p value).

    F ratios are computed over all samples, in windows of dyadic widths, and at Fourier frequencies. The p value is
    corrected for their number by Bonferroni's inequality. A significant window or wave has precedence over a signal
    everywhere, because it is more specific.

    Args:
        residuals: whitened residuals of at least two recordings at the same positions, shape (R, n).
        segments: samples of each segment of the motion. Frequencies are tested in each segment and in the whole motion,
            as if the samples were equidistant.

    Source: Fisher, Proc. R. Soc. A 125 (1929) 54 (test of a periodogram), here with the measured scatter.
    """
    ratio, *freedom = compute_f_ratio_and_freedoms(residuals)
    whole = slice(0, residuals.shape[1])
    ranges = [whole, *segments] if len(segments) > 1 else [whole]
    found = [CommonSignal(float(special.fdtrc(*freedom, ratio)), 0, whole.stop - 1),
             *_list_best_window_signal_if_any(residuals),
             *(wave for each in ranges for wave in _list_best_wave_signal_if_any(residuals, each))]
    best = min(found, key=lambda each: each.p)
    specific = [each for each in found[1:] if len(found) * each.p < _COMMON_SIGNAL.significance]
    reported = min(specific, key=lambda each: (each.p, -each.waves)) if specific else best
    return replace(reported, p=min(len(found) * best.p, 1.0))


def _list_best_window_signal_if_any(residuals: np.ndarray) -> list[CommonSignal]:
    """Return a list of one item: the most significant window of dyadic width; an empty list for few samples.

    The windows overlap by half, and the p value is corrected for their number.
    """
    count, size = residuals.shape
    totals = np.concatenate([np.zeros((count, 1)), np.cumsum(residuals, axis=1)], axis=1)
    best, tried, width = (1.0, 0, 0), 0, _COMMON_SIGNAL.narrowest
    while size >= _COMMON_SIGNAL.min_windows * width:
        first = np.arange(0, size - width + 1, width // 2)
        sums = totals[:, first + width] - totals[:, first]
        mean = sums.mean(axis=0)
        freedom = (count - 1) * (size // width)
        scatter = np.mean(np.sum((sums - mean)**2, axis=0)) / (count - 1)
        p = special.fdtrc(1, freedom, count * mean**2 / max(float(scatter), 1e-300))
        index = int(np.argmin(p))
        best = min(best, (float(p[index]), int(first[index]), int(first[index]) + width - 1))
        tried += first.size
        width *= 2
    return [CommonSignal(min(tried * best[0], 1.0), best[1], best[2])] if tried else []


def _list_best_wave_signal_if_any(residuals: np.ndarray, segment: slice) -> list[CommonSignal]:
    """Return a list of one item: the most significant wave in a segment; an empty list for a short segment.

    The p value is corrected for the number of frequencies.
    """
    part = residuals[:, segment]
    count, size = part.shape
    if size < _COMMON_SIGNAL.min_samples:
        return []
    spectra = np.fft.rfft(part, axis=1)[:, _COMMON_SIGNAL.min_waves:(size - 1) // 2 + 1]
    mean = spectra.mean(axis=0)
    differ = np.sum(np.abs(spectra - mean)**2, axis=0)
    sums = np.concatenate([[0.0], np.cumsum(differ)])
    number = np.arange(differ.size)
    reach = _COMMON_SIGNAL.half_bandwidth
    low, high = np.maximum(number - reach, 0), np.minimum(number + reach + 1, differ.size)
    freedom = 2 * (count - 1) * (high - low)
    ratio = count * np.abs(mean)**2 / 2.0 / np.maximum((sums[high] - sums[low]) / freedom, 1e-300)
    p = special.fdtrc(2, freedom, ratio)
    index = int(np.argmin(p))
    return [CommonSignal(min(float(p[index]) * p.size, 1.0), segment.start, segment.stop - 1,
                         float(index + _COMMON_SIGNAL.min_waves))]


@dataclass(frozen=True)
class ScoreTestTolerances:
    """Numerical tolerances of Rao's score tests: which modes and directions count as independent.

    Attributes:
        min_free_fraction: smallest fraction of a mode's squared norm outside the span of the design for which the mode
            can be tested. A smaller value tests modes that the fit absorbs almost completely.
        rank_tolerance: smallest ratio of a singular value to the largest one for which a direction counts as linearly
            independent.
    """

    min_free_fraction: float = 1e-3
    rank_tolerance: float = 1e-10


SCORE_TEST = ScoreTestTolerances()


@dataclass(frozen=True, eq=False)
class RegionScoreTest:
    """Result of Rao's score test for a smooth misfit in one region.

    Attributes:
        statistic: test statistic; chi-square distributed if the model is correct.
        freedom: degrees of freedom: number of modes outside the span of the design; 0: nothing can be tested.
        p: probability of a larger statistic if the model is correct; 1 for 0 degrees of freedom.
        amplitudes: estimated amplitudes of the modes, shape (q,): data = model + modes @ amplitudes, so positive values
            mean that the model is too soft. Components in the span of the design are zero.
    """

    statistic: float
    freedom: int
    p: float
    amplitudes: np.ndarray


def compute_rao_score_test(residual: np.ndarray, design: np.ndarray, modes: np.ndarray) -> RegionScoreTest:
    """Compute Rao's score test for modes that the model lacks, at the optimum of the fit.

    With r = residual, A = design, M = modes, the score is S = M'r, its information is I = M'M - M'A (A'A)^-1 A'M, and
    the statistic is S' I^-1 S. No fit with the modes is required.

    Args:
        residual: model minus data in units of the noise, including the rows of the priors, shape (N,).
        design: Jacobian of all unknowns including nuisances, with the rows of the priors, shape (N, k).
        modes: whitened modes, zero outside their region and in the rows of the priors, shape (N, q).

    Source: Rao, Proc. Cambridge Philosophical Society 44 (1948) 50.
    """
    left, sizes, right = np.linalg.svd(modes, full_matrices=False)
    kept = sizes > SCORE_TEST.rank_tolerance * sizes.max(initial=0.0)
    left, sizes, right = left[:, kept], sizes[kept], right[kept]
    fitted = compute_orthonormal_basis(design)
    free = left - fitted @ (fitted.T @ left)
    fractions, axes = np.linalg.eigh(free.T @ free)
    testable = fractions > SCORE_TEST.min_free_fraction
    fractions, axes = fractions[testable], axes[:, testable]
    # The projected modes are orthogonal to the design, so a remaining gradient of the fit does not enter the score.
    score = axes.T @ (free.T @ residual)
    statistic, freedom = float(np.sum(score**2 / fractions)), int(fractions.size)
    p = float(special.chdtrc(freedom, statistic)) if freedom else 1.0
    return RegionScoreTest(statistic, freedom, p, -right.T @ ((axes @ (score / fractions)) / sizes))


def make_cosine_modes(position: np.ndarray, count: int) -> np.ndarray:
    """Return the cosine modes cos(k pi x) for k = 0 to count - 1, shape (n, count).

    Args:
        position: positions x in a region, 0 at its first sample and 1 at its last, shape (n,).
        count: number of modes.
    """
    return np.cos(np.pi * np.outer(position, np.arange(count)))


def adjust_p_values_by_holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Adjust p values for multiple tests by Holm's step-down method.

    With p_(1) <= ... <= p_(n), the adjusted value of p_(i) is the maximum of min((n - j + 1) p_(j), 1) over j <= i.
    Rejection of all hypotheses with an adjusted p value below alpha keeps the family-wise error rate below alpha.

    Args:
        p_values: p values of the tests, shape (n,).

    Returns:
        Adjusted p values in the same order, shape (n,).

    Source: Holm, Scandinavian J. of Statistics 6 (1979) 65.
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return adjusted


def compute_orthonormal_basis(design: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the column space of a matrix, shape (N, rank).

    Args:
        design: matrix whose columns may have different scales and be linearly dependent, shape (N, k).
    """
    scale = np.sqrt(np.sum(design**2, axis=0))
    left, sizes, _ = np.linalg.svd(design / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return left[:, sizes > SCORE_TEST.rank_tolerance * sizes.max(initial=0.0)]


@dataclass(frozen=True)
class ScoreTestSimulationSettings:
    """Settings of the simulated p values of score tests of many alternative effects.

    Attributes:
        min_free_fraction: smallest fraction of the length of a change outside the span of the fit for which the change
            can be tested. A smaller value tests changes that the fit absorbs almost completely.
        draws: number of random draws of the scores; the standard error of a p value is sqrt(p / draws).
        seed: seed of the random draws, fixed so that results are reproducible.
    """

    min_free_fraction: float = 1e-3
    draws: int = 20_000
    seed: int = 1


DIRECTIONS = ScoreTestSimulationSettings()


@dataclass(frozen=True, eq=False)
class EffectDirection:
    """Change of the whitened residuals by an effect, projected onto the orthogonal complement of the fitted space.

    Attributes:
        basis: orthonormal basis of the projected change, shape (N, q); q = 0 if the fit can absorb the change.
        length: norm of the change before projection, in units of the noise.
        reach: norm of the projected change, in units of the noise: expected score of an effect of the trial size.
        positive: whether the effect has only one possible sign; used for q = 1 only.
    """

    basis: np.ndarray
    length: float
    reach: float
    positive: bool

    @property
    def degrees_of_freedom(self) -> int:
        """Number q of degrees of freedom of the score test: the number of columns of `basis`."""
        return int(self.basis.shape[1])

    @classmethod
    def from_whitened_change(cls, columns: np.ndarray, fitted: np.ndarray, *, positive: bool) -> EffectDirection:
        """Return the direction of whitened changes of the model, projected onto the complement of the fitted space.

        Args:
            columns: changes, zero in the rows of priors, shape (N, q).
            fitted: orthonormal basis of the fitted space including nuisances and priors, shape (N, k).
            positive: see `EffectDirection`.
        """
        free = columns - fitted @ (fitted.T @ columns)
        length = float(np.linalg.norm(columns))
        left, sizes, _ = np.linalg.svd(free, full_matrices=False)
        if columns.shape[1] == 1:
            # The singular vector has an arbitrary sign; the basis has the sign of the effect.
            left = free / (sizes[0] or 1.0)
        kept = sizes > max(DIRECTIONS.min_free_fraction * length / np.sqrt(columns.shape[1]),
                           SCORE_TEST.rank_tolerance * sizes.max(initial=0.0), 1e-12)
        return cls(left[:, kept], length, float(np.linalg.norm(sizes[kept])), positive)

    def compute_score_components(self, residual: np.ndarray) -> np.ndarray:
        """Return the score: components of data minus model along the basis, standard normal without the effect.

        Args:
            residual: whitened model minus data, shape (N,).

        Returns:
            Score, shape (q,).
        """
        return -(self.basis.T @ residual)

    def compute_p_value(self, score: np.ndarray) -> np.ndarray:
        """Return the p value of a score for this direction alone, without correction for the other directions.

        The p value is that of a one-sided normal test for a positive effect with q = 1, otherwise of a chi-square test
        with q degrees of freedom.

        Args:
            score: scores, shape (..., q).

        Returns:
            P values, shape (...).
        """
        if not self.degrees_of_freedom:
            return np.ones(score.shape[:-1])
        if self.positive and self.degrees_of_freedom == 1:
            return special.ndtr(-score[..., 0])
        return special.chdtrc(self.degrees_of_freedom, np.sum(score**2, axis=-1))


def compute_familywise_p_values(directions: Sequence[EffectDirection], scores: Sequence[np.ndarray], *,
                                seed: int = DIRECTIONS.seed, draws: int = DIRECTIONS.draws) -> np.ndarray:
    """Compute family-wise p values by simulation of the minimum p value (Westfall and Young).

    Without effects the scores of all directions are jointly normal with mean 0 and covariance B'B, where B contains all
    bases. For random scores from this distribution the smallest p value of all directions is computed. The family-wise
    p value of a direction is the fraction of draws whose smallest p value does not exceed that of the direction. The
    simulation accounts for the correlation of the directions, for one-sided effects, and for grids of parameters that
    are not identified without the effect.

    Args:
        directions: directions of the candidates.
        scores: score of each direction, shape (q,).
        seed: seed of the random numbers.
        draws: number of draws.

    Returns:
        P values, shape (directions,); at least 1/(draws + 1).

    Source: Westfall and Young, Resampling-Based Multiple Testing, 1993; Davies, Biometrika 74 (1987) 33 (nuisance
    parameters that exist only with the effect).
    """
    if not directions:
        return np.zeros(0)
    stacked = np.hstack([direction.basis for direction in directions])
    if not stacked.shape[1]:
        return np.ones(len(directions))
    # Random scores are drawn in the space of the directions, which is smaller than that of the samples.
    sizes, axes = np.linalg.eigh(stacked.T @ stacked)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    drawn = np.random.default_rng(seed).standard_normal((draws, sizes.size)) @ root.T
    ends = np.cumsum([0, *(direction.degrees_of_freedom for direction in directions)])
    smallest = np.min([direction.compute_p_value(drawn[:, first:last]) for direction, first, last in zip(
        directions, ends[:-1], ends[1:], strict=True)], axis=0)
    observed = np.array([float(direction.compute_p_value(score)) for direction,
                         score in zip(directions, scores, strict=True)])
    below = np.searchsorted(np.sort(smallest), observed, side="right")
    return (below + 1) / (draws + 1)


def compute_largest_principal_cosine(one: EffectDirection, other: EffectDirection) -> float:
    """Return the cosine of the smallest principal angle between two directions, 0 to 1; 1: indistinguishable."""
    if not (one.degrees_of_freedom and other.degrees_of_freedom):
        return 0.0
    return float(np.linalg.svd(one.basis.T @ other.basis, compute_uv=False)[0])
