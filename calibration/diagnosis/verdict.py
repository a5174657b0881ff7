"""From refits to a verdict: named, a set, looks like, unknown, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.confirmation import settled
from calibration.diagnosis.diagnosis import Verdict
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.pairs import SECOND, pairs_of
from calibration.diagnosis.proposals import LEVEL, Proposals, beside, propose
from calibration.diagnosis.refits import LEAST_GAIN, ODDS, Refit, odds, refit
from calibration.fit.fit import Region
from calibration.fit.run_context import RunContext

#: An effect whose form is not confirmed explains at least this share of the gap, or the lesser one where every other
#: effect gains no more than so much of what it does: two that explain alike much of a gap explain nothing.
NEARLY_ALL, MOSTLY, RIVALLED = 0.9, 0.8, 0.75
#: An effect beside which scores show another is the likeliest explanation where it gains this share of what both do.
MOST_SCORED = 0.7
#: What is left is far from chance where chance makes it in any region with less than this probability.
FAR = 1e-4


@dataclass(frozen=True, eq=False)
class Judgement:
    """What explains the gap.

    Attributes:
        verdict: in one word. refits: fits with one effect, best first. added: fits that go on, each with what the ones
            before have: of one effect, of the same once more, or of a second one; empty where nothing is added.
        indistinguishable: names that explain the gap as well. evidence: at the end: with what was added, its jitter
            and its mesh corrections, or the plain one.
    """

    verdict: Verdict
    refits: list[Refit]
    added: tuple[Refit, ...]
    indistinguishable: list[str]
    evidence: Evidence


def judge(evidence: Evidence, proposals: Proposals, context: RunContext) -> Judgement:
    """Fit what the data show, and say what can be said.

    Args:
        evidence: without any effect. proposals: the catalogue on it.
    """
    if not proposals.seen and evidence.adequate:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", [], (), [], evidence)
    refits = refit(evidence, proposals, context)
    sound = [each for each in refits if not each.absent and not each.beyond]
    good = [each for each in sound if each.gain >= LEAST_GAIN
            and (each.proposal.p <= LEVEL or not evidence.adequate)]
    if not good:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", refits, (), [], evidence)
    best = good[0]
    rivals = (each.gain for each in good if each.proposal.candidate.effect.name != best.proposal.candidate.effect.name)
    needed = MOSTLY if next(rivals, 0.0) < RIVALLED * best.gain else NEARLY_ALL
    added, after = _as_often_as_needed(best, evidence, context)
    rest = beside(proposals, after, [best.name]).seen
    if rest or not after.adequate:
        pairs = pairs_of(evidence, good, proposals, context)
        if pairs and pairs[0].gain > sum(each.gain for each in added) + SECOND:
            together = settled(pairs[0].second.evidence(pairs[0].beside))
            # Two effects whose form is not confirmed could be anything.
            if together.explained:
                names = list(dict.fromkeys(name for pair in pairs for name in (pair.first.name, pair.second.name)))
                return Judgement("SET" if len(names) > 2 else "NAMED", refits, (pairs[0].first, pairs[0].second),
                                 names, together)
        # Of a gap that is little more than noise a share means little.
        far = min(region.p for region in after.regions) < FAR or after.repeated
        if far and share_explained(evidence.regions, after.regions) < needed:
            return Judgement("UNKNOWN", refits, (), [], evidence)
    # What scores still show, beside what was gained.
    gained = sum(each.gain for each in added)
    left = max((-2.0 * each.improbability - float(np.log(evidence.samples)) for each in rest.values()), default=0.0)
    left = max(left, 0.0)
    if left > (1.0 - MOST_SCORED) * (gained + left):
        return Judgement("UNKNOWN", refits, (), [], evidence)
    if after.repeated and share_repeated(evidence, after) < needed:
        return Judgement("UNKNOWN", refits, (), [], evidence)
    # What is as likely as the best counts, though alone it would be too little to be told from nothing.
    possible = [each for each in sound if odds(best, each) < ODDS]
    names = list(dict.fromkeys([*(each.name for each in possible), *_twins(best, proposals)]))
    if len(names) > 1:
        return Judgement("SET", refits, added, names, after)
    alone = after.explained and left <= (1.0 - NEARLY_ALL) * (gained + left)
    return Judgement("NAMED" if alone else "LOOKS_LIKE", refits, added, names, after)


def _as_often_as_needed(best: Refit, evidence: Evidence, context: RunContext) -> tuple[tuple[Refit, ...], Evidence]:
    """The best effect, and more terms of it while they are needed and can be seen."""
    effect, added = best.proposal.candidate.effect, [best]
    after = settled(best.evidence(evidence))
    while not after.adequate and len(added) < effect.max_instances:
        more = propose(after, context, f"more of {effect.title}", only=effect.name)
        fits = refit(after, more, context, f"fits with more of {effect.title}", list(more.seen)[:1])
        if not fits or fits[0].gain < LEAST_GAIN or fits[0].absent:
            break
        added.append(fits[0])
        after = settled(fits[0].evidence(after))
    return tuple(added), after


def share_explained(before: Sequence[Region], after: Sequence[Region]) -> float:
    """Of the gap: the share of what the regions show beyond chance that is gone."""
    def beyond(regions: Sequence[Region]) -> float:
        return sum(max(region.statistic - region.freedom, 0.0) for region in regions)

    first = beyond(before)
    return 1.0 - beyond(after) / first if first > 0 else 0.0


def share_repeated(before: Evidence, after: Evidence) -> float:
    """Of what recordings leave behind in common: the share of it that is gone."""
    def beyond(evidence: Evidence) -> float:
        return sum(max(ratio - 1.0, 0.0) * freedom for ratio, freedom, _ in evidence.coherence.values())

    first = beyond(before)
    return 1.0 - beyond(after) / first if first > 0 else 0.0


def _twins(best: Refit, proposals: Proposals) -> list[str]:
    """What no force and displacement tell from it, as the catalogue says, where it is so in these tests."""
    known = best.proposal.candidate.effect.known_twins
    return [name for name in proposals.twins(best.name) if name.partition("@")[0] in known]
