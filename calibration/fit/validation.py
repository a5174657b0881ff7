"""Predictions of tests that were not fitted: left out one at a time, or held out by the campaign."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import Prediction
from calibration.fit.identifiability import find_undetermined_parameters
from calibration.fit.predictor import PredictionParameters, adapt_predictor_to_left_out_test_or_none
from calibration.fit.problem import LeastSquaresProblem, ProblemEvaluation
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.uncertainty import ParameterUncertainty


@dataclass(frozen=True, eq=False)
class LeftOutPredictionWithCost:
    """Prediction of a test by a fit to the other tests, and the number of simulations and processor time it used.

    Attributes:
        prediction: prediction and its errors.
        simulations: (test, resolution) -> number of simulations.
        cpu_s: processor time, s.
    """

    prediction: Prediction
    simulations: dict[tuple[str, str], int]
    cpu_s: float


def predict_left_out_test(problem: LeastSquaresProblem, theta: np.ndarray, number: int,
                          uncertainty: Callable[[Any, ProblemEvaluation], ParameterUncertainty],
                          scatter: ContactAndForceZeroJitter | None) -> LeftOutPredictionWithCost:
    """Fit all tests except one, starting from the joint estimate, and predict the test that is left out.

    If the fit fails, or the other tests do not determine the parameters, the prediction has no errors and its note
    contains the reason.

    Args:
        problem: problem with mesh correction.
        theta: unknowns at its minimum, SI, shape (k,).
        number: index of the test that is left out.
        uncertainty: function that returns the uncertainty of a problem at its minimum.
        scatter: scatter of contact and zero between recordings; None: unknown.
    """
    spent = problem.solves.make_effort_since_now_function()
    test = problem.tests[number]
    rest, theta = problem.make_problem_and_unknowns_without_test(number, theta)
    names = [other.name for other in rest.tests]
    descent = minimise_from_start(rest, theta, corrected=True)
    if not np.isfinite(descent.error):
        failed = make_prediction_with_failure_note(problem, test, names, f"no fit to the others: {descent.failure}")
        return LeftOutPredictionWithCost(failed, *spent())
    spread = uncertainty(rest, rest.evaluate(descent.theta))
    unknown = _find_parameters_needing_left_out_test(problem.space, spread, test.name, names)
    predictor = adapt_predictor_to_left_out_test_or_none(
        PredictionParameters.from_minimum_and_uncertainty(problem.space, descent.theta, spread), spread,
        unknown)
    answer = make_prediction_with_failure_note(problem, test, names, "the other tests do not determine "
                                               f"{problem.space.format_symbols(unknown)}") if predictor is None else \
        predict_test(problem, test, predictor, names, scatter)
    return LeftOutPredictionWithCost(answer, *spent())


def _find_parameters_needing_left_out_test(space: ParameterSpace, spread: ParameterUncertainty, test: str,
                                           others: Sequence[str]) -> list[str]:
    """Return the names of parameters that act in a test and that the other tests do not determine."""
    loose = set(find_undetermined_parameters(space, spread))
    # A parameter without data may stay on its bound, where it has no standard error; it is undetermined too.
    return [each.name for index, each in enumerate(space.free_parameters) if each.applies_to_recording(test, None) and (
        each.name in loose or not (np.isfinite(space.prior_deviation[index])
                                   or any(each.applies_to_recording(other, None) for other in others)))]


def predict_held_out_test(problem: LeastSquaresProblem, test: ForwardTest, predictor: PredictionParameters | None,
                          scatter: ContactAndForceZeroJitter | None) -> Prediction:
    """Predict a held-out test; if `predictor` is None, return a prediction without errors, with a note why."""
    if predictor is not None:
        return predict_test(problem, test, predictor, [], scatter)
    specimen = test.measured[0].test.specimen
    name = "its specimen" if specimen is None else specimen.name
    return make_prediction_with_failure_note(problem, test, [],
                                             f"no test of {name} is fitted, and there is no mean of other specimens")


def predict_test(problem: LeastSquaresProblem, test: ForwardTest, predictor: PredictionParameters, fitted: list[str],
                 scatter: ContactAndForceZeroJitter | None) -> Prediction:
    """Predict a test with contact offset 0 and force zero 0, and compare the prediction with its recordings.

    If the law gives no finite force, the prediction has no errors and its note contains the reason.

    Args:
        problem: problem with the law and the cache of simulations.
        test: forward model with its recordings.
        predictor: parameters of the prediction.
        fitted: names of the fitted tests; empty: all tests that are not held out.
        scatter: scatter of contact and zero between recordings; None: unknown.
    """
    space, covariance = predictor.space, predictor.covariance
    # The scatter between specimens is much larger than an unknown scatter between recordings.
    jitter = ContactAndForceZeroJitter(0.0, 0.0, None) if scatter is None and predictor.mean_of else scatter
    try:
        answer = test.solve(space, predictor.theta, problem.solves)
        seen = [test.evaluate_force_and_derivatives(answer, recording, 0.0) for recording in range(len(test.measured))]
    except InfeasibleError as failure:
        return make_prediction_with_failure_note(problem, test, fitted, str(failure))
    squares, expected, largest, samples = 0.0, 0.0, 0.0, 0
    for measured, (force, rates, contact) in zip(test.measured, seen, strict=True):
        squares += float(np.sum((force - measured.force)**2))
        if jitter is not None:
            variance = np.einsum("np,pq,nq->n", rates, covariance, rates) + measured.noise.deviation**2
            expected += float(np.sum(variance + (jitter.contact * contact)**2 + jitter.zero**2))
        largest = max(largest, float(np.abs(measured.force).max()))
        samples += measured.force.size
    rmse = float(np.sqrt(squares / samples))
    stressed = test.measured[0].test.specimen is None
    if not np.isfinite(rmse):
        return make_prediction_with_failure_note(problem, test, fitted, "the law gives no finite force")
    return Prediction(test=test.name, law=problem.space.law, RMSE_N=None if stressed else rmse,
                      RMSE_Pa=None if test.area is None else rmse / test.area, percent=100.0 * rmse / largest,
                      expected_N=None if stressed or jitter is None else float(np.sqrt(expected / samples)),
                      fitted=fitted, mean_of=list(predictor.mean_of),
                      parameters={} if scatter is None else dict(zip(space.free, predictor.theta.tolist(),
                                                                     strict=True)))


def make_prediction_with_failure_note(problem: LeastSquaresProblem, test: ForwardTest, fitted: list[str],
                                      note: str) -> Prediction:
    """Return a failed prediction: its error fields are None, and its note contains the reason."""
    return Prediction(test=test.name, law=problem.space.law, RMSE_N=None, RMSE_Pa=None, percent=None, fitted=fitted,
                      note=note)
