"""The material that stands for all specimens, as a finished fit tells it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.fit.fit import Fit


@dataclass(frozen=True, eq=False)
class TypicalMaterial:
    """Numbers that all specimens share, and of those that differ between specimens the mean, or those of the single
    specimen that the material is of; SI.

    Attributes:
        parameters: path -> value. errors: path -> standard error; 0 of a fixed one, None where there is none.
        covariance: in the order of these, shape (p, p); zero beside what is fixed or on a bound.
    """

    parameters: dict[str, float]
    errors: dict[str, float | None]
    covariance: np.ndarray


def typical_material(fit: Fit) -> TypicalMaterial:
    """The material of a fit; without numbers that differ between tests or recordings."""
    name_of: dict[str, str] = {}
    for name in fit.parameters:
        path, at, mark = name.partition("@")
        if not at or mark in fit.material_of[:1]:
            name_of[path] = name
    order, places = list(name_of), [fit.covariance.order.index(name) for name in name_of.values()]
    parameters = {path: fit.parameters[name] for path, name in name_of.items()}
    errors = {path: fit.standard_errors[name] for path, name in name_of.items()}
    covariance = np.array(fit.covariance.matrix)[np.ix_(places, places)]
    if fit.population is not None:
        found = fit.population
        parameters |= dict(zip(found.order, found.mean, strict=True))
        errors |= dict(zip(found.order, found.mean_errors, strict=True))
        means = [order.index(path) for path in found.order]
        covariance[means], covariance[:, means] = 0.0, 0.0
        together = [order.index(path) for path in found.covariance.order]
        covariance[np.ix_(together, together)] = found.covariance.matrix
    return TypicalMaterial(parameters, errors, covariance)
