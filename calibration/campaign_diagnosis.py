"""Job that diagnoses one campaign: it finds the effects that a plain model misses in its recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign, load_campaign
from calibration.campaign.measured import MeasuredCurve, make_campaign_with_scaled_offset_defaults, read_measured_curves
from calibration.diagnosis.confirmation import (
    compare_segment_misfits,
    compute_smooth_misfit_rms_newton,
    predict_held_out_tests_from_fits,
    predict_last_recordings_from_others,
)
from calibration.diagnosis.design import suggest_experiments
from calibration.diagnosis.diagnosis import Diagnosis, DiagnosisResult, DiagnosisStage, summarise_diagnosis
from calibration.diagnosis.duration import describe_expected_duration_or_empty, measure_solid_simulation_cpu_s_by_test
from calibration.diagnosis.effect_files import (
    list_all_possible_diagnosis_paths,
    write_effect_files_and_get_diagnosis,
)
from calibration.diagnosis.evidence import (
    FitEvidence,
    Measured,
    fit_without_effects,
    make_one_law_whole_recording_campaign,
    refit_from_far_contacts_and_describe_them,
)
from calibration.diagnosis.proposals import CatalogueScores, score_effects
from calibration.diagnosis.settings import LIMITS, REFITS, DecisionLimits, RefitSettings
from calibration.diagnosis.verdict import fit_effects_and_decide_verdict, list_candidate_results, list_found_effects
from calibration.fit.assess import build_fit_record
from calibration.fit.fit import Fit
from calibration.fit.generalised import GeneralisedLeastSquaresEstimator
from calibration.fit.run_context import RunContext
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.simulation_cache import SimulationCache
from calibration.job import Job
from calibration.output_folder import DIAGNOSIS_FILE, TABLES_OF_DIAGNOSIS, list_test_figure_file_names
from calibration.report.outputs import write_diagnosis_and_get_result
from calibration.report.page import require_usable_sections
from tissue_sim.settings import get_changed_settings_by_name


@dataclass(frozen=True, eq=False)
class DiagnosisWithFits:
    """A diagnosis with the fits and scores on which it is based.

    Attributes:
        diagnosis: the result.
        before: the fit without additional effects.
        after: the fit with the effects found; None if no effect was found.
        proposals: scores of all effects of the catalogue.
    """

    diagnosis: Diagnosis
    before: FitEvidence
    after: FitEvidence | None
    proposals: CatalogueScores


@dataclass
class _StageClock:
    """Measure the time and the simulations of each stage.

    Attributes:
        solves: store of simulations, which counts them.
        stages: finished stages.
    """

    solves: SimulationCache
    stages: list[DiagnosisStage] = field(default_factory=list)

    @contextmanager
    def measure_stage(self, name: str) -> Iterator[None]:
        """Append duration and number of simulations of the block to `stages`."""
        began, before = time.monotonic(), self._count_simulations_of_all_processes()
        yield
        self.stages.append(DiagnosisStage(name=name, wall_s=time.monotonic() - began,
                                          simulations=self._count_simulations_of_all_processes() - before))

    def _count_simulations_of_all_processes(self) -> int:
        """Return the number of simulations that all processes have finished so far."""
        # Worker processes have separate counters; the folder contains the simulations of all processes.
        folder = self.solves.folder
        return self.solves.counts.total() if folder is None else sum(1 for _ in folder.glob("*.msgpack"))


def diagnose_campaign(campaign: Campaign, measured: Measured, steps: RunContext,
                      solves: SimulationCache | None = None, limits: DecisionLimits = LIMITS,
                      refit_settings: RefitSettings = REFITS) -> DiagnosisWithFits:
    """Diagnose a campaign without writing files.

    Args:
        campaign: campaign with one law, see `calibration.diagnosis.evidence.make_one_law_whole_recording_campaign`.
        measured: all recordings of each test, see `read_measured_curves`.
        steps: task executor and progress reports.
        solves: store of finished simulations; None: an empty store.
        limits: decision limits.
        refit_settings: settings of the fits with an effect.

    Raises:
        ConvergenceError: no start converges.
    """
    solves = solves or SimulationCache()
    campaign = make_campaign_with_scaled_offset_defaults(campaign, measured)
    clock = _StageClock(solves)
    with clock.measure_stage("fit without any effect"):
        plain = fit_without_effects(campaign, measured, solves, steps, limits, refit_settings)
        before, offsets = refit_from_far_contacts_and_describe_them(plain, steps)
    with clock.measure_stage("scores of the catalogue"):
        proposals = score_effects(before, steps)
    with clock.measure_stage("fits with the likeliest"):
        judgement = fit_effects_and_decide_verdict(before, proposals, steps)
    after: FitEvidence | None = None
    with clock.measure_stage("last fit and unseen data"):
        steps.report_progress("final fit and prediction of data that were not fitted")
        if judgement.added:
            after = judgement.evidence
        held_out = [*predict_last_recordings_from_others(before, after),
                    *predict_held_out_tests_from_fits(before, after)]
        fit_before = _convert_evidence_to_fit_record(before)
        fit_after = None if after is None else _convert_evidence_to_fit_record(after)
        candidates = list_candidate_results(proposals, judgement, before)
        effects = [] if after is None else list_found_effects(judgement, before, after)
        regions = compare_segment_misfits(before, after)
    with clock.measure_stage("the next experiment"):
        steps.report_progress("choosing the next experiment")
        further = suggest_experiments(before, proposals, judgement)
    gaps = compute_smooth_misfit_rms_newton(before), None if after is None else compute_smooth_misfit_rms_newton(after)
    noises = [curve.noise for curve in before.problem.measured]
    noise = float(np.sqrt(np.mean([one.deviation**2 for one in noises])))
    titles = {row.name: row.title for row in candidates}
    jitter = (after or before).problem.jitter
    diagnosis = Diagnosis(
        campaign=campaign.name, law=campaign.fit.laws[0], verdict=judgement.verdict,
        message=summarise_diagnosis(
            judgement.verdict, effects, [titles.get(name, name) for name in judgement.indistinguishable], regions,
            (*gaps, noise), sum(not row.testable for row in candidates), held_out,
            next((row for row in candidates if row.explained_percent is not None), None),
            before.common_signal_descriptions, offsets, list(proposals.significant_candidate_descriptions),
            stressed=all(curve.stressed for curve in before.problem.measured), limits=limits),
        effects=effects, indistinguishable=judgement.indistinguishable, candidates=candidates, regions=regions,
        gap_before_N=gaps[0], gap_after_N=gaps[1], noise_N=noise,
        noise_correlation_s=float(np.mean([one.correlation_time for one in noises])),
        contact_jitter_mm=1e3 * jitter.contact, zero_jitter_N=jitter.zero,
        mesh_percent=100.0 * max(before.problem.mesh_error, default=0.0), held_out=held_out,
        next_experiment=further, fit_before=fit_before, fit_after=fit_after, stages=clock.stages,
        decision_limits=get_changed_settings_by_name(limits),
        refit_settings=get_changed_settings_by_name(refit_settings))
    return DiagnosisWithFits(diagnosis, before, after, proposals)


def _convert_evidence_to_fit_record(evidence: FitEvidence) -> Fit:
    """Return the `Fit` record of the estimate of the evidence, without profile likelihoods."""
    estimate = evidence.estimate
    estimator = GeneralisedLeastSquaresEstimator(evidence.campaign, evidence.measured, evidence.problem.solves)
    spread = compute_marginal_uncertainty(evidence.problem, evidence.evaluation)
    return build_fit_record(estimator, estimate, spread, [estimate], [], evidence.campaign)


def read_campaign_and_curves_for_diagnosis(path: str | Path, law: str | None = None
                                           ) -> tuple[Campaign, dict[str, tuple[MeasuredCurve, ...]]]:
    """Read a campaign with one law and its recordings, including holds and unloading.

    Args:
        path: campaign file.
        law: one of its laws; None: its first.

    Returns:
        The campaign and the recordings of each test.

    Raises:
        InputError: the campaign or a recording is invalid, the campaign is analytical, or it does not list the law.
    """
    campaign = make_one_law_whole_recording_campaign(load_campaign(path), law)
    return campaign, read_measured_curves(campaign)


class CampaignDiagnosis(Job):
    """Diagnose one campaign and write the results to a folder.

    Args:
        campaign: campaign with one law, see `read_campaign_and_curves_for_diagnosis`.
        measured: recordings of each test, see `read_campaign_and_curves_for_diagnosis`.
        folder: folder of the results.
        context: task executor and progress reports.
        limits: decision limits; None: the defaults.
        refit_settings: settings of the fits with an effect; None: the defaults.
        figures: whether the report includes figures.
        figures_format: format of separate figure files; None: no figure files.
    """

    kind = "diagnosis"
    result_file = DIAGNOSIS_FILE

    def __init__(self, campaign: Campaign, measured: Measured, folder: Path, context: RunContext,
                 *, limits: DecisionLimits | None = None, refit_settings: RefitSettings | None = None,
                 figures: bool = True, figures_format: str | None = None):
        super().__init__(campaign, measured, folder, context)
        self.limits, self.refit_settings = limits or LIMITS, refit_settings or REFITS
        self.figures, self.figures_format = figures, figures_format
        self.settings = get_changed_settings_by_name(self.limits) | {
            f"refit_settings.{name}": value
            for name, value in get_changed_settings_by_name(self.refit_settings).items()}
        self._clock = _StageClock(self.solves)

    def list_possible_files(self) -> list[Path]:
        """Return the paths of report, tables, figures, files with the effects and ``diagnosis.json``."""
        return list_all_possible_diagnosis_paths(self.campaign, self.folder)

    def decode_result(self, found: Mapping[str, Any]) -> tuple[DiagnosisResult, Sequence[str]]:
        """Convert the content of ``diagnosis.json``; see `Job.decode_result`."""
        diagnosis = msgspec.convert(found, Diagnosis)
        return DiagnosisResult(self.campaign, diagnosis, self.folder, self.digest, resumed=True), [
            *TABLES_OF_DIAGNOSIS, *diagnosis.files.values(),
            *list_test_figure_file_names(self.campaign, self.figures_format, held_out=False)]

    def check_before_writing(self) -> None:
        """Check the sections of the report and the law at its start values, and announce a long duration.

        See `Job.check_before_writing`.
        """
        require_usable_sections()
        self.context.report_progress("checking the start values")
        campaign = make_campaign_with_scaled_offset_defaults(self.campaign, self.measured)
        with self._clock.measure_stage("check of the start values"):
            estimator, law = GeneralisedLeastSquaresEstimator(campaign, self.measured,
                                                              self.solves), campaign.fit.laws[0]
            estimator.require_fittable_law(law, 0)
            if self.context.announce is not None and (
                    words := describe_expected_duration_or_empty(
                        measure_solid_simulation_cpu_s_by_test(estimator.build_law_problem(law)))):
                self.context.announce(f"{campaign.name}: {words}")

    def run(self) -> DiagnosisResult:
        """Diagnose the campaign and write all results; ``diagnosis.json`` is last and marks the campaign as finished.

        Raises:
            ConvergenceError: no start converges.
        """
        found = diagnose_campaign(self.campaign, self.measured, self.context, self.solves, self.limits,
                                  self.refit_settings)
        self.context.report_progress("writing the report")
        timed = msgspec.structs.replace(found.diagnosis, stages=[*self._clock.stages, *found.diagnosis.stages])
        diagnosis = write_effect_files_and_get_diagnosis(timed, found.after, self.folder)
        return write_diagnosis_and_get_result(DiagnosisResult(self.campaign, diagnosis, self.folder, self.digest),
                                              found.before, found.after, found.proposals.effects, self.measured,
                                              figures=self.figures, figures_format=self.figures_format)
