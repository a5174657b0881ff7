"""Records of a fit: covariance of parameters, and population of specimens."""

from __future__ import annotations

import msgspec


class ParameterCovariance(msgspec.Struct, frozen=True, kw_only=True):
    """Covariance matrix of parameters.

    Attributes:
        order: names of the parameters.
        matrix: covariance matrix, SI, shape (p, p) as lists.
    """

    order: list[str]
    matrix: list[list[float]]


class PopulationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Population of specimens with individual parameters, SI.

    See `calibration.statistics.population.PopulationEstimate`.

    Attributes:
        order: paths of the parameters.
        specimens: names of the included specimens; `Fit.left_out_specimens` are the others.
        mean: population mean.
        mean_errors: standard errors of the mean.
        mean_intervals: 95 % intervals of the mean.
        mean_covariance: covariance of the mean.
        covariance: joint covariance of the mean and the parameters that all specimens share.
        between: between-specimen covariance.
        spread: between-specimen standard deviations.
        spread_intervals: 95 % intervals of the spread.
        next_specimen: 95 % prediction intervals of a further specimen.
        estimates: estimates of each specimen alone.
        errors: standard errors of the estimates.
        shrunken: shrinkage estimates of each specimen.
        shrunken_errors: standard errors of the shrinkage estimates.
    """

    order: list[str]
    specimens: list[str]
    mean: list[float]
    mean_errors: list[float]
    mean_intervals: list[tuple[float, float]]
    mean_covariance: list[list[float]]
    covariance: ParameterCovariance
    between: list[list[float]]
    spread: list[float]
    spread_intervals: list[tuple[float, float]]
    next_specimen: list[tuple[float, float]]
    estimates: list[list[float]]
    errors: list[list[float]]
    shrunken: list[list[float]]
    shrunken_errors: list[list[float]]
