"""What predicts a test: the numbers of the fit, or for a specimen that nothing tells the mean of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import PopulationStatement
from calibration.fit.population import find_specimens
from calibration.statistics.bands import Scatter
from calibration.statistics.uncertainty import Uncertainty


@dataclass(frozen=True, eq=False)
class Predictor:
    """Numbers that predict a test, and what they may err by.

    Attributes:
        space: of the parameters. theta: the free ones, SI, shape (p,). covariance: of these, shape (p, p).
        mean_of: specimens whose mean stands for the test's own; empty: its own numbers are known.
        sampled: the part of the covariance that is known from so few specimens only, shape (p, p); None: none is.
    """

    space: ParameterSpace
    theta: np.ndarray
    covariance: np.ndarray
    mean_of: tuple[str, ...] = ()
    sampled: np.ndarray | None = None

    @classmethod
    def of(cls, space: ParameterSpace, theta: np.ndarray, spread: Uncertainty) -> Predictor:
        """That of an estimate; unknowns beside the parameters, such as offsets, are no part of it."""
        free = len(space.free)
        return cls(space, theta[:free], spread.covariance[:free, :free])

    def scatters(self, rates: np.ndarray) -> list[Scatter]:
        """How a force errs with the numbers.

        Args:
            rates: its derivatives, shape (n, p).
        """
        if self.sampled is None:
            return [Scatter(rates @ _root(self.covariance))]
        return [Scatter(rates @ _root(self.covariance - self.sampled)),
                Scatter(rates @ _root(self.sampled), max(len(self.mean_of) - 1.0, 1.0))]


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def stand_in(space: ParameterSpace, theta: np.ndarray, population: PopulationStatement, specimen: str) -> Predictor:
    """The mean of a population for all numbers of a specimen that is no part of it.

    It errs by the scatter between specimens, by the error of the mean, and together with the mean by the numbers that
    all specimens share. Numbers that do not act in its tests err by nothing here.

    Args:
        space: of the parameters. theta: the free ones, SI, shape (p,). specimen: its name.
    """
    order, known = population.order, population.covariance
    own = [place for place, each in enumerate(space.varied) if each.specimen == specimen and each.path in order]
    of_mean = [order.index(space.varied[place].path) for place in own]
    places = [*own, *(space.free.index(name) for name in known.order[len(order):])]
    rows = [*of_mean, *range(len(order), len(known.order))]
    theta, covariance, sampled = theta.copy(), *np.zeros((2, theta.size, theta.size))
    theta[own] = np.array(population.mean)[of_mean]
    together = np.array(known.matrix)[np.ix_(rows, rows)]
    covariance[np.ix_(places, places)] = together
    covariance[np.ix_(own, own)] += np.array(population.between)[np.ix_(of_mean, of_mean)]
    # Of the mean's own error, that which comes from the choice of specimens and not from what they share.
    cross, shared = together[:len(own), len(own):], together[len(own):, len(own):]
    sampled[np.ix_(own, own)] = covariance[np.ix_(own, own)] - cross @ _inverse(shared) @ cross.T
    return Predictor(space, theta, covariance, tuple(population.specimens), sampled)


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Of a covariance of numbers of any units, without directions that have no variance."""
    sizes = np.sqrt(np.diag(covariance))
    return np.linalg.pinv(covariance / np.outer(sizes, sizes), rcond=1e-12, hermitian=True) / np.outer(sizes, sizes)


def predictor_of_held_out(test: Test, predictor: Predictor, population: PopulationStatement | None) -> Predictor | None:
    """What predicts a test that no fit has seen; None where its specimen has numbers of its own that nothing tells.

    Args:
        test: as asked. predictor: of the estimate. population: of the specimens that were fitted.
    """
    space, theta = predictor.space, predictor.theta
    if test.specimen is None:
        return predictor
    further = space.with_specimen(test.specimen.name, [test.name])
    added = len(further.free) - len(space.free)
    if not added:
        return Predictor(further, theta, predictor.covariance)
    if population is None:
        return None
    return stand_in(further, np.append(theta, np.zeros(added)), population, test.specimen.name)


def predictor_without(predictor: Predictor, spread: Uncertainty, untold: Sequence[str]) -> Predictor | None:
    """What predicts a test from a fit to the others; None where these leave something open that no mean stands for.

    Args:
        predictor: of that fit. spread: its uncertainty. untold: names of what acts in the test and is not determined.
    """
    space = predictor.space
    owners = {space.unknown(name).specimen if space.unknown(name).of_material else None for name in untold}
    if not owners:
        return predictor
    owner = owners.pop()
    if owner is None or owners:
        return None
    errors = np.where([each.specimen == owner for each in space.varied], np.inf,
                      spread.standard_errors[: len(space.free)])
    population = find_specimens(space, predictor.theta, predictor.covariance, errors).population
    return None if population is None else stand_in(space, predictor.theta, population, owner)
