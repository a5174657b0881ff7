"""Two effects at once, each needed beside the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import Proposal, Proposals, beside, rescored
from calibration.diagnosis.refits import ODDS, Refit, odds, refit
from calibration.fit.run_context import RunContext
from calibration.statistics.scores import largest_cosine

#: Weakest evidence of a second effect: the Schwarz criterion must be better by this with both than with either, and
#: chance make any effect score so beside the first with less than this probability. Two effects together make almost
#: any gap smaller, and of fifty there are 1200 pairs: 2 ln 1200 against finding one among them, 2 ln 20 for its odds.
SECOND, SECOND_LEVEL = 20.0, 1e-3
#: Two effects act in different places where the cosine between their changes of the forces is less, and the second
#: shows alone this share of what it shows beside the first.
DIFFERENT, STEADY = 0.5, 0.5
#: Beside how many of the likeliest effects, and of those as likely as the best, a second one is sought; and how many
#: of the likeliest seconds are fitted.
_FIRSTS, _MOST_FIRSTS, _SECONDS = 2, 3, 3


@dataclass(frozen=True, eq=False)
class Pair:
    """Two effects.

    Attributes:
        first: the fit with one alone. second: that with both. beside: the evidence with the first.
    """

    first: Refit
    second: Refit
    beside: Evidence

    @property
    def gain(self) -> float:
        """Of the Schwarz criterion against the fit without either."""
        return self.first.gain + self.second.gain


def pairs_of(evidence: Evidence, good: Sequence[Refit], proposals: Proposals, context: RunContext) -> list[Pair]:
    """Pairs that are as likely as the best, it first; empty where one effect is enough.

    Args:
        evidence: without any effect. good: fits with one, best first. proposals: the catalogue on `evidence`.
    """
    found: list[Pair] = []
    firsts = [first for number, first in enumerate(good[:_MOST_FIRSTS])
              if number < _FIRSTS or odds(good[0], first) < ODDS]
    for first in firsts:
        with_first = first.evidence(evidence)
        others = beside(proposals, with_first, [first.name])
        # A number can be in the model once.
        likely = [name for name, each in others.seen.items() if each.p <= SECOND_LEVEL
                  and not each.candidate.paths & first.proposal.candidate.paths][:_SECONDS]
        fits = refit(with_first, others, context, f"fits beside {first.proposal.candidate.effect.title}",
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
    """Whether what either leaves without the other is as much worse, and they act in different places: two that change
    the forces alike would explain by their difference what neither explains."""
    alone = next((each for each in good if each.name == second.name), None)
    if alone is not None and alone.gain > first.gain + second.gain - SECOND:
        return False
    alone_it_shows, beside_first = rescored(second.proposal, evidence), second.proposal.strength
    if not alone_it_shows.direction.freedom or alone_it_shows.strength * beside_first < STEADY * beside_first**2:
        return False
    return largest_cosine(first.proposal.direction, alone_it_shows.direction) < DIFFERENT


def acts_in(proposal: Proposal, evidence: Evidence, most: int = 2) -> list[str]:
    """Test and segment in which an effect moves the force most beyond what the fit takes up, at most so many."""
    weights: dict[str, float] = {}
    moved = np.sum(proposal.direction.basis**2, axis=1)
    for rows, curve in zip(evidence.problem.rows, evidence.problem.measured, strict=True):
        segments = curve.segment if curve.segment is not None else np.full(curve.force.size, "ramp")
        for name in dict.fromkeys(segments.tolist()):
            place = f"{curve.test.name} ({name})"
            weights[place] = weights.get(place, 0.0) + float(moved[rows][segments == name].sum())
    ranked = sorted(weights, key=lambda place: -weights[place])
    return [place for place in ranked[:most] if weights[place] >= 0.3 * weights[ranked[0]]]
