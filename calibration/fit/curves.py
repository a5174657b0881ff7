"""Curves of an estimate for tables and pictures: model, its error, and the band for a new recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.problem import Problem
from calibration.fit.results import TestCurves
from calibration.fit.uncertainty import Uncertainty
from calibration.forward.forces import ClosedTest, InfeasibleError, SimulatedTest
from calibration.forward.motion import Timed

POINTS = 101


def draw_curves(estimate: Estimate, spread: Uncertainty,
                tests: Sequence[tuple[SimulatedTest | ClosedTest, float]]) -> list[TestCurves]:
    """The curves of each test; not a number where the simulation does not get through.

    Args:
        estimate: the minimum. spread: its uncertainty. tests: with the relative error of the mesh in each.
    """
    problem, found = estimate.problem, []
    evaluation = problem.evaluate(estimate.theta)
    fitted = {curve.name: evaluation.force[rows] for curve, rows in zip(problem.measured, problem.rows, strict=True)}
    for test, mesh_error in tests:
        try:
            found.append(_curves_of(problem, estimate.theta, spread, test, mesh_error, fitted))
        except InfeasibleError:
            path = _path(test)
            nothing = np.full(path.displacement.size, np.nan)
            found.append(TestCurves(test.measured[0].test, test.measured, path.time if _timed(test) else None,
                                    path.displacement, nothing, nothing, nothing,
                                    tuple(np.full(curve.force.size, np.nan) for curve in test.measured)))
    return found


def _curves_of(problem: Problem, theta: np.ndarray, spread: Uncertainty, test: SimulatedTest | ClosedTest,
               mesh_error: float, fitted: dict[str, np.ndarray]) -> TestCurves:
    first = test.measured[0]
    answer = test.solve(problem.space, theta, problem.solves)
    # The path is that of a recording without scatter, seen by the same test.
    path = _path(test)
    seen = replace(test, measured=(path,))
    force, rates, contact = seen.evaluate(answer, 0, 0.0)
    variance = np.einsum("np,pq,nq->n", rates, spread.covariance, rates) + (mesh_error * force)**2
    new = variance + first.noise.deviation**2 + (problem.jitter.contact * contact)**2 + problem.jitter.zero**2
    # How wide the scatter is, is itself an estimate where it was not stated.
    quantile = stats.t.ppf(0.975, problem.jitter.freedom) if problem.jitter.freedom else stats.norm.ppf(0.975)
    own = []
    for number, curve in enumerate(test.measured):
        own.append(fitted[curve.name] if curve.name in fitted else test.evaluate(answer, number, 0.0)[0])
    return TestCurves(first.test, test.measured, path.time if _timed(test) else None, path.displacement, force,
                      np.sqrt(variance), quantile * np.sqrt(new), tuple(own))


def _timed(test: SimulatedTest | ClosedTest) -> bool:
    return isinstance(test, SimulatedTest) and isinstance(test.motions[0], Timed)


def _path(test: SimulatedTest | ClosedTest) -> MeasuredCurve:
    """What a perfect recording of the test would have for its motion."""
    first = test.measured[0]
    if _timed(test):
        time = np.linspace(first.time[0], first.time[-1], 4 * POINTS)
        displacement = np.interp(time, first.time, first.displacement)
    else:
        displacement = np.linspace(0.0, max(curve.displacement.max() for curve in test.measured), POINTS)
        time = None if first.time is None else np.interp(displacement, first.displacement, first.time)
    return MeasuredCurve(first.name, first.test, time, displacement, np.zeros_like(displacement), None, first.file,
                         first.sha256, first.noise)
