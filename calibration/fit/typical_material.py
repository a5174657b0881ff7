"""Representative material of a fit: shared parameters and the mean of individual ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.fit.fit import Fit


@dataclass(frozen=True, eq=False)
class RepresentativeMaterial:
    """Shared parameters, and the mean over specimens of individual parameters (or those of the only specimen).

    Attributes:
        parameters: path -> value, SI.
        errors: path -> standard error, SI; 0 if fixed, None if not determined.
        covariance: covariance in the order of `parameters`, SI, shape (p, p); zero for fixed parameters and bounds.
    """

    parameters: dict[str, float]
    errors: dict[str, float | None]
    covariance: np.ndarray


def get_shared_and_population_mean_material(fit: Fit) -> RepresentativeMaterial:
    """Return the representative material of a fit, without parameters of single tests or recordings."""
    name_of: dict[str, str] = {}
    for name in fit.parameters:
        path, at, mark = name.partition("@")
        if not at or mark in fit.material_of[:1]:
            name_of[path] = name
    order, indices = list(name_of), [fit.covariance.order.index(name) for name in name_of.values()]
    parameters = {path: fit.parameters[name] for path, name in name_of.items()}
    errors = {path: fit.standard_errors[name] for path, name in name_of.items()}
    covariance = np.array(fit.covariance.matrix)[np.ix_(indices, indices)]
    if fit.population is not None:
        found = fit.population
        parameters |= dict(zip(found.order, found.mean, strict=True))
        errors |= dict(zip(found.order, found.mean_errors, strict=True))
        means = [order.index(path) for path in found.order]
        covariance[means], covariance[:, means] = 0.0, 0.0
        together = [order.index(path) for path in found.covariance.order]
        covariance[np.ix_(together, together)] = found.covariance.matrix
    return RepresentativeMaterial(parameters, errors, covariance)
