"""Where a fit to closed forms begins: exponents from a grid, moduli and relaxing shares from linear solves there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import nnls

from calibration.fit.ordinary_problem import OrdinaryProblem, feasible
from calibration.fit.variables import LongTerm
from tissue_sim.laws import find_law

#: Exponents and other numbers without unit that the starts are made of. 0 is the limit of a power law: in simple shear
#: the stress is even in the exponent, so that a descent from elsewhere approaches 0 slowly.
EXPONENTS = (-20.0, -10.0, -5.0, -2.0, -0.5, 0.0, 1.0, 2.0, 4.0, 8.0, 15.0, 25.0)
MAX_STARTS = 12
#: Shares of the bound of a contact offset that the best start is moved by.
_MOVED = (-0.5, -0.1, -0.01, 0.01, 0.1, 0.5)
#: Grid of relaxation times per decade that the starts are chosen from, and how many candidates are refined.
TIMES_PER_DECADE, RELAXING_STARTS = 3, 3


def closed_starts(problem: OrdinaryProblem) -> list[np.ndarray]:
    """Starts of a law, best first; what the campaign states comes before all of them.

    Returns:
        Unknowns, each of shape (k,), inside their bounds; empty where no start gives a finite stress.
    """
    space = problem.space
    relaxing = problem.relaxing
    found = _elastic_starts(problem) if relaxing is None else _relaxing_starts(problem, relaxing)
    if found and problem.shifted:
        # Moving a contact moves samples in and out of contact, which makes minima of its own.
        for share in _MOVED:
            moved = found[0].copy()
            moved[len(space.free)::2] = share * problem.settings.offset_bound
            found.append(moved)
    if space.start:
        stated = found[0].copy() if found else np.clip(np.zeros(problem.bounds[0].size), *problem.bounds)
        for place, name in enumerate(space.free):
            stated[place] = space.start.get(name, stated[place])
        found.insert(0, stated)
    return found


def _grids(count: int) -> Iterator[tuple[float, ...]]:
    """Exponents to begin with: not all of them the same."""
    for grid in combinations_with_replacement(EXPONENTS, count):
        if len(set(grid)) >= min(count, 2):
            yield grid


def _elastic_starts(problem: OrdinaryProblem) -> list[np.ndarray]:
    space = problem.space
    of_law = [each.of_law for each in space.varied]
    moduli = [i for i, each in enumerate(space.varied) if each.of_law and each.is_modulus]
    exponents = [i for i, each in enumerate(space.varied) if each.is_exponent]
    # One grid for the exponents of the law, whichever specimen they are of.
    paths = [space.varied[i].path for i in exponents]
    kinds = list(dict.fromkeys(paths))
    # Stress is linear in the moduli without weight, and bent a little with it: solved for in turn, it starts a fit.
    weightless = problem.weightless
    solves = [weightless] if all(test.proportional for test in problem.tests) else [weightless, problem, problem]
    strain = max(float(np.ptp(np.concatenate([test.strain(curve.displacement) for curve in test.measured])))
                 for test in problem.tests)
    largest = float(np.abs(problem.data / problem.area).max())
    guess = max(largest / max(strain, 1e-3), 1e-9) / 6.0 / max(len(moduli), 1)
    low, high = problem.bounds
    candidates = []
    for grid in _grids(len(kinds)):
        unknowns = np.zeros(low.size)
        for place, name in enumerate(space.free):
            unknowns[place] = guess if of_law[place] else space.start.get(name, 0.0)
        unknowns[exponents] = [grid[kinds.index(path)] for path in paths]
        tried = [np.clip(unknowns, low, high)]
        for solved_on in solves if moduli else ():
            evaluation = feasible(solved_on, tried[-1])
            if evaluation is None:
                break
            step = np.linalg.lstsq(evaluation.rates[:, moduli], -evaluation.residual, rcond=1e-9)[0]
            solved = tried[-1].copy()
            solved[moduli] = np.clip(solved[moduli] + step, low[moduli], high[moduli])
            tried.append(solved)
        # Where an exponent leaves the moduli nothing, they come out as zero, and a law without them is no start.
        evaluations = [(feasible(problem, trial), trial) for trial in tried if not moduli or trial[moduli].any()]
        candidates += sorted(((e.error, i, trial) for i, (e, trial) in enumerate(evaluations) if e is not None),
                             key=lambda item: item[:2])[:1]
    candidates.sort(key=lambda item: item[0])
    return [trial for *_, trial in candidates[:MAX_STARTS]]


class _Relaxing:
    """Stress of all recordings as elastic + sum r_i relaxing_i: long-term moduli, and r_i = g_i / (1 - sum g).

    Source: variable projection as a start, O'Leary and Rust, Comput. Optim. Appl. 54 (2013) 579.
    """

    def __init__(self, problem: OrdinaryProblem):
        self.law = find_law(problem.space.law)
        self.moduli = np.array([self.law.units[name] != "1" for name in self.law.parameters])
        self.data = problem.data / problem.area
        self.histories = [(problem.tests[t].kind.sign, problem.tests[t].history(r)) for t, r in problem.places]

    def parts(self, values: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Elastic and relaxing stresses, positive under load, shape (n, 1 + terms)."""
        with np.errstate(all="ignore"):
            parts = [(sign, *history.parts(self.law, values, tau)) for sign, history in self.histories]
        return np.concatenate([sign * np.column_stack([elastic, relaxing]) for sign, elastic, relaxing in parts])

    def solved(self, exponents: np.ndarray, grid: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Misfit, long-term parameters and shares at the times of a grid: moduli and shares in turn."""
        values, shares = exponents, np.zeros(grid.size)
        for _ in range(3):
            columns = []
            for place in np.flatnonzero(self.moduli):
                alone = np.where(self.moduli, 0.0, values)
                alone[place] = 1.0
                columns.append(self.parts(alone, grid) @ np.append(1.0, shares))
            matrix = np.column_stack(columns)
            if not np.isfinite(matrix).all():
                return None
            values = np.array(values)
            values[self.moduli] = np.linalg.lstsq(matrix, self.data, rcond=1e-9)[0]
            matrix = self.parts(values, grid)
            if not np.isfinite(matrix).all():
                return None
            weights, misfit = nnls(matrix, self.data)
            if not weights.any():
                return None
            rest = max(weights[0], 1e-2 * weights.sum())
            values, shares = np.where(self.moduli, rest * values, values), weights[1:] / rest
        return misfit, values, shares


def _relaxing_starts(problem: OrdinaryProblem, places: LongTerm) -> list[np.ndarray]:
    model = _Relaxing(problem)
    terms = places.g.size
    shortest, longest = problem.time_range
    count = int(np.clip(TIMES_PER_DECADE * np.log10(longest / shortest), terms + 1, 16))
    grid = np.geomspace(shortest, longest, count)
    candidates = []
    for exponents in _grids(int((~model.moduli).sum())):
        values = np.ones(model.moduli.size)
        values[~model.moduli] = exponents
        if (solved := model.solved(values, grid)) is not None:
            candidates.append(solved)
    candidates.sort(key=lambda item: item[0])
    found = []
    for _, values, shares in candidates[:RELAXING_STARTS]:
        for r, log_tau in (_clusters(grid, shares, terms), _even(grid, shares, terms)):
            order, factor = np.argsort(log_tau), 1.0 + r.sum()
            unknowns = np.empty(len(problem.space.free))
            unknowns[[problem.space.free.index(name) for name in model.law.parameters]] = np.where(
                model.moduli, factor * values, values)
            unknowns[places.g], unknowns[places.tau] = r[order] / factor, np.exp(log_tau[order])
            found.append(np.clip(unknowns, *problem.bounds))
    return found


def _clusters(grid: np.ndarray, shares: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours on the grid of times that carry something, each group as one term; the largest `terms` of them."""
    active = np.flatnonzero(shares > 0)
    groups: Sequence[np.ndarray] = np.split(active, np.flatnonzero(np.diff(active) > 1) + 1) if active.size else []
    groups = sorted(groups, key=lambda group: -shares[group].sum())[:terms]
    r = np.array([shares[group].sum() for group in groups])
    log_tau = np.array([np.average(np.log(grid[group]), weights=shares[group]) for group in groups])
    while log_tau.size < terms:
        # Each further time lies in the middle of the largest gap.
        edges = np.sort(np.concatenate([np.log(grid[[0, -1]]), log_tau]))
        widest = int(np.argmax(np.diff(edges)))
        log_tau, r = np.append(log_tau, edges[widest:widest + 2].mean()), np.append(r, 1e-2)
    return r, log_tau


def _even(grid: np.ndarray, shares: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Times evenly over the window, with the shares of the grid around them."""
    nearest = np.arange(grid.size) * terms // grid.size
    log_tau = np.array([np.log(grid[nearest == i]).mean() for i in range(terms)])
    return np.array([max(shares[nearest == i].sum(), 1e-2) for i in range(terms)]), log_tau
