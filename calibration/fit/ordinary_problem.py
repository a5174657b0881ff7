"""Ordinary least-squares problem on nominal stress, with contact offsets and zeros as bounded unknowns.

Its starting values have exponents from a grid and other parameters from linear least squares.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product

import numpy as np
from scipy.optimize import nnls

from calibration.campaign.campaign import FitSettings, Noise
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.parameters import OFFSET_DEFAULTS
from calibration.fit.problem import LeastSquaresProblem, LongTermPronyVariables, ProblemEvaluation, Variables
from calibration.forward.closed import ClosedFormTest
from calibration.forward.contract import InfeasibleError, find_largest_strain_of_data_or_none
from calibration.forward.force_control import evaluate_residual_under_force_control
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
        uses_newton_step: see `calibration.forward.force_control.evaluate_residual_under_force_control`. Without the
            step the residuals are linear in the moduli.
    """

    tests: tuple[ClosedFormTest, ...]
    settings: FitSettings
    noise: float
    force_noise: float
    uses_newton_step: bool = True

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
        force_noise = max((curve.noise.deviation for curve, _ in pairs if not curve.test.states_stress), default=0.0)
        space = space.with_ranges_of_data(find_largest_strain_of_data_or_none(tests))
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
        exponents = own[np.logical_not(moduli)]
        return LongTermPronyVariables(own[moduli], exponents, (self.space.low[exponents], self.space.high[exponents]),
                                      np.array([index_of[g] for g, _ in terms]),
                                      np.array([index_of[tau] for _, tau in terms]),
                                      self.median_sampling_interval_and_longest_duration)

    def with_thinned_and_merged_recordings(self, stride: int) -> OrdinaryProblem:
        """Return the problem with every `stride`-th sample, for cheaper descents.

        The recordings of a test are merged to one if they have no individual unknowns.
        """
        def concatenate_recordings_if_no_own_unknowns(curves: list[MeasuredCurve]) -> list[MeasuredCurve]:
            """Join recordings to one without time, unless they have individual unknowns or depend on the history."""
            if self.shifted or self.is_history_dependent or any(each.recording is not None
                                                                for each in self.space.unknowns):
                return curves
            motions = [curve.motions for curve in curves if curve.motions is not None]
            return [replace(curves[0], time=None, displacement=np.concatenate([curve.displacement for curve in curves]),
                            force=np.concatenate([curve.force for curve in curves]),
                            motions=np.concatenate(motions) if motions else None)]

        return replace(self, tests=tuple(
            replace(test, measured=tuple(
                concatenate_recordings_if_no_own_unknowns([curve.select(slice(None, None, stride))
                                                           for curve in test.measured])))
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

    @property
    def linear_in_moduli(self) -> OrdinaryProblem:
        """Same problem without the Newton step of recordings under force control."""
        return replace(self, uses_newton_step=False)

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
        # Bounds of a bulk modulus are 12 decades apart; then the distance refers to the value.
        reach = np.minimum(high - low, np.maximum(np.abs(u), 1.0))
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
        force, residual, rates = np.empty(self.samples), np.empty(self.samples), np.zeros((self.samples, theta.size))
        answers = [test.solve(self.space, theta[:free], self.solves) for test in self.tests]
        for i, (rows, (t, r),
                (offset, zero)) in enumerate(zip(self.rows, self.places,
                                                 self.get_contact_offsets_and_zeros(theta).tolist(),
                                                 strict=True)):
            test, shifted = self.tests[t], i in self.shifted
            columns = slice(free, free)
            if shifted:
                columns = slice(free + 2 * self.shifted.index(i), free + 2 * self.shifted.index(i) + 2)
            if test.measured[r].force_control is not None:
                residual[rows], found, force[rows] = evaluate_residual_under_force_control(
                    test, answers[t], r, offset, zero, self.uses_newton_step)
                rates[rows, :free], rates[rows, columns] = found[:, :free], found[:, free:] if shifted else 0.0
                continue
            force[rows], rates[rows, :free], contact = test.evaluate_force_and_derivatives(answers[t], r, offset,
                                                                                           shifted)
            if shifted:
                force[rows] += zero
                rates[rows, columns] = np.column_stack([contact, np.ones(contact.size)])
            residual[rows] = force[rows] - self.data[rows]
        unit = self.area * self.noise
        return residual / unit, rates / unit[:, None], np.zeros((self.samples, 0)), np.zeros(0), force

    def compute_stress_changes_per_jitter_or_none(self, theta: np.ndarray, noise: Noise) -> np.ndarray | None:
        """Return the change of the nominal stress per standard deviation of contact and zero jitter, Pa, shape (N, 2).

        Under force control the changes are whitened as the residuals are.

        None if no jitter is stated; no columns if fitted offsets have the jitter as their prior.
        """
        if not (noise.contact_jitter or noise.zero_jitter):
            return None
        if self.settings.offset == "fit":
            return np.empty((self.samples, 0))
        columns = np.zeros((self.samples, 2))
        answers = [test.solve(self.space, theta[: len(self.space.free)], self.solves) for test in self.tests]
        for rows, (t, r) in zip(self.rows, self.places, strict=True):
            curve = self.tests[t].measured[r]
            if curve.force_control is not None and not curve.stressed:
                whitened = evaluate_residual_under_force_control(self.tests[t], answers[t], r, 0.0, 0.0,
                                                                 self.uses_newton_step)[1]
                columns[rows] = whitened[:, -2:] * [noise.contact_jitter or 0.0, noise.zero_jitter or 0.0]
            elif not curve.stressed:
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


#: Grid of exponents and other dimensionless parameters. The grid includes 0, the limit of a power law: in simple shear
#: the stress is even in the exponent, so that descents approach 0 slowly.
EXPONENTS = (-20.0, -10.0, -5.0, -2.0, -0.5, 0.0, 1.0, 2.0, 4.0, 8.0, 15.0, 25.0)


@dataclass(frozen=True)
class AnalyticalStartSettings:
    """Numbers of starting values of fits with closed forms.

    Attributes:
        max_starts: largest number of elastic starts. A larger value finds more minima and costs more descents.
        times_per_decade: relaxation times per decade of the grid for Prony terms.
        relaxing_starts: number of sets of exponents that are refined for a law with Prony terms.
    """

    max_starts: int = 12
    times_per_decade: int = 3
    relaxing_starts: int = 3


_STARTS = AnalyticalStartSettings()
#: Contact offsets of additional starts, as fractions of the bound.
_TRIAL_OFFSETS = (-0.5, -0.1, -0.01, 0.01, 0.1, 0.5)


def compute_analytical_starts(problem: OrdinaryProblem) -> list[np.ndarray]:
    """Return the starting values of a law, best first; values that the campaign states come before all others.

    Args:
        problem: problem of the law.

    Returns:
        Unknowns inside their bounds, SI, each of shape (k,); empty if no start gives a finite stress.
    """
    space = problem.space
    relaxing = problem.long_term_variables_or_none
    found = _compute_elastic_starts(problem) if relaxing is None else _compute_viscoelastic_starts(problem, relaxing)
    if found and problem.shifted:
        # A contact offset moves samples across first contact, so the sum of squares may have several minima.
        for fraction in _TRIAL_OFFSETS:
            moved = found[0].copy()
            moved[len(space.free)::2] = fraction * problem.settings.offset_bound
            found.append(moved)
    if space.start:
        stated = found[0].copy() if found else np.clip(np.zeros(problem.bounds[0].size), *problem.bounds)
        for index, name in enumerate(space.free):
            stated[index] = space.start.get(name, stated[index])
        found.insert(0, stated)
    return found


def _iterate_dimensionless_starts(paths: Sequence[str],
                                  starts: Mapping[str, tuple[float, ...]]) -> Iterator[tuple[float, ...]]:
    """Yield values of dimensionless parameters of the law: their own starts, or exponents that are not all equal.

    Args:
        paths: paths of the parameters.
        starts: starts of some of the parameters by path; the others are exponents.
    """
    exponents = [path for path in paths if path not in starts]
    own = [path for path in paths if path in starts]
    for grid in combinations_with_replacement(EXPONENTS, len(exponents)):
        if len(set(grid)) >= min(len(exponents), 2):
            for values in product(*(starts[path] for path in own)):
                known = dict(zip((*exponents, *own), (*grid, *values), strict=True))
                yield tuple(known[path] for path in paths)


def _compute_elastic_starts(problem: OrdinaryProblem) -> list[np.ndarray]:
    """Return starts of a law without Prony terms, smallest sum of squares first.

    For each combination of exponents, linear least squares gives the moduli.
    """
    space = problem.space
    of_law = [each.is_law_parameter for each in space.free_parameters]
    moduli = [i for i, each in enumerate(space.free_parameters) if each.is_law_parameter and each.is_modulus]
    exponents = [i for i, each in enumerate(space.free_parameters) if each.is_dimensionless_law_parameter]
    # The exponents of all specimens have the same starting values.
    paths = [space.free_parameters[i].path for i in exponents]
    kinds = list(dict.fromkeys(paths))
    # The stress is linear in the moduli without self-weight and slightly nonlinear with it: further linear solves
    # follow.
    linear = problem.linear_in_moduli
    weightless = linear.without_self_weight
    solves = [weightless] if all(test.is_force_proportional_to_moduli
                                 for test in problem.tests) else [weightless, linear, linear]
    strain = max(float(np.ptp(np.concatenate([test.convert_displacement_to_stretch_or_shear(curve.displacement)
                                              for curve in test.measured])))
                 for test in problem.tests)
    largest = float(np.abs(problem.data / problem.area).max())
    guess = max(largest / max(strain, 1e-3), 1e-9) / 6.0 / max(len(moduli), 1)
    low, high = problem.bounds
    candidates = []
    for grid in _iterate_dimensionless_starts(kinds, space.law_starts):
        unknowns = np.zeros(low.size)
        for index, name in enumerate(space.free):
            unknowns[index] = guess if of_law[index] else space.start.get(name, 0.0)
        unknowns[exponents] = [grid[kinds.index(path)] for path in paths]
        tried = [np.clip(unknowns, low, high)]
        for solved_on in solves if moduli else ():
            evaluation = evaluate_or_none_if_infeasible(solved_on, tried[-1])
            if evaluation is None:
                break
            step = np.linalg.lstsq(evaluation.rates[:, moduli], -evaluation.residual, rcond=1e-9)[0]
            solved = tried[-1].copy()
            solved[moduli] = np.clip(solved[moduli] + step, low[moduli], high[moduli])
            tried.append(solved)
        # With unsuitable exponents all moduli are zero, and such a start is omitted.
        evaluations = [(evaluate_or_none_if_infeasible(problem, trial), trial) for trial in tried
                       if not moduli or trial[moduli].any()]
        candidates += sorted(((e.penalised_sum_of_squares, i, trial) for i,
                              (e, trial) in enumerate(evaluations) if e is not None),
                             key=lambda item: item[:2])[:1]
    candidates.sort(key=lambda item: item[0])
    return [trial for *_, trial in candidates[:_STARTS.max_starts]]


class _RelaxationModel:
    """Stress of all recordings as P_elastic + sum r_i P_relaxing(tau_i), with r_i = g_i / (1 - sum g).

    The stress is bilinear in the long-term moduli and the ratios r_i, so linear least squares for moduli and ratios
    alternate (variable projection).

    Args:
        problem: problem of a law with Prony terms.

    Source: O'Leary and Rust, Comput. Optim. Appl. 54 (2013) 579.
    """

    def __init__(self, problem: OrdinaryProblem):
        self.law = find_law(problem.space.law)
        self.moduli = np.array([self.law.units[name] != "1" for name in self.law.parameters])
        self.data = problem.data / problem.area
        self.histories = [(problem.tests[t].kind.sign, problem.tests[t].get_homogeneous_history(r)) for t,
                          r in problem.places]

    def compute_elastic_and_relaxing_stresses(self, values: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return elastic and relaxing stresses, positive under load, Pa, shape (n, 1 + terms).

        Args:
            values: long-term parameters of the law, SI.
            tau: relaxation times, s, shape (terms,).
        """
        with np.errstate(all="ignore"):
            parts = [(sign, *history.compute_elastic_and_relaxing_stress(self.law, values, tau)) for sign,
                     history in self.histories]
        return np.concatenate([sign * np.column_stack([elastic, relaxing]) for sign, elastic, relaxing in parts])

    def solve_moduli_and_ratios_or_none(self, exponents: np.ndarray,
                                        grid: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Solve for moduli and ratios by alternating linear least squares with given exponents.

        Args:
            exponents: parameters of the law with the given exponents.
            grid: relaxation times, s.

        Returns:
            Misfit, long-term parameters, and ratios at the relaxation times; None if the stress is not finite.
        """
        values, ratios = exponents, np.zeros(grid.size)
        for _ in range(3):
            columns = []
            for index in np.flatnonzero(self.moduli):
                alone = np.where(self.moduli, 0.0, values)
                alone[index] = 1.0
                columns.append(self.compute_elastic_and_relaxing_stresses(alone, grid) @ np.append(1.0, ratios))
            matrix = np.column_stack(columns)
            if not np.isfinite(matrix).all():
                return None
            values = np.array(values)
            values[self.moduli] = np.linalg.lstsq(matrix, self.data, rcond=1e-9)[0]
            matrix = self.compute_elastic_and_relaxing_stresses(values, grid)
            if not np.isfinite(matrix).all():
                return None
            weights, misfit = nnls(matrix, self.data)
            if not weights.any():
                return None
            rest = max(weights[0], 1e-2 * weights.sum())
            values, ratios = np.where(self.moduli, rest * values, values), weights[1:] / rest
        return misfit, values, ratios


def _compute_viscoelastic_starts(problem: OrdinaryProblem, variables: LongTermPronyVariables) -> list[np.ndarray]:
    """Return starts of a law with Prony terms, smallest misfit of a fit on a grid of relaxation times first."""
    model = _RelaxationModel(problem)
    terms = variables.g.size
    shortest, longest = problem.median_sampling_interval_and_longest_duration
    count = int(np.clip(_STARTS.times_per_decade * np.log10(longest / shortest), terms + 1, 16))
    grid = np.geomspace(shortest, longest, count)
    candidates = []
    paths = [name for name, is_modulus in zip(model.law.parameters, model.moduli, strict=True) if not is_modulus]
    for exponents in _iterate_dimensionless_starts(paths, problem.space.law_starts):
        values = np.ones(model.moduli.size)
        values[~model.moduli] = exponents
        if (solved := model.solve_moduli_and_ratios_or_none(values, grid)) is not None:
            candidates.append(solved)
    candidates.sort(key=lambda item: item[0])
    found = []
    for _, values, ratios in candidates[:_STARTS.relaxing_starts]:
        for r, log_tau in (_merge_neighbouring_times_into_terms(grid, ratios, terms),
                           _sum_ratios_in_time_bins(grid, ratios, terms)):
            order, factor = np.argsort(log_tau), 1.0 + r.sum()
            unknowns = np.empty(len(problem.space.free))
            unknowns[[problem.space.free.index(name) for name in model.law.parameters]] = np.where(
                model.moduli, factor * values, values)
            unknowns[variables.g], unknowns[variables.tau] = r[order] / factor, np.exp(log_tau[order])
            found.append(np.clip(unknowns, *problem.bounds))
    return found


def _merge_neighbouring_times_into_terms(grid: np.ndarray, ratios: np.ndarray,
                                         terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Merge neighbouring relaxation times with positive ratios, and return the largest `terms` groups.

    Args:
        grid: relaxation times, s.
        ratios: ratios at these times.
        terms: number of Prony terms.

    Returns:
        Ratios and logarithms of the relaxation times, shapes (terms,).
    """
    active = np.flatnonzero(ratios > 0)
    groups: Sequence[np.ndarray] = np.split(active, np.flatnonzero(np.diff(active) > 1) + 1) if active.size else []
    groups = sorted(groups, key=lambda group: -ratios[group].sum())[:terms]
    r = np.array([ratios[group].sum() for group in groups])
    log_tau = np.array([np.average(np.log(grid[group]), weights=ratios[group]) for group in groups])
    while log_tau.size < terms:
        # Further relaxation times are placed in the middle of the largest gap.
        edges = np.sort(np.concatenate([np.log(grid[[0, -1]]), log_tau]))
        widest = int(np.argmax(np.diff(edges)))
        log_tau, r = np.append(log_tau, edges[widest:widest + 2].mean()), np.append(r, 1e-2)
    return r, log_tau


def _sum_ratios_in_time_bins(grid: np.ndarray, ratios: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide the grid of relaxation times into equal bins, and sum the ratios in each bin.

    Arguments and results are those of `_merge_neighbouring_times_into_terms`.
    """
    nearest = np.arange(grid.size) * terms // grid.size
    log_tau = np.array([np.log(grid[nearest == i]).mean() for i in range(terms)])
    return np.array([max(ratios[nearest == i].sum(), 1e-2) for i in range(terms)]), log_tau
