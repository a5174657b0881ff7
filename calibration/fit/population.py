"""What a fit says of the population that its specimens come from, and whether specimens that share numbers differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.estimate import Estimate
from calibration.fit.fit import Covariance, PopulationStatement
from calibration.statistics.adequacy import orthonormal_basis
from calibration.statistics.population import MIN_SPECIMENS, estimate_population

#: Specimens differ where so large a share of the squares that are left is theirs, and chance has this probability.
_SHARE, _CHANCE = 0.3, 1e-3


@dataclass(frozen=True, eq=False)
class Specimens:
    """What a fit says of specimens whose material has free numbers of its own; empty where there are none.

    Attributes:
        population: that they come from; None where fewer than two are determined.
        material_of: names of those whose mean stands for all; without a population of one alone.
        left_out: name -> why its numbers are in no mean.
    """

    population: PopulationStatement | None = None
    material_of: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all of them."""
        return tuple(dict.fromkeys([*self.material_of, *self.left_out]))

    @property
    def missing_population(self) -> str | None:
        """Why several specimens have no mean, for people; None where they have one, or there are not several."""
        if self.population is not None or len(self.names) < MIN_SPECIMENS:
            return None
        first = self.material_of[0]
        alone = "" if first in self.left_out else f", or fit {first} in a campaign of its own"
        return (f"no population: of {len(self.names)} specimens these are not determined: {in_words(self.left_out)}; "
                f"so no material file is written, and E0 and mu0 are those of {first} alone: widen fit.bounds, give "
                f"what the tests do not tell the scope 'shared'{alone}")

    def warnings(self, unusable: str | None) -> list[str]:
        """What to mind of whom the material stands for, beside what makes it `unusable`."""
        missing = self.missing_population
        if missing is not None:
            return [] if missing == unusable else [missing]
        if self.population is not None and self.left_out:
            return [f"no part of the population: {in_words(self.left_out)}; mean, spread and material are those of "
                    f"the other {len(self.material_of)} specimens"]
        if self.population is None and self.names:
            return [f"the material is that of {self.names[0]}: a single specimen says nothing about the scatter "
                    "between specimens"]
        return []

    def typical(self, space: ParameterSpace, values: Mapping[str, float]) -> dict[str, float]:
        """The values with those of the material for each specimen: the mean, or those of the one that it is of."""
        if self.population is not None:
            known = dict(zip(self.population.order, self.population.mean, strict=True))
        else:
            known = {each.path: values[each.name] for each in space.varied if each.specimen in self.material_of}
        return {**values, **{each.name: known[each.path] for each in space.varied
                             if each.specimen is not None and each.path in known}}


def find_specimens(space: ParameterSpace, theta: np.ndarray, covariance: np.ndarray, errors: np.ndarray) -> Specimens:
    """Which specimens are determined, and the population that these come from.

    Args:
        space: of the parameters. theta: the free ones, SI, shape (p,). covariance: of these, shape (p, p).
        errors: their standard errors, shape (p,); not finite where a number is not determined or stays on its bound.
    """
    places = {(each.path, each.specimen): place for place, each in enumerate(space.varied)
              if each.specimen is not None and each.of_material}
    order = list(dict.fromkeys(path for path, _ in places))
    rows = {specimen: [places[path, specimen] for path in order] for _, specimen in places}
    left_out = {specimen: "; ".join(reasons) for specimen, row in rows.items()
                if (reasons := _lacking(space, theta, errors, row))}
    told = [specimen for specimen in rows if specimen not in left_out]
    if len(told) < MIN_SPECIMENS:
        return Specimens(None, tuple(told or list(rows)[:1]), left_out)
    table = np.array([rows[specimen] for specimen in told])
    # Beside numbers that are shared each specimen errs by itself only where these stand still.
    others = np.setdiff1d(np.flatnonzero(np.diag(covariance) > 0), [place for row in rows.values() for place in row])
    shared = covariance[np.ix_(others, others)]
    sizes, axes = np.linalg.eigh(shared / np.sqrt(np.outer(np.diag(shared), np.diag(shared))))
    kept = sizes > 1e-12
    # Columns of unit variance: errors along the axes of the shared numbers.
    unit = axes[:, kept] / np.sqrt(sizes[kept]) / np.sqrt(np.diag(shared))[:, None]
    common = np.array([covariance[np.ix_(row, others)] @ unit for row in table])
    alone = np.array([covariance[np.ix_(row, row)] - moved @ moved.T for row, moved in zip(table, common, strict=True)])
    found = estimate_population(order, told, theta[table], alone, common)
    # Of one value in all tests: those of single tests and recordings are no part of a further specimen.
    everywhere = [k for k, place in enumerate(others) if space.varied[place].name == space.varied[place].path]
    cross = (found.mean_moves @ unit.T @ shared)[:, everywhere]
    together = np.block([[found.mean_covariance, cross], [cross.T, shared[np.ix_(everywhere, everywhere)]]])
    names = ("mean", "mean_errors", "mean_intervals", "mean_covariance", "between", "spread", "spread_intervals",
             "next_specimen", "estimates", "errors", "shrunken", "shrunken_errors")
    return Specimens(PopulationStatement(
        order=order, specimens=told, covariance=Covariance(
            order=[*order, *(space.free[others[k]] for k in everywhere)], matrix=together.tolist()),
        **{name: getattr(found, name).tolist() for name in names}), tuple(told), left_out)


def _lacking(space: ParameterSpace, theta: np.ndarray, errors: np.ndarray, row: Sequence[int]) -> list[str]:
    """Why numbers of a specimen are not determined, in words."""
    reasons: dict[str, list[str]] = {}
    for place in row:
        if np.isfinite(errors[place]) and errors[place] > 0:
            continue
        unit, ends = space.varied[place].declaration.unit, (space.low[place], space.high[place])
        bound = min(ends, key=lambda end: abs(end - theta[place]))
        why = f"on its bound {bound:.4g}{'' if unit == '1' else f' {unit}'}" if np.isnan(errors[place]) else \
            "not determined by its tests"
        reasons.setdefault(why, []).append(space.symbols[space.free[place]].partition("@")[0])
    return [f"{', '.join(symbols)} {why}" for why, symbols in reasons.items()]


def in_words(left_out: Mapping[str, str]) -> str:
    """Specimens and why they are in no mean: ``animal_2 (C20 on its bound 0 Pa)``."""
    return ", ".join(f"{name} ({why})" for name, why in left_out.items())


def differing_specimens(estimate: Estimate) -> list[str]:
    """A warning where specimens that share the numbers of a law differ in them; no second fit is needed for that.

    The squares that would vanish if each specimen had its own numbers, to first order: the part of the residual in the
    span of the derivatives, specimen by specimen, that the fit did not have.
    """
    problem, evaluation, space = estimate.problem, estimate.evaluation, estimate.problem.space
    shared = [place for place, each in enumerate(space.varied) if each.of_law and each.tests is None]
    specimens = [None if curve.test.specimen is None else curve.test.specimen.name for curve in problem.measured]
    if not shared or None in specimens or len(set(specimens)) < MIN_SPECIMENS:
        return []
    residual, design = evaluation.design
    modes = np.zeros((residual.size, len(set(specimens)) * len(shared)))
    for k, name in enumerate(dict.fromkeys(specimens)):
        for rows, specimen in zip(problem.rows, specimens, strict=True):
            if specimen == name:
                modes[rows, k * len(shared):(k + 1) * len(shared)] = evaluation.rates[rows][:, shared]
    fitted = orthonormal_basis(design)
    modes -= fitted @ (fitted.T @ modes)
    found = orthonormal_basis(modes)
    theirs, left = float(np.sum((found.T @ residual)**2)), float(residual @ residual)
    if theirs < _SHARE * left or special.chdtrc(found.shape[1], theirs) > _CHANCE:
        return []
    names = space.in_symbols([space.free[place] for place in shared])
    return [f"the specimens differ: {theirs / left:.0%} of the squares that are left would vanish if each had its own "
            f"{names}; that is scatter between specimens: give them the scope 'per_specimen' in [fit.scope]"]
