"""Curves of an estimate for tables and figures: model, standard error, and prediction bands for a new recording.

The bands follow from the deviations of the recordings of a test from its model: mean, scatter and noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.population import PredictionParameters
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.force_control import compute_displacement_at_measured_force
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.uncertainty import (
    KNOWN_VARIANCE,
    ParameterUncertainty,
    ScatterComponent,
    compute_prediction_band_half_widths,
)


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


DEVIATIONS = ModelDeviationSettings()


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
                      -DEVIATIONS.max_scatter, DEVIATIONS.max_scatter)
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
        modes = int(np.clip(fewest // DEVIATIONS.min_samples_per_mode, 1, DEVIATIONS.max_modes))
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
            smooth = np.maximum(gaussian_filter1d(variance, DEVIATIONS.filter_width * variance.size, mode="nearest")
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
        position = np.log1p(position / DEVIATIONS.logarithmic_from) / np.log1p(1.0 / DEVIATIONS.logarithmic_from)
    return np.cos(np.outer(np.arccos(np.clip(1.0 - 2.0 * position, -1.0, 1.0)), np.arange(count)))


@dataclass(frozen=True)
class FittedCurveSettings:
    """Settings of the curves of an estimate.

    Attributes:
        points: number of points of a curve; a path-dependent curve has four times as many.
        min_recordings: number of recordings from which the observed scatter replaces the scatter of contact and zero.
    """

    points: int = 101
    min_recordings: int = 3


_CURVES = FittedCurveSettings()


@dataclass(frozen=True, eq=False)
class TestCurves:
    """Curves of one test for one fitted law.

    Forces in N and displacements in m; stress in Pa and strain if `test.specimen` is None.

    Attributes:
        test: test.
        measured: recordings of the test.
        time: time along the path of the model, s, shape (k,); None if the force does not depend on time.
        displacement: displacement along the path, shape (k,).
        force: force of the model along the path, without contact offset and zero, shape (k,).
        force_error: standard error of the force from parameters and mesh, shape (k,).
        band: half width of the pointwise 95 % prediction band of a new recording, shape (k,).
        whole_band: half width of the simultaneous 95 % prediction band, shape (k,).
        fitted: for each recording the force of the model at its samples, with its contact offset and zero.
        area: cross-section of the nominal stress, m2 (1 if stress was recorded); None if the stress is not homogeneous.
        displacements: for each recording under force control the displacement of the model at the measured force, with
            its contact offset and zero; None for other recordings. Empty if the simulation fails.
    """

    test: Test
    measured: tuple[MeasuredCurve, ...]
    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    force_error: np.ndarray
    band: np.ndarray
    whole_band: np.ndarray
    fitted: tuple[np.ndarray, ...]
    area: float | None = None
    displacements: tuple[np.ndarray | None, ...] = ()


def compute_test_curves(estimate: Estimate, spread: ParameterUncertainty, tests: Sequence[tuple[ForwardTest, float]],
                        scatter: ContactAndForceZeroJitter | None,
                        predictors: Mapping[str, PredictionParameters] | None = None) -> list[TestCurves]:
    """Compute the curves of tests; NaN if the simulation fails.

    The bands of a fitted test include the deviations of its recordings from the model. The bands of a held-out test
    include noise, scatter and parameter uncertainty only.

    Args:
        estimate: minimum of the fit.
        spread: uncertainty of the estimate.
        tests: forward models, each with the relative error of its mesh.
        scatter: scatter of contact and zero between recordings; None: unknown.
        predictors: test -> predictor, for tests that are not predicted by the estimate itself.
    """
    problem, found = estimate.problem, []
    own, others = PredictionParameters.from_minimum_and_uncertainty(problem.space, estimate.theta, spread), predictors \
        or {}
    along = estimate.evaluation.force
    fitted = {curve.name: along[rows] for curve, rows in zip(problem.measured, problem.rows, strict=True)}
    for test, mesh_error in tests:
        path = _build_model_path_as_forceless_recording(test)
        time = path.time if test.has_reversals_or_holds else None
        try:
            predictor = others.get(test.name, own)
            answer = test.solve(predictor.space, predictor.theta, problem.solves)
            seen = [test.evaluate_force_and_derivatives(answer, number, 0.0) for number in range(len(test.measured))]
            models = tuple(fitted.get(curve.name, force)
                           for curve, (force, *_) in zip(test.measured, seen, strict=True))
            displacements = tuple(
                None if curve.force_control is None else
                compute_displacement_at_measured_force(test, answer, number, models[number], seen[number][2])
                for number, curve in enumerate(test.measured))
            gaps = [curve.force - force for curve, (force, *_) in zip(test.measured, seen, strict=True)]
            known, count = all(curve.name in fitted for curve in test.measured), len(test.measured)
            # With enough recordings their observed scatter is used, which includes more than contact and zero.
            is_observed = known and count >= _CURVES.min_recordings and not (scatter and scatter.freedom is None)
            used = None if is_observed else scatter
            deviations = compute_model_bias_scatter_and_noise(test.measured, gaps, [contact for *_, contact in seen],
                                                              path, used) \
                if known else None
            force, error, bands = _predict_force_error_and_bands_along_path(problem.solves, predictor, test, path,
                                                                            mesh_error, used, deviations)
        except InfeasibleError:
            force = error = np.full(path.displacement.size, np.nan)
            bands, displacements = (force, force), ()
            models = tuple(np.full(curve.force.size, np.nan) for curve in test.measured)
        found.append(TestCurves(test.measured[0].test, test.measured, time, path.displacement, force, error,
                                bands[0], bands[1], models, test.area, displacements))
    return found


def _predict_force_error_and_bands_along_path(solves: SimulationCache, predictor: PredictionParameters,
                                              test: ForwardTest, path: MeasuredCurve,
                                              mesh_error: float, scatter: ContactAndForceZeroJitter | None,
                                              deviations: ModelBiasScatterAndNoise | None):
    """Return the force along a path, its standard error, and the half widths of both prediction bands."""
    # The test is evaluated for one recording that follows the path.
    seen: ForwardTest = replace(test, measured=(path,))
    answer = seen.solve(predictor.space, predictor.theta, solves)
    force, rates, contact = seen.evaluate_force_and_derivatives(answer, 0, 0.0)
    first, *sampled = predictor.compute_force_scatter_components(rates)
    unsure = [ScatterComponent(np.column_stack([first.columns, mesh_error * force])), *sampled]
    found = deviations or ModelBiasScatterAndNoise(np.zeros(force.size), [], np.full(force.size, path.noise.deviation))
    scatters, count = list(found.scatters), len(test.measured)
    # Variance of a new recording about the mean of the recordings: 1 + 1 / count.
    mean_errs = np.sqrt(1.0 + 1.0 / count) if scatters else 1.0
    if scatter is not None:
        freedom = float(scatter.freedom or KNOWN_VARIANCE)
        scatters += [ScatterComponent(mean_errs * scatter.contact * contact[:, None], freedom),
                     ScatterComponent(np.full((force.size, 1), mean_errs * scatter.zero), freedom)]
    bias = found.bias
    if found.scatters:
        # The squared bias is reduced by the variance of the mean (positive-part James-Stein estimator).
        errs = sum(scatter.variance for scatter in scatters) / (count + 1.0)
        bias = np.sign(bias) * np.sqrt(np.maximum(bias**2 - errs, 0.0))
    else:
        scatters += unsure
    samples = np.mean([curve.force.size for curve in test.measured]) / force.size
    error = np.sqrt(sum(each.variance for each in unsure))
    return force, error, compute_prediction_band_half_widths(bias, scatters, found.noise, float(samples))


def _build_model_path_as_forceless_recording(test: ForwardTest) -> MeasuredCurve:
    """Return the path of the model as a recording without force: the motion of the first recording, or one loading."""
    first, segment = test.measured[0], None
    if first.motions is not None:
        # The other motions are known along the recorded path only.
        steps = min(first.force.size, 4 * _CURVES.points)
        path = first.select(np.linspace(0, first.force.size - 1, steps).astype(int))
        return replace(path, force=np.zeros(steps), segment=None if first.segment is None else np.full(steps, ""),
                       interpolation=None)
    time: np.ndarray | None = None
    reached = np.concatenate([curve.displacement for curve in test.measured])
    if test.has_reversals_or_holds:
        even = np.linspace(first.sample_times[0], first.sample_times[-1], 4 * _CURVES.points)
        time, displacement = even, np.interp(even, first.sample_times, first.displacement)
        segment = np.full(displacement.size, "")
    elif first.test.modulus:
        displacement = np.geomspace(reached.min(), reached.max(), _CURVES.points)
    else:
        # A gripped specimen may be loaded in both directions.
        start = min(0.0, float(reached.min())) if first.test.kind.has_gripped_ends else 0.0
        displacement = np.linspace(start, max(0.0, float(reached.max())), _CURVES.points)
        if first.time is not None:
            order = np.argsort(first.displacement, kind="stable")
            time = np.interp(displacement, first.displacement[order], first.sample_times[order])
    return replace(first, time=time, displacement=displacement, force=np.zeros_like(displacement), segment=segment,
                   interpolation=None)
