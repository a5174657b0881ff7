"""Tests that a fit has not seen: left out one at a time, or held out by the campaign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.fit.estimate import Estimate
from calibration.fit.fit import Prediction
from calibration.fit.identifiability import not_identifiable
from calibration.fit.levenberg_marquardt import descend
from calibration.fit.population import as_another_specimen
from calibration.fit.problem import Evaluation, LeastSquares
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.statistics.jitter import Jitter
from calibration.statistics.uncertainty import Uncertainty


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A test predicted by a fit to the others.

    Attributes:
        prediction: errors in N and %.
        simulations: (test, resolution) -> simulations that were done. cpu_s: processor seconds.
    """

    prediction: Prediction
    simulations: dict[tuple[str, str], int]
    cpu_s: float


def leave_out(problem: LeastSquares, theta: np.ndarray, number: int,
              uncertainty: Callable[[Any, Evaluation], Uncertainty], scatter: Jitter | None) -> LeftOut:
    """Fit all tests but one from the joint estimate, and predict that one.

    Args:
        problem: at its minimum, corrected. theta: there, shape (k,). number: of the test.
        uncertainty: of the unknowns at a minimum. scatter: between recordings; None where nobody says.
    """
    spent = problem.solves.meter()
    test, free = problem.tests[number], len(problem.space.free)
    rest, theta = problem.without(number, theta)
    names = [other.name for other in rest.tests]
    descent = descend(rest, theta, corrected=True)
    if not np.isfinite(descent.error):
        return LeftOut(unpredicted(problem, test, names, f"no fit to the others: {descent.failure}"), *spent())
    spread = uncertainty(rest, rest.evaluate(descent.theta))
    told: tuple[np.ndarray, np.ndarray] | None = descent.theta[:free], spread.covariance[:free, :free]
    # What the others do not tell would stay where this test has put it.
    if open_names := not_identifiable(problem.space, spread):
        told = as_another_specimen(problem.space, descent.theta[:free], spread, open_names)
    answer = unpredicted(problem, test, names, "the other tests do not determine "
                         f"{problem.space.in_symbols(open_names)}") if told is None else \
        predict(problem, test, *told, names, scatter)
    return LeftOut(answer, *spent())


def predict_held_out(test: ForwardTest, estimate: Estimate, spread: Uncertainty, scatter: Jitter | None) -> Prediction:
    """How an estimate predicts a test that the campaign holds out."""
    free = len(estimate.problem.space.free)
    return predict(estimate.problem, test, estimate.theta[:free], spread.covariance[:free, :free], [], scatter)


def predict(problem: LeastSquares, test: ForwardTest, theta: np.ndarray, covariance: np.ndarray, fitted: list[str],
            scatter: Jitter | None) -> Prediction:
    """How parameters predict a test, with no offset and no zero of its own.

    Args:
        problem: for the parameters and what is simulated. test: with its recordings.
        theta, covariance: SI, shapes (p,) and (p, p). fitted: tests that these come from. scatter: between recordings.
    """
    try:
        answer = test.solve(problem.space, theta, problem.solves)
        seen = [test.evaluate(answer, recording, 0.0) for recording in range(len(test.measured))]
    except InfeasibleError as failure:
        return unpredicted(problem, test, fitted, str(failure))
    squares, expected, largest, samples = 0.0, 0.0, 0.0, 0
    for measured, (force, rates, contact) in zip(test.measured, seen, strict=True):
        squares += float(np.sum((force - measured.force)**2))
        if scatter is not None:
            variance = np.einsum("np,pq,nq->n", rates, covariance, rates) + measured.noise.deviation**2
            expected += float(np.sum(variance + (scatter.contact * contact)**2 + scatter.zero**2))
        largest = max(largest, float(np.abs(measured.force).max()))
        samples += measured.force.size
    rmse = float(np.sqrt(squares / samples))
    stressed = test.measured[0].test.specimen is None
    if not np.isfinite(rmse):
        return unpredicted(problem, test, fitted, "the law gives no finite force")
    return Prediction(test=test.name, law=problem.space.law, RMSE_N=None if stressed else rmse,
                      RMSE_Pa=None if test.area is None else rmse / test.area, percent=100.0 * rmse / largest,
                      expected_N=None if stressed or scatter is None else float(np.sqrt(expected / samples)),
                      fitted=fitted,
                      parameters={} if scatter is None else dict(zip(problem.space.free, np.asarray(theta).tolist(),
                                                                     strict=True)))


def unpredicted(problem: LeastSquares, test: ForwardTest, fitted: list[str], note: str) -> Prediction:
    """A prediction that there is none of, and why."""
    return Prediction(test=test.name, law=problem.space.law, RMSE_N=None, RMSE_Pa=None, percent=None, fitted=fitted,
                      note=note)
