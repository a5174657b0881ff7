"""Ordinary least-squares problem on nominal stress, with contact offsets and zeros as bounded unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.campaign import FitSettings, Noise
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.offset_defaults import OFFSET_DEFAULTS
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.problem import LeastSquaresProblem, ProblemEvaluation
from calibration.fit.variables import LongTermPronyVariables, Variables
from calibration.forward.closed import ClosedFormTest
from calibration.forward.contract import InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.statistics import (
    compute_median_sampling_interval_or_zero,
    compute_sample_weighted_rms_noise,
)
from tissue_sim.laws import find_law
from tissue_sim.material.viscoelasticity import MOST_TERMS

#: Distance to a bound at which an unknown counts as on the bound, relative to the distance of its bounds.
_BOUND_DISTANCE = 1e-6


@dataclass(frozen=True, eq=False)
class OrdinaryProblem(LeastSquaresProblem):
    """Least-squares problem with residuals of the nominal stress in units of one pooled noise.

    The unknowns are the free parameters, then contact offset, m, and zero, N, of each recording that has them.

    Attributes:
        tests: closed forms of the fitted tests.
        settings: settings of the fit, including bounds and priors of offsets.
        noise: pooled noise of the nominal stress, Pa.
        force_noise: largest force noise of the recordings, N.
    """

    tests: tuple[ClosedFormTest, ...]
    settings: FitSettings
    noise: float
    force_noise: float

    @property
    def mesh_error(self) -> tuple[float, ...]:
        """Mesh error of each test, 0: closed forms have no mesh."""
        return (0.0,) * len(self.tests)

    @cached_property
    def area(self) -> np.ndarray:
        """Cross-section at each sample, m2, shape (N,)."""
        return np.concatenate([np.full(curve.force.size, self.tests[t].area)
                               for (t, _), curve in zip(self.places, self.measured, strict=True)])

    @cached_property
    def shifted(self) -> list[int]:
        """Indices of the recordings with a contact offset and a zero."""
        return [i for i, curve in enumerate(self.measured) if self.settings.offset == "fit" and not curve.stressed]

    @property
    def _zero_prior_deviation(self) -> float:
        """Standard deviation of the prior of a zero, N."""
        return self.settings.zero_prior or OFFSET_DEFAULTS.zero_prior * self.force_noise

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the unknowns, shapes (k,)."""
        zero_bound = self.settings.zero_bound or OFFSET_DEFAULTS.zero_bound * self._zero_prior_deviation
        high = np.tile([self.settings.offset_bound, zero_bound], len(self.shifted))
        return np.append(self.space.low, -high), np.append(self.space.high, high)

    @cached_property
    def prior_mean(self) -> np.ndarray:
        """Means of the priors, shape (k,)."""
        return np.append(self.space.prior_mean, np.zeros(2 * len(self.shifted)))

    @cached_property
    def prior_deviation(self) -> np.ndarray:
        """Standard deviations of the priors, shape (k,); inf without a prior."""
        return np.append(self.space.prior_deviation, np.tile([self.settings.offset_prior, self._zero_prior_deviation],
                                                             len(self.shifted)))

    @classmethod
    def build_with_pooled_noise(cls, space: ParameterSpace, tests: Sequence[ClosedFormTest], settings: FitSettings,
                                solves: SimulationCache) -> OrdinaryProblem:
        """Return the problem with the pooled noise of its recordings.

        Args:
            space: parameter space.
            tests: closed forms of the fitted tests.
            settings: settings of the fit.
            solves: cache of simulations.
        """
        pairs = [(curve, test.area) for test in tests for curve in test.measured]
        index = np.repeat(np.arange(len(pairs)), [curve.force.size for curve, _ in pairs])
        noise = compute_sample_weighted_rms_noise(np.array([curve.noise.deviation / area for curve, area in pairs]),
                                                  index)
        force_noise = max((curve.noise.deviation for curve, _ in pairs if curve.test.specimen is not None), default=0.0)
        return cls(space, tuple(tests), solves, settings, noise, force_noise)

    @property
    def recording_index_of_each_sample(self) -> np.ndarray:
        """Index of the recording of each sample, shape (N,)."""
        return np.repeat(np.arange(len(self.rows)), [rows.stop - rows.start for rows in self.rows])

    @property
    def median_sampling_interval_and_longest_duration(self) -> tuple[float, float]:
        """Median sampling interval and duration of the longest recording, s."""
        times = [curve.sample_times for curve in self.measured]
        return compute_median_sampling_interval_or_zero(times), max(float(np.ptp(time)) for time in times)

    @property
    def is_history_dependent(self) -> bool:
        """Whether the force depends on the history of the deformation."""
        return any(curve.segment is not None for curve in self.measured)

    @property
    def long_term_variables_or_none(self) -> LongTermPronyVariables | None:
        """Variables of a law with Prony terms if all parameters are free and without stated bounds; otherwise None."""
        law, free = find_law(self.space.law), self.space.free
        terms = [pair for i in range(MOST_TERMS) if set(pair := (
            f"viscoelastic.terms[{i}].g", f"viscoelastic.terms[{i}].tau")) <= set(free)]
        names = [*law.parameters, *(name for pair in terms for name in pair)]
        if not terms or set(names) != set(self.space.names) or set(names) != set(free) or self.shifted \
                or self.settings.bounds or self.settings.prior:
            return None
        index_of = {name: index for index, name in enumerate(free)}
        moduli = [law.units[name] != "1" for name in law.parameters]
        own = np.array([index_of[name] for name in law.parameters])
        return LongTermPronyVariables(own[moduli], own[np.logical_not(moduli)],
                                      np.array([index_of[g] for g, _ in terms]),
                                      np.array([index_of[tau] for _, tau in terms]),
                                      self.median_sampling_interval_and_longest_duration)

    def with_thinned_and_merged_recordings(self, stride: int) -> OrdinaryProblem:
        """Return the problem with every `stride`-th sample, for cheaper descents.

        The recordings of a test are merged to one if they have no individual unknowns.
        """
        def slice_recording_by_stride(curve: MeasuredCurve) -> MeasuredCurve:
            """Return a recording with every `stride`-th sample."""
            time = None if curve.time is None else curve.time[::stride]
            return replace(curve, displacement=curve.displacement[::stride], force=curve.force[::stride], time=time)

        def concatenate_recordings_if_no_own_unknowns(curves: list[MeasuredCurve]) -> list[MeasuredCurve]:
            """Join recordings to one without time, unless they have individual unknowns or depend on the history."""
            if self.shifted or self.is_history_dependent or any(each.recording is not None
                                                                for each in self.space.unknowns):
                return curves
            return [replace(curves[0], time=None, displacement=np.concatenate([curve.displacement for curve in curves]),
                            force=np.concatenate([curve.force for curve in curves]))]

        return replace(self, tests=tuple(
            replace(test, measured=tuple(
                concatenate_recordings_if_no_own_unknowns(list(map(slice_recording_by_stride, test.measured)))))
            for test in self.tests))

    def make_problem_and_unknowns_without_test(self, number: int,
                                               theta: np.ndarray) -> tuple[OrdinaryProblem, np.ndarray]:
        """Return the problem without one test, and its unknowns.

        See `LeastSquaresProblem.make_problem_and_unknowns_without_test`.
        """
        free = len(self.space.free)
        kept = [self.places[i][0] != number for i in self.shifted]
        tests = [test for i, test in enumerate(self.tests) if i != number]
        return (OrdinaryProblem.build_with_pooled_noise(self.space, tests, self.settings, self.solves),
                np.append(theta[:free], theta[free:].reshape(-1, 2)[kept]))

    @property
    def without_self_weight(self) -> OrdinaryProblem:
        """Same problem without the self-weight of the specimens."""
        return replace(self, tests=tuple(test.counterpart_without_self_weight for test in self.tests))

    def compute_unknown_scales(self, theta: np.ndarray) -> np.ndarray:
        """Return the scale of each unknown: size of a parameter, prior deviation of an offset or zero; shape (k,)."""
        free = len(self.space.free)
        return np.append(super().compute_unknown_scales(theta[:free]), self.prior_deviation[free:])

    def make_scaled_or_long_term_variables(self, theta: np.ndarray) -> Variables:
        """Return the variables of a descent: `LongTermPronyVariables` for Prony terms, otherwise scaled unknowns."""
        return self.long_term_variables_or_none or super().make_scaled_or_long_term_variables(theta)

    def make_mask_of_unknowns_on_bound(self, theta: np.ndarray) -> np.ndarray:
        """Return which unknowns are on a bound, bool, shape (k,)."""
        variables = self.long_term_variables_or_none
        low, high = self.bounds if variables is None else variables.bounds
        u = theta if variables is None else variables.convert_from_unknowns(theta)
        reach = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(u), 1.0))
        return (u - low <= _BOUND_DISTANCE * reach) | (high - u <= _BOUND_DISTANCE * reach)

    def get_contact_offsets_and_zeros(self, theta: np.ndarray) -> np.ndarray:
        """Return contact offset, m, and zero, N, of each recording, shape (recordings, 2)."""
        values = np.zeros((len(self.places), 2))
        values[self.shifted] = theta[len(self.space.free):].reshape(-1, 2)
        return values

    def _compute_residual_rates_columns_and_force(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return residuals of the stress over its noise.

        See `LeastSquaresProblem._compute_residual_rates_columns_and_force`.
        """
        free = len(self.space.free)
        force, rates = np.empty(self.samples), np.zeros((self.samples, theta.size))
        answers = [test.solve(self.space, theta[:free], self.solves) for test in self.tests]
        for i, (rows, (t, r),
                (offset, zero)) in enumerate(zip(self.rows, self.places,
                                                 self.get_contact_offsets_and_zeros(theta).tolist(),
                                                 strict=True)):
            shifted = i in self.shifted
            force[rows], rates[rows, :free], contact = self.tests[t].evaluate_force_and_derivatives(
                answers[t], r, offset, shifted)
            if shifted:
                column = free + 2 * self.shifted.index(i)
                force[rows] += zero
                rates[rows, column], rates[rows, column + 1] = contact, 1.0
        unit = self.area * self.noise
        return (force - self.data) / unit, rates / unit[:, None], np.zeros((self.samples, 0)), np.zeros(0), force

    def compute_stress_changes_per_jitter_or_none(self, theta: np.ndarray, noise: Noise) -> np.ndarray | None:
        """Return the change of the nominal stress per standard deviation of contact and zero jitter, Pa, shape (N, 2).

        None if no jitter is stated; no columns if fitted offsets have the jitter as their prior.
        """
        if not (noise.contact_jitter or noise.zero_jitter):
            return None
        if self.settings.offset == "fit":
            return np.empty((self.samples, 0))
        columns = np.zeros((self.samples, 2))
        answers = [test.solve(self.space, theta[: len(self.space.free)], self.solves) for test in self.tests]
        for rows, (t, r) in zip(self.rows, self.places, strict=True):
            if not self.tests[t].measured[r].stressed:
                contact = self.tests[t].evaluate_force_and_derivatives(answers[t], r, 0.0)[2]
                columns[rows, 0], columns[rows, 1] = contact * noise.contact_jitter, noise.zero_jitter
        return columns / self.area[:, None]


def evaluate_or_none_if_infeasible(problem: OrdinaryProblem, theta: np.ndarray) -> ProblemEvaluation | None:
    """Return the evaluation of a problem; None if the model is infeasible or its values are not finite."""
    try:
        evaluation = problem.evaluate(theta)
    except InfeasibleError:
        return None
    return evaluation if np.isfinite(evaluation.residual).all() and np.isfinite(evaluation.rates).all() else None
