"""What a fit says of the population that its specimens come from, and whether specimens that share numbers differ."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy import special

from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.estimate import Estimate
from calibration.fit.fit import PopulationStatement
from calibration.statistics.adequacy import span
from calibration.statistics.population import FEWEST_SPECIMENS, estimate_population
from calibration.statistics.uncertainty import Uncertainty

#: Specimens differ where so large a share of the squares that are left is theirs, and chance has this probability.
_SHARE, _CHANCE = 0.3, 1e-3


def population_of(space: ParameterSpace, theta: np.ndarray, covariance: np.ndarray,
                  errors: np.ndarray) -> PopulationStatement | None:
    """The population of the specimens whose material has free numbers of its own; None where there are none, or fewer
    than two of them are determined.

    Args:
        space: of the parameters. theta: the free ones, SI, shape (p,). covariance: of these, shape (p, p).
        errors: their standard errors, shape (p,); not finite where a number is not determined or stays on its bound.
    """
    places = {(each.path, each.specimen): place for place, each in enumerate(space.varied)
              if each.specimen is not None and each.of_material}
    order = list(dict.fromkeys(path for path, _ in places))
    rows = {specimen: [places[path, specimen] for path in order] for _, specimen in places
            if all((path, specimen) in places for path in order)}
    told = {specimen: row for specimen, row in rows.items()
            if np.isfinite(errors[row]).all() and (errors[row] > 0).all()}
    if not order or len(told) < FEWEST_SPECIMENS:
        return None
    table = np.array(list(told.values()))
    # Beside numbers that are shared each specimen errs by itself only where these stand still.
    others = np.setdiff1d(np.flatnonzero(np.diag(covariance) > 0), [place for row in rows.values() for place in row])
    shared = covariance[np.ix_(others, others)]
    sizes, axes = np.linalg.eigh(shared / np.sqrt(np.outer(np.diag(shared), np.diag(shared))))
    kept = sizes > 1e-12
    # Columns of unit variance: errors along the axes of the shared numbers.
    unit = axes[:, kept] / np.sqrt(sizes[kept]) / np.sqrt(np.diag(shared))[:, None]
    common = np.array([covariance[np.ix_(row, others)] @ unit for row in table])
    alone = np.array([covariance[np.ix_(row, row)] - moved @ moved.T for row, moved in zip(table, common, strict=True)])
    found = estimate_population(order, list(told), theta[table], alone, common)
    numbers = ("mean", "mean_errors", "mean_intervals", "mean_covariance", "between", "spread", "spread_intervals",
               "next_specimen", "estimates", "errors", "shrunken", "shrunken_errors")
    return PopulationStatement(order=order, specimens=list(told),
                               **{name: getattr(found, name).tolist() for name in numbers})


def left_out_of_population(space: ParameterSpace, population: PopulationStatement | None) -> list[str]:
    """A warning where specimens with numbers of their own are no part of the population."""
    names = list(dict.fromkeys(each.specimen for each in space.varied
                               if each.specimen is not None and each.of_material))
    missing = [name for name in names if population is None or name not in population.specimens]
    if not missing or len(names) < FEWEST_SPECIMENS:
        return []
    rest = "no population: the material is that of the first specimen" if population is None else \
        f"population and material are those of the other {len(population.specimens)}"
    return [f"not all numbers of {', '.join(missing)} are determined inside their bounds, so {rest}"]


def as_another_specimen(space: ParameterSpace, theta: np.ndarray, spread: Uncertainty,
                        names: Collection[str]) -> tuple[np.ndarray, np.ndarray] | None:
    """Free parameters, shape (p,), and their covariance with the mean of the other specimens for numbers of a specimen
    that nothing tells; None where there is no such population.

    Args:
        space: of the parameters. theta: the free ones, SI, shape (p,). spread: their uncertainty.
        names: those that nothing tells.
    """
    places = [place for place, name in enumerate(space.free) if name in names]
    free = len(space.free)
    errors, covariance = spread.standard_errors[:free].copy(), spread.covariance[:free, :free].copy()
    errors[places] = np.inf
    found = population_of(space, theta, covariance, errors)
    if found is None or any(space.varied[place].path not in found.order or space.varied[place].specimen is None
                            for place in places):
        return None
    of_order = [found.order.index(space.varied[place].path) for place in places]
    further = np.array(found.between) + np.array(found.mean_covariance)
    theta = theta.copy()
    theta[places] = np.array(found.mean)[of_order]
    covariance[places], covariance[:, places] = 0.0, 0.0
    covariance[np.ix_(places, places)] = further[np.ix_(of_order, of_order)]
    return theta, covariance


def typical(space: ParameterSpace, values: dict[str, float],
            population: PopulationStatement | None) -> dict[str, float]:
    """The values with the mean of the population for each specimen."""
    if population is None:
        return values
    mean = dict(zip(population.order, population.mean, strict=True))
    return values | {each.name: mean[each.path] for each in space.varied
                     if each.specimen is not None and each.path in mean}


def differing_specimens(estimate: Estimate) -> list[str]:
    """A warning where specimens that share the numbers of a law differ in them; no second fit is needed for that.

    The squares that would vanish if each specimen had its own numbers, to first order: the part of the residual in the
    span of the derivatives, specimen by specimen, that the fit did not have.
    """
    problem, evaluation, space = estimate.problem, estimate.evaluation, estimate.problem.space
    shared = [place for place, each in enumerate(space.varied) if each.of_law and each.tests is None]
    specimens = [None if curve.test.specimen is None else curve.test.specimen.name for curve in problem.measured]
    if not shared or None in specimens or len(set(specimens)) < FEWEST_SPECIMENS:
        return []
    residual, design = evaluation.design
    modes = np.zeros((residual.size, len(set(specimens)) * len(shared)))
    for k, name in enumerate(dict.fromkeys(specimens)):
        for rows, specimen in zip(problem.rows, specimens, strict=True):
            if specimen == name:
                modes[rows, k * len(shared):(k + 1) * len(shared)] = evaluation.rates[rows][:, shared]
    fitted = span(design)
    modes -= fitted @ (fitted.T @ modes)
    found = span(modes)
    theirs, left = float(np.sum((found.T @ residual)**2)), float(residual @ residual)
    if theirs < _SHARE * left or special.chdtrc(found.shape[1], theirs) > _CHANCE:
        return []
    names = space.in_symbols([space.free[place] for place in shared])
    return [f"the specimens differ: {theirs / left:.0%} of the squares that are left would vanish if each had its own "
            f"{names}; that is scatter between specimens: give them the scope 'per_specimen' in [fit.scope]"]
