"""Scores of all effects in the data of a campaign: significance, detectable size and indistinguishable effects.

A score needs the least-squares problem that is extended by the effect, and the change of the forces by the effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.settings import LIMITS, DecisionLimits
from calibration.effects.effect import CATALOGUE, Candidate, Effect, NotTestableError
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.fit.run_context import RunContext
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulated import SimulatedTest
from calibration.statistics.adequacy import (
    EffectDirection,
    compute_familywise_p_values,
    compute_largest_principal_cosine,
)
from tissue_sim.errors import InputError


def add_effect_to_problem_and_campaign(problem: GeneralisedProblem, campaign: Campaign, candidate: Candidate,
                                       values: Mapping[str, float] | None = None, *,
                                       free: bool) -> tuple[GeneralisedProblem, Campaign]:
    """Return the problem and the campaign with an effect; mesh corrections and jitter are unchanged.

    Args:
        problem: problem without the effect.
        campaign: campaign of `problem`.
        candidate: candidate that is added.
        values: path -> value, SI; None: trial values.
        free: whether the parameters of the effect are free or fixed.

    Raises:
        NotTestableError: no test has the parameters of the effect.
    """
    changed = candidate.add_to_campaign(campaign, values, free=free)
    names = {test.name: [curve.name for curve in test.measured] for test in problem.tests}
    space = ParameterSpace.from_campaign(changed.fit.laws[0], changed, names)
    by_name = {test.name: test for test in changed.tests}
    layered = bool(changed.fit.placeholder_material_with_effects.layers)

    def extend_test_with_effect(test: ForwardTest) -> ForwardTest:
        """Return a test with experiment and rig of the changed campaign; a closed form is returned unchanged."""
        if not isinstance(test, SimulatedTest):
            return test
        asked = by_name[test.name]
        if asked.experiment is None:
            return test
        experiment = replace(asked.experiment, protocol=test.experiment.protocol)
        return replace(test, experiment=experiment, rig=asked.rig, layered=layered)

    return GeneralisedProblem(space, tuple(map(extend_test_with_effect, problem.tests)), problem.solves, problem.jitter,
                              problem.mesh_error), changed


def combine_free_values_with_effect_sizes(space: ParameterSpace, values: Mapping[str, float],
                                          sizes: Mapping[str, float]) -> np.ndarray:
    """Return the free parameters of a space, SI, shape (p,).

    Args:
        space: parameter space with an effect.
        values: name -> value of the parameters without the effect, SI.
        sizes: path -> value of the parameters of the effect, SI.
    """
    return np.array([values[each.name] if each.name in values else sizes[each.path] for each in space.free_parameters])


def simulate_whitened_effect_change_or_reason(problem: GeneralisedProblem, evaluation: ProblemEvaluation,
                                              campaign: Campaign,
                                              candidate: Candidate, factor: float = 1.0) -> np.ndarray | str:
    """Compute the change of the whitened model by an effect of its trial size.

    Args:
        problem: problem without the effect.
        evaluation: evaluation at its minimum.
        campaign: campaign of `problem`.
        candidate: candidate of the effect.
        factor: amplitude in units of the trial size.

    Returns:
        Change, shape (N, q): one column for all tests, or one for each specimen or test with its own parameters. If the
        simulation fails, the reason.
    """
    touched = [number for number, test in enumerate(problem.tests)
               if candidate.tests is None or test.name in candidate.tests]
    nuisances = np.concatenate([np.zeros(0), *(
        evaluation.nuisances[columns] for columns, (t, _) in zip(problem.offset_columns, problem.places, strict=True)
        if t in touched), *(evaluation.nuisances[first:last] for first, last in dict.fromkeys(
            (problem.shared[t].start, problem.shared[t].stop) for t in touched))])

    def make_fixed_problem_of_affected_tests(of: GeneralisedProblem) -> GeneralisedProblem:
        """Return the problem of the tests in `touched`, with all parameters of the fit fixed."""
        # Fixed parameters avoid the computation of derivatives.
        space = of.space.with_all_fixed(dict(zip(problem.space.free, evaluation.theta, strict=True)))
        return GeneralisedProblem(space, tuple(of.tests[t] for t in touched), of.solves, of.jitter,
                                  tuple(of.mesh_error[t] for t in touched))

    try:
        absent = {path: candidate.find_value_without_effect(campaign, path) for path in candidate.sizes}
        sizes = candidate.scale_trial_values(absent, factor)
        extended, _ = add_effect_to_problem_and_campaign(problem, campaign, candidate, sizes, free=False)
        with_it = make_fixed_problem_of_affected_tests(extended)
        # Both forces must be computed on one mesh and by one method, so that their difference is due to the effect.
        if not candidate.has_mesh_changing_shape_parameter(campaign):
            without = _match_full_motion_or_none(make_fixed_problem_of_affected_tests(problem), with_it)
        else:
            neutral, _ = add_effect_to_problem_and_campaign(problem, campaign, candidate, absent, free=False)
            without = make_fixed_problem_of_affected_tests(neutral)
        change = _compute_residual_at_given_nuisances(with_it, nuisances)
        # Without changes of mesh and method the residual without the effect is that of the evaluation.
        change -= np.concatenate([evaluation.residual[rows] for rows, (t, _) in zip(
            problem.rows, problem.places, strict=True) if t in touched]) if without is None else \
            _compute_residual_at_given_nuisances(without, nuisances)
    except (InfeasibleError, NotTestableError, InputError) as error:
        return str(error)
    groups: dict[str, np.ndarray] = {}
    for rows, (t, r) in zip(with_it.rows, with_it.places, strict=True):
        column = groups.setdefault(_get_effect_scope_key_of_test(with_it.tests[t], candidate),
                                   np.zeros(problem.samples))
        column[problem.rows[problem.places.index((touched[t], r))]] = change[rows]
    return np.column_stack(list(groups.values()))


def _match_full_motion_or_none(held: GeneralisedProblem,
                               other: GeneralisedProblem) -> GeneralisedProblem | None:
    """Return the problem with the whole motion simulated in the tests for which another problem requires it.

    Returns:
        The problem; None if no test changes.
    """
    def with_full_motion_if_other_needs_it(test: ForwardTest, of: ForwardTest) -> ForwardTest:
        """Return `test`, with the simulation of the whole motion requested if only `of` requires it."""
        if not (isinstance(test, SimulatedTest) and isinstance(of, SimulatedTest)):
            return test
        differs = test.can_use_position_curve_at_parameters(held.space, np.zeros(0)) \
            and not of.can_use_position_curve_at_parameters(
            other.space, np.zeros(0))
        return replace(test, full_motion=True) if differs else test

    tests = tuple(map(with_full_motion_if_other_needs_it, held.tests, other.tests))
    if all(one is test for one, test in zip(tests, held.tests, strict=True)):
        return None
    return GeneralisedProblem(held.space, tests, held.solves, held.jitter, held.mesh_error)


def _compute_residual_at_given_nuisances(held: GeneralisedProblem, nuisances: np.ndarray) -> np.ndarray:
    """Return the whitened model minus data of a problem without free parameters at given nuisances, shape (N,).

    Raises:
        InfeasibleError: see `ForwardTest.solve`.
    """
    answers = [test.solve(held.space, np.zeros(0), held.solves) for test in held.tests]
    return held._compute_whitened_terms_at_nuisances(answers, nuisances)[0]


def _get_effect_scope_key_of_test(test: ForwardTest, candidate: Candidate) -> str:
    """Return a key that is equal for tests with common parameters of a candidate."""
    if candidate.scope == "per_test":
        return test.name
    if candidate.scope == "per_specimen":
        specimen = test.measured[0].test.specimen
        return "" if specimen is None else specimen.name
    return ""


#: Fraction of a change outside the fitted space below which its second-order part is computed too.
_SECOND_ORDER = 0.05


@dataclass(frozen=True)
class JumpSearchStepFractions:
    """Steps of the search for the displacement at which a force jumps.

    Attributes:
        first_step: first step, as a fraction of the largest displacement: the distance of the trial depths of the
            effects. A larger step costs more simulations and may pass over the jump.
        min_step: smallest step, as a fraction of the largest displacement; the sampling step if this is larger.
    """

    first_step: float = 0.05
    min_step: float = 0.002


_JUMP_SEARCH = JumpSearchStepFractions()


@dataclass(frozen=True, eq=False)
class ScoredCandidate:
    """Candidate of an effect with the result of its score test.

    Attributes:
        candidate: candidate of an effect.
        change: change of the whitened model by the trial size, shape (N, q).
        direction: change of the whitened model, projected onto the complement of the fitted space.
        score: score along the direction, shape (q,).
        p: family-wise p value.
        absent: path -> value at which the effect is absent, SI.
    """

    candidate: Candidate
    change: np.ndarray
    direction: EffectDirection
    score: np.ndarray
    p: float
    absent: dict[str, float]

    @property
    def signed_score(self) -> float:
        """Score in standard deviations; with the sign of the effect if it has one degree of freedom."""
        return float(self.score[0]) if self.direction.degrees_of_freedom == 1 else float(np.linalg.norm(self.score))

    @property
    def estimated_size_factor(self) -> float:
        """Estimated size of the effect from the score, in units of the trial size."""
        return self.signed_score / self.direction.reach if self.direction.reach else 0.0

    @cached_property
    def negative_log_likelihood_change(self) -> float:
        """Log likelihood ratio -score^2 / 2 for the ranking of candidates; 0 if the sign of the score is impossible."""
        squares = float(np.sum(self.score**2))
        if self.direction.positive and self.direction.degrees_of_freedom == 1 and self.signed_score < 0:
            return 0.0
        return -0.5 * squares

    def compute_effect_parameter_values(self, factor: float | None = None) -> dict[str, float]:
        """Return path -> value, SI, at a multiple of the trial size; None: at the size from the score."""
        return self.candidate.scale_trial_values(self.absent, self.estimated_size_factor if factor is None else factor)


@dataclass(frozen=True, eq=False)
class CatalogueScores:
    """Candidates of all effects of the catalogue with their scores.

    Attributes:
        all: scored candidates that the tests can show.
        untestable: name -> reason why the tests cannot show an effect.
        effects: name -> effect, for the whole catalogue.
        limits: decision limits of the diagnosis.
    """

    all: tuple[ScoredCandidate, ...]
    untestable: dict[str, str]
    effects: dict[str, Effect]
    limits: DecisionLimits = LIMITS

    @cached_property
    def best_variant_by_candidate_name(self) -> dict[str, ScoredCandidate]:
        """Name of a candidate -> its trial shape values with the highest score; highest scores first."""
        found: dict[str, ScoredCandidate] = {}
        for each in sorted(self.all, key=lambda one: one.negative_log_likelihood_change):
            found.setdefault(each.candidate.name, each)
        return found

    @property
    def significant_candidates(self) -> dict[str, ScoredCandidate]:
        """Name -> significant candidates (`DecisionLimits.effect_level`), strongest first."""
        return {name: each for name, each in self.best_variant_by_candidate_name.items() if each.p
                <= self.limits.effect_level}

    @property
    def significant_candidate_descriptions(self) -> list[str]:
        """Descriptions of the significant candidates, such as ``zero offset (8.1 standard deviations)``."""
        return [f"{each.candidate.effect.title} ({abs(each.signed_score):.2g} standard deviations)"
                for each in self.significant_candidates.values()]

    def find_names_of_indistinguishable_candidates(self, name: str) -> list[str]:
        """Return the names of indistinguishable candidates of other effects, most similar first."""
        mine = [each for each in self.all if each.candidate.name == name]
        found: dict[str, float] = {}
        for other in self.all:
            if other.candidate.effect.name != mine[0].candidate.effect.name:
                likeness = max(compute_largest_principal_cosine(one.direction, other.direction) for one in mine)
                found[other.candidate.name] = max(found.get(other.candidate.name, 0.0), likeness)
        return [other for other, likeness in sorted(found.items(), key=lambda pair: -pair[1])
                if likeness > self.limits.twin_cosine]


def score_effects(evidence: FitEvidence, context: RunContext, words: str = "effects, one at a time",
                  only: str | None = None) -> CatalogueScores:
    """Simulate every effect of the catalogue at its trial size, and compute its score.

    Args:
        evidence: fit of the campaign.
        context: workers and listeners.
        words: description for progress messages.
        only: name of the only effect; None: all effects.
    """
    untestable: dict[str, str] = {}
    effects: dict[str, Effect] = {}
    candidates: list[Candidate] = []
    for name, kind in CATALOGUE.items() if only is None else [(only, CATALOGUE[only])]:
        effects[name] = effect = kind()
        if effect.scales_all_forces and any(each.is_modulus for each in evidence.problem.space.free_parameters):
            untestable[name] = "forces cannot separate it from the moduli"
            continue
        try:
            candidates += effect.candidates(evidence.diagnosis_data)
        except NotTestableError as reason:
            untestable[name] = str(reason)
    problem, evaluation = evidence.problem, evidence.evaluation
    tasks = [(problem, evaluation, evidence.campaign, each) for each in candidates]
    changes = context.run_task_for_all(simulate_whitened_effect_change_or_reason, tasks, words,
                                       names=[each.title for each in candidates])
    columns = {number: change for number, change in enumerate(changes) if not isinstance(change, str)}
    failures = {candidates[number].name: change for number, change in enumerate(changes) if isinstance(change, str)}
    directions = {number: _make_effect_direction(candidates[number], change, evidence) for number,
                  change in columns.items()}
    # If nearly all of a change lies in the fitted space, the rest may be a nonlinearity. With c(s) = a s + b s^2 the
    # combination 4 c(1/2) - c(1) = a removes the second-order part.
    bent = [number for number, direction in directions.items() if direction.reach < _SECOND_ORDER * direction.length]
    halves = context.run_task_for_all(simulate_whitened_effect_change_or_reason,
                                      [(problem, evaluation, evidence.campaign, candidates[number], 0.5)
                                       for number in bent], words,
                                      names=[candidates[number].title for number in bent]) if bent else []
    for number, half in zip(bent, halves, strict=True):
        if not isinstance(half, str):
            columns[number] = 4.0 * half - columns[number]
            directions[number] = _make_effect_direction(candidates[number], columns[number], evidence)
    for number, direction in directions.items():
        if not direction.degrees_of_freedom:
            failures[candidates[number].name] = "the other parameters can absorb its change of the forces" \
                if direction.length > 1e-6 else "it does not change the forces of these tests"
    proposals = _score_simulated_changes([(candidates[number], columns[number], direction)
                                          for number, direction in directions.items()], evidence)
    shown = {each.candidate.name for each in proposals}
    untestable |= {name: reason for name, reason in failures.items() if name not in shown}
    return CatalogueScores(proposals, untestable, effects, evidence.limits)


def recompute_all_scores(proposals: CatalogueScores, evidence: FitEvidence, known: Sequence[str]) -> CatalogueScores:
    """Compute the scores of all candidates in a fit that contains some effects.

    The changes of the forces are taken from the fit without these effects, on which they hardly depend.

    Args:
        proposals: scores in the fit without the effects.
        evidence: fit with the effects.
        known: names of the candidates that the fit contains.
    """
    return replace(proposals, all=_score_simulated_changes([
        (each.candidate, each.change, _make_effect_direction(each.candidate, each.change, evidence))
        for each in proposals.all
        if each.candidate.name not in known], evidence))


def recompute_candidate_score_in_other_fit(proposal: ScoredCandidate, evidence: FitEvidence) -> ScoredCandidate:
    """Return a candidate with its score in another fit; the p value is unchanged."""
    direction = _make_effect_direction(proposal.candidate, proposal.change, evidence)
    return replace(proposal, direction=direction,
                   score=direction.compute_score_components(evidence.whitened_residual_with_nuisances_and_priors))


def _score_simulated_changes(asked: Sequence[tuple[Candidate, np.ndarray, EffectDirection]],
                             evidence: FitEvidence) -> tuple[ScoredCandidate, ...]:
    """Return scored candidates, without those whose changes lie in the fitted space.

    Args:
        asked: candidates with their changes, shape (N, q), and directions.
        evidence: fit.
    """
    testable = [(candidate, change, direction) for candidate, change,
                direction in asked if direction.degrees_of_freedom]
    directions = [direction for *_, direction in testable]
    scores = [direction.compute_score_components(evidence.whitened_residual_with_nuisances_and_priors)
              for direction in directions]
    return tuple(ScoredCandidate(candidate, change, direction, score, float(p), {
        path: candidate.find_value_without_effect(evidence.campaign, path) for path in candidate.sizes})
        for (candidate, change, direction), score, p in zip(
            testable, scores, compute_familywise_p_values(directions, scores), strict=True))


def refine_jump_displacement(proposal: ScoredCandidate, evidence: FitEvidence) -> ScoredCandidate:
    """Move the jump of a candidate to the position with the highest score, by steps that are halved down to a sample.

    Candidates without a jump are returned unchanged. The p value is unchanged.
    """
    candidate = proposal.candidate
    if not candidate.jump:
        return proposal
    curves = [curve for curve in evidence.problem.measured
              if candidate.tests is None or curve.test.name in candidate.tests]
    deepest = max(float(curve.displacement.max()) for curve in curves)
    step = _JUMP_SEARCH.first_step * deepest
    while step > max(find_smallest_median_displacement_step(curves), _JUMP_SEARCH.min_step * deepest):
        step *= 0.5
        for change_of_depth in (-step, step):
            depth = float(np.clip(candidate.shape[candidate.jump] + change_of_depth, *candidate.bounds.get(
                candidate.jump, (0.0, deepest))))
            other = replace(candidate, shape={**candidate.shape, candidate.jump: depth})
            change = simulate_whitened_effect_change_or_reason(evidence.problem, evidence.evaluation, evidence.campaign,
                                                               other)
            if isinstance(change, str):
                continue
            found = recompute_candidate_score_in_other_fit(replace(proposal, candidate=other, change=change), evidence)
            if found.direction.degrees_of_freedom and found.negative_log_likelihood_change \
                < proposal.negative_log_likelihood_change:
                proposal = found
        candidate = proposal.candidate
    return proposal


def find_smallest_median_displacement_step(curves: Sequence[MeasuredCurve]) -> float:
    """Return the smallest median displacement between successive samples of some recordings, m."""
    return min(float(np.median(np.abs(np.diff(curve.displacement[curve.displacement > 0])))) for curve in curves)


def _make_effect_direction(candidate: Candidate, change: np.ndarray, evidence: FitEvidence) -> EffectDirection:
    """Return the direction of a change, shape (N, q), with zeros in the rows of nuisances and priors."""
    rows = evidence.whitened_residual_with_nuisances_and_priors.size - evidence.problem.samples
    columns = np.vstack([change, np.zeros((rows, change.shape[1]))])
    return EffectDirection.from_whitened_change(columns, evidence.fitted_space_basis,
                                                positive=_has_one_sided_size(candidate, evidence))


def _has_one_sided_size(candidate: Candidate, evidence: FitEvidence) -> bool:
    """Return whether the only size parameter can lie on one side of its absent value only."""
    if len(candidate.sizes) != 1:
        return False
    (path, size), = candidate.sizes.items()
    absent = candidate.find_value_without_effect(evidence.campaign, path)
    prepared = candidate.make_campaign_with_prepared_tests(evidence.campaign)
    low, high = candidate.bounds.get(path, candidate.find_parameter_declaration(prepared, path).bounds)
    return (low >= absent - 1e-12 * abs(absent)) if size > absent else (high <= absent + 1e-12 * abs(absent))
