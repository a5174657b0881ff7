"""Curves of an estimate for tables and figures: model, standard error, and prediction bands for a new recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.deviations import ModelBiasScatterAndNoise, compute_model_bias_scatter_and_noise
from calibration.fit.estimate import Estimate
from calibration.fit.predictor import PredictionParameters
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.bands import KNOWN_VARIANCE, ScatterComponent, compute_prediction_band_half_widths
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.uncertainty import ParameterUncertainty


@dataclass(frozen=True)
class FittedCurveSettings:
    """Settings of the curves of an estimate.

    Attributes:
        points: number of points of a curve; a path-dependent curve has four times as many.
        min_recordings: number of recordings from which the observed scatter replaces the scatter of contact and zero.
    """

    points: int = 101
    min_recordings: int = 3


_SETTINGS = FittedCurveSettings()


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
            gaps = [curve.force - force for curve, (force, *_) in zip(test.measured, seen, strict=True)]
            known, count = all(curve.name in fitted for curve in test.measured), len(test.measured)
            # With enough recordings their observed scatter is used, which includes more than contact and zero.
            is_observed = known and count >= _SETTINGS.min_recordings and not (scatter and scatter.freedom is None)
            used = None if is_observed else scatter
            deviations = compute_model_bias_scatter_and_noise(test.measured, gaps, [contact for *_, contact in seen],
                                                              path, used) \
                if known else None
            force, error, bands = _predict_force_error_and_bands_along_path(problem.solves, predictor, test, path,
                                                                            mesh_error, used, deviations)
        except InfeasibleError:
            force = error = np.full(path.displacement.size, np.nan)
            bands = force, force
            models = tuple(np.full(curve.force.size, np.nan) for curve in test.measured)
        found.append(TestCurves(test.measured[0].test, test.measured, time, path.displacement, force, error,
                                bands[0], bands[1], models, test.area))
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
    time: np.ndarray | None = None
    reached = np.concatenate([curve.displacement for curve in test.measured])
    if test.has_reversals_or_holds:
        even = np.linspace(first.sample_times[0], first.sample_times[-1], 4 * _SETTINGS.points)
        time, displacement = even, np.interp(even, first.sample_times, first.displacement)
        segment = np.full(displacement.size, "")
    else:
        # A gripped specimen may be loaded in both directions.
        start = min(0.0, float(reached.min())) if first.test.kind.has_gripped_ends else 0.0
        displacement = np.linspace(start, max(0.0, float(reached.max())), _SETTINGS.points)
        if first.time is not None:
            order = np.argsort(first.displacement, kind="stable")
            time = np.interp(displacement, first.displacement[order], first.sample_times[order])
    return replace(first, time=time, displacement=displacement, force=np.zeros_like(displacement), segment=segment,
                   interpolation=None)
