"""From the solution of a fit to what people need to know about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.analytical.replicates import Replicate
from calibration.analytical.uniaxial import Solution, jitter_columns
from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Covariance, Fit, Minimum, Nuisance, Prediction
from calibration.report.self_weight import sags
from calibration.statistics.statistics import (
    CURVATURE_RATIO,
    MODEL_ERROR_RATIO,
    Uncertainty,
    chi_square,
    correlation,
    information_criteria,
    r_squared,
    uncertainty,
)
from tissue_sim.laws import Law, Stability, check_stability, find_law
from tissue_sim.laws.stability import STRETCH_RANGE


def assess(solution: Solution, replicates: Sequence[Replicate], campaign: Campaign) -> Fit:
    """The `Fit` of a solution: uncertainties, goodness, moduli, stability and a message.

    Args:
        solution: from `calibration.analytical.uniaxial.fit_law` over these replicates.
        replicates: those that were fitted. campaign: where they come from.
    """
    law, residual = solution.law, solution.residual
    data = np.concatenate([r.stress for r in replicates])
    index = np.repeat(np.arange(len(replicates)), [r.stress.size for r in replicates])
    noise = np.array([r.noise for r in replicates])
    interpolations = [r.interpolation for r in replicates]
    jitter = jitter_columns(solution, replicates, campaign.noise, campaign.fit.offset)
    # What a bound holds is not free; its own error is not known.
    inside = ~solution.on_bound
    spread = uncertainty(solution.jacobian[:, inside], residual, index, noise, solution.prior_precision[inside], jitter,
                         interpolations)
    squares, samples = chi_square(residual, index, noise, interpolations)
    ratio = float(np.sqrt(squares / samples))

    count = len(law.parameters)
    free = solution.free
    unknown_errors = np.full(inside.size, np.nan)
    unknown_errors[inside] = spread.standard_errors
    errors, covariance = np.zeros(count), np.zeros((count, count))
    errors[free] = unknown_errors[: free.size]
    kept = free[inside[: free.size]]
    covariance[np.ix_(kept, kept)] = spread.covariance[: kept.size, : kept.size]
    loose = [name for name, error, value in zip(law.parameters, errors, solution.values, strict=True)
             if error > abs(value)]
    measured = _measured_ranges(law, solution.values, replicates)
    stretches = _stretch_range(measured)
    stability = check_stability(law, solution.values, (min(STRETCH_RANGE[0], stretches[0]),
                                                       max(STRETCH_RANGE[1], stretches[1])))
    mu0 = law.mu0(solution.values)
    aic, bic = information_criteria(squares + solution.prior_squares, samples, solution.unknowns.size)
    on_bound = [law.parameters[i] for i, hit in zip(free, solution.on_bound[: free.size], strict=True) if hit]
    nuisances = _nuisances(solution, unknown_errors, replicates)
    on_bound += [f"{n.replicate}: {name}" for n in nuisances for name in n.on_bound]
    status, unusable = _verdict(solution, stability, measured, mu0)
    warnings = [f"{name} ended on its bound {value:.6g}" for name, value in _held(solution, on_bound, nuisances)]
    if mu0 > 0:
        warnings += _other_losses(stability, measured)
    message = _message(solution, spread, (status, unusable), warnings, loose, replicates, ratio)
    total = float(np.sum((data - data.mean())**2))
    return Fit(
        law=law.name, formula=law.formula(), parameters=law.as_mapping(solution.values),
        standard_errors={name: float(e) if np.isfinite(e) else None
                         for name, e in zip(law.parameters, errors, strict=True)},
        covariance=Covariance(order=list(law.parameters), matrix=covariance.tolist()),
        correlation=correlation(covariance).tolist(), covariance_from=spread.basis,
        intervals95=_intervals(solution, errors, spread.quantile),
        not_identifiable=loose, on_bound=on_bound, R2=r_squared(data, residual),
        RMSE_N=_force_rmse(residual, replicates), RMSE_Pa=float(np.sqrt(np.mean(residual**2))),
        noise_ratio=ratio, AIC=aic, BIC=bic,
        E0=law.E0(solution.values), mu0=mu0, stable_from=stability.stable_from, stable_to=stability.stable_to,
        stability=stability.describe(), stretch_range=stretches,
        sag_mm=sags(law, solution.values, campaign), nuisances=nuisances,
        minima=[Minimum(parameters=law.as_mapping(values), R2=1.0 - squares / total, starts=starts)
                for values, squares, starts in solution.minima],
        starts=solution.starts, status=status, unusable=unusable, warnings=warnings, message=message,
        iterations=solution.evaluations, cpu_s=solution.cpu_s,
        material_file=f"{law.name}.material.json" if mu0 > 0 else None)


def predict(law: Law | str, parameters, replicates: Sequence[Replicate]) -> list[Prediction]:
    """How a fitted law predicts each of the tests that these replicates belong to; no offset, no zero."""
    law = find_law(law) if isinstance(law, str) else law
    predictions = []
    for name in dict.fromkeys(r.test.name for r in replicates):
        mine = [r for r in replicates if r.test.name == name]
        residual = np.concatenate([r.model.stress(law, r.abscissa, parameters) - r.stress for r in mine])
        if not np.isfinite(residual).all():
            predictions.append(Prediction(test=name, law=law.name, RMSE_N=None, RMSE_Pa=None, percent=None))
            continue
        rmse = float(np.sqrt(np.mean(residual**2)))
        largest = max(float(np.abs(r.stress).max()) for r in mine)
        predictions.append(Prediction(test=name, law=law.name, RMSE_N=_force_rmse(residual, mine), RMSE_Pa=rmse,
                                      percent=100.0 * rmse / largest))
    return predictions


def residual_of(fit: Fit, replicate: Replicate) -> np.ndarray:
    """Model minus data of one replicate with its fitted offset and zero, Pa, shape (n,)."""
    nuisance = next((n for n in fit.nuisances if n.replicate == replicate.name), None)
    abscissa, zero = replicate.abscissa, 0.0
    if nuisance is not None:
        abscissa = abscissa + replicate.offset_slope * nuisance.contact_offset_mm * 1e-3
        zero = replicate.zero_slope * nuisance.zero_offset_N
    return replicate.model.stress(find_law(fit.law), abscissa, fit.parameters) + zero - replicate.stress


def _force_rmse(residual: np.ndarray, replicates: Sequence[Replicate]) -> float | None:
    if any(r.area is None for r in replicates):
        return None
    area = np.repeat([r.area for r in replicates], [r.stress.size for r in replicates])
    return float(np.sqrt(np.mean((residual * area)**2)))


#: Mode of `Stability.limits` -> extreme principal stretches along the load, rest included.
Ranges = dict[str, tuple[float, float]]


def _stretch_range(measured: Ranges) -> tuple[float, float]:
    """Extreme stretches over all modes."""
    return min(low for low, _ in measured.values()), max(high for _, high in measured.values())


def _measured_ranges(law: Law, values: np.ndarray, replicates: Sequence[Replicate]) -> Ranges:
    """What the data reach in each mode that was measured."""
    ranges: Ranges = {}
    for replicate in replicates:
        mode, *ends = replicate.model.reached(law, replicate.abscissa, values)
        low, high = ranges.get(mode, (1.0, 1.0))
        ranges[mode] = min(low, ends[0]), max(high, ends[1])
    return ranges


def _intervals(solution: Solution, errors: np.ndarray, quantile: float) -> dict[str, tuple[float, float] | None]:
    """95 % intervals inside the bounds; None without a standard error."""
    low, high = np.full(errors.size, -np.inf), np.full(errors.size, np.inf)
    low[solution.free], high[solution.free] = (side[: solution.free.size] for side in (solution.low, solution.high))
    ends = np.clip([solution.values - quantile * errors, solution.values + quantile * errors], low, high)
    return {name: (float(start), float(end)) if np.isfinite(error) else None
            for name, start, end, error in zip(solution.law.parameters, *ends, errors, strict=True)}


def _nuisances(solution: Solution, errors: np.ndarray, replicates: Sequence[Replicate]) -> list[Nuisance]:
    errors = errors[solution.free.size:].reshape(-1, 2)
    hits = solution.on_bound[solution.free.size:].reshape(-1, 2)
    if not errors.size:
        return []
    fitted = [(r, values) for r, values in zip(replicates, solution.nuisances, strict=True) if r.mechanical]
    names = np.array(["contact_offset_mm", "zero_offset_N"])
    contact, zero = ([float(e) if np.isfinite(e) else None for e in column] for column in (errors * [1e3, 1.0]).T)
    return [Nuisance(replicate=r.name, contact_offset_mm=float(values[0] * 1e3), contact_offset_error_mm=contact[i],
                     zero_offset_N=float(values[1]), zero_offset_error_N=zero[i], on_bound=names[hits[i]].tolist())
            for i, (r, values) in enumerate(fitted)]


def _held(solution: Solution, on_bound: Sequence[str], nuisances: Sequence[Nuisance]) -> list[tuple[str, float]]:
    """Everything that ended on a bound, and its value there in the unit of the file."""
    values = dict(solution.law.as_mapping(solution.values))
    values.update((f"{n.replicate}: {name}", getattr(n, name)) for n in nuisances for name in n.on_bound)
    return [(name, values[name]) for name in on_bound]


def _losses(stability: Stability, mode: str, stretches: tuple[float, float]) -> str:
    """Where one mode loses Drucker stability inside these stretches, in words; empty where it does not."""
    (low, high), (lower, upper) = stretches, stability.limits[mode]
    if lower == upper == 1.0:
        return f"in {mode} loading at every stretch"
    ends = [f"{side} stretch {limit:.3g}" for side, limit, lost in (("below", lower, lower > low),
                                                                  ("above", upper, upper < high)) if lost]
    return f"in {mode} loading {' and '.join(ends)}" if ends else ""


def _other_losses(stability: Stability, measured: Ranges) -> list[str]:
    """A warning where loading that was not measured is unstable inside the stretches of the data."""
    reached = _stretch_range(measured)
    found = [loss for mode in stability.limits if mode not in measured
             if (loss := _losses(stability, mode, reached))]
    return [f"not stable {' and '.join(found)}, which was not measured"] if found else []


def _verdict(solution: Solution, stability: Stability, measured: Ranges, mu0: float) -> tuple[str, str | None]:
    """Status, and why the law is not usable over the data."""
    if not mu0 > 0:
        return "not_physical", f"its shear modulus at rest is {mu0:.4g} Pa"
    if not solution.converged:
        return "not_converged", "it did not converge"
    lost = [loss for mode, reached in measured.items() if (loss := _losses(stability, mode, reached))]
    if lost:
        return "unstable", f"not stable {' and '.join(lost)}, where there are data"
    return "converged", None


#: Status -> what to do about a fit that is not usable.
_REMEDIES = {
    "not_physical": "no material has that, so no material file is written: set bounds or use another law",
    "not_converged": "the optimiser ran out of evaluations in a flat valley where other parameters fit as well: fix "
                     "one, or use a law with fewer",
}


def _message(solution: Solution, spread: Uncertainty, verdict: tuple[str, str | None], warnings: Sequence[str],
             loose: Sequence[str], replicates: Sequence[Replicate], ratio: float) -> str:
    status, unusable = verdict
    starts = f"{solution.starts} start{'s' if solution.starts != 1 else ''}"
    parts = [f"converged from {starts}" if unusable is None else unusable]
    if status in _REMEDIES:
        parts.append(_REMEDIES[status])
    if ratio > MODEL_ERROR_RATIO:
        parts.append(f"residuals are {ratio:.3g} times the noise: model error dominates")
    elif ratio < CURVATURE_RATIO and any(r.noise_source == "estimated" for r in replicates):
        parts.append(f"residuals are {ratio:.2g} times the estimated noise, so that is too large")
    if spread.basis == "replicates":
        parts.append(f"standard errors follow the scatter of the {len(replicates)} replicates")
    elif spread.basis == "residuals":
        parts.append("standard errors follow the residuals, as if these were independent")
    if loose:
        parts.append(f"the data do not determine {', '.join(loose)}")
    return "; ".join([*parts, *warnings])
