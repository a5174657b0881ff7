"""Test for a common signal in the residuals of several recordings: everywhere, in a window, or as a wave.

A rough misfit of the model is counted as noise by a noise estimate, and it is orthogonal to smooth modes. Repetition
reveals it: the mean of the recordings is compared with their scatter in the same window or at the same frequency, so
the test requires neither the level nor the spectrum of the noise.
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


_SETTINGS = CommonSignalSettings()


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
    specific = [each for each in found[1:] if len(found) * each.p < _SETTINGS.significance]
    reported = min(specific, key=lambda each: (each.p, -each.waves)) if specific else best
    return replace(reported, p=min(len(found) * best.p, 1.0))


def _list_best_window_signal_if_any(residuals: np.ndarray) -> list[CommonSignal]:
    """Return a list of one item: the most significant window of dyadic width; an empty list for few samples.

    The windows overlap by half, and the p value is corrected for their number.
    """
    count, size = residuals.shape
    totals = np.concatenate([np.zeros((count, 1)), np.cumsum(residuals, axis=1)], axis=1)
    best, tried, width = (1.0, 0, 0), 0, _SETTINGS.narrowest
    while size >= _SETTINGS.min_windows * width:
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
    if size < _SETTINGS.min_samples:
        return []
    spectra = np.fft.rfft(part, axis=1)[:, _SETTINGS.min_waves:(size - 1) // 2 + 1]
    mean = spectra.mean(axis=0)
    differ = np.sum(np.abs(spectra - mean)**2, axis=0)
    sums = np.concatenate([[0.0], np.cumsum(differ)])
    number = np.arange(differ.size)
    reach = _SETTINGS.half_bandwidth
    low, high = np.maximum(number - reach, 0), np.minimum(number + reach + 1, differ.size)
    freedom = 2 * (count - 1) * (high - low)
    ratio = count * np.abs(mean)**2 / 2.0 / np.maximum((sums[high] - sums[low]) / freedom, 1e-300)
    p = special.fdtrc(2, freedom, ratio)
    index = int(np.argmin(p))
    return [CommonSignal(min(float(p[index]) * p.size, 1.0), segment.start, segment.stop - 1,
                         float(index + _SETTINGS.min_waves))]
