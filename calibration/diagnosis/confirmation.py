"""Confirmation of a diagnosis: misfit in each region before and after, and predictions of unseen data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import linalg, special

from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.diagnosis import HeldOutPrediction, SegmentMisfit
from calibration.diagnosis.evidence import FitEvidence
from calibration.fit.estimate import Estimate, iterate_mesh_correction_and_jitter
from calibration.fit.fit import RegionMisfitTest
from calibration.fit.generalised import GeneralisedLeastSquaresEstimator
from calibration.fit.lack_of_fit import compute_smooth_misfit_tests_of_regions
from calibration.fit.population import PredictionParameters
from calibration.fit.problem import GeneralisedProblem
from calibration.fit.trust_region import minimise_from_start
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import InputError

#: P value below which Fisher's normal approximation of chi-square gives the equivalent standard deviations.
_SMALLEST = 1e-14
#: Fraction of a hold over which the force at each end is averaged.
_END_FRACTION = 0.1


def refit_with_updated_corrections(evidence: FitEvidence) -> FitEvidence:
    """Return the evidence of a new fit with jitter and mesh corrections of the model that includes the effect.

    The given evidence has the jitter and the mesh corrections of the fit without the effect.

    The evidence is returned unchanged if this fit fails.
    """
    problem = evidence.problem
    stated = GeneralisedLeastSquaresEstimator(evidence.campaign, evidence.measured,
                                              problem.solves).get_stated_or_prior_jitter(problem)
    estimate = iterate_mesh_correction_and_jitter(problem, evidence.estimate.theta, stated)
    return replace(evidence, estimate=estimate) if np.isfinite(estimate.error) else evidence


def convert_region_p_value_to_deviations(region: RegionMisfitTest) -> float:
    """Return the number of standard deviations of a normal distribution with the p value of a region (two-sided)."""
    if region.p > _SMALLEST:
        return max(float(-special.ndtri(0.5 * region.p)), 0.0) + 0.0  # converts -0.0 to 0.0
    return float(np.sqrt(2.0 * region.statistic) - np.sqrt(2.0 * region.freedom - 1.0))


def compare_segment_misfits(before: FitEvidence, after: FitEvidence | None) -> list[SegmentMisfit]:
    """Return the misfit of each region before and after effects were added, with a description.

    Args:
        before: fit without effects.
        after: fit with effects; None: no effect was added.
    """
    later = {(region.test, region.segment): region
             for region in (after.region_misfit_tests if after is not None else ())}
    answers = []
    for region in before.region_misfit_tests:
        other = later.get((region.test, region.segment))
        curves = [(curve, rows) for curve, rows in zip(before.problem.measured, before.problem.rows, strict=True)
                  if curve.test.name == region.test]
        inside = _make_segment_or_full_mask(curves[0][0], region.segment)
        answers.append(SegmentMisfit(
            test=region.test, segment=region.segment, speed_mm_s=_compute_mean_speed_mm_s_or_none(curves[0][0], inside),
            cycle=_parse_segment_number(region.segment), before_N=region.misfit_N, largest_before_N=-region.largest_N,
            before_sigma=convert_region_p_value_to_deviations(region), adequate_before=region.adequate,
            after_N=None if other is None else other.misfit_N,
            after_sigma=None if other is None else convert_region_p_value_to_deviations(other),
            adequate_after=None if other is None else other.adequate,
            sentence=_describe_region_misfit_and_significance(region, curves, before)))
    return answers


def compute_smooth_misfit_rms_newton(evidence: FitEvidence) -> float:
    """Return the root mean square of the smooth part of the residuals over all samples, N."""
    weights, total = 0.0, 0.0
    for region in evidence.region_misfit_tests:
        count = sum(int(_make_segment_or_full_mask(curve, region.segment).sum()) for curve in evidence.problem.measured
                    if curve.test.name == region.test)
        weights += count
        total += count * region.misfit_N**2
    return float(np.sqrt(total / weights)) if weights else 0.0


def predict_last_recordings_from_others(before: FitEvidence, after: FitEvidence | None) -> list[HeldOutPrediction]:
    """Predict the last recording of each test with at least three recordings by fits to the other recordings."""
    plain = _fit_and_split_off_last_recordings_or_none(before)
    if plain is None:
        return []
    with_effect = None if after is None else _fit_and_split_off_last_recordings_or_none(after)
    first = _compute_last_recording_errors_or_reason(*plain)
    second = [None] * len(first) if with_effect is None else _compute_last_recording_errors_or_reason(*with_effect)
    return [_build_held_out_record(test.measured[0].name, "replicate", one, two, test.measured)
            for test, one, two in zip(plain[1].tests, first, second, strict=True)]


def predict_held_out_tests_from_fits(before: FitEvidence, after: FitEvidence | None) -> list[HeldOutPrediction]:
    """Predict the tests that the campaign holds out, from the fits without (`before`) and with effects (`after`)."""
    found = []
    for test in before.campaign.tests:
        if not test.hold_out:
            continue
        first = _compute_held_out_error_or_reason(before, test.name)
        second = None if after is None else _compute_held_out_error_or_reason(after, test.name)
        found.append(_build_held_out_record(test.name, "test", first or "not predicted", second,
                                            before.measured[test.name]))
    return found


#: Root mean square error, N, and whether the residuals are adequate.
Prediction = tuple[float, bool]


def _build_held_out_record(name: str, kind: str, before: Prediction | str, after: Prediction | str | None,
                           curves: Sequence[MeasuredCurve]) -> HeldOutPrediction:
    """Combine predictions before and after (or the reasons why there are none) to a record."""
    note = "; ".join(dict.fromkeys(each for each in (before, after) if isinstance(each, str)))
    one = before if isinstance(before, tuple) else (None, None)
    two = after if isinstance(after, tuple) else (None, None)
    return HeldOutPrediction(name=name, kind=kind, before_N=one[0], adequate_before=one[1], after_N=two[0],
                             adequate_after=two[1], noise_N=float(np.mean([curve.noise.deviation for curve in curves])),
                             note=note)


def _compute_held_out_error_or_reason(evidence: FitEvidence, name: str) -> Prediction | str:
    """Return root mean square error, N, and adequacy of a predicted test; the reason if the prediction fails."""
    asked = next(test for test in evidence.campaign.tests if test.name == name)
    problem = evidence.problem
    try:
        own = PredictionParameters.from_minimum_and_uncertainty(
            problem.space, evidence.estimate.theta, compute_marginal_uncertainty(problem, evidence.evaluation))
        estimator = GeneralisedLeastSquaresEstimator(evidence.campaign, evidence.measured, problem.solves)
        test, error = estimator.build_held_out_test_and_mesh_error(asked, evidence.estimate, own)
        unseen = GeneralisedProblem(problem.space, (test,), problem.solves, problem.jitter, (error,))
        return _compute_test_rms_errors_and_adequacy(unseen, own.theta, own.covariance)[0]
    except (InfeasibleError, InputError) as failure:
        return str(failure)


def _fit_and_split_off_last_recordings_or_none(evidence: FitEvidence) -> tuple[Estimate, GeneralisedProblem] | None:
    """Return the fit without the last recording of each test with three or more, and the problem of these recordings.

    None if no test has three recordings.
    """
    problem = evidence.problem
    repeated = [len(test.measured) > 2 for test in problem.tests]
    if not any(repeated):
        return None

    def select_recording_range_of_test(test, first: int, last: int | None):
        """Return a copy of a test with its recordings ``[first:last]`` only."""
        changes: dict = {"measured": test.measured[first:last]}
        if hasattr(test, "motion_of"):
            changes["motion_of"] = test.motion_of[first:last]
        return replace(test, **changes)

    rest = GeneralisedProblem(problem.space, tuple(select_recording_range_of_test(test, 0, -1) if several else test
                                                   for test, several in zip(problem.tests, repeated, strict=True)),
                              problem.solves, problem.jitter, problem.mesh_error)
    chosen = [i for i, several in enumerate(repeated) if several]
    last = GeneralisedProblem(problem.space,
                              tuple(select_recording_range_of_test(problem.tests[i], -1, None) for i in chosen),
                              problem.solves, problem.jitter, tuple(problem.mesh_error[i] for i in chosen))
    descent = minimise_from_start(rest, evidence.estimate.theta, corrected=True)
    estimate = Estimate(1, descent.theta, descent.error, descent.converged, descent.failure, (), {}, 0.0, problem=rest)
    return estimate, last


def _compute_last_recording_errors_or_reason(estimate: Estimate, last: GeneralisedProblem) -> list[Prediction | str]:
    """Return error, N, and adequacy of the prediction of each test of `last`, or the reason if there is none."""
    if not np.isfinite(estimate.error):
        return [f"no fit to the others: {estimate.failure}"] * len(last.tests)
    covariance = compute_marginal_uncertainty(estimate.problem, estimate.evaluation).covariance
    try:
        return list(_compute_test_rms_errors_and_adequacy(last, estimate.theta, covariance))
    except InfeasibleError as failure:
        return [str(failure)] * len(last.tests)


def _compute_test_rms_errors_and_adequacy(unseen: GeneralisedProblem, theta: np.ndarray,
                                          covariance: np.ndarray) -> list[Prediction]:
    """Return the root mean square prediction error of each test, N, and whether its residuals are adequate.

    Contact offset and zero of each recording are fitted. The covariance of the parameters enters the residual tests as
    a prior.

    Args:
        unseen: problem with recordings that were not fitted.
        theta: free parameters of the prediction, SI, shape (p,).
        covariance: covariance of the parameters, shape (p, p).
    """
    evaluation = unseen.evaluate(theta)
    sizes = unseen.compute_unknown_scales(theta)
    scaled = covariance / np.outer(sizes, sizes)
    values, axes = linalg.eigh(0.5 * (scaled + scaled.T))
    known = values > 1e-14 * max(values.max(initial=0.0), 1e-300)
    # Directions without variance, such as parameters on a bound, get a very narrow prior.
    root = (axes[:, known] / np.sqrt(values[known])).T / sizes
    held = (axes[:, ~known].T / sizes) * 1e6
    rows = np.vstack([root, held])
    judged = replace(evaluation, prior_residual=np.zeros(rows.shape[0]), prior_rates=rows)
    regions = compute_smooth_misfit_tests_of_regions(unseen, judged)
    answers = []
    for number, test in enumerate(unseen.tests):
        gaps = np.concatenate([evaluation.force[rows] - unseen.data[rows] for rows, (t, _) in zip(
            unseen.rows, unseen.places, strict=True) if t == number])
        adequate = all(region.adequate for region in regions if region.test == test.name)
        answers.append((float(np.sqrt(np.mean(gaps**2))), adequate))
    return answers


def _make_segment_or_full_mask(curve: MeasuredCurve, segment: str) -> np.ndarray:
    """Return the mask of the samples of a segment, shape (n,); all true if the region is a third of a loading."""
    if curve.segment is None or segment not in curve.segment:
        return np.ones(curve.force.size, bool)
    return curve.segment == segment


def _compute_mean_speed_mm_s_or_none(curve: MeasuredCurve, inside: np.ndarray) -> float | None:
    """Return the mean speed over some samples, mm/s, to three digits; None without time."""
    if curve.time is None or inside.sum() < 2:
        return None
    time, displacement = curve.time[inside], curve.displacement[inside]
    duration = time[-1] - time[0]
    speed = abs(displacement[-1] - displacement[0]) / duration if duration > 0 else 0.0
    return float(f"{1e3 * speed:.3g}")


def _parse_segment_number(segment: str) -> int:
    """Return the number at the end of a segment's name, such as 2 for ``hold 2``; 1 without a number."""
    last = segment.rpartition(" ")[2]
    return int(last) if last.isdigit() else 1


def _describe_region_misfit_and_significance(region: RegionMisfitTest, curves: Sequence[tuple[MeasuredCurve, slice]],
                                             evidence: FitEvidence) -> str:
    """Describe the misfit of a region: change over a hold, or largest deviation, and its significance."""
    place = f"{region.test} {region.segment}"
    if region.adequate:
        return f"{place} agrees"
    sigma, stressed = convert_region_p_value_to_deviations(region), curves[0][0].stressed
    what, unit, factor = ("stress", "kPa", 1e-3) if stressed else ("force", "N", 1.0)
    at = f"strain {region.at:.3g}" if stressed else f"{region.at:.3g} mm"
    if curves[0][0].test.modulus:
        what, unit, factor, at = curves[0][0].test.modulus, "%", 100.0, f"{region.at:.3g} Hz"
    if region.segment.startswith("hold"):
        measured, error = _compute_mean_hold_change_and_error(region, curves, evidence, "data")
        modelled, _ = _compute_mean_hold_change_and_error(region, curves, evidence, "model")
        if abs(measured - modelled) > evidence.limits.hold_change * error:
            goes, sign = ("falls", -1) if measured < 0 else ("rises", 1)
            predicted = f"{sign * factor * modelled:.2g} {unit}" if abs(modelled) > 0.1 * error else "nothing"
            return (f"{place}: the {what} {goes} by {factor * abs(measured):.2g} {unit}, the model's by {predicted} "
                    f"({sigma:.0f} sigma)")
    side = "above" if region.largest_N < 0 else "below"
    return (f"{place}: the {what} is up to {factor * abs(region.largest_N):.2g} {unit} {side} the model, at {at} "
            f"({sigma:.0f} sigma)")


def _compute_mean_hold_change_and_error(region: RegionMisfitTest, curves: Sequence[tuple[MeasuredCurve, slice]],
                                        evidence: FitEvidence, of: str) -> tuple[float, float]:
    """Return the mean change of the force over a hold, N, and its standard error, N.

    Args:
        region: the hold.
        curves: recordings with their rows in the problem.
        evidence: fit.
        of: ``"data"`` or ``"model"``.
    """
    force = evidence.problem.data if of == "data" else evidence.evaluation.force
    changes, errors = [], []
    for curve, rows in curves:
        inside = force[rows][_make_segment_or_full_mask(curve, region.segment)]
        end = max(int(_END_FRACTION * inside.size), 1)
        changes.append(inside[-end:].mean() - inside[:end].mean())
        errors.append(curve.noise.deviation * np.sqrt(2.0 / end))
    return float(np.mean(changes)), float(np.mean(errors) / np.sqrt(len(errors)))
