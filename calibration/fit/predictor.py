"""Parameters for predictions: those of the fit, or the population mean for a specimen without fitted tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.population import determine_population_and_left_out_specimens
from calibration.fit.population_records import PopulationRecord
from calibration.statistics.bands import ScatterComponent
from calibration.statistics.uncertainty import ParameterUncertainty


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
