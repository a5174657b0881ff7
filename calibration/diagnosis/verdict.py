"""Verdict of a diagnosis from the fits with effects: NAMED, SET, LOOKS_LIKE, UNKNOWN or NONE.

Scores and fits are converted to the records of a diagnosis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.confirmation import refit_with_updated_corrections
from calibration.diagnosis.diagnosis import CandidateResult, EffectParameter, FoundEffect, Verdict
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import CatalogueScores, ScoredCandidate, recompute_all_scores, score_effects
from calibration.diagnosis.refits import (
    EffectRefit,
    compute_odds_of_best_over_other,
    find_reached_bound_value_or_none,
    find_regions_of_largest_force_change,
    find_required_effect_pairs,
    fit_best_scored_effects,
)
from calibration.effects.effect import Candidate
from calibration.fit.fit import RegionMisfitTest
from calibration.fit.run_context import RunContext
from calibration.fit.uncertainty import compute_marginal_uncertainty


@dataclass(frozen=True, eq=False)
class VerdictWithFits:
    """Verdict with its fits.

    Attributes:
        verdict: verdict.
        refits: fits with one effect, best first.
        added: fits with the added effects; each includes the effects of the previous ones. Empty: nothing was added.
        indistinguishable: names of the candidates that explain the misfit equally well.
        evidence: final fit with the added effects, their jitter and mesh corrections; without effects if none was
            added.
    """

    verdict: Verdict
    refits: list[EffectRefit]
    added: tuple[EffectRefit, ...]
    indistinguishable: list[str]
    evidence: FitEvidence


def fit_effects_and_decide_verdict(evidence: FitEvidence, proposals: CatalogueScores,
                                   context: RunContext) -> VerdictWithFits:
    """Fit the significant effects and derive the verdict.

    Args:
        evidence: fit without effects.
        proposals: scores of all effects.
        context: workers and listeners.
    """
    if not proposals.significant_candidates and evidence.has_adequate_region_residuals:
        return VerdictWithFits("NONE" if evidence.has_no_misfit_or_common_signal else "UNKNOWN", [], (), [], evidence)
    limits = evidence.limits
    refits = fit_best_scored_effects(evidence, proposals, context)
    sound = [each for each in refits if not each.is_effect_absent and not each.is_size_at_bound]
    good = [each for each in sound if each.gain >= limits.min_bic_decrease
            and (each.proposal.p <= limits.effect_level or not evidence.has_adequate_region_residuals)]
    if not good:
        return VerdictWithFits("NONE" if evidence.has_no_misfit_or_common_signal else "UNKNOWN", refits, (), [],
                               evidence)
    best = good[0]
    rivals = (each.gain for each in good if each.proposal.candidate.effect.name != best.proposal.candidate.effect.name)
    has_rival = next(rivals, 0.0) >= limits.rival_gain_ratio * best.gain
    needed = limits.explained_fraction if has_rival else limits.explained_without_rival
    added, after = _refit_with_further_terms_of_effect(best, evidence, context)
    rest = recompute_all_scores(proposals, after, [best.candidate_name]).significant_candidates
    if rest or not after.has_adequate_region_residuals:
        pairs = find_required_effect_pairs(evidence, good, proposals, context)
        if pairs and pairs[0].bic_decrease_of_both_effects > sum(each.gain for each in added) + limits.min_pair_gain:
            together = refit_with_updated_corrections(pairs[0].second.make_evidence(pairs[0].with_first))
            # A pair is accepted only if it explains the whole misfit.
            if together.has_no_misfit_or_common_signal:
                names = list(dict.fromkeys(name for pair in pairs
                                           for name in (pair.first.candidate_name, pair.second.candidate_name)))
                return VerdictWithFits("SET" if len(names) > 2 else "NAMED", refits, (pairs[0].first, pairs[0].second),
                                       names, together)
        # The explained fraction is meaningful only if the remaining misfit is significant.
        smallest_p = min(region.p for region in after.region_misfit_tests)
        far = smallest_p < limits.clear_misfit_level or after.tests_with_common_signal
        if far and compute_explained_misfit_fraction(evidence.region_misfit_tests, after.region_misfit_tests) < needed:
            return VerdictWithFits("UNKNOWN", refits, (), [], evidence)
    # Decrease of BIC that the remaining scores predict.
    gained = sum(each.gain for each in added)
    left = max((-2.0 * each.negative_log_likelihood_change - float(np.log(evidence.effective_sample_count))
                for each in rest.values()),
               default=0.0)
    left = max(left, 0.0)
    if left > (1.0 - limits.scored_fraction) * (gained + left):
        return VerdictWithFits("UNKNOWN", refits, (), [], evidence)
    if after.tests_with_common_signal and compute_explained_common_signal_fraction(evidence, after) < needed:
        return VerdictWithFits("UNKNOWN", refits, (), [], evidence)
    # Candidates as likely as the best one belong to the set even if their own decrease of BIC is insignificant.
    possible = [each for each in sound if compute_odds_of_best_over_other(best, each) < limits.odds]
    names = list(dict.fromkeys([*(each.candidate_name for each in possible),
                                *_list_known_indistinguishable_candidates(best, proposals)]))
    if len(names) > 1:
        return VerdictWithFits("SET", refits, added, names, after)
    alone = after.has_no_misfit_or_common_signal and left <= (1.0 - limits.explained_fraction) * (gained + left)
    return VerdictWithFits("NAMED" if alone else "LOOKS_LIKE", refits, added, names, after)


def _refit_with_further_terms_of_effect(best: EffectRefit, evidence: FitEvidence,
                                        context: RunContext) -> tuple[tuple[EffectRefit, ...], FitEvidence]:
    """Add further instances of the best effect, such as Prony terms, while the residuals require them.

    Returns:
        Fits with one, two, ... instances, and the final evidence.
    """
    effect, added = best.proposal.candidate.effect, [best]
    after = refit_with_updated_corrections(best.make_evidence(evidence))
    while not after.has_adequate_region_residuals and len(added) < effect.max_instances:
        more = score_effects(after, context, f"more of {effect.title}", only=effect.name)
        fits = fit_best_scored_effects(after, more, context, f"fits with more of {effect.title}",
                                       list(more.significant_candidates)[:1])
        if not fits or fits[0].gain < evidence.limits.min_bic_decrease or fits[0].is_effect_absent:
            break
        added.append(fits[0])
        after = refit_with_updated_corrections(fits[0].make_evidence(after))
    return tuple(added), after


def compute_explained_misfit_fraction(before: Sequence[RegionMisfitTest], after: Sequence[RegionMisfitTest]) -> float:
    """Return the explained fraction of the misfit: relative decrease of the excess of chi-square over its expectation.

    Args:
        before: regions without effects.
        after: regions with effects.
    """
    def sum_excess_statistic_of_regions(regions: Sequence[RegionMisfitTest]) -> float:
        return sum(max(region.statistic - region.freedom, 0.0) for region in regions)

    first = sum_excess_statistic_of_regions(before)
    return 1.0 - sum_excess_statistic_of_regions(after) / first if first > 0 else 0.0


def compute_explained_common_signal_fraction(before: FitEvidence, after: FitEvidence) -> float:
    """Return the explained fraction of the common signal of recordings, from the excess of the variance ratios.

    Args:
        before: fit without effects.
        after: fit with effects.
    """
    def sum_excess_of_variance_ratios(evidence: FitEvidence) -> float:
        return sum(max(ratio - 1.0, 0.0) * freedom for ratio, freedom,
                   _ in evidence.variance_f_ratios_and_freedoms_by_test.values())

    first = sum_excess_of_variance_ratios(before)
    return 1.0 - sum_excess_of_variance_ratios(after) / first if first > 0 else 0.0


def _list_known_indistinguishable_candidates(best: EffectRefit, proposals: CatalogueScores) -> list[str]:
    """Return the known twins of the best effect (`Effect.known_twins`) that are indistinguishable in these tests."""
    known = best.proposal.candidate.effect.known_twins
    return [name for name in proposals.find_names_of_indistinguishable_candidates(best.candidate_name)
            if name.partition("@")[0] in known]


def list_found_effects(judgement: VerdictWithFits, before: FitEvidence, after: FitEvidence) -> list[FoundEffect]:
    """Return the added effects with the parameters of the final fit.

    Args:
        judgement: verdict with the added effects.
        before: fit without effects.
        after: fit with all added effects.
    """
    found: dict[str, FoundEffect] = {}
    for each in judgement.added:
        candidate = each.proposal.candidate
        numbers = list_fitted_parameters_of_candidate(candidate, after)
        effect = candidate.effect
        if candidate.name in found:
            # A further instance of the effect, such as a second Prony term.
            numbers = [*found[candidate.name].parameters, *numbers]
        found[candidate.name] = FoundEffect(
            name=effect.name, category=effect.category, title=effect.title,
            tests=list(candidate.tests or ()) if candidate.mark else [], parameters=numbers,
            acts_in=find_regions_of_largest_force_change(each.proposal, before))
    return list(found.values())


def list_fitted_parameters_of_candidate(candidate: Candidate, evidence: FitEvidence) -> list[EffectParameter]:
    """Return the fitted parameters of a candidate with their standard errors."""
    space = evidence.problem.space
    spread = compute_marginal_uncertainty(evidence.problem, evidence.evaluation)
    errors = dict(zip(space.free, spread.standard_errors, strict=True))
    mine = {**candidate.sizes, **candidate.shape}
    numbers = []
    for each in space.unknowns:
        if each.path not in mine:
            continue
        error = float(errors.get(each.name, 0.0))
        absent = candidate.find_value_without_effect(evidence.campaign, each.path) \
            if each.path in candidate.sizes else None
        bound = find_reached_bound_value_or_none(space, evidence.estimate.theta, each.name, absent,
                                                 evidence.refit_settings.on_bound)
        numbers.append(EffectParameter(path=each.name, symbol=space.symbols[each.name], unit=each.declaration.unit,
                                       value=evidence.parameter_values[each.name], absent=absent, bound=bound,
                                       standard_error=error if np.isfinite(error) else None))
    return numbers


def list_candidate_results(proposals: CatalogueScores, judgement: VerdictWithFits,
                           before: FitEvidence) -> list[CandidateResult]:
    """Return the records of all candidates: fitted by BIC, then testable ones by score, then untestable effects."""
    refits = {each.candidate_name: each for each in judgement.refits}
    best = judgement.refits[0] if judgement.refits else None
    rows = [_make_testable_candidate_result(name, proposal, proposals, refits.get(name), best, before)
            for name, proposal in proposals.best_variant_by_candidate_name.items()]
    rows.sort(key=lambda row: (row.delta_BIC is None, -(row.delta_BIC or 0.0)))
    for name, reason in proposals.untestable.items():
        effect = proposals.effects[name.partition("@")[0]]
        rows.append(CandidateResult(name=name, effect=effect.name, category=effect.category, title=effect.title,
                                    testable=False, reason=reason, separated_by=effect.separated_by))
    return rows


def _make_testable_candidate_result(name: str, proposal: ScoredCandidate, proposals: CatalogueScores,
                                    fitted: EffectRefit | None,
                                    best: EffectRefit | None, before: FitEvidence) -> CandidateResult:
    """Return the record of a testable candidate: detectable size, score and, after a fit, its parameters."""
    effect, finite = proposal.candidate.effect, fitted is not None and np.isfinite(fitted.gain)
    # The detectable size refers to the shape parameters with the highest expected score.
    mine = [each for each in proposals.all if each.candidate.name == name]
    clearest = max(mine, key=lambda each: each.direction.reach)
    smallest = clearest.compute_effect_parameter_values(before.limits.detectable_score / clearest.direction.reach)
    after = fitted.make_evidence(before) if fitted is not None and finite else None
    prepared = clearest.candidate.make_campaign_with_prepared_tests(before.campaign)
    symbols = clearest.candidate.make_symbols_by_path(before.campaign)
    return CandidateResult(
        name=name, effect=effect.name, category=effect.category, title=effect.title, testable=True, seen_from=smallest,
        symbols={path: symbols[path] for path in smallest}, absent=clearest.absent,
        units={path: clearest.candidate.find_parameter_declaration(prepared, path).unit for path in smallest},
        twins=proposals.find_names_of_indistinguishable_candidates(name), separated_by=effect.separated_by,
        score=proposal.signed_score, p=proposal.p, estimate=proposal.compute_effect_parameter_values(),
        refitted=fitted is not None, delta_BIC=float(fitted.gain) if fitted is not None and finite else None,
        explained_percent=None if after is None
        else 100.0 * compute_explained_misfit_fraction(before.region_misfit_tests, after.region_misfit_tests),
        evidence_ratio=compute_odds_of_best_over_other(best, fitted)
        if fitted is not None and best is not None and finite else None,
        parameters=[] if after is None else list_fitted_parameters_of_candidate(proposal.candidate, after),
        on_bound=[] if fitted is None
        else [fitted.problem.space.symbols[held] for held in fitted.reached_bounds_by_effect_parameter],
        note="" if fitted is None else fitted.failure)
