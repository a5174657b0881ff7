"""From an estimate to what people need to know about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.fit.estimate import Estimate
from calibration.fit.estimator import Estimator, Findings
from calibration.fit.fit import Covariance, Fit, Profile
from calibration.fit.identifiability import not_identifiable
from calibration.fit.levenberg_marquardt import Descent
from calibration.fit.population import Specimens, differing_specimens, find_specimens
from calibration.fit.profiles import ProfileSide
from calibration.fit.self_weight import sags
from calibration.forward.contract import Reached
from calibration.statistics.statistics import MODEL_ERROR_RATIO, correlation, information_criteria
from calibration.statistics.uncertainty import Uncertainty
from tissue_sim.laws import Stability, check_stability, find_law
from tissue_sim.laws.stability import STRETCH_RANGE

#: Residuals above this share of the largest force of a test, and above the model error ratio of its noise, describe
#: no data.
FAR_OFF = 0.1


def assess(estimator: Estimator, estimate: Estimate, spread: Uncertainty, descents: Sequence[Descent],
           sides: Sequence[ProfileSide], campaign: Campaign) -> Fit:
    """The `Fit` of an estimate; what it cost, and its rank, are not in it yet.

    Args:
        estimator: the weights. estimate: the minimum. spread: its uncertainty. descents: of all starts.
        sides: of the profiles. campaign: what was asked.
    """
    problem, space = estimate.problem, estimate.problem.space
    law = find_law(space.law)
    theta = estimate.theta[: len(space.free)]
    values = space.values(theta)
    free = slice(0, len(space.free))
    specimens = find_specimens(space, theta, spread.covariance[free, free], spread.standard_errors[free])
    moduli = space.of_law(specimens.typical(space, values))
    errors: dict[str, float | None] = dict.fromkeys(space.fixed, 0.0)
    errors |= {name: float(e) if np.isfinite(e) else None
               for name, e in zip(space.free, spread.standard_errors, strict=False)}
    reached = {test.name: test.reached(space, theta) for test in problem.tests}
    stretches = (min(one.principal[0] for one in reached.values()), max(one.principal[1] for one in reached.values()))
    stability = check_stability(law, law.as_array(moduli), (min(STRETCH_RANGE[0], stretches[0]),
                                                            max(STRETCH_RANGE[1], stretches[1])))
    mu0 = law.mu0(moduli)
    misfits, missed = _misfits(estimate)
    status, unusable = _verdict(estimate, stability, reached, mu0, missed, specimens)
    loose = not_identifiable(space, spread)
    profiles, intervals, notes = _profiles(estimate, spread, sides)
    aic, bic = information_criteria(*spread.criteria, problem.bounds[0].size)
    order = list(space.names)
    covariance = np.zeros((len(order), len(order)))
    places = [order.index(name) for name in space.free]
    covariance[np.ix_(places, places)] = spread.covariance[free, free]
    shared = {
        "law": law.name, "formula": law.formula(), "parameters": values, "symbols": space.symbols,
        "units": {each.name: each.declaration.unit for each in space.unknowns},
        "standard_errors": {name: errors[name] for name in order},
        "derivatives": _derivatives(estimate, theta), "covariance": Covariance(order=order, matrix=covariance.tolist()),
        "correlation": correlation(covariance).tolist(), "covariance_from": spread.basis, "intervals95": intervals,
        "not_identifiable": loose, "noise_ratio": spread.ratio, "AIC": aic, "BIC": bic, "E0": law.E0(moduli),
        "mu0": mu0, "stable_from": stability.stable_from, "stable_to": stability.stable_to,
        "stability": stability.describe(), "stretch_range": (float(stretches[0]), float(stretches[1])),
        "minima": list(estimate.minima), "starts": len(descents),
        "misfits": misfits, "status": status, "unusable": unusable, "cpu_s": 0.0,
        "interval_notes": notes, "profiles": profiles,
        "iterations": sum(len(descent.history) for descent in descents) + len(estimate.history),
        "population": specimens.population, "material_of": list(specimens.material_of),
        "left_out_specimens": dict(specimens.left_out),
        "material_file": f"{law.name}.material.json" if mu0 > 0 and not specimens.missing_population else None}
    lost = [*_other_losses(stability, reached, stretches), *differing_specimens(estimate),
            *specimens.warnings(unusable)]
    found = Findings(estimate, spread, descents, values, loose, status, unusable, lost)
    fit = Fit(**shared | estimator.describe(found))
    return replace(fit, sag_mm=sags(fit, campaign))


def _derivatives(estimate: Estimate, theta: np.ndarray) -> dict[str, str]:
    """Free parameter -> ``"exact"``, or ``"difference"`` where it is one in any test."""
    problem, names = estimate.problem, set()
    for test in problem.tests:
        names |= test.differences(test.solve(problem.space, theta, problem.solves))
    return {name: "difference" if name in names else "exact" for name in problem.space.free}


def _misfits(estimate: Estimate) -> tuple[dict[str, float], list[str]]:
    """Root mean square residual of each test, % of its largest force, and of those that are missed, in words.

    Residuals below the model error ratio may be noise however large they are, and those above it are usual in precise
    tests: only together they say that the law is not that of the data.
    """
    problem, gap = estimate.problem, estimate.evaluation.force - estimate.problem.data
    shares: dict[str, float] = {}
    missed = []
    for number, test in enumerate(problem.tests):
        mine = [(rows, test.measured[r]) for rows, (t, r) in zip(problem.rows, problem.places, strict=True)
                if t == number]
        residual = np.concatenate([gap[rows] for rows, _ in mine])
        ratio = float(np.sqrt(np.mean(np.concatenate([gap[rows] / curve.noise.deviation for rows, curve in mine])**2)))
        largest = max(float(np.abs(curve.force).max()) for _, curve in mine)
        share = float(np.sqrt(np.mean(residual**2))) / largest
        shares[test.name] = 100.0 * share
        if share > FAR_OFF and ratio > MODEL_ERROR_RATIO:
            quantity = "stress" if mine[0][1].stressed else "force"
            missed.append(f"its residuals in {test.name} are {100 * share:.2g} % of the largest {quantity} and "
                          f"{ratio:.3g} times the noise")
    return shares, missed


def _verdict(estimate: Estimate, stability: Stability, reached: Mapping[str, Reached], mu0: float,
             missed: Sequence[str], specimens: Specimens) -> tuple[str, str | None]:
    """Status, and why the law is not usable."""
    if not mu0 > 0:
        return "not_physical", f"its shear modulus at rest is {mu0:.4g} Pa"
    if not estimate.converged:
        return "not_converged", estimate.failure or "it did not converge"
    lost = [loss for mode in dict.fromkeys(one.mode for one in reached.values() if one.mode)
            if (loss := _losses(stability, mode, (min(one.low for one in reached.values() if one.mode == mode),
                                                  max(one.high for one in reached.values() if one.mode == mode))))]
    if lost:
        return "unstable", f"not stable {' and '.join(lost)}, where there are data"
    if missed:
        return "misfit", (f"does not describe the data: {' and '.join(missed)}; end the test before something else "
                          "begins, such as failure (max_strain), or take another law")
    if specimens.missing_population:
        return "no_population", specimens.missing_population
    return "converged", None


def _losses(stability: Stability, mode: str, stretches: tuple[float, float]) -> str:
    """Where one mode loses Drucker stability inside these stretches, in words; empty where it does not."""
    (low, high), (lower, upper) = stretches, stability.limits[mode]
    if lower == upper == 1.0:
        return f"in {mode} loading at every stretch"
    ends = [f"{side} stretch {limit:.3g}" for side, limit, lost in (("below", lower, lower > low),
                                                                  ("above", upper, upper < high)) if lost]
    return f"in {mode} loading {' and '.join(ends)}" if ends else ""


def _other_losses(stability: Stability, reached: Mapping[str, Reached], stretches: tuple[float, float]) -> list[str]:
    """A warning where loading that was not measured is unstable inside the stretches of the data."""
    measured = {one.mode for one in reached.values()}
    found = [loss for mode in stability.limits if mode not in measured
             if (loss := _losses(stability, mode, stretches))]
    return [f"not stable {' and '.join(found)}, which was not measured"] if found else []


def _profiles(estimate: Estimate, spread: Uncertainty, sides: Sequence[ProfileSide]):
    space, theta = estimate.problem.space, estimate.theta
    values = space.values(theta[: len(space.free)])
    profiles: dict[str, Profile] = {}
    intervals: dict[str, tuple[float, float] | None] = {name: (values[name], values[name]) for name in space.fixed}
    notes: dict[str, str] = {}
    for i, name in enumerate(space.free):
        mine = sorted((side for side in sides if side.index == i), key=lambda side: side.side)
        if len(mine) == 2:
            down, up = mine
            points = sorted({*zip(down.values.tolist(), down.rises.tolist(), strict=True),
                             *zip(up.values.tolist(), up.rises.tolist(), strict=True)})
            cuts = [f"{end}: {side.note}" for end, side in (("low", down), ("high", up)) if side.note]
            profiles[name] = Profile(values=[v for v, _ in points], rises=[r for _, r in points],
                                     level=float(spread.quantile[i]**2), notes=cuts)
            intervals[name] = (down.end, up.end)
            if cuts:
                notes[name] = "; ".join(cuts)
        else:
            error = spread.standard_errors[i]
            ends = np.clip(values[name] + spread.quantile[i] * error * np.array([-1.0, 1.0]), space.low[i],
                           space.high[i])
            intervals[name] = (float(ends[0]), float(ends[1])) if np.isfinite(error) else None
    return profiles, {name: intervals[name] for name in space.names}, notes
