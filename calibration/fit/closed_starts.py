"""Starting values of fits with closed forms: exponents from a grid, other parameters from linear least squares."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import nnls

from calibration.fit.ordinary_problem import OrdinaryProblem, evaluate_or_none_if_infeasible
from calibration.fit.variables import LongTermPronyVariables
from tissue_sim.laws import find_law

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


_SETTINGS = AnalyticalStartSettings()
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


def _iterate_exponent_combinations(count: int) -> Iterator[tuple[float, ...]]:
    """Yield combinations of exponents that are not all equal."""
    for grid in combinations_with_replacement(EXPONENTS, count):
        if len(set(grid)) >= min(count, 2):
            yield grid


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
    weightless = problem.without_self_weight
    solves = [weightless] if all(test.is_force_proportional_to_moduli
                                 for test in problem.tests) else [weightless, problem, problem]
    strain = max(float(np.ptp(np.concatenate([test.convert_displacement_to_stretch_or_shear(curve.displacement)
                                              for curve in test.measured])))
                 for test in problem.tests)
    largest = float(np.abs(problem.data / problem.area).max())
    guess = max(largest / max(strain, 1e-3), 1e-9) / 6.0 / max(len(moduli), 1)
    low, high = problem.bounds
    candidates = []
    for grid in _iterate_exponent_combinations(len(kinds)):
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
    return [trial for *_, trial in candidates[:_SETTINGS.max_starts]]


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
    count = int(np.clip(_SETTINGS.times_per_decade * np.log10(longest / shortest), terms + 1, 16))
    grid = np.geomspace(shortest, longest, count)
    candidates = []
    for exponents in _iterate_exponent_combinations(int((~model.moduli).sum())):
        values = np.ones(model.moduli.size)
        values[~model.moduli] = exponents
        if (solved := model.solve_moduli_and_ratios_or_none(values, grid)) is not None:
            candidates.append(solved)
    candidates.sort(key=lambda item: item[0])
    found = []
    for _, values, ratios in candidates[:_SETTINGS.relaxing_starts]:
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
