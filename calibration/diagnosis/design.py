"""Design of experiments: detectable size of each effect, indistinguishable effects, and expected standard errors.

After a diagnosis, further experiments are suggested that separate the remaining explanations of a misfit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve, make_campaign_with_scaled_offset_defaults
from calibration.campaign.planned import create_planned_curves_with_placeholder_force, replace_forces_of_curves
from calibration.diagnosis.diagnosis import CandidateResult, NextExperiment
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import CatalogueScores, score_effects
from calibration.diagnosis.refits import EffectRefit
from calibration.diagnosis.verdict import VerdictWithFits, list_candidate_results
from calibration.effects.effect import Candidate
from calibration.fit.estimate import Estimate, make_test_with_mesh_correction
from calibration.fit.identifiability import find_undetermined_parameters
from calibration.fit.problem import GeneralisedProblem, build_generalised_problem, make_stated_or_guessed_jitter
from calibration.fit.run_context import RunContext
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import build_forward_test_of_inverse_fit, compute_mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.parameters import list_field_declarations, with_values


@dataclass(frozen=True)
class PlannedTestVariationSettings:
    """Variations of the existing tests that are considered as further experiments.

    Attributes:
        hold: duration of an added hold, s.
        speed_factor: factor of the speed.
        depth_factor: factor of the depth.
        size_factor: factor of the tool radius or of the specimen's height.
        max_depth: largest depth as a fraction of the thickness.
        max_plans: largest number of reported experiments.
    """

    hold: float = 60.0
    speed_factor: float = 10.0
    depth_factor: float = 1.5
    size_factor: float = 0.5
    max_depth: float = 0.5
    max_plans: int = 4


_PLANNED_VARIATION = PlannedTestVariationSettings()


@dataclass(frozen=True, eq=False)
class PlannedTestVariation:
    """Planned further test: a variation of a test of the campaign.

    Attributes:
        sentence: description of the planned test for the report.
        test: planned test, with the tool and the specimen of the variation.
        protocol: motion of the tool: displacement in m at times in s.
    """

    sentence: str
    test: Test
    protocol: Protocol


def suggest_experiments(before: FitEvidence, proposals: CatalogueScores,
                        judgement: VerdictWithFits) -> list[NextExperiment]:
    """Return further experiments, the most informative first.

    For a set of indistinguishable effects, planned tests are ranked by the smallest difference of any two members.
    Descriptions from the catalogue follow.

    Args:
        before: fit without effects.
        proposals: scores of all effects.
        judgement: verdict.
    """
    rivals = [each for each in judgement.refits if each.candidate_name in judgement.indistinguishable]
    found: list[NextExperiment] = []
    if judgement.verdict == "SET" and len(rivals) > 1:
        for plan in list_variations_of_existing_tests(before):
            closest = _find_closest_rivals_and_deviation_or_none(plan, before, rivals)
            if closest is not None and closest[1] > 1.0:
                found.append(NextExperiment(sentence=plan.sentence, separates=closest[0], deviations=closest[1]))
        found.sort(key=lambda each: -(each.deviations or 0.0))
    names = judgement.indistinguishable if judgement.verdict == "SET" else []
    effects = [proposals.effects[name.partition("@")[0]] for name in names]
    by_hand = [NextExperiment(sentence=f"{effect.title}: {effect.separated_by}", separates=[name])
               for name, effect in zip(names, effects, strict=True)]
    if judgement.verdict == "UNKNOWN":
        by_hand = [NextExperiment(sentence="repeat the test with another rig or another operator: a misfit that stays "
                                  "is a property of the tissue")]
    if judgement.verdict == "NONE":
        silent: dict[str, list[str]] = {}
        for name in proposals.untestable:
            silent.setdefault(proposals.effects[name.partition("@")[0]].separated_by, []).append(name)
        by_hand = [NextExperiment(sentence=f"to see {', '.join(each)}: {sentence}", separates=each)
                   for sentence, each in silent.items()]
    return [*found[:_PLANNED_VARIATION.max_plans], *by_hand]


def list_variations_of_existing_tests(before: FitEvidence) -> list[PlannedTestVariation]:
    """Return variations of the existing tests: hold, higher speed, larger depth, smaller tool or lower specimen."""
    found = []
    faster, smaller = _PLANNED_VARIATION.speed_factor, _PLANNED_VARIATION.size_factor
    for test in before.diagnosis_data.simulated_tests():
        curve = before.measured[test.name][0]
        experiment = test.experiment
        if curve.time is None or experiment is None:
            continue
        depth = float(curve.displacement.max())
        speed = curve.mean_loading_speed or 1e-4
        held = curve.segment is not None and any(str(name).startswith(("hold", "unload")) for name in curve.segment)
        label = f"{1e3 * depth:.3g} mm"
        if not held:
            found.append(_make_planned_variation_or_none(
                f"{test.name} again, to {label}, with a hold of {_PLANNED_VARIATION.hold:g} s and "
                "unloading", test, depth, speed, hold=True))
        found.append(_make_planned_variation_or_none(
            f"{test.name} again {faster:g} times as fast ({1e3 * faster * speed:.3g} mm/s)",
            test, depth, faster * speed, hold=held))
        height = experiment.specimen.height
        deeper = min(_PLANNED_VARIATION.depth_factor * depth, _PLANNED_VARIATION.max_depth * experiment.thickness)
        if deeper > 1.1 * depth:
            found.append(_make_planned_variation_or_none(f"{test.name} again to {1e3 * deeper:.3g} mm", test, deeper,
                                                         speed, hold=held))
        radius = experiment.tool.radius
        if not experiment.tool.is_plate and radius is not None:
            tool = replace(experiment.tool, radius=smaller * radius)
            found.append(
                _make_planned_variation_or_none(f"{test.name} with a tool of {1e3 * smaller * radius:.3g} mm radius",
                                                replace(test, experiment=replace(experiment, tool=tool)), depth, speed,
                                                hold=held))
        elif "height" in list_field_declarations(type(experiment.specimen)):
            lower = with_values(experiment.specimen, {"height": smaller * height})
            shorter = replace(test, specimen=lower, experiment=replace(experiment, specimen=lower))
            found.append(_make_planned_variation_or_none(f"{test.name} on a specimen of half the height, to "
                                                         f"{1e3 * smaller * depth:.3g} mm", shorter, smaller * depth,
                                                         speed, hold=held))
    return [plan for plan in found if plan is not None]


def _make_planned_variation_or_none(sentence: str, test: Test, depth: float, speed: float, *,
                                    hold: bool) -> PlannedTestVariation | None:
    """Return a planned ramp, with hold and unloading if `hold`; None if the motion or geometry is invalid."""
    ending = f"; hold {_PLANNED_VARIATION.hold:g}s; unload" if hold else ""
    text = f"ramp {1e3 * depth:.6g}mm @{1e3 * speed:.6g}mm/s{ending}"
    try:
        assert test.experiment is not None
        protocol = Protocol.parse(text)
        experiment = replace(test.experiment, protocol=Protocol.ramp(1e-3 * test.experiment.specimen.height, 2))
        return PlannedTestVariation(sentence, replace(test, name=f"{test.name} (planned)", experiment=experiment),
                                    protocol)
    except InputError:
        return None


def _find_closest_rivals_and_deviation_or_none(plan: PlannedTestVariation, before: FitEvidence,
                                               rivals: Sequence[EffectRefit]) -> tuple[list[str], float] | None:
    """Return the two rivals that a planned test separates least, and their difference in standard deviations.

    The difference of the expected forces is taken relative to noise, nuisances and parameter uncertainty: d'V^-1 d with
    V = I + C C'.

    Returns:
        Names and difference; None if the test cannot be simulated.
    """
    noise = before.measured[plan.test.name.removesuffix(" (planned)")][0].noise
    curves = create_planned_curves_with_placeholder_force(plan.test, plan.protocol, noise)
    try:
        expected = [_predict_whitened_force_and_uncertainty(plan.test, curves, before, each) for each in rivals]
    except (InfeasibleError, InputError):
        return None
    worst: tuple[list[str], float] | None = None
    for i, (force, covariance) in enumerate(expected):
        for j in range(i):
            gap = force - expected[j][0]
            inner = np.eye(covariance.shape[1]) + covariance.T @ covariance
            absorbed = covariance @ cho_solve(cho_factor(inner), covariance.T @ gap)
            separation = float(np.sqrt(max(gap @ (gap - absorbed), 0.0)))
            if worst is None or separation < worst[1]:
                worst = [rivals[j].candidate_name, rivals[i].candidate_name], separation
    return worst


def _predict_whitened_force_and_uncertainty(test: Test, curves: tuple[MeasuredCurve, ...], before: FitEvidence,
                                            rival: EffectRefit) -> tuple[np.ndarray, np.ndarray]:
    """Return the whitened force that a refit predicts for a planned test, and its uncertainty.

    Returns:
        Force, shape (N,), and changes per standard deviation of contact, zero, mesh error and parameters, shape (N, m).
    """
    candidate = _extend_candidate_to_planned_test(rival.proposal.candidate, test)
    campaign: Campaign = replace(before.campaign, tests=(*before.campaign.tests, test))
    changed = candidate.add_to_campaign(campaign, free=True)
    asked = changed.tests[-1]
    problem = rival.problem
    forward = build_forward_test_of_inverse_fit(asked, curves, changed.fit, problem.jitter.contact)
    names = {each.name: [curve.name for curve in each.measured] for each in problem.tests}
    space = type(problem.space).from_campaign(changed.fit.laws[0], changed,
                                              {**names, asked.name: [c.name for c in curves]})
    error = compute_mesh_uncertainty(forward, ACCURATE_MESH_ERRORS)
    planned = GeneralisedProblem(space, (forward,), problem.solves, problem.jitter, (error,))
    theta = np.array([problem.space.get_values_by_name(rival.theta)[name] for name in space.free])
    answers = [forward.solve(space, theta, problem.solves)]
    residual, rates, columns, _ = planned._compute_whitened_terms_at_nuisances(answers, np.zeros(planned.nuisances))
    spread = compute_marginal_uncertainty(problem, problem.evaluate(rival.theta))
    order = [problem.space.free.index(name) for name in space.free]
    covariance = spread.covariance[np.ix_(order, order)]
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    return residual, np.hstack([columns, rates @ root])


def _extend_candidate_to_planned_test(candidate: Candidate, test: Test) -> Candidate:
    """Return a candidate that also acts in a planned test if it acts in the existing test that the plan varies."""
    if candidate.tests is None:
        return candidate
    like = test.name.removesuffix(" (planned)")
    return replace(candidate, tests=(*candidate.tests, test.name)) if like in candidate.tests else candidate


class PlannedTestSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a planned test: recordings, samples, largest depth and force, duration.

    Attributes:
        name: name of the test.
        recordings: number of recordings.
        samples: number of samples of the longest recording.
        depth_mm: largest displacement, mm.
        force_N: largest expected force, N.
        duration_s: duration of the longest recording, s; None without time.
    """

    name: str
    recordings: int
    samples: int
    depth_mm: float
    force_N: float
    duration_s: float | None = None


class Design(msgspec.Struct, frozen=True, kw_only=True):
    """Expected information of the planned experiments of a campaign.

    Attributes:
        campaign: name of the campaign.
        law: name of the law.
        candidates: all effects; testable ones first.
        parameters: name -> assumed value, SI.
        symbols: name -> symbol.
        units: name -> SI unit.
        standard_errors: name -> expected standard error, SI; None if the experiments do not determine the parameter, 0
            if it is fixed.
        noise_N: root mean square of the sensors' noise, N.
        tests: planned tests.
    """

    campaign: str
    law: str
    candidates: list[CandidateResult]
    parameters: dict[str, float]
    symbols: dict[str, str]
    units: dict[str, str]
    standard_errors: dict[str, float | None]
    noise_N: float
    tests: list[PlannedTestSummary]


def simulate_expected_recordings(problem: GeneralisedProblem,
                                 campaign: Campaign) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Return noise-free recordings of each test, for a material with the starting values of the campaign.

    Args:
        problem: least-squares problem of the planned tests.
        campaign: campaign of the problem.

    Raises:
        InputError: a parameter has no starting value, or the simulation fails at the starting values.
    """
    space = problem.space
    if missing := [name for name in space.free if name not in space.start]:
        raise InputError(f"fit.start must give the material of a design; state {', '.join(missing)}",
                         file=campaign.path, field="fit.start")
    theta = _get_starting_values(problem)
    known = {}
    try:
        for test in problem.tests:
            answer = test.solve(space, theta, problem.solves)
            known[test.name] = replace_forces_of_curves(test.measured,
                                                        [test.evaluate_force_and_derivatives(answer, number, 0.0)[0]
                                                         for number in range(len(test.measured))])
    except InfeasibleError as failure:
        raise InputError(f"the tests cannot be simulated with this start ({failure}); state another start or a smaller "
                         "depth", file=campaign.path, field="fit.start") from None
    return known


def _get_starting_values(problem: GeneralisedProblem) -> np.ndarray:
    """Return the starting values of the free parameters, shape (number of free parameters,)."""
    return np.array([problem.space.start[name] for name in problem.space.free])


def make_design_campaign_and_problem(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]],
                                     solves: SimulationCache) -> tuple[Campaign, GeneralisedProblem]:
    """Return the campaign with default offsets, and the least-squares problem of its planned tests.

    Args:
        campaign: campaign from `calibration.diagnosis.evidence.make_one_law_whole_recording_campaign`.
        measured: test -> recordings, of which only the motions are used.
        solves: cache of simulations.
    """
    campaign = make_campaign_with_scaled_offset_defaults(campaign, measured)
    return campaign, build_generalised_problem(campaign.fit.laws[0], campaign, measured, solves)


def simulate_noise_free_evidence(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]],
                                 solves: SimulationCache) -> FitEvidence:
    """Return the evidence of noise-free recordings of a material with the starting values of the campaign.

    Args:
        campaign: see `make_design_campaign_and_problem`.
        measured: see `make_design_campaign_and_problem`.
        solves: cache of simulations.

    Raises:
        InputError: see `simulate_expected_recordings`.
    """
    campaign, problem = make_design_campaign_and_problem(campaign, measured, solves)
    known = simulate_expected_recordings(problem, campaign)
    theta = _get_starting_values(problem)
    # The default scatter between recordings is proportional to the force, which is known only now.
    jitter = make_stated_or_guessed_jitter(campaign, [curve for curves in known.values() for curve in curves])
    # A fit will correct the mesh; the forces of a design are those of the fast mesh, with the error after a correction.
    mesh_error = tuple(make_test_with_mesh_correction(test, problem.space, theta, solves)[2] for test in problem.tests)
    problem = replace(problem, tests=tuple(replace(test, measured=known[test.name]) for test in problem.tests),
                      jitter=jitter, mesh_error=mesh_error)
    evaluation = problem.evaluate(theta)
    estimate = Estimate(1, theta, evaluation.penalised_sum_of_squares, True, "", (), {}, 0.0, problem=problem)
    return FitEvidence(campaign, {**measured, **known}, estimate)


def evaluate_experiment_design(evidence: FitEvidence, context: RunContext) -> Design:
    """Compute the expected information of planned experiments.

    Args:
        evidence: noise-free recordings of the experiments, see `simulate_noise_free_evidence`.
        context: workers and listeners.
    """
    campaign = evidence.campaign
    proposals = score_effects(evidence, context)
    nothing = VerdictWithFits("NONE", [], (), [], evidence)
    rows = [msgspec.structs.replace(row, score=None, p=None, estimate={})
            for row in list_candidate_results(proposals, nothing, evidence)]
    rows.sort(key=lambda row: not row.testable)
    problem = evidence.problem
    spread = compute_marginal_uncertainty(problem, evidence.evaluation)
    open_names = find_undetermined_parameters(problem.space, spread)
    space = problem.space
    errors = {**dict.fromkeys(evidence.parameter_values, 0.0),
              **{name: float(error) if np.isfinite(error) and name not in open_names else None
                 for name, error in zip(space.free, spread.standard_errors, strict=True)}}
    noise = float(np.sqrt(np.mean([curve.noise.deviation**2 for curve in problem.measured])))
    return Design(campaign=campaign.name, law=campaign.fit.laws[0], candidates=rows,
                  parameters=evidence.parameter_values, symbols=space.symbols,
                  units={each.name: each.declaration.unit for each in space.unknowns}, standard_errors=errors,
                  noise_N=noise, tests=[_summarise_planned_test(test.name, test.measured) for test in problem.tests])


def _summarise_planned_test(name: str, curves: Sequence[MeasuredCurve]) -> PlannedTestSummary:
    """Summarise the recordings of a planned test."""
    clocks = [curve.sample_times[-1] - curve.sample_times[0] for curve in curves
              if curve.time is not None]
    return PlannedTestSummary(
        name=name, recordings=len(curves), samples=max(curve.force.size for curve in curves),
        depth_mm=1e3 * max(float(curve.displacement.max()) for curve in curves),
        force_N=max(float(curve.force.max()) for curve in curves), duration_s=float(max(clocks)) if clocks else None)
