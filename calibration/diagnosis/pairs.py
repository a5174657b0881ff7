"""Pairs of effects that are both required to explain a misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import Proposal, Proposals, rescore, rescore_all
from calibration.diagnosis.refits import ODDS, Refit, odds, refit
from calibration.fit.run_context import RunContext
from calibration.statistics.scores import largest_cosine

#: Smallest decrease of BIC by a second effect. Two effects reduce almost any misfit, and 50 effects form 1200 pairs: 2
#: ln 1200 corrects for the choice of a pair, and 2 ln 20 gives odds of 20.
SECOND = 20.0
#: Largest family-wise p value of a second effect in a fit with the first one.
SECOND_LEVEL = 1e-3
#: Largest cosine between the changes of the forces by two effects that count as different.
DIFFERENT = 0.5
#: Smallest ratio of the score of the second effect alone to its score in the fit with the first effect.
MIN_SCORE_RATIO = 0.5
#: Number of first effects that are combined with a second one.
_FIRSTS = 2
#: Largest number of first effects if further ones are as likely as the best.
_MAX_FIRSTS = 3
#: Number of second effects that are fitted for each first effect.
_SECONDS = 3


@dataclass(frozen=True, eq=False)
class Pair:
    """Two effects.

    Attributes:
        first: fit with the first effect.
        second: fit with both effects.
        with_first: evidence with the first effect.
    """

    first: Refit
    second: Refit
    with_first: Evidence

    @property
    def gain(self) -> float:
        """Decrease of BIC by both effects."""
        return self.first.gain + self.second.gain


def find_pairs(evidence: Evidence, good: Sequence[Refit], proposals: Proposals, context: RunContext) -> list[Pair]:
    """Return pairs of effects that are as likely as the best pair, best first; empty if one effect suffices.

    Args:
        evidence: fit without effects.
        good: fits with one effect, best first.
        proposals: scores of all effects.
        context: workers and listeners.
    """
    found: list[Pair] = []
    firsts = [first for number, first in enumerate(good[:_MAX_FIRSTS])
              if number < _FIRSTS or odds(good[0], first) < ODDS]
    for first in firsts:
        with_first = first.evidence(evidence)
        others = rescore_all(proposals, with_first, [first.name])
        # Two effects with a common parameter cannot be combined.
        likely = [name for name, each in others.seen.items() if each.p <= SECOND_LEVEL
                  and not each.candidate.paths & first.proposal.candidate.paths][:_SECONDS]
        fits = refit(with_first, others, context, f"fits with {first.proposal.candidate.effect.title}",
                     likely) if likely else []
        found += [Pair(first, second, with_first) for second in fits if second.gain >= SECOND
                  and not second.absent and not second.beyond and _both_needed(first, second, good, evidence)]
    found.sort(key=lambda pair: -pair.gain)
    kept: dict[frozenset[str], Pair] = {}
    for pair in found:
        if 0.5 * (found[0].gain - pair.gain) < np.log(ODDS):
            kept.setdefault(frozenset((pair.first.name, pair.second.name)), pair)
    return list(kept.values())


def _both_needed(first: Refit, second: Refit, good: Sequence[Refit], evidence: Evidence) -> bool:
    """Return whether both effects of a pair are required and change the forces differently.

    Two effects with similar changes of the forces could explain a misfit by the difference of their changes, although
    neither acts.

    Args:
        first: fit with the first effect.
        second: fit with both effects.
        good: fits with one effect.
        evidence: fit without effects.
    """
    alone = next((each for each in good if each.name == second.name), None)
    if alone is not None and alone.gain > first.gain + second.gain - SECOND:
        return False
    single, score_with_first = rescore(second.proposal, evidence), second.proposal.strength
    if not single.direction.freedom or single.strength * score_with_first < MIN_SCORE_RATIO * score_with_first**2:
        return False
    return largest_cosine(first.proposal.direction, single.direction) < DIFFERENT


def acts_in(proposal: Proposal, evidence: Evidence, most: int = 2) -> list[str]:
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
