"""How the recordings of a test differ from its model: what a band for a new one is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calibration.campaign.measured import MeasuredCurve
from calibration.statistics.bands import Scatter
from calibration.statistics.jitter import Jitter

#: Shapes along each segment that carry what recordings have beside the model; fewer where samples are few.
MODES, SAMPLES_PER_MODE = 6, 4
#: A hold is looked at over the logarithm of its time, from this share of its length on.
_SOONEST = 0.01
#: Scatter counts as that of the neighbourhood: standard deviation of its weights, as a share of the segment.
_NEAR = 0.1
#: Standard deviations of contact and zero that are chance.
_CHANCE = 2.0


@dataclass(frozen=True, eq=False)
class Deviations:
    """Of the recordings of one test from its model, at the points of a path.

    Attributes:
        bias: their mean, N, shape (k,). scatters: how they differ from it. noise: standard deviation of what is left,
            N, shape (k,).
    """

    bias: np.ndarray
    scatters: list[Scatter]
    noise: np.ndarray


def assess_deviations(measured: Sequence[MeasuredCurve], gaps: Sequence[np.ndarray], contacts: Sequence[np.ndarray],
                      path: MeasuredCurve, scatter: Jitter | None) -> Deviations:
    """Mean, scatter and noise of data minus model along a path.

    Each recording's gap is a sum of smooth shapes along each segment. Their means over the recordings are what the
    model lacks; how they differ from these is the scatter between recordings, with one degree of freedom less than
    there are recordings. Where the scatter of contact and zero is known better, that is taken out of the gaps before.

    Args:
        measured: recordings of one test. gaps: data minus model of each without offset and zero, N, shapes (n,).
        contacts: derivatives of its model with the contact offset, N/m, shapes (n,).
        path: where the answer is wanted. scatter: of contact and zero, where that is known.
    """
    if scatter is not None:
        own = np.array([_own(*each, scatter) for each in zip(gaps, contacts, measured, strict=True)])
        # What all recordings have, the model lacks, and so it does what is far beyond the scatter.
        own = np.clip(own - own.mean(axis=0) if len(own) > 1 else own, -_CHANCE, _CHANCE)
        gaps = [gap - _columns(contact, scatter) @ weights
                for gap, contact, weights in zip(gaps, contacts, own, strict=True)]
    segments = [_segments(curve) for curve in measured]
    along, count = _segments(path, measured[0]), len(measured)
    bias, noise = np.zeros(along.size), np.empty(along.size)
    spread = np.zeros((along.size, count))
    for name in dict.fromkeys(along.tolist()):
        here = along == name
        parts = [labels == name for labels in segments]
        fewest = min(int(part.sum()) for part in parts)
        modes = int(np.clip(fewest // SAMPLES_PER_MODE, 1, MODES))
        amplitudes, squares, freedom, unsure = [], 0.0, 0, np.zeros((modes, modes))
        for curve, gap, part in zip(measured, gaps, parts, strict=True):
            if not part.any():
                amplitudes.append(np.zeros(modes))
                continue
            columns = _shapes(curve, part, name, modes)
            found = np.linalg.lstsq(columns, gap[part], rcond=1e-9)[0]
            amplitudes.append(found)
            unsure += np.linalg.pinv(columns.T @ columns, hermitian=True) / count
            squares += float(np.sum((gap[part] - columns @ found)**2))
            freedom += int(part.sum()) - modes
        columns = _shapes(path, here, name, modes)
        mean = np.mean(amplitudes, axis=0)
        bias[here] = columns @ mean
        rest = squares / max(freedom, 1)
        noise[here] = max(path.noise.deviation, np.sqrt(rest))
        if count > 1:
            away = columns @ (np.array(amplitudes) - mean).T
            found, by_noise = np.sum(away**2, axis=1) / (count - 1), rest * np.einsum("ni,ij,nj->n", columns, unsure,
                                                                                     columns)
            # Few recordings meet somewhere by chance; noise moves the amplitudes too, and is there already.
            wanted = np.maximum(gaussian_filter1d(found, _NEAR * found.size, mode="nearest") - by_noise, 0.0)
            spread[here] = away * np.sqrt(np.divide(wanted, found, out=np.zeros_like(found), where=found > 0))[:, None]
    if count == 1:
        return Deviations(bias, [], noise)
    # The mean errs too.
    spread *= np.sqrt((1.0 + 1.0 / count) / (count - 1))
    return Deviations(bias, [Scatter(spread, count - 1.0)], noise)


def _columns(contact: np.ndarray, scatter: Jitter) -> np.ndarray:
    """What one standard deviation of contact offset and of zero make of a force, N, shape (n, 2)."""
    return np.column_stack([scatter.contact * contact, np.full(contact.size, scatter.zero)])


def _own(gap: np.ndarray, contact: np.ndarray, curve: MeasuredCurve, scatter: Jitter) -> np.ndarray:
    """Contact offset and zero of a recording, at their most likely, in units of their scatter, shape (2,)."""
    columns = _columns(contact, scatter) / curve.noise.deviation
    return np.linalg.solve(np.eye(2) + columns.T @ columns, columns.T @ gap / curve.noise.deviation)


def _segments(curve: MeasuredCurve, first: MeasuredCurve | None = None) -> np.ndarray:
    """Name of the segment of each sample, those of `first` at the same time where it is given, shape (n,)."""
    labelled = curve if first is None else first
    if labelled.segment is None:
        return np.full(curve.displacement.size, "")
    if first is None:
        return labelled.segment
    return labelled.segment[np.clip(np.searchsorted(first.clock, curve.clock), 0, first.clock.size - 1)]


def _shapes(curve: MeasuredCurve, part: np.ndarray, name: str, count: int) -> np.ndarray:
    """Chebyshev polynomials along a part of a curve, shape (n, count): models often leave most at its ends, where
    cosines of the place are flat."""
    along = curve.displacement[part] if curve.segment is None else curve.clock[part]
    place = (along - along.min()) / max(float(np.ptp(along)), 1e-300)
    if name.startswith("hold"):
        place = np.log1p(place / _SOONEST) / np.log1p(1.0 / _SOONEST)
    return np.cos(np.outer(np.arccos(np.clip(1.0 - 2.0 * place, -1.0, 1.0)), np.arange(count)))
