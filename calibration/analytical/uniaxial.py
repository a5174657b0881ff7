"""The fit: least squares on nominal stress (the study's equations 4 to 7), several starts, exact Jacobian."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import least_squares

from calibration.analytical.forward import Weighing
from calibration.analytical.replicates import Replicate
from calibration.campaign.campaign import FitSettings, Noise
from calibration.statistics.statistics import pooled_noise
from tissue_sim.errors import ConvergenceError
from tissue_sim.laws import Law, find_law

#: Exponents and other numbers without unit that the starts are made of, and how far they may run.
EXPONENTS = (-20.0, -10.0, -5.0, -2.0, -0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 25.0)
EXPONENT_BOUND = 50.0
#: Smallest exponent: formulas divide by it, and their limit is reached long before.
TINY_EXPONENT = 1e-5
#: Starts are refined on a thinned curve, its best distinct minima on all samples.
THINNED_POINTS, MAX_STARTS, MAX_MINIMA = 200, 12, 2
THINNED_EVALUATIONS, EVALUATIONS, TOLERANCE = 300, 80, 1e-10


@dataclass(frozen=True, eq=False)
class Solution:
    """The best minimum of one law; unknowns are the free parameters, then (offset m, zero N) of each replicate.

    Attributes:
        values: all parameters in the order of the law, shape (m,).
        free: indices of the free ones. nuisances: shape (replicates, 2), zero where not fitted.
        unknowns: shape (k,). low, high: their bounds, shape (k,). on_bound: bool, shape (k,).
        jacobian: d(stress)/d(unknown), Pa per unit, shape (n, k). residual: model minus data, Pa, shape (n,).
        prior_precision: 1/variance, shape (k,). prior_squares: sum of squares of the prior rows, in units of them.
        minima: (parameters, sum of squares, starts that ended there), best first.
        starts, evaluations: how many. converged: whether the optimiser said so. cpu_s: processor seconds.
    """

    law: Law
    values: np.ndarray
    free: np.ndarray
    nuisances: np.ndarray
    unknowns: np.ndarray
    low: np.ndarray
    high: np.ndarray
    on_bound: np.ndarray
    jacobian: np.ndarray
    residual: np.ndarray
    prior_precision: np.ndarray
    prior_squares: float
    minima: tuple[tuple[np.ndarray, float, int], ...]
    starts: int
    evaluations: int
    converged: bool
    cpu_s: float


class _Problem:
    """Stress of all replicates as a function of the unknowns."""

    def __init__(self, law: Law, replicates: Sequence[Replicate], settings: FitSettings, noise: float,
                 force_noise: float, stride: int = 1):
        self.law, self.settings, self.noise = law, settings, noise
        self.replicates = replicates
        self.abscissa = np.concatenate([r.abscissa[::stride] for r in replicates])
        self.data = np.concatenate([r.stress[::stride] for r in replicates])
        self.index = np.concatenate([np.full(r.abscissa[::stride].size, i) for i, r in enumerate(replicates)])
        models = [r.model for r in replicates]
        self.models = [(model, np.flatnonzero(np.array([other == model for other in models])[self.index]))
                       for model in dict.fromkeys(models)]
        # Stress is linear in the moduli without weight, and bent a little with it: solved for in turn, it starts a fit.
        self.linear_solves = [[(model.weightless, mine) for model, mine in self.models]]
        if any(isinstance(model, Weighing) for model in models):
            self.linear_solves += [self.models, self.models]
        self.dimensionless = np.array([unit == "1" for unit in law.units.values()])
        self.fixed = np.array([settings.fixed.get(name, np.nan) for name in law.parameters])
        self.free = np.flatnonzero(np.isnan(self.fixed))
        self.shifted = [i for i, r in enumerate(replicates) if settings.offset == "fit" and r.mechanical]
        self._bounds_and_priors(force_noise)

    def _bounds_and_priors(self, force_noise: float) -> None:
        names = [self.law.parameters[i] for i in self.free]
        default = [(-EXPONENT_BOUND, EXPONENT_BOUND) if self.dimensionless[i] else (-np.inf, np.inf) for i in self.free]
        limits = [self.settings.bounds.get(name, pair) for name, pair in zip(names, default, strict=True)]
        prior = [self.settings.prior.get(name, (0.0, np.inf)) for name in names]
        zero_prior = self.settings.zero_prior or 5.0 * force_noise
        zero_bound = self.settings.zero_bound or 10.0 * zero_prior
        for _ in self.shifted:
            limits += [(-self.settings.offset_bound, self.settings.offset_bound), (-zero_bound, zero_bound)]
            prior += [(0.0, self.settings.offset_prior), (0.0, zero_prior)]
        self.low, self.high = np.array(limits, dtype=float).reshape(-1, 2).T
        self.prior_mean, self.prior_deviation = np.array(prior, dtype=float).reshape(-1, 2).T
        self.prior_rows = np.flatnonzero(np.isfinite(self.prior_deviation))

    def split(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All parameters of the law, and offset and zero of each replicate, shape (replicates, 2)."""
        values = self.fixed.copy()
        values[self.free] = unknowns[: self.free.size]
        small = self.dimensionless & (np.abs(values) < TINY_EXPONENT)
        values[small] = np.copysign(TINY_EXPONENT, values[small])
        nuisances = np.zeros((len(self.replicates), 2))
        nuisances[self.shifted] = unknowns[self.free.size:].reshape(-1, 2)
        return values, nuisances

    def stress(self, unknowns: np.ndarray, derivatives: bool = False, models=None):
        """Stress as the rig reports it, Pa, shape (n,); with `derivatives` also those of the unknowns, shape (n, k).

        `models` are pairs of a forward model and the samples that it is for, `self.models` by default.
        """
        values, nuisances = self.split(unknowns)
        abscissa = self.abscissa.copy()
        zero = np.zeros_like(abscissa)
        for i in self.shifted:
            mine = self.index == i
            abscissa[mine] += self.replicates[i].offset_slope * nuisances[i, 0]
            zero[mine] = self.replicates[i].zero_slope * nuisances[i, 1]
        stress, slope = np.zeros_like(abscissa), np.zeros_like(abscissa)
        columns = np.zeros((abscissa.size, unknowns.size)) if derivatives else None
        for model, mine in self.models if models is None else models:
            # Wild trial values overflow; the optimiser turns back from what is not finite.
            with np.errstate(all="ignore"):
                stress[mine] = model.stress(self.law, abscissa[mine], values)
                if derivatives:
                    columns[mine, : self.free.size] = model.derivatives(self.law, abscissa[mine], values)[:, self.free]
                if derivatives and self.shifted:
                    slope[mine] = model.slope(self.law, abscissa[mine], values)
        if not derivatives:
            return stress + zero
        for j, i in enumerate(self.shifted):
            mine, column = self.index == i, self.free.size + 2 * j
            columns[mine, column] = slope[mine] * self.replicates[i].offset_slope
            columns[mine, column + 1] = self.replicates[i].zero_slope
        return stress + zero, columns

    def residual(self, unknowns: np.ndarray) -> np.ndarray:
        """Stress residuals and priors, both in units of the noise."""
        return np.concatenate([(self.stress(unknowns) - self.data) / self.noise, self.prior_residual(unknowns)])

    def prior_residual(self, unknowns: np.ndarray) -> np.ndarray:
        """Distance of each unknown with a prior from its mean, in standard deviations."""
        rows = self.prior_rows
        return (unknowns[rows] - self.prior_mean[rows]) / self.prior_deviation[rows]

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        rows = self.prior_rows
        prior = np.zeros((rows.size, unknowns.size))
        prior[np.arange(rows.size), rows] = 1.0 / self.prior_deviation[rows]
        return np.concatenate([self.stress(unknowns, derivatives=True)[1] / self.noise, prior])

    def solve(self, unknowns: np.ndarray, evaluations: int):
        """Trust-region least squares from one start; None where the start has no finite residual."""
        start = np.clip(unknowns, self.low, self.high)
        if not np.isfinite(self.residual(start)).all() or not np.isfinite(self.jacobian(start)).all():
            return None
        # Scaled by the columns of the Jacobian: Pa, exponents, metres and newtons stand side by side.
        return least_squares(self.residual, start, self.jacobian, bounds=(self.low, self.high), x_scale="jac",
                             ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=evaluations)

    def starts(self) -> list[np.ndarray]:
        """Deterministic starts, best first: exponents from a grid, moduli from linear solves at them."""
        law, free = self.law, self.free
        exponents = [i for i in free if self.dimensionless[i]]
        moduli = [i for i in free if not self.dimensionless[i]]
        strain = np.where(self.abscissa == 0, 1.0, self.abscissa)
        guess = max(abs(float(self.data[np.argmax(np.abs(self.data))])) / max(np.ptp(strain), 1e-3), 1e-9) / 6.0
        candidates = []
        for grid in combinations_with_replacement(EXPONENTS, len(exponents)):
            if len(set(grid)) < min(len(grid), 2):
                continue
            unknowns = np.zeros(self.low.size)
            values = np.where(np.isnan(self.fixed), guess / max(len(moduli), 1), self.fixed)
            values[exponents] = grid
            unknowns[: free.size] = np.clip(values[free], self.low[: free.size], self.high[: free.size])
            tried = [unknowns]
            places = [int(np.flatnonzero(free == i)[0]) for i in moduli]
            for models in self.linear_solves if moduli else ():
                stress, columns = self.stress(tried[-1], derivatives=True, models=models)
                if not (np.isfinite(stress).all() and np.isfinite(columns).all()):
                    break
                step = np.linalg.lstsq(columns[:, places], self.data - stress, rcond=1e-9)[0]
                solved = tried[-1].copy()
                solved[places] = np.clip(solved[places] + step, self.low[places], self.high[places])
                tried.append(solved)
            costs = [float(np.sum(self.residual(trial)**2)) for trial in tried]
            if np.isfinite(costs).any():
                candidates.append((np.nanmin(costs), tried[int(np.nanargmin(costs))]))
        candidates.sort(key=lambda item: item[0])
        starts = [unknowns for _, unknowns in candidates[:MAX_STARTS]]
        if starts and self.shifted:
            # Moving a contact moves samples in and out of contact, which makes minima of its own.
            for share in (-0.5, -0.1, -0.01, 0.01, 0.1, 0.5):
                moved = starts[0].copy()
                moved[free.size::2] = share * self.settings.offset_bound
                starts.append(moved)
        if any(law.parameters[i] in self.settings.start for i in free):
            stated = starts[0].copy() if starts else np.full(self.low.size, 0.0)
            for place, i in enumerate(free):
                stated[place] = self.settings.start.get(law.parameters[i], stated[place])
            starts.insert(0, stated)
        return starts


def fit_law(law: Law | str, replicates: Sequence[Replicate], settings: FitSettings) -> Solution:
    """Fit one law to all replicates together.

    Minimises the sum of squares of the nominal-stress error over all samples, unweighted as in the study, plus the
    priors in units of the pooled noise.

    Args:
        law: a law or its name.
        replicates: loading curves, at least one.
        settings: bounds, start, fixed, prior, offset.

    Raises:
        ValueError: no replicate.
        ConvergenceError: no start, and no set of fixed parameters, gives a finite stress.

    Source: trust region reflective method of scipy.optimize.least_squares (Branch, Coleman, Li, SIAM J. Sci. Comput.
    21 (1999) 1).
    """
    law = find_law(law) if isinstance(law, str) else law
    if not replicates:
        raise ValueError("fit_law needs at least one replicate")
    began = time.process_time()
    index = np.repeat(np.arange(len(replicates)), [r.stress.size for r in replicates])
    deviation = pooled_noise([r.noise for r in replicates], index)
    force_noise = max((r.noise * r.area for r in replicates if r.area is not None), default=0.0)
    full = _Problem(law, replicates, settings, deviation, force_noise)
    stride = -(-full.data.size // THINNED_POINTS)
    thin = full if stride == 1 else _Problem(law, replicates, settings, deviation, force_noise, stride)
    starts = thin.starts()
    tried = [thin.solve(start, THINNED_EVALUATIONS) for start in starts] if full.low.size else []
    found = [result for result in tried if result is not None]
    evaluations = sum(r.nfev for r in found)
    minima = _distinct([(r.x, 2 * r.cost) for r in found], full)
    refined = []
    for unknowns, _, count in minima[:MAX_MINIMA]:
        result = full.solve(unknowns, EVALUATIONS)
        if result is not None:
            evaluations += result.nfev
            refined.append((result, count))
    refined.sort(key=lambda item: item[0].cost)
    unknowns = refined[0][0].x if refined else np.zeros(0)
    if unknowns.size != full.low.size or not np.isfinite(full.residual(unknowns)).all():
        weighing = any(isinstance(r.model, Weighing) for r in replicates)
        hint = "; the specimen may be too heavy for it, so check density_kg_m3" if weighing else ""
        raise ConvergenceError(f"no start of {law.name} gives a finite stress over the data; state one in fit.start"
                               f"{hint}")
    values, nuisances = full.split(unknowns)
    stress, jacobian = full.stress(unknowns, derivatives=True)
    residual = stress - full.data
    merged = _distinct([(r.x, float(np.sum((full.stress(r.x) - full.data)**2))) for r, _ in refined], full,
                       [count for _, count in refined])
    reach = np.where(np.isfinite(full.high - full.low), full.high - full.low, np.inf)
    near = 1e-6 * np.where(np.isfinite(reach), reach, np.maximum(np.abs(unknowns), 1.0))
    on_bound = (unknowns - full.low <= near) | (full.high - unknowns <= near)
    minima = [(full.split(x)[0], s, n) for x, s, n in merged] or [(values, float(residual @ residual), 0)]
    return Solution(law, values, full.free, nuisances, unknowns, full.low, full.high, on_bound, jacobian, residual,
                    1.0 / full.prior_deviation**2, float(np.sum(full.prior_residual(unknowns)**2)), tuple(minima),
                    len(starts), evaluations, not refined or refined[0][0].status > 0, time.process_time() - began)


def jitter_columns(solution: Solution, replicates: Sequence[Replicate], noise: Noise,
                   offset: str) -> np.ndarray | None:
    """Stress that one standard deviation of contact and zero jitter makes, Pa, shape (n, 2); None where none is stated.

    Offsets that are fitted carry their jitter as a prior instead: no columns then.
    """
    if not (noise.contact_jitter or noise.zero_jitter):
        return None
    if offset == "fit":
        return np.empty((solution.residual.size, 0))
    columns = []
    for replicate in replicates:
        column = np.zeros((replicate.abscissa.size, 2))
        if replicate.mechanical:
            slope = replicate.model.slope(solution.law, replicate.abscissa, solution.values)
            column[:, 0] = slope * replicate.offset_slope * noise.contact_jitter
            column[:, 1] = replicate.zero_slope * noise.zero_jitter
        columns.append(column)
    return np.concatenate(columns)


def _distinct(points: list[tuple[np.ndarray, float]], problem: _Problem,
              counts: list[int] | None = None) -> list[tuple[np.ndarray, float, int]]:
    """Minima that differ in the parameters, best first, with how many points fell into each."""
    size = problem.free.size
    kept: list[list] = []
    order = sorted(range(len(points)), key=lambda i: points[i][1])
    for i in order:
        unknowns, cost = points[i]
        count = 1 if counts is None else counts[i]
        for other in kept:
            gap = np.abs(unknowns[:size] - other[0][:size])
            if (gap <= 1e-2 * np.abs(other[0][:size]) + 1e-9).all():
                other[2] += count
                break
        else:
            kept.append([unknowns, cost, count])
    return [tuple(item) for item in kept]
