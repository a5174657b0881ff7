"""Predictions of tests that were not fitted, and the ranking of laws by them.

The tests are left out one at a time, or held out by the campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Prediction
from calibration.fit.identifiability import find_undetermined_parameters
from calibration.fit.lack_of_fit import format_regions_with_misfit, get_residual_scale
from calibration.fit.population import PredictionParameters, adapt_predictor_to_left_out_test_or_none
from calibration.fit.problem import LeastSquaresProblem, ProblemEvaluation
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.statistics import NOISE_RATIOS
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
        largest = max(largest, get_residual_scale(measured))
        samples += measured.force.size
    rmse = float(np.sqrt(squares / samples))
    stressed = test.measured[0].test.states_stress
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


@dataclass(frozen=True)
class RankingSettings:
    """Limits of the sentences that explain a ranking.

    Attributes:
        equal_error: relative difference of prediction errors below which they do not decide between two laws.
        max_error: prediction error above which a law counts as not predictive, %.
        scatter_ratio: ratio of the error to its expected value up to which the error of a further specimen is scatter
            between specimens.
    """

    equal_error: float = 0.1
    max_error: float = 10.0
    scatter_ratio: float = 2.0


_SETTINGS = RankingSettings()
#: Fit of a law, its predictions, and its curves.
Fitted = tuple[Fit, list[Prediction], Sequence[TestCurves]]


def rank_fits_predictions_and_curves(
        fitted: Sequence[Fitted]) -> tuple[list[Fit], list[Prediction], dict[str, Sequence[TestCurves]]]:
    """Sort laws: usable fits first, then fits without parameters on bounds, then fits with a material.

    Within these groups the root mean square prediction error in % decides: over the held-out tests if there are any,
    otherwise over tests that were left out one at a time. Without predictions BIC decides.

    Args:
        fitted: fit, predictions and curves of each law.

    Returns:
        Fits, predictions, and law -> curves, best law first.
    """
    predicted = {p.test for _, predictions, _ in fitted for p in predictions if p.percent is not None}
    fitted = [(
        replace(fit, left_out=_compute_rms_prediction_percent_or_none([p for p in predictions if p.test in predicted])),
        predictions, curves) for fit, predictions, curves in fitted]

    def law_sort_key(item: Fitted):
        """Return the key that sorts the results of laws, best first."""
        fit = item[0]
        return (fit.unusable is not None, bool(fit.parameters_on_bounds), fit.material_file is None,
                fit.left_out is None, _get_ranking_criterion(fit))

    fitted = sorted(fitted, key=law_sort_key)
    return ([fit for fit, _, _ in fitted], [p for _, predictions, _ in fitted for p in predictions],
            {fit.law: curves for fit, _, curves in fitted})


def _get_ranking_criterion(fit: Fit) -> float:
    """Return the criterion of the ranking: prediction error, %, or BIC without predictions."""
    return fit.BIC if fit.left_out is None else fit.left_out


def _compute_rms_prediction_percent_or_none(predictions: Sequence[Prediction]) -> float | None:
    """Return the root mean square prediction error, %; a test that only other laws can predict counts as 100 %."""
    held_out = [p for p in predictions if not p.fitted]
    errors = [100.0 if p.percent is None else p.percent for p in held_out or predictions]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def explain_ranking(fits: Sequence[Fit], predictions: Sequence[Prediction], fitted: Sequence[MeasuredCurve]) -> str:
    """Explain the ranking and its limits.

    Args:
        fits: fits, best first.
        predictions: predictions of all laws.
        fitted: fitted recordings.
    """
    best = fits[0]
    if best.unusable is not None:
        return f"No law is usable over the data; the first is {best.law}: {best.message}."
    parts = []
    if best.parameters_on_bounds:
        parts.append(f"{best.law} is held by the bounds of {best.format_symbols(best.parameters_on_bounds)}: widen "
                     "them in fit.bounds, or do not trust it")
    if best.left_out is None:
        parts.append(
            f"Best of the laws that are usable over the data: {best.law}"
            f"{_describe_bic_ranking_reliability(fits, fitted)}")
        tests = {curve.test.name for curve in fitted}
        single = "with a single test there is nothing to predict" if len(tests) == 1 else "no test could be predicted"
        parts.append(f"{single}, so BIC ranks, and this does not say which law is right: add a test of another kind"
                     if len(fits) > 1 else f"{single}, so nothing is known of how it predicts another")
    else:
        parts += [*_describe_predictions_of_best_and_rivals(fits, predictions),
                  *filter(None, [_describe_unreliable_noise(best, fitted)])]
    if passed := [_describe_unusable_law(fit) for fit in fits
                  if (fit.unusable is not None or (fit.parameters_on_bounds and not best.parameters_on_bounds))
                  and (fit.left_out is None) == (best.left_out is None)
                  and _get_ranking_criterion(fit) < _get_ranking_criterion(best)]:
        parts.append(f"{'lower BIC' if best.left_out is None else 'less wrong'}, but not usable: {', '.join(passed)}")
    if bad := format_regions_with_misfit(best.regions):
        parts.append(f"a smooth misfit remains in {bad}, so the model is incomplete")
    if best.not_identifiable:
        parts.append(f"the tests do not determine {best.format_symbols(best.not_identifiable)}"
                     + (f"; {best.suggestions[0].test} would" if best.suggestions else ""))
    known = {fit.law for fit in fits}
    sentences = (part if part.split()[0].rstrip(",") in known else part[0].upper() + part[1:] for part in parts)
    return f"{'. '.join(sentences)}."


def does_any_law_predict_a_held_out_test(predictions: Sequence[Prediction]) -> bool:
    """Return whether held-out tests rank the laws, which requires that at least one law predicts one of them."""
    return any(not p.fitted and p.percent is not None for p in predictions)


def _describe_unusable_law(fit: Fit) -> str:
    """Describe a law with a better criterion that is ranked lower, with the reason."""
    return f"{fit.law} ({fit.unusable or f'held by the bounds of {fit.format_symbols(fit.parameters_on_bounds)}'})"


def _describe_predictions_of_best_and_rivals(fits: Sequence[Fit], predictions: Sequence[Prediction]) -> list[str]:
    """Describe the predictions of the first law, and other laws with similar prediction errors."""
    best = fits[0]
    mine = [p for p in predictions if p.law == best.law]
    held_out = does_any_law_predict_a_held_out_test(predictions)
    words = ", ".join(_describe_prediction(p) for p in mine if bool(p.fitted) != held_out)
    what = "held-out tests" if held_out else "each test from the others"
    large = [p for p in mine if bool(p.fitted) != held_out and (p.percent is None or p.percent > _SETTINGS.max_error)]
    if (best.left_out or 0.0) > _SETTINGS.max_error and not all(map(_is_error_within_specimen_scatter, large)):
        parts = [f"no law predicts {what}; the least wrong is {best.law}: {words}" if len(fits) > 1 else
                 f"{best.law} does not predict {what}: {words}"]
    else:
        parts = [f"{best.law} predicts {what} best: {words}" if len(fits) > 1 else
                 f"{best.law} predicts {what}: {words}"]
    rivals = [fit.law for fit in fits[1:] if fit.unusable is None and not fit.parameters_on_bounds
              and fit.left_out is not None
              and fit.left_out <= (1 + _SETTINGS.equal_error) * (best.left_out or 0.0)]
    if rivals:
        parts.append(f"{', '.join(rivals)} within {_SETTINGS.equal_error:.0%} of its prediction error, so these tests "
                     "do not decide between them")
    return parts


def _describe_bic_ranking_reliability(fits: Sequence[Fit], fitted: Sequence[MeasuredCurve]) -> str:
    """Describe the reliability of a ranking by BIC, as the end of a sentence."""
    best = fits[0]
    if best.noise_ratio > NOISE_RATIOS.model_error:
        return (f"; its residuals are {best.noise_ratio:.3g} times the noise, so model error dominates and the ranking "
                "says which law is least wrong over this range, not which one is right")
    if doubt := _describe_unreliable_noise(best, fitted):
        return f"; {doubt}"
    rivals = [fit.law for fit in fits[1:] if fit.unusable is None and not fit.parameters_on_bounds
              and fit.BIC - best.BIC < 10]
    if rivals:
        return f"; {', '.join(rivals)} within 10 of its BIC, so these data do not decide between them"
    return f"; its residuals are {best.noise_ratio:.2g} times the noise"


def _describe_unreliable_noise(best: Fit, fitted: Sequence[MeasuredCurve]) -> str:
    """Describe why the estimated noise is unreliable; empty if it is reliable or stated."""
    guessed = [curve for curve in fitted if curve.noise.source == "estimated"]
    if best.noise_ratio >= NOISE_RATIOS.curvature or not guessed:
        return ""
    key = "nominal_stress_Pa" if guessed[0].stressed else "force_N"
    return (f"its residuals are {best.noise_ratio:.2g} times the noise, which could not be estimated from samples so "
            f"coarse or smooth: state {key} in [noise]")


def _describe_prediction(prediction: Prediction) -> str:
    """Describe a prediction, such as ``needle within 0.02 N, 3.1 %``."""
    if prediction.percent is None:
        return f"{prediction.test} not ({prediction.note})"
    force = f"{prediction.RMSE_N:.3g} N, " if prediction.RMSE_N is not None else "" if prediction.RMSE_Pa is None \
        else f"{prediction.RMSE_Pa:.3g} Pa, "
    chance = "" if not prediction.mean_of else f" by the mean of {len(prediction.mean_of)} other specimens" + (
        "" if prediction.expected_N is None else f", whose scatter makes {prediction.expected_N:.2g} N")
    return f"{prediction.test} within {force}{float(f'{prediction.percent:.2g}'):g} %{chance}"


def _is_error_within_specimen_scatter(prediction: Prediction) -> bool:
    """Return whether the error of a prediction by a mean is compatible with the scatter between specimens."""
    rmse, expected = prediction.RMSE_N, prediction.expected_N
    return (bool(prediction.mean_of) and rmse is not None and expected is not None
            and rmse <= _SETTINGS.scatter_ratio * expected)
