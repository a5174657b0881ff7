"""What a diagnosis stands on: the tests from contact to the end, fitted without any effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
from scipy import special

from calibration.campaign.campaign import Campaign, Noise
from calibration.campaign.measured import MeasuredCurve
from calibration.effects.effect import Situation
from calibration.fit.estimate import Estimate
from calibration.fit.fit import Region
from calibration.fit.generalised import Generalised
from calibration.fit.problem import Evaluation, Problem
from calibration.fit.regions import judge_regions
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import descend
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.adequacy import orthonormal_basis
from calibration.statistics.common_signal import CommonSignal, find_common_signal, variance_ratio
from calibration.statistics.jitter import Jitter
from tissue_sim.errors import ConvergenceError, InputError

#: A region disagrees where chance makes it, or any other of the tests, look so with less than this probability.
LEVEL = 0.005
#: Recordings leave the same behind where chance makes it in any test with less than this probability.
REPEATED = 1e-3
#: Samples of two recordings are at one place within this share of the largest displacement.
_SAME_PLACE = 0.005
#: The jitter between recordings is taken as large as it is with less than this probability.
_DOUBT = 0.2
Measured = Mapping[str, tuple[MeasuredCurve, ...]]


def whole_campaign(campaign: Campaign, law: str | None = None) -> Campaign:
    """The campaign with one law, whose holds and returns count.

    Raises:
        InputError: an analytical campaign, or a law that it does not list.
    """
    if campaign.fit.method != "inverse_fem":
        raise InputError('a diagnosis simulates the tests; set method = "inverse_fem"', file=campaign.path,
                         field="fit.method")
    if law is not None and law not in campaign.fit.laws:
        raise InputError(f"{law!r} is not among its laws ({', '.join(campaign.fit.laws)})", file=campaign.path,
                         field="fit.laws")
    # What comes after a force that falls is evidence: of a tear, a puncture, or a motor that lost steps.
    return replace(campaign, tests=tuple(
        replace(test, failure="keep") if test.failure == "cut" else test for test in campaign.tests),
                   fit=replace(campaign.fit, whole=True, laws=(law or campaign.fit.laws[0],)))


@dataclass(eq=False)
class Evidence:
    """A campaign at the minimum of its fit, and the residuals there.

    Attributes:
        campaign: with one law and whole recordings. measured: all recordings. estimate: the minimum.
    """

    campaign: Campaign
    measured: Measured
    estimate: Estimate

    @property
    def problem(self) -> Problem:
        return self.estimate.problem

    @property
    def law(self) -> str:
        return self.problem.space.law

    @cached_property
    def evaluation(self) -> Evaluation:
        return self.estimate.evaluation

    @cached_property
    def values(self) -> dict[str, float]:
        """All parameters by name, SI."""
        return self.problem.space.values(self.estimate.theta)

    @cached_property
    def situation(self) -> Situation:
        return Situation(self.campaign, self.measured, self.law)

    @cached_property
    def residual(self) -> np.ndarray:
        """Model minus data, whitened, then nuisances and priors, shape (M,)."""
        return self.evaluation.design[0]

    @cached_property
    def fitted(self) -> np.ndarray:
        """Orthonormal columns that span all that is fitted, nuisances included, shape (M, k)."""
        return orthonormal_basis(self.evaluation.design[1])

    @cached_property
    def regions(self) -> list[Region]:
        """Those of all tests; adequate where `LEVEL` does not speak against it."""
        return [msgspec.structs.replace(region, adequate=region.p > LEVEL)
                for region in judge_regions(self.problem, self.evaluation)]

    @property
    def adequate(self) -> bool:
        """Whether no smooth misfit is left in any region."""
        return all(region.adequate for region in self.regions)

    @cached_property
    def _left(self) -> dict[str, tuple[MeasuredCurve, np.ndarray]]:
        """Test -> its first recording, and the whitened residuals of those that are at the same places, shape
        (recordings, n); of tests with several such."""
        found = {}
        for number, test in enumerate(self.problem.tests):
            mine = [(curve, self.evaluation.residual[rows]) for (t, _), rows, curve in zip(
                self.problem.places, self.problem.rows, self.problem.measured, strict=True) if t == number]
            first = mine[0][0].displacement
            alike = [left for curve, left in mine if left.size == first.size
                     and np.abs(curve.displacement - first).max() < _SAME_PLACE * np.abs(first).max()]
            if len(alike) > 1:
                found[test.name] = mine[0][0], np.array(alike)
        return found

    @cached_property
    def coherence(self) -> dict[str, tuple[float, int, int]]:
        """Test -> `calibration.statistics.common_signal.variance_ratio` of its recordings; of those with several."""
        return {name: variance_ratio(left) for name, (_, left) in self._left.items()}

    @cached_property
    def repetitions(self) -> dict[str, CommonSignal]:
        """Test -> what its recordings leave behind in common, of those where it is more than chance: perhaps too rough
        for the shapes of the regions, and for the estimate of the noise, which takes what is rough for noise."""
        found = {}
        for name, (curve, left) in self._left.items():
            segments = _runs(curve.segment, left.shape[1])
            most = find_common_signal(left, segments)
            if len(self._left) * most.p < REPEATED:
                found[name] = most
        return found

    @property
    def repeated(self) -> list[str]:
        """Tests whose recordings leave the same behind."""
        return list(self.repetitions)

    @cached_property
    def repeated_in_words(self) -> list[str]:
        """Of each such test: ``needle (most at 5.1 mm)``, ``plates (a wave of 17 s)``."""
        words = []
        for name, each in self.repetitions.items():
            curve = self._left[name][0]
            inside = slice(each.first, each.last + 1)
            if each.waves and curve.time is not None:
                words.append(f"{name} (a wave of {np.ptp(curve.clock[inside]) / each.waves:.2g} s)")
            elif each.last - each.first + 1 < curve.force.size and not each.waves:
                place = float(np.mean(curve.displacement[inside]))
                words.append(f"{name} (most at {f'strain {place:.2g}' if curve.stressed else f'{1e3 * place:.2g} mm'})")
            else:
                words.append(name)
        return words

    @property
    def explained(self) -> bool:
        """Whether nothing is left, neither smooth nor the same in all recordings."""
        return self.adequate and not self.repeated

    @cached_property
    def samples(self) -> float:
        """Independent samples that the recordings are worth."""
        total = 0.0
        for curve in self.problem.measured:
            memory = 0.0
            if curve.noise.correlation_time:
                step = float(np.median(np.diff(curve.clock))) if curve.time is not None else 1.0
                memory = float(np.exp(-step / curve.noise.correlation_time))
            total += curve.force.size * (1.0 - memory) / (1.0 + memory)
        return max(total, 2.0)


def _runs(labels: np.ndarray | None, size: int) -> list[slice]:
    """Where a label stays the same."""
    if labels is None:
        return [slice(0, size)]
    ends = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), size]
    return list(map(slice, ends[:-1], ends[1:]))


def gather(campaign: Campaign, measured: Measured, solves: SimulationCache, context: RunContext) -> Evidence:
    """Fit a campaign without any effect.

    Args:
        campaign: see `whole_campaign`. measured: all recordings. solves: what has been simulated.

    Raises:
        ConvergenceError: no start gets through the data.
    """
    law = campaign.fit.laws[0]
    estimator = Generalised(campaign, measured, solves)
    _, estimate = estimator.estimate((law,), context)[law]
    if not isinstance(estimate, Estimate):
        raise ConvergenceError(f"{campaign.path}: no start of {law} gets through the data ({estimate}); state another "
                               "one in fit.start, or take a smaller max_strain")
    problem = estimate.problem
    problem.jitter = doubted(problem, estimate.theta, estimator.stated(problem))
    problem.forget()
    descent = descend(problem, estimate.theta, corrected=True)
    estimate = replace(estimate, theta=descent.theta, error=descent.error)
    return Evidence(campaign, measured, estimate)


def doubted(problem: Problem, theta: np.ndarray, stated: Noise) -> Jitter:
    """Jitter that is an estimate, as large as it may well be: few recordings may agree by chance, and an effect that
    moves like contact or zero would then stand out. What is stated or assumed stays.

    The variance of what the recordings show (jitter and what one of them resolves) is known to a chi-square.
    """
    jitter = problem.jitter
    if not jitter.freedom:
        return jitter
    factor = jitter.freedom / float(special.chdtri(jitter.freedom, 1.0 - _DOUBT))
    resolved: dict[str, list[float]] = {"contact": [], "zero": []}
    for test in problem.replicates(theta):
        for one in test:
            own = np.column_stack([one.contact, one.zero])
            variances = np.diag(np.linalg.pinv(own.T @ own))
            for name, variance in zip(resolved, variances, strict=True):
                resolved[name].append(float(variance))
    known = {"contact": stated.contact_jitter, "zero": stated.zero_jitter}
    found = {}
    for name, several in resolved.items():
        own_variance, value = float(np.median(several)), getattr(jitter, name)
        larger = np.sqrt((value**2 + own_variance) * factor - own_variance)
        found[name] = value if known[name] is not None else float(larger)
    return Jitter(found["contact"], found["zero"], jitter.freedom)
