"""Which effects these tests could show, which of them the data show, and which are twins here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.extended import change_of
from calibration.effects.catalogue import CATALOGUE
from calibration.effects.effect import Candidate, Effect, NotTestableError
from calibration.fit.run_context import RunContext
from calibration.statistics.scores import Direction, familywise_p_values, largest_cosine

#: An effect is seen where chance alone makes any of the catalogue score as it does with less than this probability.
LEVEL = 0.01
#: Deviations at which a size is seen in nine of ten data sets: that of the level with a catalogue of this size, and
#: 1.28 more.
SEEN = 4.3 + 1.28
#: Below this share of a change that the fit leaves, it is tried at half its size too.
_BENT = 0.05
#: A jump is sought from this part of the largest displacement on, to this one.
_COARSEST, _FINEST = 0.05, 0.002
#: Directions of which this share is the same are twins.
TWINS = 0.97


@dataclass(frozen=True, eq=False)
class Proposal:
    """A candidate and its direction in the data.

    Attributes:
        candidate: what it is. change: of the whitened samples by it, shape (N, q).
        direction: see `Direction`. score: deviations along it, shape (q,).
        p: that chance alone makes any candidate as improbable. absent: path -> value at which it is absent.
    """

    candidate: Candidate
    change: np.ndarray
    direction: Direction
    score: np.ndarray
    p: float
    absent: dict[str, float]

    @property
    def strength(self) -> float:
        """Deviations that the data show, with the sign of the effect where it has one number."""
        return float(self.score[0]) if self.direction.freedom == 1 else float(np.linalg.norm(self.score))

    @property
    def factor(self) -> float:
        """Size by the score, in units of the size at which it was tried."""
        return self.strength / self.direction.reach if self.direction.reach else 0.0

    @cached_property
    def improbability(self) -> float:
        """Logarithm of the probability of its score alone; the less the more telling, without a floor."""
        squares = float(np.sum(self.score**2))
        if self.direction.positive and self.direction.freedom == 1 and self.strength < 0:
            return 0.0
        return -0.5 * squares

    def sizes(self, factor: float | None = None) -> dict[str, float]:
        """Path -> value of its numbers at a multiple of the size at which it was tried; None: by the score."""
        return self.candidate.scaled_sizes(self.absent, self.factor if factor is None else factor)


@dataclass(frozen=True, eq=False)
class Proposals:
    """The catalogue, held against the data.

    Attributes:
        all: candidates that these tests could show. silent: name -> why they cannot, of the other effects.
        effects: name -> effect, of the whole catalogue.
    """

    all: tuple[Proposal, ...]
    silent: dict[str, str]
    effects: dict[str, Effect]

    @cached_property
    def best(self) -> dict[str, Proposal]:
        """Name -> the candidate of an effect that the data show most, strongest first."""
        found: dict[str, Proposal] = {}
        for each in sorted(self.all, key=lambda one: one.improbability):
            found.setdefault(each.candidate.name, each)
        return found

    @property
    def seen(self) -> dict[str, Proposal]:
        """Name -> candidates that chance does not explain, strongest first."""
        return {name: each for name, each in self.best.items() if each.p <= LEVEL}

    @property
    def seen_in_words(self) -> list[str]:
        """``zero offset (8.1 standard deviations)`` of each of `seen`, strongest first."""
        return [f"{each.candidate.effect.title} ({abs(each.strength):.2g} standard deviations)"
                for each in self.seen.values()]

    def twins(self, name: str) -> list[str]:
        """Names of others whose direction here is the same but for a few per cent, the likest first."""
        mine = [each for each in self.all if each.candidate.name == name]
        found: dict[str, float] = {}
        for other in self.all:
            if other.candidate.effect.name != mine[0].candidate.effect.name:
                likeness = max(largest_cosine(one.direction, other.direction) for one in mine)
                found[other.candidate.name] = max(found.get(other.candidate.name, 0.0), likeness)
        return [other for other, likeness in sorted(found.items(), key=lambda pair: -pair[1]) if likeness > TWINS]


def propose(evidence: Evidence, context: RunContext, words: str = "effects, one at a time",
            only: str | None = None) -> Proposals:
    """Try every effect of the catalogue at a usual size, and score its direction.

    Args:
        evidence: at its minimum. steps: where the simulations run. words: for people.
        only: name of the only effect that is tried; None: all.
    """
    silent: dict[str, str] = {}
    effects: dict[str, Effect] = {}
    candidates: list[Candidate] = []
    for name, kind in CATALOGUE.items() if only is None else [(only, CATALOGUE[only])]:
        effects[name] = effect = kind()
        if effect.scales_all_forces and any(each.is_modulus for each in evidence.problem.space.varied):
            silent[name] = "no force tells it from the moduli"
            continue
        try:
            candidates += effect.candidates(evidence.situation)
        except NotTestableError as reason:
            silent[name] = str(reason)
    problem, evaluation = evidence.problem, evidence.evaluation
    changes = context.run_all(change_of, [(problem, evaluation, evidence.campaign, each) for each in candidates], words,
                           names=[each.title for each in candidates])
    columns = {number: change for number, change in enumerate(changes) if not isinstance(change, str)}
    failures = {candidates[number].name: change for number, change in enumerate(changes) if isinstance(change, str)}
    directions = {number: _direction(candidates[number], change, evidence) for number, change in columns.items()}
    # Where the fit takes nearly all of it up, what is left may be how the change bends with the size.
    bent = [number for number, direction in directions.items() if direction.reach < _BENT * direction.length]
    halves = context.run_all(change_of, [(problem, evaluation, evidence.campaign, candidates[number], 0.5)
                                      for number in bent], words,
                          names=[candidates[number].title for number in bent]) if bent else []
    for number, half in zip(bent, halves, strict=True):
        if not isinstance(half, str):
            columns[number] = 4.0 * half - columns[number]
            directions[number] = _direction(candidates[number], columns[number], evidence)
    for number, direction in directions.items():
        if not direction.freedom:
            failures[candidates[number].name] = "the other parameters take all of it up" \
                if direction.length > 1e-6 else "it changes nothing in these tests"
    proposals = _scored([(candidates[number], columns[number], direction) for number, direction in directions.items()],
                        evidence)
    shown = {each.candidate.name for each in proposals}
    silent |= {name: reason for name, reason in failures.items() if name not in shown}
    return Proposals(proposals, silent, effects)


def beside(proposals: Proposals, evidence: Evidence, known: Sequence[str]) -> Proposals:
    """The proposals held against a fit that has some effects: their changes hardly depend on these.

    Args:
        proposals: on the fit without them. evidence: with them. known: their names.
    """
    return replace(proposals, all=_scored([
        (each.candidate, each.change, _direction(each.candidate, each.change, evidence)) for each in proposals.all
        if each.candidate.name not in known], evidence))


def rescored(proposal: Proposal, evidence: Evidence) -> Proposal:
    """A proposal held against another fit; its probability stays."""
    direction = _direction(proposal.candidate, proposal.change, evidence)
    return replace(proposal, direction=direction, score=direction.score(evidence.residual))


def _scored(asked: Sequence[tuple[Candidate, np.ndarray, Direction]], evidence: Evidence) -> tuple[Proposal, ...]:
    """Proposals of those of which the fit leaves anything."""
    left = [(candidate, change, direction) for candidate, change, direction in asked if direction.freedom]
    directions = [direction for *_, direction in left]
    scores = [direction.score(evidence.residual) for direction in directions]
    return tuple(Proposal(candidate, change, direction, score, float(p), {
        path: candidate.absent_value(evidence.campaign, path) for path in candidate.sizes})
        for (candidate, change, direction), score, p in zip(
            left, scores, familywise_p_values(directions, scores), strict=True))


def sharpened(proposal: Proposal, evidence: Evidence) -> Proposal:
    """The proposal with its jump where the data show it most, to a sample; itself where the force does not jump.

    Its probability stays that of the grid.
    """
    candidate = proposal.candidate
    if not candidate.jump:
        return proposal
    curves = [curve for curve in evidence.problem.measured
              if candidate.tests is None or curve.test.name in candidate.tests]
    deepest = max(float(curve.displacement.max()) for curve in curves)
    step = _COARSEST * deepest
    while step > max(step_of(curves), _FINEST * deepest):
        step *= 0.5
        for way in (-step, step):
            place = float(np.clip(candidate.shape[candidate.jump] + way, *candidate.bounds.get(
                candidate.jump, (0.0, deepest))))
            other = replace(candidate, shape={**candidate.shape, candidate.jump: place})
            change = change_of(evidence.problem, evidence.evaluation, evidence.campaign, other)
            if isinstance(change, str):
                continue
            found = rescored(replace(proposal, candidate=other, change=change), evidence)
            if found.direction.freedom and found.improbability < proposal.improbability:
                proposal = found
        candidate = proposal.candidate
    return proposal


def step_of(curves: Sequence[MeasuredCurve]) -> float:
    """How far a tool goes from sample to sample in the finest of some recordings, m."""
    return min(float(np.median(np.abs(np.diff(curve.displacement[curve.displacement > 0])))) for curve in curves)


def _direction(candidate: Candidate, change: np.ndarray, evidence: Evidence) -> Direction:
    rows = evidence.residual.size - evidence.problem.samples
    columns = np.vstack([change, np.zeros((rows, change.shape[1]))])
    return Direction.project(columns, evidence.fitted, positive=_one_sided(candidate, evidence))


def _one_sided(candidate: Candidate, evidence: Evidence) -> bool:
    """Whether its number can only lie on one side of where it is absent."""
    if len(candidate.sizes) != 1:
        return False
    (path, size), = candidate.sizes.items()
    absent = candidate.absent_value(evidence.campaign, path)
    prepared = candidate.with_prepared_tests(evidence.campaign)
    low, high = candidate.bounds.get(path, candidate.declaration(prepared, path).bounds)
    return (low >= absent - 1e-12 * abs(absent)) if size > absent else (high <= absent + 1e-12 * abs(absent))
