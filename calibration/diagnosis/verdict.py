"""From refits to a verdict: named, a set, looks like, unknown, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.diagnosis.confirmation import settled
from calibration.diagnosis.diagnosis import Verdict
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import LEVEL, Proposals, propose
from calibration.diagnosis.refits import LEAST_GAIN, ODDS, Refit, refit
from calibration.fit.fit import Region
from calibration.fit.steps import Steps

#: An effect whose form is not confirmed explains at least this share of the gap.
MOSTLY = 0.9
#: What is left is far from chance where chance makes it in any region with less than this probability.
FAR = 1e-4
#: Weakest evidence of a second effect: the Schwarz criterion must be better by this with both than with either.
SECOND = 10.0


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


def judge(evidence: Evidence, proposals: Proposals, steps: Steps) -> Judgement:
    """Fit what the data show, and say what can be said.

    Args:
        evidence: without any effect. proposals: the catalogue on it.
    """
    if not proposals.seen and evidence.adequate:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", [], (), [], evidence)
    refits = refit(evidence, proposals, steps)
    sound = [each for each in refits if not each.absent and not each.beyond]
    good = [each for each in sound if each.gain >= LEAST_GAIN
            and (each.proposal.p <= LEVEL or not evidence.adequate)]
    if not good:
        return Judgement("NONE" if evidence.explained else "UNKNOWN", refits, (), [], evidence)
    best = good[0]
    added, after = _as_often_as_needed(best, evidence, steps)
    if not after.adequate:
        pair = _pair(evidence, good, proposals, steps)
        if pair is not None:
            first, second, both = pair
            together = settled(second.evidence(both))
            words: Verdict = "NAMED" if together.explained else "LOOKS_LIKE"
            return Judgement(words, refits, (first, second), [first.name, second.name], together)
        # Of a gap that is little more than noise a share means little.
        far = min(region.p for region in after.regions) < FAR or after.repeated
        if far and share_explained(evidence.regions, after.regions) < MOSTLY:
            return Judgement("UNKNOWN", refits, (), [], evidence)
    if after.repeated and share_repeated(evidence, after) < MOSTLY:
        return Judgement("UNKNOWN", refits, (), [], evidence)
    # What is as likely as the best counts, though alone it would be too little to be told from nothing.
    possible = [each for each in sound if odds(best, each) < ODDS]
    names = list(dict.fromkeys([*(each.name for each in possible), *_twins(best, proposals)]))
    if len(names) > 1:
        return Judgement("SET", refits, added, names, after)
    return Judgement("NAMED" if after.explained else "LOOKS_LIKE", refits, added, names, after)


def _as_often_as_needed(best: Refit, evidence: Evidence, steps: Steps) -> tuple[tuple[Refit, ...], Evidence]:
    """The best effect, and more terms of it while they are needed and can be seen."""
    effect, added = best.proposal.candidate.effect, [best]
    after = settled(best.evidence(evidence))
    while not after.adequate and len(added) < effect.times:
        more = propose(after, steps, f"more of {effect.title}", only=effect.name)
        fits = refit(after, more, steps, f"fits with more of {effect.title}", list(more.seen)[:1])
        if not fits or fits[0].gain < LEAST_GAIN or fits[0].absent:
            break
        added.append(fits[0])
        after = settled(fits[0].evidence(after))
    return tuple(added), after


def odds(best: Refit, other: Refit) -> float:
    """Of one fit against another, by the Schwarz criterion."""
    return float(np.exp(min(0.5 * (best.gain - other.gain), 700.0)))


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


def _pair(evidence: Evidence, good: Sequence[Refit], proposals: Proposals, steps: Steps
          ) -> tuple[Refit, Refit, Evidence] | None:
    """Two effects of which each is needed beside the other, where one alone leaves a gap.

    Returns:
        The fit with the first, the fit with both, and the evidence with the first.
    """
    found: list[tuple[float, Refit, Refit, Evidence]] = []
    for first in good[:2]:
        with_first = first.evidence(evidence)
        others = propose(with_first, steps, f"effects beside {first.proposal.candidate.effect.title}",
                         known=[first.name])
        if not others.seen:
            continue
        both = [each for each in refit(with_first, others, steps, "fits with two effects", list(others.seen)[:3])
                if each.gain >= SECOND and not each.absent]
        if not both:
            continue
        second = both[0]
        # Without the first, what the second leaves must be as much worse.
        alone = next((each for each in good if each.name == second.name), None)
        if alone is not None and alone.gain > first.gain + second.gain - SECOND:
            continue
        if acts_in(first.proposal, evidence)[:1] == acts_in(second.proposal, evidence)[:1]:
            continue
        found.append((first.gain + second.gain, first, second, with_first))
    if not found:
        return None
    _, first, second, with_first = max(found, key=lambda each: each[0])
    return first, second, with_first


def acts_in(proposal, evidence: Evidence, most: int = 2) -> list[str]:
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
