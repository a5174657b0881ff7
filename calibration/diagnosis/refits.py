"""Nonlinear fits with one effect, their comparison by the Schwarz criterion (BIC), and pairs of effects.

A pair is reported if both effects are required to explain a misfit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.parameter_space import ParameterSpace
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import (
    CatalogueScores,
    ScoredCandidate,
    add_effect_to_problem_and_campaign,
    combine_free_values_with_effect_sizes,
    find_smallest_median_displacement_step,
    recompute_all_scores,
    recompute_candidate_score_in_other_fit,
    refine_jump_displacement,
)
from calibration.diagnosis.settings import REFITS, RefitSettings
from calibration.effects.effect import Candidate, NotTestableError
from calibration.fit.estimate import Estimate, make_test_with_mesh_correction
from calibration.fit.problem import GeneralisedProblem
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import DescentResult, minimise_from_start
from calibration.forward.contract import InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.adequacy import compute_largest_principal_cosine
from tissue_sim.errors import InputError


@dataclass(frozen=True, eq=False)
class EffectRefit:
    """Nonlinear fit of a campaign with one candidate effect added to the model.

    Attributes:
        proposal: candidate that was added.
        problem: problem with the effect.
        campaign: campaign with the effect.
        theta: free parameters at the minimum, SI, shape (p,); those of the fit without the effect if the fit failed.
        error: sum of squares; infinite if the simulation failed.
        gain: decrease of BIC by the effect.
        failure: reason of a failure; empty otherwise.
        settings: settings of the fit.
    """

    proposal: ScoredCandidate
    problem: GeneralisedProblem
    campaign: Campaign
    theta: np.ndarray
    error: float
    gain: float
    failure: str = ""
    settings: RefitSettings = REFITS

    @property
    def candidate_name(self) -> str:
        """Name of the candidate."""
        return self.proposal.candidate.name

    @property
    def effect_values(self) -> dict[str, float]:
        """Name -> value of the parameters of the effect, SI."""
        candidate, space = self.proposal.candidate, self.problem.space
        mine = {**candidate.sizes, **candidate.shape}
        values = space.get_values_by_name(self.theta)
        return {each.name: values[each.name] for each in space.unknowns if each.path in mine}

    @property
    def reached_bounds_by_effect_parameter(self) -> dict[str, float]:
        """Name -> bound, SI, for parameters of the effect on a bound other than their absent value."""
        absent = {name: self.proposal.absent.get(self.problem.space.get_parameter_by_name(name).path)
                  for name in self.effect_values}
        met = {name: find_reached_bound_value_or_none(self.problem.space, self.theta, name, value,
                                                      self.settings.on_bound) for name, value in absent.items()}
        return {name: bound for name, bound in met.items() if bound is not None}

    @property
    def is_size_at_bound(self) -> bool:
        """Whether a size of the effect ended on a bound, so that its value is not plausible."""
        sizes = self.proposal.candidate.sizes
        return any(self.problem.space.get_parameter_by_name(name).path in sizes
                   for name in self.reached_bounds_by_effect_parameter)

    @property
    def is_effect_absent(self) -> bool:
        """Whether all sizes of the effect ended at the values at which the effect has no influence."""
        values = self.effect_values
        return all(abs(values[name] - self.proposal.absent[path]) <= 1e-6 * abs(size - self.proposal.absent[path])
                   for path, size in self.proposal.candidate.sizes.items()
                   for name in values if self.problem.space.get_parameter_by_name(name).path == path)

    def with_simulation_cache(self, solves: SimulationCache) -> EffectRefit:
        """Return the fit with another cache of simulations; results of worker processes contain copies of the cache."""
        return replace(self, problem=self.problem.with_simulation_cache(solves))

    def make_evidence(self, before: FitEvidence) -> FitEvidence:
        """Return the evidence with the effect; jitter and mesh corrections are those of `before`."""
        estimate = Estimate(1, self.theta, self.error, True, "", (), {}, 0.0, problem=self.problem,
                            differences=before.estimate.differences, refreshes=before.estimate.refreshes)
        return FitEvidence(self.campaign, before.measured, estimate, before.limits, before.refit_settings)


def find_reached_bound_value_or_none(space: ParameterSpace, theta: np.ndarray, name: str,
                                     absent: float | None, distance: float) -> float | None:
    """Return the bound on which a parameter ended, SI; None if it is on no bound, at its absent value, or fixed.

    Args:
        space: parameter space.
        theta: free parameters at the minimum, SI, shape (p,).
        name: name of the parameter.
        absent: value at which the effect is absent, SI; None: not defined.
        distance: relative distance at which a parameter counts as on its bound.
    """
    if name not in space.free:
        return None
    index = space.free.index(name)
    for bound in (space.low[index], space.high[index]):
        tolerance = distance * max(abs(bound), abs(theta[index]))
        near = np.isfinite(bound) and abs(theta[index] - bound) <= tolerance
        if near and bound != absent:
            return float(bound)
    return None


def fit_best_scored_effects(evidence: FitEvidence, proposals: CatalogueScores, context: RunContext,
                            words: str = "fits with an effect",
                            names: Sequence[str] | None = None) -> list[EffectRefit]:
    """Fit the effects with the highest scores, and sort them by their decrease of BIC.

    Args:
        evidence: fit without the effects.
        proposals: scores of all effects.
        context: workers and listeners.
        words: description for progress messages.
        names: names of the candidates; None: those with the highest scores.
    """
    ranked = [(name, -2.0 * each.negative_log_likelihood_change) for name,
              each in proposals.best_variant_by_candidate_name.items()]
    settings = evidence.refit_settings
    # Rivals of the best effect are fitted even if all scores are small.
    penalty = evidence.limits.min_bic_decrease + float(np.log(evidence.effective_sample_count))
    promising = min(settings.promising * penalty,
                    max((squares for _, squares in ranked), default=0.0) - settings.rival_margin)
    chosen = [name for number, (name, squares) in enumerate(ranked[:settings.max_similar]) if squares > promising
              and (number < settings.max_effects or squares > settings.similar**2 * ranked[0][1])] \
        if names is None else list(names)
    # An effect may make homogeneous tests inhomogeneous and add a mesh error, so the log determinant is included.
    error = evidence.estimate.error + evidence.evaluation.covariance_log_determinant
    tasks = []
    for name in chosen:
        variants = sorted((each for each in proposals.all if each.candidate.name == name),
                          key=lambda each: each.negative_log_likelihood_change)
        if variants[0].candidate.jump:
            variants = [refine_jump_displacement(variants[0], evidence)]
        tasks += [(evidence.problem, evidence.campaign, variant, evidence.parameter_values, error,
                   evidence.effective_sample_count, settings)
                  for variant in variants[:2]
                  if variant.negative_log_likelihood_change < variants[0].negative_log_likelihood_change + 0.5
                  * settings.shape_margin]
    titles = [variant.candidate.title for _, _, variant, *_ in tasks]
    found = context.run_task_for_all(fit_effect_or_none_if_untestable, tasks, words, names=titles) if tasks else []
    fits = [each for each in found if each is not None]
    best: dict[str, EffectRefit] = {}
    for each in sorted(fits, key=lambda one: -one.gain):
        best.setdefault(each.candidate_name, each.with_simulation_cache(evidence.problem.solves))
    if not best:
        return []
    limit = next(iter(best.values())).gain
    limit -= max(settings.near * limit, settings.min_near)
    near = [each for each in best.values() if each.gain >= limit]
    if len(near) > 1:
        # The mesh correction depends on the effect and may decide between similar effects.
        again = context.run_task_for_all(
            refit_with_mesh_correction,
            [(each, evidence.problem, error, evidence.effective_sample_count) for each in near],
            "their mesh corrections", names=[each.proposal.candidate.title for each in near])
        for each in again:
            best[each.candidate_name] = each.with_simulation_cache(evidence.problem.solves)
    return sorted(best.values(), key=lambda one: -one.gain)


def compute_odds_of_best_over_other(best: EffectRefit, other: EffectRefit) -> float:
    """Return the odds of the fit `best` against the fit `other`, exp(difference of their BIC / 2)."""
    return float(np.exp(min(0.5 * (best.gain - other.gain), 700.0)))


def refit_with_mesh_correction(fitted: EffectRefit, plain: GeneralisedProblem, error: float,
                               samples: float) -> EffectRefit:
    """Repeat a fit with the mesh correction of its effect; return it unchanged if the accurate mesh fails.

    Args:
        fitted: fit with an effect.
        plain: problem without the effect.
        error: sum of squares plus log determinant without the effect.
        samples: effective number of samples.
    """
    tests, errors, problem = [], [], fitted.problem
    for test in problem.tests:
        corrected, difference, mesh_error = make_test_with_mesh_correction(test, problem.space, fitted.theta,
                                                                           problem.solves)
        if np.isnan(difference):
            return fitted
        tests.append(corrected)
        errors.append(mesh_error)
    problem = replace(problem, tests=tuple(tests), mesh_error=tuple(errors))
    descent = minimise_from_start(problem, fitted.theta, corrected=True, enough=fitted.settings.gain,
                                  tolerance=fitted.settings.tolerance)
    if not np.isfinite(descent.error):
        return fitted
    penalty = _compute_bic_penalty(problem, plain, fitted.proposal.candidate, samples)
    gain = error - _compute_error_plus_log_determinant(problem, descent) - penalty
    return replace(fitted, problem=problem, theta=descent.theta, error=descent.error, gain=gain)


def fit_effect_or_none_if_untestable(problem: GeneralisedProblem, campaign: Campaign, proposal: ScoredCandidate,
                                     values: Mapping[str, float], error: float, samples: float,
                                     settings: RefitSettings = REFITS) -> EffectRefit | None:
    """Fit a problem with one effect, starting from the size that its score gives.

    Args:
        problem: problem without the effect.
        campaign: campaign of `problem`.
        proposal: scored candidate.
        values: name -> value of the parameters without the effect, SI.
        error: sum of squares plus log determinant without the effect.
        samples: effective number of samples.
        settings: settings of the fit.

    Returns:
        The fit; None if no test has the parameters of the effect.
    """
    candidate = proposal.candidate
    prepared = candidate.make_campaign_with_prepared_tests(campaign)
    start = {}
    for path, size in proposal.compute_effect_parameter_values().items():
        low, high = candidate.bounds.get(path, candidate.find_parameter_declaration(prepared, path).bounds)
        absent, trial = proposal.absent[path], candidate.sizes[path]
        if proposal.direction.degrees_of_freedom > 1 or not np.isfinite(size):
            size = trial
        # The linear estimate is limited to ten times the trial size.
        change = np.clip(size - absent, -10 * abs(trial - absent), 10 * abs(trial - absent))
        inside = absent + change
        margin = 1e-3 * abs(trial - absent)
        start[path] = float(np.clip(inside, low + margin if np.isfinite(low) else low,
                                    high - margin if np.isfinite(high) else high))
    try:
        extended, changed = add_effect_to_problem_and_campaign(problem, campaign, candidate, start, free=True)
    except (NotTestableError, InputError):
        return None
    starts = [combine_free_values_with_effect_sizes(extended.space, values, {**candidate.shape, **{
        path: proposal.absent[path] + fraction * (size - proposal.absent[path]) for path, size in start.items()}})
        for fraction in settings.starts]
    theta = _choose_start_below_error(extended, starts, error)
    gain, tolerance, stalled = settings.gain, settings.tolerance, (settings.patience, settings.gain)
    descent = minimise_from_start(extended, theta, corrected=True, enough=gain, tolerance=tolerance, stalled=stalled)
    if not np.isfinite(descent.error):
        return EffectRefit(proposal, extended, changed, descent.theta, descent.error, -np.inf, descent.failure,
                           settings)
    decrease = error - _compute_error_plus_log_determinant(extended, descent)
    shortfall = -2.0 * proposal.negative_log_likelihood_change - decrease
    if proposal.direction.degrees_of_freedom == 1 and shortfall > settings.shortfall:
        # With nearly dependent parameters a step with a small decrease may precede one with a larger decrease.
        again = minimise_from_start(extended, descent.theta, corrected=True, enough=0.0, tolerance=tolerance,
                                    stalled=stalled)
        descent = again if again.error < descent.error else descent
    for _ in range(settings.max_jump_moves if candidate.jump else 0):
        moved = _refit_with_better_jump_or_none(problem, campaign, proposal, extended, descent, settings)
        if moved is None:
            break
        proposal, extended, changed, descent = moved
    decrease = error - _compute_error_plus_log_determinant(extended, descent)
    gain = decrease - _compute_bic_penalty(extended, problem, candidate, samples)
    return EffectRefit(proposal, extended, changed, descent.theta, descent.error, gain, descent.failure, settings)


def _refit_with_better_jump_or_none(problem: GeneralisedProblem, campaign: Campaign, proposal: ScoredCandidate,
                                    extended: GeneralisedProblem, descent: DescentResult, settings: RefitSettings
                                    ) -> tuple[ScoredCandidate, GeneralisedProblem, Campaign, DescentResult] | None:
    """Search a better position of the jump at the contacts of the fit, and repeat the fit there.

    Args:
        problem: problem without the effect.
        campaign: campaign of `problem`.
        proposal: candidate with the jump of the fit.
        extended: problem with the effect.
        descent: end of the fit.
        settings: settings of the fit.

    Returns:
        Candidate, problem, campaign and end of the new fit; None if no better position is found.
    """
    candidate, best = proposal.candidate, _compute_error_plus_log_determinant(extended, descent)
    curves = [curve for curve in problem.measured if candidate.tests is None or curve.test.name in candidate.tests]
    position = candidate.shape[candidate.jump]
    low, high = candidate.bounds.get(candidate.jump, (0.0, max(float(c.displacement.max()) for c in curves)))
    found = None
    for steps in (sign * steps for steps in settings.jump_steps for sign in (-1, 1)):
        depth = float(np.clip(position + steps * find_smallest_median_displacement_step(curves), low, high))
        other = replace(candidate, shape={**candidate.shape, candidate.jump: depth})
        moved, changed = add_effect_to_problem_and_campaign(problem, campaign, other, free=True)
        try:
            evaluation = moved.evaluate(descent.theta)
        except InfeasibleError:
            continue
        if evaluation.penalised_sum_of_squares + evaluation.covariance_log_determinant < best - settings.gain:
            best, found = evaluation.penalised_sum_of_squares + evaluation.covariance_log_determinant, (replace(
                proposal, candidate=other), moved, changed)
    if found is None:
        return None
    again = minimise_from_start(found[1], descent.theta, corrected=True, enough=settings.gain,
                                tolerance=settings.tolerance)
    return (*found, again) if np.isfinite(again.error) else None


def _compute_error_plus_log_determinant(problem: GeneralisedProblem, descent: DescentResult) -> float:
    """Return the sum of squares at the end of a descent plus the log determinant of the covariance there."""
    return descent.error + problem.evaluate(descent.theta).covariance_log_determinant


def _compute_bic_penalty(problem: GeneralisedProblem, plain: GeneralisedProblem, candidate: Candidate,
                         samples: float) -> float:
    """Return the BIC penalty of the additional parameters: their number, including a jump position, times ln n."""
    return (problem.space.low.size - plain.space.low.size + bool(candidate.jump)) * float(np.log(samples))


def _choose_start_below_error(problem: GeneralisedProblem, starts: Sequence[np.ndarray], error: float) -> np.ndarray:
    """Return the first start with an error of at most `error`; if there is none, the start with the smallest error.

    Args:
        problem: problem with the effect.
        starts: free parameters, SI, each of shape (p,).
        error: sum of squares plus log determinant without the effect.
    """
    errors = []
    for theta in starts:
        try:
            evaluation = problem.evaluate(theta)
            errors.append(evaluation.penalised_sum_of_squares + evaluation.covariance_log_determinant)
        except InfeasibleError:
            errors.append(np.inf)
        if errors[-1] <= error:
            break
    return starts[int(np.argmin(errors))]


@dataclass(frozen=True)
class PairSearchSettings:
    """Numbers of effects that the search for pairs combines. Larger numbers find more pairs and cost more fits.

    Attributes:
        first_effects: number of first effects that are combined with a second one.
        max_first_effects: largest number of first effects if further ones are as likely as the best.
        second_effects: number of second effects that are fitted for each first effect.
    """

    first_effects: int = 2
    max_first_effects: int = 3
    second_effects: int = 3


_PAIR_SEARCH = PairSearchSettings()


@dataclass(frozen=True, eq=False)
class EffectPair:
    """Pair of effects that one fit contains together.

    Attributes:
        first: fit with the first effect.
        second: fit with both effects.
        with_first: evidence with the first effect.
    """

    first: EffectRefit
    second: EffectRefit
    with_first: FitEvidence

    @property
    def bic_decrease_of_both_effects(self) -> float:
        """Decrease of the Schwarz criterion (BIC) by both effects, compared with the fit without effects."""
        return self.first.gain + self.second.gain


def find_required_effect_pairs(evidence: FitEvidence, good: Sequence[EffectRefit], proposals: CatalogueScores,
                               context: RunContext) -> list[EffectPair]:
    """Return pairs of effects that are as likely as the best pair, best first; empty if one effect suffices.

    Args:
        evidence: fit without effects.
        good: fits with one effect, best first.
        proposals: scores of all effects.
        context: workers and listeners.
    """
    limits = evidence.limits
    found: list[EffectPair] = []
    firsts = [first for number, first in enumerate(good[:_PAIR_SEARCH.max_first_effects])
              if number < _PAIR_SEARCH.first_effects or compute_odds_of_best_over_other(good[0], first) < limits.odds]
    for first in firsts:
        with_first = first.make_evidence(evidence)
        others = recompute_all_scores(proposals, with_first, [first.candidate_name])
        # Two effects with a common parameter cannot be combined.
        likely = [name for name, each in others.significant_candidates.items() if each.p <= limits.pair_level
                  and not each.candidate.parameter_paths & first.proposal.candidate.parameter_paths
                  ][:_PAIR_SEARCH.second_effects]
        fits = fit_best_scored_effects(with_first, others, context,
                                       f"fits with {first.proposal.candidate.effect.title}", likely) if likely else []
        found += [EffectPair(first, second, with_first) for second in fits if second.gain >= limits.min_pair_gain
                  and not second.is_effect_absent and not second.is_size_at_bound
                  and _are_both_required_and_dissimilar(first, second, good, evidence)]
    found.sort(key=lambda pair: -pair.bic_decrease_of_both_effects)
    kept: dict[frozenset[str], EffectPair] = {}
    for pair in found:
        if 0.5 * (found[0].bic_decrease_of_both_effects - pair.bic_decrease_of_both_effects) < np.log(limits.odds):
            kept.setdefault(frozenset((pair.first.candidate_name, pair.second.candidate_name)), pair)
    return list(kept.values())


def _are_both_required_and_dissimilar(first: EffectRefit, second: EffectRefit, good: Sequence[EffectRefit],
                                      evidence: FitEvidence) -> bool:
    """Return whether both effects of a pair are required and change the forces differently.

    Two effects with similar changes of the forces could explain a misfit by the difference of their changes, although
    neither acts.

    Args:
        first: fit with the first effect.
        second: fit with both effects.
        good: fits with one effect.
        evidence: fit without effects.
    """
    alone = next((each for each in good if each.candidate_name == second.candidate_name), None)
    if alone is not None and alone.gain > first.gain + second.gain - evidence.limits.min_pair_gain:
        return False
    single, score_with_first = recompute_candidate_score_in_other_fit(second.proposal,
                                                                      evidence), second.proposal.signed_score
    if not single.direction.degrees_of_freedom:
        return False
    if single.signed_score * score_with_first < evidence.limits.min_score_ratio * score_with_first**2:
        return False
    cosine = compute_largest_principal_cosine(first.proposal.direction, single.direction)
    return cosine < evidence.limits.max_pair_cosine


def find_regions_of_largest_force_change(proposal: ScoredCandidate, evidence: FitEvidence, most: int = 2) -> list[str]:
    """Return the regions in which an effect changes the force most, after projection on the residual space.

    Args:
        proposal: scored candidate.
        evidence: fit without the effect.
        most: largest number of regions.

    Returns:
        Names such as ``needle (hold 1)``.
    """
    weights: dict[str, float] = {}
    moved = np.sum(proposal.direction.basis**2, axis=1)
    for rows, curve in zip(evidence.problem.rows, evidence.problem.measured, strict=True):
        segments = curve.segment if curve.segment is not None else np.full(curve.force.size, "ramp")
        for name in dict.fromkeys(segments.tolist()):
            place = f"{curve.test.name} ({name})"
            weights[place] = weights.get(place, 0.0) + float(moved[rows][segments == name].sum())
    ranked = sorted(weights, key=lambda place: -weights[place])
    return [place for place in ranked[:most] if weights[place] >= 0.3 * weights[ranked[0]]]
