"""Population of the specimens of a fit, and a test for differences between specimens with shared parameters.

Predictions use the parameters of the fit, or the population mean for a specimen without fitted tests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from calibration.campaign.campaign import Test
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.estimate import Estimate
from calibration.fit.fit import ParameterCovariance, PopulationRecord
from calibration.statistics.adequacy import compute_orthonormal_basis
from calibration.statistics.population import POPULATION, estimate_population
from calibration.statistics.uncertainty import ParameterUncertainty, ScatterComponent


@dataclass(frozen=True)
class SpecimenDifferenceSettings:
    """Limits of the warning that specimens with shared parameters differ.

    Attributes:
        min_fraction: smallest fraction of the residual sum of squares that differences between specimens explain, for a
            warning.
        max_p: largest p value of these differences, for a warning. A larger value gives more false warnings.
    """

    min_fraction: float = 0.3
    max_p: float = 1e-3


_SETTINGS = SpecimenDifferenceSettings()


@dataclass(frozen=True, eq=False)
class PopulationAndLeftOutSpecimens:
    """Specimens with individual material parameters; empty if all specimens share the parameters.

    Attributes:
        population: population of the specimens; None if fewer than two specimens are determined.
        material_of: names of the specimens whose mean is the material; without a population one specimen.
        left_out: name of a specimen -> reason why it is not included in the mean.
    """

    population: PopulationRecord | None = None
    material_of: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def specimen_names(self) -> tuple[str, ...]:
        """Names of all specimens with individual parameters."""
        return tuple(dict.fromkeys([*self.material_of, *self.left_out]))

    @property
    def missing_population_reason(self) -> str | None:
        """Reason why several specimens have no population mean; None if they have one, or if there is one specimen."""
        if self.population is not None or len(self.specimen_names) < POPULATION.min_specimens:
            return None
        first = self.material_of[0]
        alone = "" if first in self.left_out else f", or fit {first} in a separate campaign"
        return (f"no population: of {len(self.specimen_names)} specimens these are not determined: "
                f"{describe_excluded_specimens(self.left_out)}; so no material file is written, and E0 and mu0 are "
                f"those of {first} alone: widen fit.bounds, give undetermined parameters the scope 'shared'{alone}")

    def list_specimen_warnings(self, unusable: str | None) -> list[str]:
        """Return warnings on the specimens that the material represents.

        Args:
            unusable: reason why the fit is not usable, which is not repeated; None: it is usable.
        """
        missing = self.missing_population_reason
        if missing is not None:
            return [] if missing == unusable else [missing]
        if self.population is not None and self.left_out:
            return [f"no part of the population: {describe_excluded_specimens(self.left_out)}; mean, spread and "
                    f"material are those of the other {len(self.material_of)} specimens"]
        if self.population is None and self.specimen_names:
            return [f"the material is that of {self.specimen_names[0]}: a single specimen says nothing about the "
                    "scatter between specimens"]
        return []

    def replace_specimen_values_by_representative(self, space: ParameterSpace,
                                                  values: Mapping[str, float]) -> dict[str, float]:
        """Return parameter values in which each specimen has those of the representative material.

        Args:
            space: parameter space.
            values: name -> value, SI.
        """
        if self.population is not None:
            known = dict(zip(self.population.order, self.population.mean, strict=True))
        else:
            known = {each.path: values[each.name] for each in space.free_parameters
                     if each.specimen in self.material_of}
        return {**values, **{each.name: known[each.path] for each in space.free_parameters
                             if each.specimen is not None and each.path in known}}


def determine_population_and_left_out_specimens(space: ParameterSpace, theta: np.ndarray, covariance: np.ndarray,
                                                errors: np.ndarray) -> PopulationAndLeftOutSpecimens:
    """Determine the population of the specimens with individual parameters.

    Args:
        space: parameter space.
        theta: free parameters, SI, shape (p,).
        covariance: covariance of the free parameters, shape (p, p).
        errors: standard errors, shape (p,); not finite for undetermined parameters and those on a bound.

    Returns:
        The population, None with fewer than `PopulationSettings.min_specimens` determined specimens; the specimens
        that represent the material; and the reason for each specimen that is left out.
    """
    index_of = {(each.path, each.specimen): index for index, each in enumerate(space.free_parameters)
                if each.specimen is not None and each.is_material_parameter}
    order = list(dict.fromkeys(path for path, _ in index_of))
    rows = {specimen: [index_of[path, specimen] for path in order] for _, specimen in index_of}
    left_out = {specimen: "; ".join(reasons) for specimen, row in rows.items()
                if (reasons := _list_undetermined_reasons_of_specimen(space, theta, errors, row))}
    determined = [specimen for specimen in rows if specimen not in left_out]
    if len(determined) < POPULATION.min_specimens:
        return PopulationAndLeftOutSpecimens(None, tuple(determined or list(rows)[:1]), left_out)
    table = np.array([rows[specimen] for specimen in determined])
    # The errors of shared parameters are common to all specimens. Given the shared parameters, the errors of different
    # specimens are independent.
    others = np.setdiff1d(np.flatnonzero(np.diag(covariance) > 0), [index for row in rows.values() for index in row])
    shared = covariance[np.ix_(others, others)]
    sizes, axes = np.linalg.eigh(shared / np.sqrt(np.outer(np.diag(shared), np.diag(shared))))
    kept = sizes > 1e-12
    # Directions of the shared parameters with unit variance.
    unit = axes[:, kept] / np.sqrt(sizes[kept]) / np.sqrt(np.diag(shared))[:, None]
    common = np.array([covariance[np.ix_(row, others)] @ unit for row in table])
    alone = np.array([covariance[np.ix_(row, row)] - moved @ moved.T for row, moved in zip(table, common, strict=True)])
    found = estimate_population(order, determined, theta[table], alone, common)
    # Parameters of single tests or recordings do not belong to a further specimen.
    everywhere = [k for k, index in enumerate(others)
                  if space.free_parameters[index].name == space.free_parameters[index].path]
    cross = (found.mean_moves @ unit.T @ shared)[:, everywhere]
    together = np.block([[found.mean_covariance, cross], [cross.T, shared[np.ix_(everywhere, everywhere)]]])
    names = ("mean", "mean_errors", "mean_intervals", "mean_covariance", "between", "spread", "spread_intervals",
             "next_specimen", "estimates", "errors", "shrunken", "shrunken_errors")
    return PopulationAndLeftOutSpecimens(PopulationRecord(
        order=order, specimens=determined, covariance=ParameterCovariance(
            order=[*order, *(space.free[others[k]] for k in everywhere)], matrix=together.tolist()),
        **{name: getattr(found, name).tolist() for name in names}), tuple(determined), left_out)


def _list_undetermined_reasons_of_specimen(space: ParameterSpace, theta: np.ndarray, errors: np.ndarray,
                                           row: Sequence[int]) -> list[str]:
    """Return the reasons why parameters of a specimen are not determined; empty if all are.

    Args:
        space: parameter space.
        theta: free parameters, SI, shape (p,).
        errors: standard errors, shape (p,).
        row: indices of the parameters of the specimen.
    """
    reasons: dict[str, list[str]] = {}
    for index in row:
        if np.isfinite(errors[index]) and errors[index] > 0:
            continue
        unit, ends = space.free_parameters[index].declaration.unit, (space.low[index], space.high[index])
        bound = min(ends, key=lambda end: abs(end - theta[index]))
        why = f"on its bound {bound:.4g}{'' if unit == '1' else f' {unit}'}" if np.isnan(errors[index]) else \
            "not determined by its tests"
        reasons.setdefault(why, []).append(space.symbols[space.free[index]].partition("@")[0])
    return [f"{', '.join(symbols)} {why}" for why, symbols in reasons.items()]


def describe_excluded_specimens(left_out: Mapping[str, str]) -> str:
    """Describe specimens that are not included in a mean, such as ``animal_2 (C20 on its bound 0 Pa)``."""
    return ", ".join(f"{name} ({why})" for name, why in left_out.items())


def list_warning_if_specimens_differ(estimate: Estimate) -> list[str]:
    """Return a warning if specimens that share the parameters of a law differ significantly.

    The test needs no second fit: the decrease of the sum of squares by individual parameters is, to first order, the
    squared projection of the residual on the derivatives of each specimen, orthogonal to the fitted space.
    """
    problem, evaluation, space = estimate.problem, estimate.evaluation, estimate.problem.space
    shared = [index for index, each in enumerate(space.free_parameters) if each.is_law_parameter and each.tests is None]
    specimens = [None if curve.test.specimen is None else curve.test.specimen.name for curve in problem.measured]
    if not shared or None in specimens or len(set(specimens)) < POPULATION.min_specimens:
        return []
    residual, design = evaluation.full_residual_and_jacobian
    modes = np.zeros((residual.size, len(set(specimens)) * len(shared)))
    for k, name in enumerate(dict.fromkeys(specimens)):
        for rows, specimen in zip(problem.rows, specimens, strict=True):
            if specimen == name:
                modes[rows, k * len(shared):(k + 1) * len(shared)] = evaluation.rates[rows][:, shared]
    fitted = compute_orthonormal_basis(design)
    modes -= fitted @ (fitted.T @ modes)
    found = compute_orthonormal_basis(modes)
    decrease, total = float(np.sum((found.T @ residual)**2)), float(residual @ residual)
    if decrease < _SETTINGS.min_fraction * total or special.chdtrc(found.shape[1], decrease) > _SETTINGS.max_p:
        return []
    names = space.format_symbols([space.free[index] for index in shared])
    return [f"the specimens differ: individual values of {names} would explain {decrease / total:.0%} of the residual "
            "sum of squares; give these parameters the scope 'per_specimen' in [fit.scope]"]


@dataclass(frozen=True, eq=False)
class PredictionParameters:
    """Parameters that predict a test, and their covariance.

    Attributes:
        space: parameter space.
        theta: free parameters, SI, shape (p,).
        covariance: covariance of the free parameters, shape (p, p).
        mean_of: specimens whose mean replaces the parameters of the test's specimen; empty: they are known.
        sampled: part of the covariance that was estimated from the specimens in `mean_of`, shape (p, p); None: none.
    """

    space: ParameterSpace
    theta: np.ndarray
    covariance: np.ndarray
    mean_of: tuple[str, ...] = ()
    sampled: np.ndarray | None = None

    @classmethod
    def from_minimum_and_uncertainty(cls, space: ParameterSpace, theta: np.ndarray,
                                     spread: ParameterUncertainty) -> PredictionParameters:
        """Return the predictor of an estimate, without unknowns other than the parameters, such as offsets."""
        free = len(space.free)
        return cls(space, theta[:free], spread.covariance[:free, :free])

    def compute_force_scatter_components(self, rates: np.ndarray) -> list[ScatterComponent]:
        """Return the scatter of a predicted force by the uncertainty of the parameters.

        Args:
            rates: derivatives of the force with respect to the free parameters, shape (n, p).
        """
        if self.sampled is None:
            return [ScatterComponent(rates @ _compute_covariance_root(self.covariance))]
        return [ScatterComponent(rates @ _compute_covariance_root(self.covariance - self.sampled)),
                ScatterComponent(rates @ _compute_covariance_root(self.sampled), max(len(self.mean_of) - 1.0, 1.0))]


def _compute_covariance_root(covariance: np.ndarray) -> np.ndarray:
    """Return R with R R' = covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def make_population_mean_predictor(space: ParameterSpace, theta: np.ndarray, population: PopulationRecord,
                                   specimen: str) -> PredictionParameters:
    """Return a predictor with the population mean for all parameters of a further specimen.

    Its covariance is the between-specimen covariance plus the joint covariance of the mean and the shared parameters.

    Args:
        space: parameter space with the parameters of the specimen.
        theta: free parameters, SI, shape (p,).
        population: population that does not contain the specimen.
        specimen: name of the specimen.
    """
    order, known = population.order, population.covariance
    own = [index for index, each in enumerate(space.free_parameters) if each.specimen == specimen
           and each.path in order]
    of_mean = [order.index(space.free_parameters[index].path) for index in own]
    indices = [*own, *(space.free.index(name) for name in known.order[len(order):])]
    rows = [*of_mean, *range(len(order), len(known.order))]
    theta, covariance, sampled = theta.copy(), *np.zeros((2, theta.size, theta.size))
    theta[own] = np.array(population.mean)[of_mean]
    together = np.array(known.matrix)[np.ix_(rows, rows)]
    covariance[np.ix_(indices, indices)] = together
    covariance[np.ix_(own, own)] += np.array(population.between)[np.ix_(of_mean, of_mean)]
    # The conditional covariance given the shared parameters is due to the choice of the specimens.
    cross, shared = together[:len(own), len(own):], together[len(own):, len(own):]
    sampled[np.ix_(own, own)] = covariance[np.ix_(own, own)] - cross @ _invert_covariance(shared) @ cross.T
    return PredictionParameters(space, theta, covariance, tuple(population.specimens), sampled)


def _invert_covariance(covariance: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a covariance of parameters with different units."""
    sizes = np.sqrt(np.diag(covariance))
    return np.linalg.pinv(covariance / np.outer(sizes, sizes), rcond=1e-12, hermitian=True) / np.outer(sizes, sizes)


def make_held_out_predictor_or_none(test: Test, predictor: PredictionParameters, population: PopulationRecord | None
                                    ) -> PredictionParameters | None:
    """Return the predictor of a held-out test; None if its specimen has unknown parameters and there is no population.

    Args:
        test: held-out test.
        predictor: predictor of the estimate.
        population: population of the fitted specimens; None: none.
    """
    space, theta = predictor.space, predictor.theta
    if test.specimen is None:
        return predictor
    further = space.with_parameters_for_unfitted_specimen(test.specimen.name, [test.name])
    added = len(further.free) - len(space.free)
    if not added:
        return PredictionParameters(further, theta, predictor.covariance)
    if population is None:
        return None
    return make_population_mean_predictor(further, np.append(theta, np.zeros(added)), population, test.specimen.name)


def adapt_predictor_to_left_out_test_or_none(predictor: PredictionParameters, spread: ParameterUncertainty,
                                             undetermined: Sequence[str]) -> PredictionParameters | None:
    """Return the predictor of a test from a fit to the other tests.

    Args:
        predictor: predictor of the fit to the other tests.
        spread: uncertainty of this fit.
        undetermined: names of parameters that act in the test and are not determined by the other tests.

    Returns:
        The predictor, with the population mean if all undetermined parameters belong to one specimen; otherwise None.
    """
    space = predictor.space
    owners = {space.get_parameter_by_name(name).specimen if space.get_parameter_by_name(name).is_material_parameter
              else None
              for name in undetermined}
    if not owners:
        return predictor
    owner = owners.pop()
    if owner is None or owners:
        return None
    errors = np.where([each.specimen == owner for each in space.free_parameters], np.inf,
                      spread.standard_errors[: len(space.free)])
    population = determine_population_and_left_out_specimens(space, predictor.theta, predictor.covariance,
                                                             errors).population
    return None if population is None else make_population_mean_predictor(space, predictor.theta, population, owner)
