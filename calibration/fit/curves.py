"""Curves of an estimate for tables and pictures: model, its error, and the band for a new recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.deviations import Deviations, assess_deviations
from calibration.fit.estimate import Estimate
from calibration.fit.predictor import Predictor
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.bands import KNOWN_VARIANCE, Scatter, prediction_bands
from calibration.statistics.jitter import Jitter
from calibration.statistics.uncertainty import Uncertainty

POINTS = 101
#: So many recordings of a test tell their scatter better than an estimate of contact and zero.
ENOUGH = 3


@dataclass(frozen=True, eq=False)
class TestCurves:
    """One test as one fitted law sees it.

    Forces in N, displacements in m; Pa and strain where `test.specimen` is None.

    Attributes:
        test: the test. measured: its recordings.
        time: of the model's path, s, shape (k,), or None where the rate does not matter.
        displacement: of the path, shape (k,). force: of the model there, without offset and zero, shape (k,).
        force_error: standard error of that, from the parameters and the mesh, shape (k,).
        band: half width of the band that holds 95 % of the samples of new recordings, with noise, offset, zero and
            what the model lacks, shape (k,). whole_band: of the one that holds 95 % of new recordings wholly.
        fitted: of each recording the model's force at its samples, with its own offset and zero.
        area: cross-section of the nominal stress, m2 (1 where stress was recorded); None where that is not homogeneous.
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


def draw_curves(estimate: Estimate, spread: Uncertainty, tests: Sequence[tuple[ForwardTest, float]],
                scatter: Jitter | None, predictors: Mapping[str, Predictor] | None = None) -> list[TestCurves]:
    """The curves of each test; not a number where the model does not get through.

    The bands of a test that was fitted follow its recordings; those of one that was held out, or that the model does
    not get through, know chance alone: noise, scatter and the uncertainty of the parameters.

    Args:
        estimate: the minimum. spread: its uncertainty. tests: with the relative error of the mesh in each.
        scatter: between recordings; None where nobody says.
        predictors: test -> what predicts it, where that is not the estimate itself.
    """
    problem, found = estimate.problem, []
    own, others = Predictor.of(problem.space, estimate.theta, spread), predictors or {}
    along = estimate.evaluation.force
    fitted = {curve.name: along[rows] for curve, rows in zip(problem.measured, problem.rows, strict=True)}
    for test, mesh_error in tests:
        path = _path(test)
        time = path.time if test.is_path_dependent else None
        try:
            predictor = others.get(test.name, own)
            answer = test.solve(predictor.space, predictor.theta, problem.solves)
            seen = [test.evaluate(answer, number, 0.0) for number in range(len(test.measured))]
            models = tuple(fitted.get(curve.name, force)
                           for curve, (force, *_) in zip(test.measured, seen, strict=True))
            gaps = [curve.force - force for curve, (force, *_) in zip(test.measured, seen, strict=True)]
            known, count = all(curve.name in fitted for curve in test.measured), len(test.measured)
            # Recordings of the test itself tell of any scatter, and not of contact and zero alone.
            told = scatter if not known or count < ENOUGH or (scatter and scatter.freedom is None) else None
            deviations = assess_deviations(test.measured, gaps, [contact for *_, contact in seen], path, told) \
                if known else None
            force, error, bands = _along(problem.solves, predictor, test, path, mesh_error, told, deviations)
        except InfeasibleError:
            force = error = np.full(path.displacement.size, np.nan)
            bands = force, force
            models = tuple(np.full(curve.force.size, np.nan) for curve in test.measured)
        found.append(TestCurves(test.measured[0].test, test.measured, time, path.displacement, force, error,
                                bands[0], bands[1], models, test.area))
    return found


def _along(solves: SimulationCache, predictor: Predictor, test: ForwardTest, path: MeasuredCurve, mesh_error: float,
           scatter: Jitter | None, deviations: Deviations | None):
    """Force along the path, its standard error, and half widths of the bands of a new recording."""
    # The path is that of a recording without scatter, seen by the same test.
    seen: ForwardTest = replace(test, measured=(path,))
    answer = seen.solve(predictor.space, predictor.theta, solves)
    force, rates, contact = seen.evaluate(answer, 0, 0.0)
    first, *sampled = predictor.scatters(rates)
    unsure = [Scatter(np.column_stack([first.columns, mesh_error * force])), *sampled]
    found = deviations or Deviations(np.zeros(force.size), [], np.full(force.size, path.noise.deviation))
    scatters, count = list(found.scatters), len(test.measured)
    # The mean of the recordings, as far as the curve is off, says what the parameters err by; it errs itself.
    mean_errs = np.sqrt(1.0 + 1.0 / count) if scatters else 1.0
    if scatter is not None:
        freedom = float(scatter.freedom or KNOWN_VARIANCE)
        scatters += [Scatter(mean_errs * scatter.contact * contact[:, None], freedom),
                     Scatter(np.full((force.size, 1), mean_errs * scatter.zero), freedom)]
    bias = found.bias
    if found.scatters:
        # Of the mean's distance from the curve, what the mean errs by is no misfit (James and Stein, positive part).
        errs = sum(scatter.variance for scatter in scatters) / (count + 1.0)
        bias = np.sign(bias) * np.sqrt(np.maximum(bias**2 - errs, 0.0))
    else:
        scatters += unsure
    samples = np.mean([curve.force.size for curve in test.measured]) / force.size
    error = np.sqrt(sum(each.variance for each in unsure))
    return force, error, prediction_bands(bias, scatters, found.noise, float(samples))


def _path(test: ForwardTest) -> MeasuredCurve:
    """What a perfect recording of the test would have for its motion."""
    first, segment = test.measured[0], None
    time: np.ndarray | None = None
    reached = np.concatenate([curve.displacement for curve in test.measured])
    if test.is_path_dependent:
        even = np.linspace(first.clock[0], first.clock[-1], 4 * POINTS)
        time, displacement = even, np.interp(even, first.clock, first.displacement)
        segment = np.full(displacement.size, "")
    else:
        # A gripped specimen may be loaded to both sides: there the path leads from one end to the other.
        start = min(0.0, float(reached.min())) if first.test.kind.gripped else 0.0
        displacement = np.linspace(start, max(0.0, float(reached.max())), POINTS)
        if first.time is not None:
            order = np.argsort(first.displacement, kind="stable")
            time = np.interp(displacement, first.displacement[order], first.clock[order])
    return replace(first, time=time, displacement=displacement, force=np.zeros_like(displacement), segment=segment,
                   interpolation=None)
