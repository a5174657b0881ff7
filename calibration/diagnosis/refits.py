"""Full fits with an effect: is it as good as its score says, with the finite elements and all parameters free?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.parameter_space import ParameterSpace
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.extended import extend, unknowns
from calibration.diagnosis.proposals import Proposal, Proposals, sharpened, step_of
from calibration.effects.effect import Candidate, NotTestableError
from calibration.fit.estimate import Estimate
from calibration.fit.problem import Problem
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import Descent, descend
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS
from tissue_sim.errors import InputError

#: How many effects are fitted, and at most where the scores of more are this near to the best; and from which value of
#: what means nothing in their absence beside the likeliest: the next one, where its score is as good but for so much in
#: its square.
MOST, MOST_ALIKE, ALIKE, AS_GOOD = 6, 10, 0.9, 20.0
#: Odds against an effect from which on it is no longer held for possible.
ODDS = 20.0
#: A gain of the Schwarz criterion below this is none: no effect at all is held against one by the same odds.
LEAST_GAIN = 2.0 * float(np.log(ODDS))
#: An effect is fitted where its score alone would gain this share of the least gain.
_PROMISING = 0.6
#: And where its score is less by no more than this in its square than the best one.
_RIVALS = 8.0
#: The mesh corrections of a fit with an effect are its own where its gain is this near to the best, as a share of that,
#: and in any case within so much.
_NEAR, _NEAR_AT_LEAST = 0.3, 40.0
#: A fit that lowers the sum of squares by so much less than its score promises goes on.
_SHORT = 1.0
#: A number this near to its bound, relative to the way between them or to itself, is on it.
_ON_BOUND = 1e-4
#: Shares of the size that the score says, from which a fit starts: the first that is better than no effect at all.
_STARTS = (1.0, 0.3, 0.1)
#: A jump is sought anew after a fit, which may have moved the contacts: so many steps between samples to either side,
#: and as often as it moves, but so many times at most.
_SOUGHT, _AGAIN = (0.25, 0.5, 1.0, 2.0), 3
#: Fits are compared by their sums of squares, which these ends of a descent tell to far less than matters.
_ENOUGH, _TOLERANCE = 0.1, 2e-5
#: A fit goes on while so many solves together gain more than that.
_PATIENT = 4


@dataclass(frozen=True, eq=False)
class Refit:
    """The minimum with an effect.

    Attributes:
        proposal: what was added. problem, campaign: with it. theta: free parameters at the minimum; estimate of the
            plain problem where it failed. error: sum of squares, infinite where no simulation got through.
        gain: of the Schwarz criterion against the fit without it. failure: why there is none.
    """

    proposal: Proposal
    problem: Problem
    campaign: Campaign
    theta: np.ndarray
    error: float
    gain: float
    failure: str = ""

    @property
    def name(self) -> str:
        return self.proposal.candidate.name

    @property
    def numbers(self) -> dict[str, float]:
        """Name among the parameters -> value, SI, of the numbers of the effect."""
        candidate, space = self.proposal.candidate, self.problem.space
        mine = {**candidate.sizes, **candidate.shape}
        values = space.values(self.theta)
        return {each.name: values[each.name] for each in space.unknowns if each.path in mine}

    @property
    def bounds_met(self) -> dict[str, float]:
        """Name -> bound, SI, of its numbers that ended on a bound which is not that of its absence."""
        absent = {name: self.proposal.absent.get(self.problem.space.unknown(name).path) for name in self.numbers}
        met = {name: bound_met(self.problem.space, self.theta, name, there) for name, there in absent.items()}
        return {name: bound for name, bound in met.items() if bound is not None}

    @property
    def beyond(self) -> bool:
        """Whether a size of it ended on a bound, where it makes no physical sense any more."""
        return any(self.problem.space.unknown(name).path in self.proposal.candidate.sizes for name in self.bounds_met)

    @property
    def absent(self) -> bool:
        """Whether all of its sizes ended where it is absent."""
        values = self.numbers
        return all(abs(values[name] - self.proposal.absent[path]) <= 1e-6 * abs(size - self.proposal.absent[path])
                   for path, size in self.proposal.candidate.sizes.items()
                   for name in values if self.problem.space.unknown(name).path == path)

    def evidence(self, before: Evidence) -> Evidence:
        """As it would be if the effect had been in the campaign from the beginning; jitter and mesh as before."""
        estimate = Estimate(1, self.theta, self.error, True, "", (), {}, 0.0, problem=self.problem,
                            differences=before.estimate.differences, refreshes=before.estimate.refreshes)
        return Evidence(self.campaign, before.measured, estimate)


def bound_met(space: ParameterSpace, theta: np.ndarray, name: str, absent: float | None) -> float | None:
    """The bound, SI, that a number ended on and that is not the value at which it is absent; None: none, or held.

    Args:
        theta: free parameters at the minimum, shape (p,).
    """
    if name not in space.free:
        return None
    place = space.free.index(name)
    for bound in (space.low[place], space.high[place]):
        near = np.isfinite(bound) and abs(theta[place] - bound) <= _ON_BOUND * max(abs(bound), abs(theta[place]))
        if near and bound != absent:
            return float(bound)
    return None


def refit(evidence: Evidence, proposals: Proposals, context: RunContext, words: str = "fits with an effect",
          names: Sequence[str] | None = None) -> list[Refit]:
    """Fit the effects that the data show most, best first.

    Args:
        evidence: without them. proposals: the catalogue on it. names: of candidates; None: the `MOST` strongest.
    """
    telling = [(name, -2.0 * each.improbability) for name, each in proposals.best.items()]
    # Rivals of the best count, however little it is itself.
    promising = min(_PROMISING * (LEAST_GAIN + float(np.log(evidence.samples))), max(
        (squares for _, squares in telling), default=0.0) - _RIVALS)
    chosen = [name for number, (name, squares) in enumerate(telling[:MOST_ALIKE]) if squares > promising
              and (number < MOST or squares > ALIKE**2 * telling[0][1])] if names is None else list(names)
    # Tests that are homogeneous without an effect need no mesh error, with it they may: the determinant counts.
    error = evidence.estimate.error + evidence.evaluation.log_determinant
    tasks = []
    for name in chosen:
        ways = sorted((each for each in proposals.all if each.candidate.name == name),
                      key=lambda each: each.improbability)
        if ways[0].candidate.jump:
            ways = [sharpened(ways[0], evidence)]
        tasks += [(evidence.problem, evidence.campaign, way, evidence.values, error, evidence.samples)
                  for way in ways[:2] if way.improbability < ways[0].improbability + 0.5 * AS_GOOD]
    titles = [way.candidate.title for *_, way, _, _, _ in tasks]
    found = context.run_all(refit_one, tasks, words, names=titles) if tasks else []
    fits = [each for each in found if each is not None]
    best: dict[str, Refit] = {}
    for each in sorted(fits, key=lambda one: -one.gain):
        # Tasks of other processes come with copies of what has been simulated.
        each.problem.solves = evidence.problem.solves
        best.setdefault(each.name, each)
    if not best:
        return []
    limit = next(iter(best.values())).gain
    limit -= max(_NEAR * limit, _NEAR_AT_LEAST)
    near = [each for each in best.values() if each.gain >= limit]
    if len(near) > 1:
        # What the accurate mesh has more depends on the effect, and may decide between two that are alike.
        again = context.run_all(corrected, [(each, evidence.problem, error, evidence.samples) for each in near],
                             "their mesh corrections", names=[each.proposal.candidate.title for each in near])
        for each in again:
            each.problem.solves = evidence.problem.solves
            best[each.name] = each
    return sorted(best.values(), key=lambda one: -one.gain)


def odds(best: Refit, other: Refit) -> float:
    """Of one fit against another, by the Schwarz criterion."""
    return float(np.exp(min(0.5 * (best.gain - other.gain), 700.0)))


def corrected(fitted: Refit, plain: Problem, error: float, samples: float) -> Refit:
    """The fit with mesh corrections of its own; as it was where the accurate mesh does not get through."""
    problem = with_own_corrections(fitted.problem)
    try:
        for test in problem.tests:
            test.update_correction(problem.space, fitted.theta, problem.solves)
    except InfeasibleError:
        return fitted
    problem.mesh_error = tuple(mesh_uncertainty(test, ACCURATE_MESH_ERRORS) for test in problem.tests)
    problem.forget()
    descent = descend(problem, fitted.theta, corrected=True, enough=_ENOUGH, tolerance=_TOLERANCE)
    if not np.isfinite(descent.error):
        return fitted
    gain = error - _error_of(problem, descent) - _penalty(problem, plain, fitted.proposal.candidate, samples)
    return replace(fitted, problem=problem, theta=descent.theta, error=descent.error, gain=gain)


def with_own_corrections(problem: Problem) -> Problem:
    """A problem of its own, whose corrections and jitter may change without touching others."""
    tests = tuple(replace(test, correction=list(getattr(test, "correction", ()))) if hasattr(test, "correction")
                  else test for test in problem.tests)
    return Problem(problem.space, tests, problem.solves, problem.jitter, problem.mesh_error)


def refit_one(problem: Problem, campaign: Campaign, proposal: Proposal, values: Mapping[str, float], error: float,
              samples: float) -> Refit | None:
    """The minimum with one effect, from the size that its score says; None where no test has its numbers."""
    candidate = proposal.candidate
    prepared = candidate.with_prepared_tests(campaign)
    start = {}
    for path, size in proposal.sizes().items():
        low, high = candidate.bounds.get(path, candidate.declaration(prepared, path).bounds)
        absent, trial = proposal.absent[path], candidate.sizes[path]
        if proposal.direction.freedom > 1 or not np.isfinite(size):
            size = trial
        # Not beyond ten times the size of the trial, to where the linear score may point.
        away = np.clip(size - absent, -10 * abs(trial - absent), 10 * abs(trial - absent))
        inside = absent + away
        margin = 1e-3 * abs(trial - absent)
        start[path] = float(np.clip(inside, low + margin if np.isfinite(low) else low,
                                    high - margin if np.isfinite(high) else high))
    try:
        extended, changed = extend(problem, campaign, candidate, start, free=True)
    except (NotTestableError, InputError):
        return None
    theta = _near_enough(extended, [unknowns(extended.space, values, {**candidate.shape, **{
        path: proposal.absent[path] + share * (size - proposal.absent[path]) for path, size in start.items()}})
        for share in _STARTS], error)
    descent = descend(extended, theta, corrected=True, enough=_ENOUGH, tolerance=_TOLERANCE,
                      stalled=(_PATIENT, _ENOUGH))
    if not np.isfinite(descent.error):
        return Refit(proposal, extended, changed, descent.theta, descent.error, -np.inf, descent.failure)
    promised = -2.0 * proposal.improbability - (error - _error_of(extended, descent))
    if proposal.direction.freedom == 1 and promised > _SHORT:
        # Nearly dependent numbers: a step that gains little may be followed by one that gains more.
        again = descend(extended, descent.theta, corrected=True, enough=0.0, tolerance=_TOLERANCE,
                        stalled=(_PATIENT, _ENOUGH))
        descent = again if again.error < descent.error else descent
    for _ in range(_AGAIN if candidate.jump else 0):
        moved = _with_jump_moved(problem, campaign, proposal, extended, descent)
        if moved is None:
            break
        proposal, extended, changed, descent = moved
    gain = error - _error_of(extended, descent) - _penalty(extended, problem, candidate, samples)
    return Refit(proposal, extended, changed, descent.theta, descent.error, gain, descent.failure)


def _with_jump_moved(problem: Problem, campaign: Campaign, proposal: Proposal, extended: Problem, descent: Descent
                     ) -> tuple[Proposal, Problem, Campaign, Descent] | None:
    """The fit with its jump where it explains more, at the contacts that the fit has found; None: nowhere near by.

    Args:
        problem, campaign: without the effect. proposal: with the jump of the fit. extended: with the effect.
    """
    candidate, best = proposal.candidate, _error_of(extended, descent)
    curves = [curve for curve in problem.measured if candidate.tests is None or curve.test.name in candidate.tests]
    here = candidate.shape[candidate.jump]
    low, high = candidate.bounds.get(candidate.jump, (0.0, max(float(c.displacement.max()) for c in curves)))
    found = None
    for share in (sign * share for share in _SOUGHT for sign in (-1, 1)):
        other = replace(candidate, shape={**candidate.shape,
                                          candidate.jump: float(np.clip(here + share * step_of(curves), low, high))})
        moved, changed = extend(problem, campaign, other, free=True)
        try:
            evaluation = moved.evaluate(descent.theta)
        except InfeasibleError:
            continue
        if evaluation.error + evaluation.log_determinant < best - _ENOUGH:
            best, found = evaluation.error + evaluation.log_determinant, (replace(
                proposal, candidate=other), moved, changed)
    if found is None:
        return None
    again = descend(found[1], descent.theta, corrected=True, enough=_ENOUGH, tolerance=_TOLERANCE)
    return (*found, again) if np.isfinite(again.error) else None


def _error_of(problem: Problem, descent: Descent) -> float:
    """Sum of squares at the end of a descent, and the logarithm of the determinant of the covariance there."""
    return descent.error + problem.evaluate(descent.theta).log_determinant


def _penalty(problem: Problem, plain: Problem, candidate: Candidate, samples: float) -> float:
    """Of the Schwarz criterion, for the numbers that a problem has more than the plain one; a jump that was sought is
    one of them."""
    return (problem.space.low.size - plain.space.low.size + bool(candidate.jump)) * float(np.log(samples))


def _near_enough(problem: Problem, starts: Sequence[np.ndarray], error: float) -> np.ndarray:
    """The first start, each shape (p,), with a sum of squares that is no worse than this one; else the best."""
    errors = []
    for theta in starts:
        try:
            evaluation = problem.evaluate(theta)
            errors.append(evaluation.error + evaluation.log_determinant)
        except InfeasibleError:
            errors.append(np.inf)
        if errors[-1] <= error:
            break
    return starts[int(np.argmin(errors))]
