"""Verdict of a diagnosis from the fits with effects: NAMED, SET, LOOKS_LIKE, UNKNOWN or NONE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.confirmation import update_corrections
from calibration.diagnosis.diagnosis import Verdict
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.pairs import find_pairs
from calibration.diagnosis.proposals import CatalogueScores, rescore_all, score_effects
from calibration.diagnosis.refits import Refit, fit_effects, odds
from calibration.fit.fit import Region
from calibration.fit.run_context import RunContext


@dataclass(frozen=True, eq=False)
class Judgement:
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
    refits: list[Refit]
    added: tuple[Refit, ...]
    indistinguishable: list[str]
    evidence: Evidence


def decide_verdict(evidence: Evidence, proposals: CatalogueScores, context: RunContext) -> Judgement:
    """Fit the significant effects and derive the verdict.

    Args:
        evidence: fit without effects.
        proposals: scores of all effects.
        context: workers and listeners.
    """
    if not proposals.significant and evidence.adequate:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", [], (), [], evidence)
    limits = evidence.limits
    refits = fit_effects(evidence, proposals, context)
    sound = [each for each in refits if not each.is_absent and not each.is_at_bound]
    good = [each for each in sound if each.gain >= limits.min_gain
            and (each.proposal.p <= limits.effect_level or not evidence.adequate)]
    if not good:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", refits, (), [], evidence)
    best = good[0]
    rivals = (each.gain for each in good if each.proposal.candidate.effect.name != best.proposal.candidate.effect.name)
    has_rival = next(rivals, 0.0) >= limits.rival_gain_ratio * best.gain
    needed = limits.explained_fraction if has_rival else limits.explained_without_rival
    added, after = _add_instances(best, evidence, context)
    rest = rescore_all(proposals, after, [best.name]).significant
    if rest or not after.adequate:
        pairs = find_pairs(evidence, good, proposals, context)
        if pairs and pairs[0].gain > sum(each.gain for each in added) + limits.min_pair_gain:
            together = update_corrections(pairs[0].second.evidence(pairs[0].with_first))
            # A pair is accepted only if it explains the whole misfit.
            if together.explained:
                names = list(dict.fromkeys(name for pair in pairs for name in (pair.first.name, pair.second.name)))
                return Judgement("SET" if len(names) > 2 else "NAMED", refits, (pairs[0].first, pairs[0].second),
                                 names, together)
        # The explained fraction is meaningful only if the remaining misfit is significant.
        far = min(region.p for region in after.regions) < limits.clear_misfit_level or after.tests_with_common_signal
        if far and explained_misfit_fraction(evidence.regions, after.regions) < needed:
            return Judgement("UNKNOWN", refits, (), [], evidence)
    # Decrease of BIC that the remaining scores predict.
    gained = sum(each.gain for each in added)
    left = max((-2.0 * each.improbability - float(np.log(evidence.samples)) for each in rest.values()), default=0.0)
    left = max(left, 0.0)
    if left > (1.0 - limits.scored_fraction) * (gained + left):
        return Judgement("UNKNOWN", refits, (), [], evidence)
    if after.tests_with_common_signal and explained_common_signal(evidence, after) < needed:
        return Judgement("UNKNOWN", refits, (), [], evidence)
    # Candidates as likely as the best one belong to the set even if their own decrease of BIC is insignificant.
    possible = [each for each in sound if odds(best, each) < limits.odds]
    names = list(dict.fromkeys([*(each.name for each in possible), *_list_known_twins(best, proposals)]))
    if len(names) > 1:
        return Judgement("SET", refits, added, names, after)
    alone = after.explained and left <= (1.0 - limits.explained_fraction) * (gained + left)
    return Judgement("NAMED" if alone else "LOOKS_LIKE", refits, added, names, after)


def _add_instances(best: Refit, evidence: Evidence, context: RunContext) -> tuple[tuple[Refit, ...], Evidence]:
    """Add further instances of the best effect, such as Prony terms, while the residuals require them.

    Returns:
        Fits with one, two, ... instances, and the final evidence.
    """
    effect, added = best.proposal.candidate.effect, [best]
    after = update_corrections(best.evidence(evidence))
    while not after.adequate and len(added) < effect.max_instances:
        more = score_effects(after, context, f"more of {effect.title}", only=effect.name)
        fits = fit_effects(after, more, context, f"fits with more of {effect.title}", list(more.significant)[:1])
        if not fits or fits[0].gain < evidence.limits.min_gain or fits[0].is_absent:
            break
        added.append(fits[0])
        after = update_corrections(fits[0].evidence(after))
    return tuple(added), after


def explained_misfit_fraction(before: Sequence[Region], after: Sequence[Region]) -> float:
    """Return the explained fraction of the misfit: relative decrease of the excess of chi-square over its expectation.

    Args:
        before: regions without effects.
        after: regions with effects.
    """
    def excess(regions: Sequence[Region]) -> float:
        return sum(max(region.statistic - region.freedom, 0.0) for region in regions)

    first = excess(before)
    return 1.0 - excess(after) / first if first > 0 else 0.0


def explained_common_signal(before: Evidence, after: Evidence) -> float:
    """Return the explained fraction of the common signal of recordings, from the excess of the variance ratios.

    Args:
        before: fit without effects.
        after: fit with effects.
    """
    def excess(evidence: Evidence) -> float:
        return sum(max(ratio - 1.0, 0.0) * freedom for ratio, freedom, _ in evidence.coherence.values())

    first = excess(before)
    return 1.0 - excess(after) / first if first > 0 else 0.0


def _list_known_twins(best: Refit, proposals: CatalogueScores) -> list[str]:
    """Return the known twins of the best effect (`Effect.known_twins`) that are indistinguishable in these tests."""
    known = best.proposal.candidate.effect.known_twins
    return [name for name in proposals.twins(best.name) if name.partition("@")[0] in known]
