"""Further experiments that separate the remaining explanations of a misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.planned import create_planned_curves_with_placeholder_force
from calibration.diagnosis.diagnosis import NextExperiment
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import CatalogueScores
from calibration.diagnosis.refits import EffectRefit
from calibration.diagnosis.verdict import VerdictWithFits
from calibration.effects.effect import Candidate
from calibration.fit.problem import GeneralisedProblem
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import build_forward_test_of_inverse_fit, compute_mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS
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
