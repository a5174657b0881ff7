"""Which experiment would tell more: planned ones, by how far the explanations that are left differ there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.planned import planned_curves
from calibration.diagnosis.diagnosis import NextExperiment
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import Proposals
from calibration.diagnosis.refits import Refit
from calibration.diagnosis.verdict import Judgement
from calibration.effects.effect import Candidate
from calibration.fit.problem import Problem
from calibration.fit.uncertainty import assess_uncertainty
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import build_test, mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.parameters import declared, with_values

#: A hold that is added, s; how much faster and deeper, and how much smaller a tool or lower a specimen, a test is done.
_HOLD, _FASTER, _DEEPER, _SMALLER = 60.0, 10.0, 1.5, 0.5
#: Deepest a test may go, as a share of the specimen's height.
_DEEPEST = 0.5
#: Most that are named.
_MOST = 4


@dataclass(frozen=True, eq=False)
class Plan:
    """A test that could be done: what to do, in words, and the test with its motion."""

    sentence: str
    test: Test
    protocol: Protocol


def next_experiments(before: Evidence, proposals: Proposals, judgement: Judgement) -> list[NextExperiment]:
    """What to do next, the most telling first.

    Of a set, planned tests by how far its members differ in them; then what the catalogue says of those that these
    tests leave open.
    """
    rivals = [each for each in judgement.refits if each.name in judgement.indistinguishable]
    found: list[NextExperiment] = []
    if judgement.verdict == "SET" and len(rivals) > 1:
        for plan in plans(before):
            apart = _apart(plan, before, rivals)
            if apart is not None and apart[1] > 1.0:
                found.append(NextExperiment(sentence=plan.sentence, separates=apart[0], deviations=apart[1]))
        found.sort(key=lambda each: -(each.deviations or 0.0))
    names = judgement.indistinguishable if judgement.verdict == "SET" else []
    effects = [proposals.effects[name.partition("@")[0]] for name in names]
    by_hand = [NextExperiment(sentence=f"{effect.title}: {effect.separated_by}", separates=[name])
               for name, effect in zip(names, effects, strict=True)]
    if judgement.verdict == "UNKNOWN":
        by_hand = [NextExperiment(sentence="repeat the test with another rig or another operator: what stays is the "
                                           "tissue's")]
    if judgement.verdict == "NONE":
        silent: dict[str, list[str]] = {}
        for name in proposals.silent:
            silent.setdefault(proposals.effects[name.partition("@")[0]].separated_by, []).append(name)
        by_hand = [NextExperiment(sentence=f"to see {', '.join(each)}: {sentence}", separates=each)
                   for sentence, each in silent.items()]
    return [*found[:_MOST], *by_hand]


def plans(before: Evidence) -> list[Plan]:
    """Tests like those that were done, each with one thing changed."""
    found = []
    for test in before.situation.simulated_tests():
        curve = before.measured[test.name][0]
        experiment = test.experiment
        if curve.time is None or experiment is None:
            continue
        depth = float(curve.displacement.max())
        speed = curve.speed or 1e-4
        held = curve.segment is not None and any(str(name).startswith(("hold", "unload")) for name in curve.segment)
        label = f"{1e3 * depth:.3g} mm"
        if not held:
            found.append(_plan(f"{test.name} again, to {label}, with a hold of {_HOLD:g} s and the return", test,
                               depth, speed, hold=True))
        found.append(_plan(f"{test.name} again {_FASTER:g} times as fast ({1e3 * _FASTER * speed:.3g} mm/s)", test,
                           depth, _FASTER * speed, hold=held))
        height = experiment.specimen.height
        deeper = min(_DEEPER * depth, _DEEPEST * experiment.thickness)
        if deeper > 1.1 * depth:
            found.append(_plan(f"{test.name} again to {1e3 * deeper:.3g} mm", test, deeper, speed, hold=held))
        radius = experiment.tool.radius
        if not experiment.tool.is_plate and radius is not None:
            tool = replace(experiment.tool, radius=_SMALLER * radius)
            found.append(_plan(f"{test.name} with a tool of {1e3 * _SMALLER * radius:.3g} mm radius",
                               replace(test, experiment=replace(experiment, tool=tool)), depth, speed, hold=held))
        elif "height" in declared(type(experiment.specimen)):
            lower = with_values(experiment.specimen, {"height": _SMALLER * height})
            shorter = replace(test, specimen=lower, experiment=replace(experiment, specimen=lower))
            found.append(_plan(f"{test.name} on a specimen of half the height, to {1e3 * _SMALLER * depth:.3g} mm",
                               shorter, _SMALLER * depth, speed, hold=held))
    return [plan for plan in found if plan is not None]


def _plan(sentence: str, test: Test, depth: float, speed: float, *, hold: bool) -> Plan | None:
    text = f"ramp {1e3 * depth:.6g}mm @{1e3 * speed:.6g}mm/s" + (f"; hold {_HOLD:g}s; unload" if hold else "")
    try:
        assert test.experiment is not None
        protocol = Protocol.parse(text)
        experiment = replace(test.experiment, protocol=Protocol.ramp(1e-3 * test.experiment.specimen.height, 2))
        return Plan(sentence, replace(test, name=f"{test.name} (planned)", experiment=experiment), protocol)
    except InputError:
        return None


def _apart(plan: Plan, before: Evidence, rivals: Sequence[Refit]) -> tuple[list[str], float] | None:
    """Names of two rivals that a planned test tells apart worst, and by how many deviations."""
    noise = before.measured[plan.test.name.removesuffix(" (planned)")][0].noise
    curves = planned_curves(plan.test, plan.protocol, noise)
    try:
        expected = [_expected(plan.test, curves, before, each) for each in rivals]
    except (InfeasibleError, InputError):
        return None
    worst: tuple[list[str], float] | None = None
    for i, (force, covariance) in enumerate(expected):
        for j in range(i):
            gap = force - expected[j][0]
            inner = np.eye(covariance.shape[1]) + covariance.T @ covariance
            taken = covariance @ cho_solve(cho_factor(inner), covariance.T @ gap)
            apart = float(np.sqrt(max(gap @ (gap - taken), 0.0)))
            if worst is None or apart < worst[1]:
                worst = [rivals[j].name, rivals[i].name], apart
    return worst


def _expected(test: Test, curves: tuple[MeasuredCurve, ...], before: Evidence,
              rival: Refit) -> tuple[np.ndarray, np.ndarray]:
    """Whitened force that a rival expects, shape (N,), and columns of one deviation each of what is not known: contact,
    zero, mesh and the rival's parameters, shape (N, m)."""
    candidate = _everywhere(rival.proposal.candidate, test)
    campaign: Campaign = replace(before.campaign, tests=(*before.campaign.tests, test))
    changed = candidate.add_to(campaign, free=True)
    asked = changed.tests[-1]
    problem = rival.problem
    forward = build_test(asked, curves, changed.fit, problem.jitter.contact)
    names = {each.name: [curve.name for curve in each.measured] for each in problem.tests}
    space = type(problem.space).of(changed.fit.laws[0], changed, {**names, asked.name: [c.name for c in curves]})
    error = mesh_uncertainty(forward, ACCURATE_MESH_ERRORS)
    planned = Problem(space, (forward,), problem.solves, problem.jitter, (error,))
    theta = np.array([problem.space.values(rival.theta)[name] for name in space.free])
    answers = [forward.solve(space, theta, problem.solves)]
    residual, rates, columns, _ = planned._linearise(answers, np.zeros(planned.nuisances))
    spread = assess_uncertainty(problem, problem.evaluate(rival.theta))
    order = [problem.space.free.index(name) for name in space.free]
    covariance = spread.covariance[np.ix_(order, order)]
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    return residual, np.hstack([columns, rates @ root])


def _everywhere(candidate: Candidate, test: Test) -> Candidate:
    """The candidate that acts in a planned test, too, where it acts in the test that this is like."""
    if candidate.tests is None:
        return candidate
    like = test.name.removesuffix(" (planned)")
    return replace(candidate, tests=(*candidate.tests, test.name)) if like in candidate.tests else candidate
