"""Verdict of a diagnosis from the fits with effects: NAMED, SET, LOOKS_LIKE, UNKNOWN or NONE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.confirmation import refit_with_updated_corrections
from calibration.diagnosis.diagnosis import Verdict
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.pairs import find_required_effect_pairs
from calibration.diagnosis.proposals import CatalogueScores, recompute_all_scores, score_effects
from calibration.diagnosis.refits import EffectRefit, compute_odds_of_best_over_other, fit_best_scored_effects
from calibration.fit.fit import RegionMisfitTest
from calibration.fit.run_context import RunContext


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
