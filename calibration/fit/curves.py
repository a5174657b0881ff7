"""Curves of an estimate for tables and pictures: model, its error, and the band for a new recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.statistics.jitter import Jitter
from calibration.statistics.uncertainty import Uncertainty

POINTS = 101


@dataclass(frozen=True, eq=False)
class TestCurves:
    """One test as one fitted law sees it.

    Forces in N, displacements in m; Pa and strain where `test.specimen` is None.

    Attributes:
        test: the test. measured: its recordings.
        time: of the model's path, s, shape (k,), or None where the rate does not matter.
        displacement: of the path, shape (k,). force: of the model there, without offset and zero, shape (k,).
        force_error: standard error of that, from the parameters and the mesh, shape (k,).
        band: half width of the 95 % band for a new recording: with noise, offset and zero, shape (k,).
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
    fitted: tuple[np.ndarray, ...]
    area: float | None = None


def draw_curves(estimate: Estimate, spread: Uncertainty, tests: Sequence[tuple[ForwardTest, float]],
                scatter: Jitter | None) -> list[TestCurves]:
    """The curves of each test; not a number where the model does not get through.

    Args:
        estimate: the minimum. spread: its uncertainty. tests: with the relative error of the mesh in each.
        scatter: between recordings; None where nobody says.
    """
    problem, found = estimate.problem, []
    along = estimate.evaluation.force
    fitted = {curve.name: along[rows] for curve, rows in zip(problem.measured, problem.rows, strict=True)}
    for test, mesh_error in tests:
        path = _path(test)
        time = path.time if test.timed else None
        try:
            force, error, band = _along(estimate, spread, test, path, mesh_error, scatter)
            answer = test.solve(problem.space, estimate.theta[: len(problem.space.free)], problem.solves)
            models = tuple(fitted[curve.name] if curve.name in fitted else test.evaluate(answer, number, 0.0)[0]
                           for number, curve in enumerate(test.measured))
        except InfeasibleError:
            force = error = band = np.full(path.displacement.size, np.nan)
            models = tuple(np.full(curve.force.size, np.nan) for curve in test.measured)
        found.append(TestCurves(test.measured[0].test, test.measured, time, path.displacement, force, error, band,
                                models, test.area))
    return found


def _along(estimate: Estimate, spread: Uncertainty, test: ForwardTest, path: MeasuredCurve, mesh_error: float,
           scatter: Jitter | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force along the path, its standard error, and the half width of the 95 % band of a new recording."""
    space = estimate.problem.space
    free = len(space.free)
    # The path is that of a recording without scatter, seen by the same test.
    seen: ForwardTest = replace(test, measured=(path,))
    answer = seen.solve(space, estimate.theta[:free], estimate.problem.solves)
    force, rates, contact = seen.evaluate(answer, 0, 0.0)
    variance = np.einsum("np,pq,nq->n", rates, spread.covariance[:free, :free], rates) + (mesh_error * force)**2
    new = variance + path.noise.deviation**2
    quantile = stats.norm.ppf(0.975)
    if scatter is not None:
        new = new + (scatter.contact * contact)**2 + scatter.zero**2
        # How wide the scatter is, is itself an estimate where it was not stated.
        quantile = stats.t.ppf(0.975, scatter.freedom) if scatter.freedom else quantile
    return force, np.sqrt(variance), quantile * np.sqrt(new)


def _path(test: ForwardTest) -> MeasuredCurve:
    """What a perfect recording of the test would have for its motion."""
    first, segment = test.measured[0], None
    time: np.ndarray | None = None
    reached = np.concatenate([curve.displacement for curve in test.measured])
    if test.timed:
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
