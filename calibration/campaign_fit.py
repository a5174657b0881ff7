"""Job that fits one campaign and writes its results, with the analytical or the inverse finite element method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import (
    MeasuredCurve,
    compute_input_and_version_digest,
    make_campaign_with_scaled_offset_defaults,
)
from calibration.campaign.sample_selection import format_notes_summary_by_test_and_subject
from calibration.fit.curves import compute_test_curves
from calibration.fit.estimate import Estimate
from calibration.fit.estimator import Estimator, LawFailureRecord, build_fit_record, call_and_catch_law_errors
from calibration.fit.fit import SensorNoiseRecord
from calibration.fit.generalised import GeneralisedLeastSquaresEstimator
from calibration.fit.ordinary import OrdinaryLeastSquaresEstimator
from calibration.fit.population import PredictionParameters, make_held_out_predictor_or_none
from calibration.fit.ranking import (
    Fitted,
    LeftOutPredictionWithCost,
    explain_ranking,
    predict_held_out_test,
    predict_left_out_test,
    rank_fits_predictions_and_curves,
)
from calibration.fit.replicates import find_replicate_disagreements
from calibration.fit.result import CalibrationResult, decode_calibration_result, write_material_files
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import DescentResult
from calibration.fit.uncertainty import ProfileSide, add_influence_to_fit, compute_profile_side
from calibration.fit.usability import USABILITY, UsabilitySettings, copy_notes_with_explained_preload
from calibration.forward.forms import check_solvers_accept_test_geometries
from calibration.job import Job
from calibration.output_folder import (
    FIT_FILE,
    TABLES,
    list_possible_calibration_file_paths,
    list_test_figure_file_names,
)
from calibration.report.outputs import (
    require_usable_sections,
    write_calibration_files,
    write_failure_report,
    write_summary_table,
)
from calibration.statistics.uncertainty import ParameterUncertainty
from tissue_sim.errors import ConvergenceError
from tissue_sim.settings import get_changed_settings_by_name

#: Method of a campaign -> estimator.
ESTIMATORS: dict[str, type[Estimator]] = {"analytical": OrdinaryLeastSquaresEstimator,
                                          "inverse_fem": GeneralisedLeastSquaresEstimator}


class CampaignFit(Job):
    """Fit all laws of one campaign and write the results to a folder.

    Args:
        campaign: the campaign.
        measured: recordings of each test, see `read_measured_curves`.
        folder: folder of the results.
        context: task executor and progress reports.
        limits: limits of the usability rule; None: the defaults.
        figures: whether the report includes figures.
        figures_format: format of separate figure files; None: no figure files.

    Attributes:
        estimator: estimator of the method.
    """

    kind = "fit"
    result_file = FIT_FILE

    def __init__(self, campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]], folder: Path,
                 context: RunContext, *, limits: UsabilitySettings | None = None, figures: bool = True,
                 figures_format: str | None = None):
        super().__init__(make_campaign_with_scaled_offset_defaults(campaign, measured), measured, folder, context)
        self.limits, self.figures, self.figures_format = limits or USABILITY, figures, figures_format
        self.settings = get_changed_settings_by_name(self.limits)
        self.estimator: Estimator = ESTIMATORS[campaign.fit.method](self.campaign, measured, self.solves)
        self.stores_simulations = self.estimator.explores
        #: Law -> number of simulations in the check of its start values.
        self.checked: dict[str, int] = {}

    @cached_property
    def digest(self) -> str:
        """Digest of campaign, recordings, settings and version of the program."""
        return compute_input_and_version_digest(self.campaign, self.recordings, self.settings)

    def list_possible_files(self) -> list[Path]:
        """Return the paths of material files, report, tables, figures and ``fit.json``."""
        return list_possible_calibration_file_paths(self.campaign, self.folder)

    def decode_result(self, found: Mapping[str, Any]) -> tuple[CalibrationResult, Sequence[str]]:
        """Convert the content of ``fit.json``; see `Job.decode_result`."""
        result = decode_calibration_result(found, self.campaign, self.folder)
        materials = [fit.material_file for fit in result.fits if fit.material_file is not None]
        return result, [*TABLES, *materials, *list_test_figure_file_names(self.campaign, self.figures_format)]

    @classmethod
    def write_summary(cls, results: Sequence[CalibrationResult], path: Path) -> None:
        """Write the table of all laws of all campaigns."""
        write_summary_table(results, path)

    def check_before_writing(self) -> None:
        """Check the sections of the report, and each law at its start values; see `Job.check_before_writing`."""
        require_usable_sections()
        if self.estimator.explores:
            check_solvers_accept_test_geometries(self.campaign)
        for number, law in enumerate(self.campaign.fit.laws):
            if self.estimator.explores:
                self.context.report_progress(f"checking the start values of {law}")
            before = self.solves.counts.total()
            self.estimator.require_fittable_law(law, number)
            self.checked[law] = self.solves.counts.total() - before

    def run(self) -> CalibrationResult:
        """Fit all laws and write all results; ``fit.json`` is last and marks the campaign as finished.

        Raises:
            ConvergenceError: no law could be fitted.
        """
        disagreements = self._announce_and_describe_disagreements()
        found, failures = self._compute_results_and_failures_of_laws()
        if not found:
            write_failure_report(self.campaign, failures, self.folder)
            raise ConvergenceError(f"{self.campaign.path}: no start of any law converges "
                                   f"({next(iter(failures.values()), '')}); state other values in fit.start, or use a "
                                   "smaller max_strain")
        fits, predictions, curves = rank_fits_predictions_and_curves(found)
        fitted = [curve for test in self.campaign.tests if not test.hold_out for curve in self.measured[test.name]]
        message = explain_ranking(fits, predictions, fitted)
        for disagreement in disagreements:
            message = message if disagreement in message else f"{disagreement}. {message}"
        for law, failure in failures.items():
            message += f" {law} has no fit: {failure}."
        message_before_notes = message
        # A material with memory describes relaxation and creep, so these need no note.
        left_out = {"control"} if self.campaign.fit.placeholder_material_with_effects.is_history_dependent else set()
        message += format_notes_summary_by_test_and_subject((curve.test.name, curve.name, {
            subject: note for subject, note in copy_notes_with_explained_preload(curve, fits[0]).items()
            if note not in message_before_notes and subject not in left_out})
            for curve in self.recordings)
        noises = {name: several[0].noise for name, several in self.measured.items()}
        noise = tuple(SensorNoiseRecord(test=name, deviation_N=one.deviation,
                                        correlation_time_s=one.correlation_time,
                                        source=one.source) for name, one in noises.items())
        sources = {curve.noise.source for curve in fitted}
        result = CalibrationResult(
            self.campaign, tuple(fits), tuple(predictions), message, self.folder, self.digest,
            self.estimator.pooled_sensor_stress_noise_or_none, sources.pop() if len(sources) == 1 else "mixed",
            noise if self.estimator.explores else (), failures=failures,
            usability_settings=self.settings)
        if self.estimator.explores:
            self.context.report_progress("writing the report")
        write_material_files(result, self.measured, self.estimator.words)
        write_calibration_files(result, curves, self.measured, figures=self.figures,
                                figures_format=self.figures_format)
        return result

    def _compute_results_and_failures_of_laws(self) -> tuple[list[Fitted], dict[str, str]]:
        """Return (fit, predictions, curves) of each fitted law, and law -> reason of failure of the other laws."""
        laws = self.campaign.fit.laws
        ends = self.estimator.fit_laws(laws, self.context)
        estimates = {law: estimate for law, (_, estimate) in ends.items() if isinstance(estimate, Estimate)}
        failures = {law: estimate for law, (_, estimate) in ends.items() if not isinstance(estimate, Estimate)}
        spreads: dict[str, ParameterUncertainty] = {}
        for law, estimate in list(estimates.items()):
            spread = call_and_catch_law_errors(_compute_estimate_uncertainty, self.estimator, estimate)
            if isinstance(spread, LawFailureRecord):
                failures[law] = spread.reason
                del estimates[law]
            else:
                spreads[law] = spread
        sides_of, left_of = self._compute_profiles_and_left_out_of_all_laws(estimates, spreads)
        answers: list[Fitted] = []
        for law, estimate in estimates.items():
            if self.estimator.explores:
                self.context.report_progress(f"uncertainty and predictions of {law}")
            answer = call_and_catch_law_errors(self._compute_results_of_one_law, estimate, spreads[law], ends[law][0],
                                               sides_of[law], left_of[law])
            if isinstance(answer, LawFailureRecord):
                failures[law] = answer.reason
            else:
                answers.append(answer)
        return answers, failures

    def _compute_results_of_one_law(self, estimate: Estimate, spread: ParameterUncertainty,
                                    descents: Sequence[DescentResult],
                                    sides: Sequence[ProfileSide], left: Sequence[LeftOutPredictionWithCost]) -> Fitted:
        """Return the `Fit` record, the predictions of other tests, and the curves of one law."""
        campaign, law = self.campaign, estimate.problem.space.law
        spent = self.solves.make_effort_since_now_function()
        fit = build_fit_record(self.estimator, estimate, spread, descents, sides, campaign, self.limits)
        fit = add_influence_to_fit(fit, estimate.problem, estimate.evaluation)
        fitted = zip(estimate.problem.tests, estimate.problem.mesh_error, strict=True)
        own = PredictionParameters.from_minimum_and_uncertainty(estimate.problem.space, estimate.theta, spread)
        predictors = {test.name: make_held_out_predictor_or_none(test, own, fit.population)
                      for test in campaign.tests if test.hold_out}
        tests = [self.estimator.build_held_out_test_and_mesh_error(test, estimate, predictors[test.name] or own)
                 if test.hold_out else next(fitted) for test in campaign.tests]
        scatter = self.estimator.get_replicate_jitter_or_none(estimate)
        held_out = [predict_held_out_test(estimate.problem, test, predictors[test.name], scatter)
                    for test, _ in tests if test.name in predictors]
        curves = compute_test_curves(estimate, spread, tests, scatter, {name: predictor for name, predictor
                                                                        in predictors.items() if predictor is not None})
        parts: list[Any] = [*descents, estimate, *sides, *left]
        costs = [spent(), *((part.simulations, part.cpu_s) for part in parts)]
        best = min(descents, key=lambda end: end.error)
        fit = replace(fit, fem_solves=sum(sum(done.values()) for done, _ in costs) + self.checked.get(law, 0),
                      cpu_s=sum(seconds for _, seconds in costs),
                      estimate_cpu_s=best.cpu_s + estimate.cpu_s if self.estimator.explores else 0.0)
        return fit, [*(one.prediction for one in left), *held_out], curves

    def _compute_profiles_and_left_out_of_all_laws(self, estimates: dict[str, Estimate],
                                                   spreads: dict[str, ParameterUncertainty]
                                                   ) -> tuple[dict[str, list[ProfileSide]],
                                                              dict[str, list[LeftOutPredictionWithCost]]]:
        """Compute the profiles of all parameters with a standard error, and the fits with one test left out.

        Returns:
            The sides of the profiles by law, and the left-out results by law.
        """
        sides_of: dict[str, list[ProfileSide]] = {law: [] for law in estimates}
        left_of: dict[str, list[LeftOutPredictionWithCost]] = {law: [] for law in estimates}
        sides, left = [], []
        for law, estimate in estimates.items():
            known = [i for i, error in enumerate(spreads[law].standard_errors) if np.isfinite(error) and error > 0
                     and self.estimator.explores]
            sides += [(law, (estimate.problem, estimate.theta, estimate.error, spreads[law], i, side)) for i in known
                      for side in (-1, 1)]
            if len(estimate.problem.tests) > 1:
                left += [(law, (estimate.problem, estimate.theta, number, self.estimator.problem_uncertainty_function,
                                self.estimator.get_replicate_jitter_or_none(estimate)))
                         for number in range(len(estimate.problem.tests))]
        for function, tasks, words, found in ((compute_profile_side, sides, "profiles", sides_of),
                                              (predict_left_out_test, left, "tests left out, one at a time", left_of)):
            answers = self.context.run_task_for_all(partial(call_and_catch_law_errors, function),
                                                  [arguments for _, arguments in tasks], words) if tasks else []
            for (law, _), answer in zip(tasks, answers, strict=True):
                # A failed profile or left-out test does not invalidate the fit.
                if not isinstance(answer, LawFailureRecord):
                    found[law].append(answer)
        return sides_of, left_of

    def _announce_and_describe_disagreements(self) -> list[str]:
        """Return a sentence for each test whose recordings disagree, and send each sentence as a progress message."""
        found = [each.describe() for each in find_replicate_disagreements(self.measured)]
        for sentence in found:
            self.context.report_progress(sentence)
        return found


def _compute_estimate_uncertainty(estimator: Estimator, estimate: Estimate) -> ParameterUncertainty:
    """Return the uncertainty (covariance, standard errors) of the unknowns at the estimate."""
    return estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
