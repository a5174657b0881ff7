"""Job that diagnoses one campaign: it finds the effects that a plain model misses in its recordings.

The effects found are written to files that other commands read. The duration is estimated from one simulation of each
test.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign, Test, load_campaign
from calibration.campaign.measured import MeasuredCurve, make_campaign_with_scaled_offset_defaults, read_measured_curves
from calibration.campaign.schema import replace_mesh_profile_and_rig_paths, resolve_path_to_text
from calibration.diagnosis.confirmation import (
    compare_segment_misfits,
    compute_smooth_misfit_rms_newton,
    predict_held_out_tests_from_fits,
    predict_last_recordings_from_others,
)
from calibration.diagnosis.design import suggest_experiments
from calibration.diagnosis.diagnosis import Diagnosis, DiagnosisResult, DiagnosisStage, FoundEffect, summarise_diagnosis
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
from calibration.fit.estimator import build_fit_record
from calibration.fit.fit import Fit
from calibration.fit.generalised import GeneralisedLeastSquaresEstimator, list_starts_with_varied_exponents
from calibration.fit.problem import GeneralisedProblem
from calibration.fit.result import CalibrationResult, make_material_file_of_fit
from calibration.fit.run_context import RunContext
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.meshes import get_solver_fit_resolutions
from calibration.forward.simulated import SimulatedTest
from calibration.forward.simulation_cache import SimulationCache, simulate_force_or_record_failure
from calibration.job import Job
from calibration.output_folder import (
    DIAGNOSIS_FILE,
    TABLES_OF_DIAGNOSIS,
    list_possible_diagnosis_result_paths,
    list_test_figure_file_names,
)
from calibration.report.outputs import require_usable_sections, write_diagnosis_and_get_result
from tissue_sim.decode import format_toml, read_toml_dict
from tissue_sim.errors import InputError
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.files import write_text
from tissue_sim.laws import LAWS
from tissue_sim.material.file import MaterialFile, write_material_file
from tissue_sim.model import Model
from tissue_sim.parameters import convert_to_file_values, with_values
from tissue_sim.rig.file import write_rig
from tissue_sim.rig.rig import Rig
from tissue_sim.settings import get_changed_settings_by_name


@dataclass(frozen=True)
class DiagnosisDurationSettings:
    """Range of the duration of a diagnosis, in simulations of each test.

    Attributes:
        min_simulations: simulations of a short diagnosis: no effect is missing (docs/inverse_calibration.md).
        max_simulations: simulations of a long diagnosis: friction of plates, whose simulations take longest, is among
            the fitted effects.
        min_announced: duration from which the duration is announced, s.
    """

    min_simulations: float = 40.0
    max_simulations: float = 300.0
    min_announced: float = 60.0


SETTINGS = DiagnosisDurationSettings()


def measure_solid_simulation_cpu_s_by_test(problem: GeneralisedProblem) -> dict[str, float]:
    """Measure the processor time of a simulation of each three-dimensional test, without derivatives.

    Tests with fast solvers and failed simulations are omitted.

    Args:
        problem: problem whose first start has been simulated, so that its kernels are compiled.

    Returns:
        Name of the test -> processor time, s.
    """
    found = {}
    for test in problem.tests:
        if isinstance(test, SimulatedTest) and get_solver_fit_resolutions(test.solver).slow:
            experiment = replace(test.experiment, protocol=test.motions[0].tool_protocol)
            try:
                values = problem.space.get_values_by_name(list_starts_with_varied_exponents(problem.space, 1)[0])
                material = problem.space.build_material(values, test=test.name)
                curve = simulate_force_or_record_failure(Model(experiment, material, Rig()), None, [],
                                                         get_solver_fit_resolutions(test.solver).fast, test.solver)
            except InputError:
                continue
            if not curve.problem:
                found[test.name] = curve.cpu_s
    return found


def describe_expected_duration_or_empty(seconds: Mapping[str, float]) -> str:
    """Describe the expected duration and ways to shorten it; empty for a short diagnosis.

    Args:
        seconds: name of the test -> processor time of a simulation, s, from `measure_solid_simulation_cpu_s_by_test`.
    """
    each = sum(seconds.values())
    if SETTINGS.max_simulations * each < SETTINGS.min_announced:
        return ""
    low, high = math.floor(SETTINGS.min_simulations * each / 60.0), math.ceil(SETTINGS.max_simulations * each / 60.0)
    minutes = f"{low} to {high} minutes" if low else f"up to {high} minute{'s' if high > 1 else ''}"
    return (f"expect {minutes} on one processor: a simulation of {'its tests' if len(seconds) > 1 else 'its test'} in "
            f"space takes {each:.2g} s; --workers N shares them between N processes, a smaller max_strain shortens "
            "each, and an interrupted run resumes")


#: Name of the campaign file that includes the effects found.
CAMPAIGN_FILE = "diagnosed.toml"


def list_all_possible_diagnosis_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of all files that the diagnosis of a campaign may write.

    Material files of all laws are included, because an effect may require a more general law than the campaign states.
    """
    return [*list_possible_diagnosis_result_paths(campaign, folder),
            *(folder / f"{law}.material.json" for law in sorted(LAWS)), folder / CAMPAIGN_FILE,
            folder / "rig.rig.json",
            *(folder / _make_rig_file_name_of_test_number(number) for number in range(len(campaign.tests)))]


def write_effect_files_and_get_diagnosis(diagnosis: Diagnosis, after: FitEvidence | None, folder: Path) -> Diagnosis:
    """Write a material file, rig files and a campaign file that include the effects found.

    Files of an earlier calibration in the folder stay unchanged.

    Args:
        diagnosis: the result of the diagnosis.
        after: the fit with the effects found; None if no effect was found, in which case no file is written.
        folder: folder of the results.

    Returns:
        The diagnosis with the names of the written files in `files` and in each effect's `written_to`.
    """
    if after is None or diagnosis.fit_after is None:
        return diagnosis
    files = {}
    name = f"{after.law_name}.material.json"
    write_material_file(_make_material_file_with_effects(diagnosis, after, folder), folder / name)
    files["material"] = name
    rigs = {test.name: _copy_rig_with_fitted_values(after, test) for test in after.diagnosis_data.tests
            if test.experiment is not None}
    if any(effect.category == "rig" for effect in diagnosis.effects):
        if len({json.dumps(convert_to_file_values(rig), sort_keys=True) for rig in rigs.values()}) == 1:
            write_rig(next(iter(rigs.values())), folder / "rig.rig.json")
            files["rig"] = "rig.rig.json"
        else:
            for number, test in enumerate(after.campaign.tests):
                if test.name in rigs:
                    write_rig(rigs[test.name], folder / _make_rig_file_name_of_test_number(number))
                    files[f"rig of {test.name}"] = _make_rig_file_name_of_test_number(number)
    write_text(folder / CAMPAIGN_FILE, _format_campaign_with_found_effects(diagnosis, after))
    files["campaign"] = CAMPAIGN_FILE
    file_of = {"tissue": name, "rig": files.get("rig", "rig files of the tests"), "population": name}
    effects = [msgspec.structs.replace(effect, written_to=(
        CAMPAIGN_FILE if _is_effect_of_single_tests(effect) and effect.category == "tissue"
        else file_of.get(effect.category, CAMPAIGN_FILE))) for effect in diagnosis.effects]
    return msgspec.structs.replace(diagnosis, effects=effects, files=files)


def _is_effect_of_single_tests(effect: FoundEffect) -> bool:
    """Return whether an effect acts only in the tests that it names, and not in all tests."""
    return bool(effect.tests)


def _make_rig_file_name_of_test_number(number: int) -> str:
    """Return the name of the rig file of a test; `number` is the index of the test from 0."""
    return f"test_{number + 1}.rig.json"


def _make_material_file_with_effects(diagnosis: Diagnosis, after: FitEvidence, folder: Path) -> MaterialFile:
    """Return the material file of the fitted law and tissue effects, with the diagnosis in its provenance."""
    fit = diagnosis.fit_after
    assert fit is not None
    # An effect of a single test or session is not a property of the tissue: the material file has it switched off.
    switched_off = {number.path: number.absent for effect in diagnosis.effects if _is_effect_of_single_tests(effect)
                    for number in effect.parameters if number.absent is not None}
    fit = msgspec.structs.replace(fit, parameters={**fit.parameters, **switched_off})
    result = CalibrationResult(after.campaign, (fit,), (), diagnosis.message, folder, "", None, "estimated")
    file = make_material_file_of_fit(fit, result, after.measured, "inverse FEM with a diagnosed effect")
    added = [{"name": effect.name, "room": effect.category, "tests": effect.tests,
              "parameters": {number.path: number.value for number in effect.parameters}}
             for effect in diagnosis.effects]
    provenance = file.provenance
    assert provenance is not None
    settings = {**(provenance.settings or {}), "diagnosis": {
        "campaign": diagnosis.campaign, "verdict": diagnosis.verdict, "effects": added}}
    return msgspec.structs.replace(file, provenance=msgspec.structs.replace(provenance, settings=settings))


def _copy_rig_with_fitted_values(after: FitEvidence, test: Test) -> Rig:
    """Return a copy of the rig of a test with the fitted values of its parameters."""
    space = after.problem.space
    values = {each.path.removeprefix("rig."): after.parameter_values[each.name] for each in space.unknowns
              if each.path.startswith("rig.") and each.applies_to_recording(test.name, None) and each.recording is None}
    return with_values(test.rig, values) if values else test.rig


def _format_campaign_with_found_effects(diagnosis: Diagnosis, after: FitEvidence) -> str:
    """Return the text of a campaign (TOML) in which the effects found are additional unknowns with start values."""
    campaign = after.campaign
    folder = campaign.path.parent.resolve()
    content = replace_mesh_profile_and_rig_paths(read_toml_dict(campaign.path, "a campaign (TOML)"), folder,
                                                 resolve_path_to_text)
    for table in (content.get("defaults", {}), *content["test"]):
        if "recordings" in table:
            table["recordings"] = [str(folder / name) for name in table["recordings"]]
    # A table with several loads or moduli gives several tests, which have the same experiment.
    first_tests = {test.place: test for test in reversed(campaign.tests)}
    for number, table in enumerate(content["test"]):
        test = first_tests[f"test[{number}]"]
        if test.experiment is not None and test.experiment.contact_laws:
            table["contact_laws"] = {name: convert_to_file_values(law) for name,
                                     law in test.experiment.contact_laws.items()}
        if test.experiment is not None and test.experiment.friction_base == AS_TOOL:
            # Friction of both plates was added: the test is no longer a lubricated compression.
            friction = next(each for each in after.problem.space.unknowns
                            if each.path == "experiment.friction" and each.applies_to_recording(test.name, None))
            table |= {"kind": "friction_compression", "friction": after.parameter_values[friction.name],
                      "friction_base": AS_TOOL}
    densities = {test.experiment.specimen.name: test.experiment.specimen.density for test in campaign.tests
                 if test.experiment is not None}
    for table in content.get("specimen", []):
        density = densities.get(table.get("name", "specimen"))
        if density is not None:
            table["density_kg_m3"] = density
    fit, settings = content["fit"], campaign.fit
    fit["laws"] = [after.law_name]
    start: dict[str, dict[str, Any]] = {"start": {}, "fixed": {}, "bounds": {}, "scope": {}}
    for path, named in settings.named.items():
        factor = named.declaration.factor
        if path in settings.bounds:
            (low, high), (least, most) = settings.bounds[path], named.declaration.bounds
            start["bounds"][path] = [max(low, least) / factor, min(high, most) / factor]
        if named.scope != "shared":
            start["scope"][path] = list(named.scope) if isinstance(named.scope, tuple) else named.scope
    for each in after.problem.space.unknowns:
        kind = "fixed" if each.name in after.problem.space.fixed else "start"
        start[kind].setdefault(each.path, after.parameter_values[each.name] / each.declaration.factor)
    fit.update({key: table for key, table in start.items() if table})
    words = "; ".join(effect.title for effect in diagnosis.effects)
    return f"# {campaign.path.name} with the effects that a diagnosis found: {words}.\n{format_toml(content)}"


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
            stressed=all(curve.stressed for curve in before.problem.measured),
            has_moduli=any(curve.test.modulus for curve in before.problem.measured), limits=limits),
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
