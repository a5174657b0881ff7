"""Do several recordings of one test leave the same behind? Everywhere a little, at one place, or as a wave.

What is rough looks like noise to an estimate of the noise, and is orthogonal to smooth shapes. What recordings have in
common is held against what they differ by at the same place, width or frequency, so that neither the size nor the
colour of the noise need be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

#: Windows are this many samples wide at least, and a test has this many of the widest; waves go through a segment so
#: often at least. Wider and longer ones are smooth, and have tests of their own.
_NARROWEST, _FEWEST_WINDOWS, _FEWEST_WAVES = 2, 8, 3
#: Frequencies on either side over which what recordings differ by is averaged, and samples of a segment that has waves.
_AROUND, _SHORTEST = 10, 32
#: A window or a wave that chance makes with less than this probability is told.
_CLEAR = 1e-4


@dataclass(frozen=True)
class Repetition:
    """What recordings have most surely in common.

    Attributes:
        p: that chance makes them have as much in common anywhere.
        first, last: samples of the window, or of the segment with the wave; all of them where it is everywhere.
        waves: how often a wave goes through the segment; 0: it is none.
    """

    p: float
    first: int
    last: int
    waves: float = 0.0


def variance_ratio(left: np.ndarray) -> tuple[float, int, int]:
    """How much more recordings have in common than their scatter explains, 1 by chance; freedom of both.

    Args:
        left: whitened residuals of recordings at the same places, shape (recordings, n).

    Source: analysis of variance, mean over recordings against their scatter.
    """
    count, size = left.shape
    mean = left.mean(axis=0)
    scatter = float(np.sum((left - mean)**2)) / (count - 1)
    return count * float(mean @ mean) / max(scatter, 1e-300), size, (count - 1) * size


def repetition(left: np.ndarray, segments: Sequence[slice]) -> Repetition:
    """The most telling of all that recordings have in common.

    Args:
        left: whitened residuals of recordings at the same places, shape (recordings, n), two recordings at least.
        segments: of the motion. Waves are sought in each and in all of it, as if samples followed each other evenly.

    Source: variance ratios everywhere, in windows of dyadic widths and at frequencies (Fisher, Proc. R. Soc. A 125
    (1929) 54, against a scatter that is measured); Bonferroni's bound over all of them.
    """
    ratio, *freedom = variance_ratio(left)
    whole = slice(0, left.shape[1])
    places = [whole, *segments] if len(segments) > 1 else [whole]
    found = [Repetition(float(special.fdtrc(*freedom, ratio)), 0, whole.stop - 1), *_in_windows(left),
             *(wave for each in places for wave in _waves(left, each))]
    best = min(found, key=lambda each: each.p)
    # A place or a period says more than that it is everywhere.
    clear = [each for each in found[1:] if len(found) * each.p < _CLEAR]
    told = min(clear, key=lambda each: (each.p, -each.waves)) if clear else best
    return replace(told, p=min(len(found) * best.p, 1.0))


def _in_windows(left: np.ndarray) -> list[Repetition]:
    """The most telling window, of windows that overlap by half."""
    count, size = left.shape
    totals = np.concatenate([np.zeros((count, 1)), np.cumsum(left, axis=1)], axis=1)
    best, tried, width = (1.0, 0, 0), 0, _NARROWEST
    while size >= _FEWEST_WINDOWS * width:
        first = np.arange(0, size - width + 1, width // 2)
        sums = totals[:, first + width] - totals[:, first]
        mean = sums.mean(axis=0)
        freedom = (count - 1) * (size // width)
        scatter = np.mean(np.sum((sums - mean)**2, axis=0)) / (count - 1)
        p = special.fdtrc(1, freedom, count * mean**2 / max(float(scatter), 1e-300))
        at = int(np.argmin(p))
        best = min(best, (float(p[at]), int(first[at]), int(first[at]) + width - 1))
        tried += first.size
        width *= 2
    return [Repetition(min(tried * best[0], 1.0), best[1], best[2])] if tried else []


def _waves(left: np.ndarray, segment: slice) -> list[Repetition]:
    """The most telling frequency of a segment; the bound counts those of this segment alone."""
    part = left[:, segment]
    count, size = part.shape
    if size < _SHORTEST:
        return []
    spectra = np.fft.rfft(part, axis=1)[:, _FEWEST_WAVES:(size - 1) // 2 + 1]
    mean = spectra.mean(axis=0)
    differ = np.sum(np.abs(spectra - mean)**2, axis=0)
    sums = np.concatenate([[0.0], np.cumsum(differ)])
    number = np.arange(differ.size)
    low, high = np.maximum(number - _AROUND, 0), np.minimum(number + _AROUND + 1, differ.size)
    freedom = 2 * (count - 1) * (high - low)
    ratio = count * np.abs(mean)**2 / 2.0 / np.maximum((sums[high] - sums[low]) / freedom, 1e-300)
    p = special.fdtrc(2, freedom, ratio)
    at = int(np.argmin(p))
    return [Repetition(min(float(p[at]) * p.size, 1.0), segment.start, segment.stop - 1, float(at + _FEWEST_WAVES))]
