"""Deviations of the recordings of a test from its model: mean, scatter and noise for prediction bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calibration.campaign.measured import MeasuredCurve
from calibration.statistics.bands import ScatterComponent
from calibration.statistics.jitter import ContactAndForceZeroJitter


@dataclass(frozen=True)
class ModelDeviationSettings:
    """Settings of `compute_model_bias_scatter_and_noise`.

    Attributes:
        max_modes: largest number of modes per segment. More modes resolve shorter features of the bias.
        min_samples_per_mode: smallest number of samples per mode. A larger value uses fewer modes on short segments.
        logarithmic_from: fraction of the duration of a hold from which on its time axis is logarithmic.
        filter_width: standard deviation of the Gaussian filter that smooths the scatter, as a fraction of the segment.
        max_scatter: largest contact offset and zero that count as scatter, in standard deviations. Larger offsets count
            as errors of the model.
    """

    max_modes: int = 6
    min_samples_per_mode: int = 4
    logarithmic_from: float = 0.01
    filter_width: float = 0.1
    max_scatter: float = 2.0


SETTINGS = ModelDeviationSettings()


@dataclass(frozen=True, eq=False)
class ModelBiasScatterAndNoise:
    """Deviations of the recordings of one test from its model at the points of a path.

    Attributes:
        bias: mean deviation, N, shape (k,).
        scatters: components of the scatter about the mean.
        noise: standard deviation of the noise, N, shape (k,).
    """

    bias: np.ndarray
    scatters: list[ScatterComponent]
    noise: np.ndarray


def compute_model_bias_scatter_and_noise(measured: Sequence[MeasuredCurve], gaps: Sequence[np.ndarray],
                                         contacts: Sequence[np.ndarray],
                                         path: MeasuredCurve, scatter: ContactAndForceZeroJitter
                                         | None) -> ModelBiasScatterAndNoise:
    """Compute mean, scatter and noise of data minus model along a path.

    The deviation of each recording is fitted by smooth modes along each segment. The mean amplitudes over the
    recordings give the bias of the model. Their scatter has one degree of freedom less than there are recordings. A
    known scatter of contact and zero is subtracted first.

    Args:
        measured: recordings of one test.
        gaps: data minus model without contact offset and zero for each recording, N, shapes (n,).
        contacts: derivatives of the model with respect to the contact offset, N/m, shapes (n,).
        path: path at whose points the deviations are evaluated.
        scatter: known scatter of contact and zero; None: unknown.
    """
    if scatter is not None:
        own = np.array([_estimate_scaled_contact_offset_and_zero(*each, scatter)
                        for each in zip(gaps, contacts, measured, strict=True)])
        # A common offset, and offsets far beyond the scatter, are errors of the model and stay in the deviations.
        own = np.clip(own - own.mean(axis=0) if len(own) > 1 else own,
                      -SETTINGS.max_scatter, SETTINGS.max_scatter)
        gaps = [gap - _compute_force_changes_per_jitter(contact, scatter) @ weights
                for gap, contact, weights in zip(gaps, contacts, own, strict=True)]
    segments = [_get_segment_label_of_each_sample(curve) for curve in measured]
    path_segments, count = _get_segment_label_of_each_sample(path, measured[0]), len(measured)
    bias, noise = np.zeros(path_segments.size), np.empty(path_segments.size)
    spread = np.zeros((path_segments.size, count))
    for name in dict.fromkeys(path_segments.tolist()):
        here = path_segments == name
        parts = [labels == name for labels in segments]
        fewest = min(int(part.sum()) for part in parts)
        modes = int(np.clip(fewest // SETTINGS.min_samples_per_mode, 1, SETTINGS.max_modes))
        amplitudes, squares, freedom, covariance = [], 0.0, 0, np.zeros((modes, modes))
        for curve, gap, part in zip(measured, gaps, parts, strict=True):
            if not part.any():
                amplitudes.append(np.zeros(modes))
                continue
            columns = _evaluate_chebyshev_polynomials(curve, part, name, modes)
            found = np.linalg.lstsq(columns, gap[part], rcond=1e-9)[0]
            amplitudes.append(found)
            covariance += np.linalg.pinv(columns.T @ columns, hermitian=True) / count
            squares += float(np.sum((gap[part] - columns @ found)**2))
            freedom += int(part.sum()) - modes
        columns = _evaluate_chebyshev_polynomials(path, here, name, modes)
        mean = np.mean(amplitudes, axis=0)
        bias[here] = columns @ mean
        rest = squares / max(freedom, 1)
        noise[here] = max(path.noise.deviation, np.sqrt(rest))
        if count > 1:
            difference = columns @ (np.array(amplitudes) - mean).T
            variance = np.sum(difference**2, axis=1) / (count - 1)
            by_noise = rest * np.einsum("ni,ij,nj->n", columns, covariance, columns)
            # The variance of few recordings may be small at single points by chance, so it is smoothed. The
            # contribution of the noise is subtracted, since the noise is a separate component.
            smooth = np.maximum(gaussian_filter1d(variance, SETTINGS.filter_width * variance.size, mode="nearest")
                                - by_noise, 0.0)
            factor = np.sqrt(np.divide(smooth, variance, out=np.zeros_like(variance), where=variance > 0))
            spread[here] = difference * factor[:, None]
    if count == 1:
        return ModelBiasScatterAndNoise(bias, [], noise)
    # The factor 1 + 1 / count includes the variance of the mean.
    spread *= np.sqrt((1.0 + 1.0 / count) / (count - 1))
    return ModelBiasScatterAndNoise(bias, [ScatterComponent(spread, count - 1.0)], noise)


def _compute_force_changes_per_jitter(contact: np.ndarray, scatter: ContactAndForceZeroJitter) -> np.ndarray:
    """Return the change of the force per standard deviation of contact offset and zero, N, shape (n, 2)."""
    return np.column_stack([scatter.contact * contact, np.full(contact.size, scatter.zero)])


def _estimate_scaled_contact_offset_and_zero(gap: np.ndarray, contact: np.ndarray, curve: MeasuredCurve,
                                             scatter: ContactAndForceZeroJitter) -> np.ndarray:
    """Return the most probable contact offset and zero of a recording in units of their scatter, shape (2,)."""
    columns = _compute_force_changes_per_jitter(contact, scatter) / curve.noise.deviation
    return np.linalg.solve(np.eye(2) + columns.T @ columns, columns.T @ gap / curve.noise.deviation)


def _get_segment_label_of_each_sample(curve: MeasuredCurve, first: MeasuredCurve | None = None) -> np.ndarray:
    """Return the segment of each sample of a curve, shape (n,); taken from `first` at the same time if given."""
    labelled = curve if first is None else first
    if labelled.segment is None:
        return np.full(curve.displacement.size, "")
    if first is None:
        return labelled.segment
    return labelled.segment[np.clip(np.searchsorted(first.sample_times, curve.sample_times), 0,
                                    first.sample_times.size - 1)]


def _evaluate_chebyshev_polynomials(curve: MeasuredCurve, part: np.ndarray, name: str, count: int) -> np.ndarray:
    """Return the values of Chebyshev polynomials at the samples of a curve in the mask `part`, shape (n, count).

    The polynomials have large slopes at the ends of a segment, where models often deviate most.
    """
    along = curve.displacement[part] if curve.segment is None else curve.sample_times[part]
    position = (along - along.min()) / max(float(np.ptp(along)), 1e-300)
    if name.startswith("hold"):
        position = np.log1p(position / SETTINGS.logarithmic_from) / np.log1p(1.0 / SETTINGS.logarithmic_from)
    return np.cos(np.outer(np.arccos(np.clip(1.0 - 2.0 * position, -1.0, 1.0)), np.arange(count)))
