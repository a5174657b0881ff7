"""Pairs of effects that are both required to explain a misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import (
    CatalogueScores,
    ScoredCandidate,
    recompute_all_scores,
    recompute_candidate_score_in_other_fit,
)
from calibration.diagnosis.refits import EffectRefit, compute_odds_of_best_over_other, fit_best_scored_effects
from calibration.fit.run_context import RunContext
from calibration.statistics.scores import compute_largest_principal_cosine


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


_SETTINGS = PairSearchSettings()


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
    firsts = [first for number, first in enumerate(good[:_SETTINGS.max_first_effects])
              if number < _SETTINGS.first_effects or compute_odds_of_best_over_other(good[0], first) < limits.odds]
    for first in firsts:
        with_first = first.make_evidence(evidence)
        others = recompute_all_scores(proposals, with_first, [first.candidate_name])
        # Two effects with a common parameter cannot be combined.
        likely = [name for name, each in others.significant_candidates.items() if each.p <= limits.pair_level
                  and not each.candidate.parameter_paths & first.proposal.candidate.parameter_paths
                  ][:_SETTINGS.second_effects]
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
