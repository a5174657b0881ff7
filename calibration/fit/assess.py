"""From an estimate to what people need to know about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.fit.estimate import Estimate
from calibration.fit.fit import (
    Covariance,
    Fit,
    JitterStatement,
    MeshCorrection,
    Minimum,
    Nuisance,
    Profile,
    Region,
)
from calibration.fit.identifiability import condition, not_identifiable, suggest_tests, weak_directions
from calibration.fit.levenberg_marquardt import Descent
from calibration.fit.problem import Evaluation, Problem
from calibration.fit.profiles import ProfileSide
from calibration.fit.regions import judge_regions, name_misfits
from calibration.fit.uncertainty import Uncertainty
from calibration.report.self_weight import sags
from calibration.statistics.statistics import MODEL_ERROR_RATIO, correlation, information_criteria, r_squared
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.laws import Stability, check_stability, find_law
from tissue_sim.laws.stability import STRETCH_RANGE
from tissue_sim.model import Model
from tissue_sim.simulation import simulate

#: Minima whose parameters differ by less than this share of their size are one.
_SAME = 1e-2
#: Shares of the volume that are stretched less, or more, than what counts as the range of the data.
_TAIL = 0.01
#: A nuisance so many standard deviations away is not chance.
SUSPECT = 4.0
#: Degrees of freedom below which an estimated scatter of 0 is doubted.
FEW = 6


def assess(estimate: Estimate, spread: Uncertainty, descents: Sequence[Descent], sides: Sequence[ProfileSide],
           campaign: Campaign) -> Fit:
    """The `Fit` of an estimate; what it cost, and its rank, are not in it yet.

    Args:
        estimate: the minimum. spread: its uncertainty. descents: of all starts. sides: of the profiles.
        campaign: what was asked.
    """
    problem, space = estimate.problem, estimate.problem.space
    law, evaluation = find_law(space.law), problem.evaluate(estimate.theta)
    values = space.values(estimate.theta)
    own = {name: values[name] for name in law.parameters}
    data = np.concatenate([curve.force for curve in problem.measured])
    residual = evaluation.force - data
    errors: dict[str, float | None] = dict.fromkeys(space.fixed, 0.0)
    errors |= {name: float(e) if np.isfinite(e) else None
               for name, e in zip(space.free, spread.standard_errors, strict=True)}
    ranges = stretches(problem, evaluation)
    low, high = min(r[0] for r in ranges.values()), max(r[1] for r in ranges.values())
    stability = check_stability(law, law.as_array(own), (min(STRETCH_RANGE[0], low), max(STRETCH_RANGE[1], high)))
    profiles, intervals, notes = _profiles(estimate, spread, sides)
    on_bound = [name for name, hit in zip(space.free, spread.on_bound, strict=True) if hit]
    loose = not_identifiable(space, spread)
    directions = weak_directions(space, spread)
    status, unusable = _verdict(estimate, stability, ranges)
    warnings = [*estimate.warnings, *(f"{name} ended on its bound {values[name]:.6g}" for name in on_bound)]
    warnings += _unstable_elsewhere(stability, (low, high))
    if later := sum(curve.later for curve in problem.measured):
        names = dict.fromkeys(curve.test.name for curve in problem.measured if curve.later)
        warnings.append(f"what comes after the loading in {', '.join(names)} is not fitted ({later} samples): an "
                        'elastic material has no holds and returns of its own; name "viscoelastic.terms[0].g" and '
                        '".tau_s", or "softening.loss", in fit.start to use them')
    few = problem.jitter.freedom is not None and 0 < problem.jitter.freedom < FEW
    if few and not (problem.jitter.contact and problem.jitter.zero):
        what = "contact" if not problem.jitter.contact else "zero"
        warnings.append(f"the scatter of the {what} comes out as 0 from few recordings, which does not prove it: state "
                        f"{'contact_jitter_mm' if what == 'contact' else 'zero_jitter_N'}")
    if problem.jitter.freedom == 0:
        warnings.append("no test has two recordings, so the scatter between recordings is not known and was assumed: "
                        f"contact {problem.jitter.contact * 1e3:.2g} mm, zero {problem.jitter.zero:.2g} N; state "
                        "contact_jitter_mm and zero_jitter_N (of tests without a specimen: 1000 times strain, and Pa)")
    if spread.ratio > MODEL_ERROR_RATIO:
        warnings.append(f"residuals are {spread.ratio:.3g} times the noise: the model misses something, and the "
                        "standard errors are no more than a guess")
    nuisances = _nuisances(problem, evaluation)
    away = np.abs(evaluation.nuisances)
    if stuck := [curve.name for own, curve in zip(problem.own, problem.measured, strict=True)
                 if away[own].max(initial=0.0) > SUSPECT]:
        warnings.append(f"contact or zero of {', '.join(stuck)} is more than {SUSPECT:g} times the stated or estimated "
                        "scatter away: check where these recordings touch, or what the model lacks")
    if away[len(problem.own) * len(problem.kinds):].max(initial=0.0) > SUSPECT:
        warnings.append(f"the mesh error would be more than {SUSPECT:g} times what is known of it: something that the "
                        "model lacks hides there")
    regions = judge_regions(problem, evaluation)
    unknowns = len(space.free)
    # Laws may come to another jitter, so that the determinant of the covariance counts.
    aic, bic = information_criteria(estimate.error + evaluation.log_determinant, problem.samples, unknowns)
    order = list(space.names)
    covariance = np.zeros((len(order), len(order)))
    free = [order.index(name) for name in space.free]
    covariance[np.ix_(free, free)] = spread.covariance
    history = [entry for descent in descents for entry in descent.history] + list(estimate.history)
    stressed = [curve for curve in problem.measured if curve.test.specimen is None]
    root = float(np.sqrt(np.mean(residual**2)))
    return Fit(
        law=law.name, formula=law.formula(), parameters=values, standard_errors={n: errors[n] for n in order},
        covariance=Covariance(order=order, matrix=covariance.tolist()),
        correlation=correlation(covariance).tolist(), covariance_from=spread.basis, intervals95=intervals,
        not_identifiable=loose, on_bound=on_bound, R2=r_squared(data, residual),
        RMSE_N=None if stressed else root, RMSE_Pa=root if len(stressed) == len(problem.measured) else None,
        noise_ratio=spread.ratio, AIC=aic, BIC=bic, E0=law.E0(own), mu0=law.mu0(own),
        stable_from=stability.stable_from, stable_to=stability.stable_to, stability=stability.describe(),
        stretch_range=(float(low), float(high)), sag_mm=sags(law, law.as_array(own), campaign),
        nuisances=nuisances, minima=_minima(descents, problem, data),
        starts=len(descents), status=status, unusable=unusable, warnings=warnings,
        message=_message(descents, unusable, loose, regions, warnings),
        iterations=len(history), cpu_s=0.0,
        material_file=f"{law.name}.material.json" if law.mu0(own) > 0 else None, interval_notes=notes,
        profiles=profiles, regions=regions, history=history, condition=condition(spread), directions=directions,
        suggestions=suggest_tests(problem, estimate.theta, spread) if (loose or directions) and not on_bound else [],
        jitter=JitterStatement(contact_mm=problem.jitter.contact * 1e3, zero_N=problem.jitter.zero,
                               freedom=problem.jitter.freedom),
        mesh=[MeshCorrection(test=test.name, largest_percent=100.0 * difference if np.isfinite(difference) else None,
                             remainder_percent=100.0 * error, refreshes=estimate.refreshes)
              for test, difference, error in zip(problem.tests, estimate.differences, problem.mesh_error,
                                                 strict=True)])


def stretches(problem: Problem, evaluation: Evaluation) -> dict[str, tuple[float, float]]:
    """Test -> extreme principal stretches that the data reach: of the volume, without a hundredth at either end."""
    values, found = problem.space.values(evaluation.theta), {}
    for test in problem.tests:
        deepest = max(float(curve.displacement.max()) for curve in test.measured)
        if test.homogeneous:
            reached = test.closed_form.rest + test.sign * deepest / test.height
            found[test.name] = test.closed_form.extremes(reached, reached)
            continue
        motion = test.motions[0].protocol
        experiment = replace(test.experiment, protocol=Protocol.ramp(deepest, max(3, motion.time.size // 2)))
        try:
            fields = simulate(Model(experiment, problem.space.material(values)), fields=True).fields
        except (ConvergenceError, InputError):
            found[test.name] = (1 - deepest / test.specimen.height, 1.0)
            continue
        F = fields.deformation_gradient()
        plane = np.linalg.svd(F[..., :4].reshape(*F.shape[:-1], 2, 2), compute_uv=False)
        principal = np.concatenate([plane, F[..., 4:]], axis=-1)
        found[test.name] = (_quantile(principal.min(axis=-1), fields.weights, _TAIL),
                            _quantile(principal.max(axis=-1), fields.weights, 1 - _TAIL))
    return found


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, share * total[-1])])


def _verdict(estimate: Estimate, stability: Stability, ranges: dict) -> tuple[str, str | None]:
    if not estimate.converged:
        return "not_converged", estimate.failure or "it did not converge"
    for test in estimate.problem.tests:
        low, high = ranges[test.name]
        if test.homogeneous and test.closed_form.rest:
            mode = test.closed_form.mode
            lower, upper = stability.limits[mode]
            # Along the load; across it the stretch follows.
            low, high = (low, 1.0) if test.sign < 0 else (1.0, high)
            if lower > low or upper < high:
                return "unstable", (f"not stable in {mode} loading {'below' if lower > low else 'above'} stretch "
                                    f"{lower if lower > low else upper:.3g}, where {test.name} has data")
    return "converged", None


def _unstable_elsewhere(stability: Stability, reached: tuple[float, float]) -> list[str]:
    lost = [f"in {mode} loading {side} stretch {limit:.3g}" for mode, (lower, upper) in stability.limits.items()
            for side, limit, bad in (("below", lower, lower > reached[0]), ("above", upper, upper < reached[1])) if bad]
    return [f"not stable {' and '.join(lost)}; the tests reach {reached[0]:.3g} to {reached[1]:.3g}"] if lost else []


def _profiles(estimate: Estimate, spread: Uncertainty, sides: Sequence[ProfileSide]):
    space, theta = estimate.problem.space, estimate.theta
    values = space.values(theta)
    profiles: dict[str, Profile] = {}
    intervals: dict[str, tuple[float, float] | None] = {name: (values[name], values[name]) for name in space.fixed}
    notes: dict[str, str] = {}
    for i, name in enumerate(space.free):
        mine = sorted((side for side in sides if side.index == i), key=lambda side: side.side)
        if len(mine) == 2:
            down, up = mine
            points = sorted({*zip(down.values.tolist(), down.rises.tolist(), strict=True),
                             *zip(up.values.tolist(), up.rises.tolist(), strict=True)})
            own = [f"{end}: {side.note}" for end, side in (("low", down), ("high", up)) if side.note]
            profiles[name] = Profile(values=[v for v, _ in points], rises=[r for _, r in points],
                                     level=float(spread.quantile[i]**2), notes=own)
            intervals[name] = (down.end, up.end)
            if own:
                notes[name] = "; ".join(own)
        else:
            error = spread.standard_errors[i]
            ends = np.clip(theta[i] + spread.quantile[i] * error * np.array([-1.0, 1.0]), space.low[i], space.high[i])
            intervals[name] = (float(ends[0]), float(ends[1])) if np.isfinite(error) else None
    return profiles, {name: intervals[name] for name in space.names}, notes


def _nuisances(problem: Problem, evaluation: Evaluation) -> list[Nuisance]:
    if not problem.kinds:
        return []
    matrix = np.linalg.inv(np.eye(evaluation.nuisances.size) + evaluation.columns.T @ evaluation.columns)
    deviations = np.sqrt(np.diag(matrix))
    found = []
    for own, curve in zip(problem.own, problem.measured, strict=True):
        size = {kind: getattr(problem.jitter, kind) for kind in problem.kinds}
        values = dict(zip(problem.kinds, evaluation.nuisances[own], strict=True))
        errors = dict(zip(problem.kinds, deviations[own], strict=True))
        pairs = {kind: (values[kind] * size[kind], errors[kind] * size[kind]) if kind in values else (0.0, 0.0)
                 for kind in ("contact", "zero")}
        found.append(Nuisance(
            replicate=curve.name, contact_offset_mm=float(pairs["contact"][0] * 1e3),
            contact_offset_error_mm=float(pairs["contact"][1] * 1e3), zero_offset_N=float(pairs["zero"][0]),
            zero_offset_error_N=float(pairs["zero"][1])))
    return found


def _minima(descents: Sequence[Descent], problem: Problem, data: np.ndarray) -> list[Minimum]:
    """Distinct ends of the starts, before the mesh difference was in."""
    total = float(np.sum((data - data.mean())**2))
    kept: list[list] = []
    for descent in sorted((d for d in descents if d.history and np.isfinite(d.error)), key=lambda d: d.error):
        values = problem.space.values(descent.theta)
        size = problem.space.sizes(values)
        for other in kept:
            if (np.abs(descent.theta - other[0].theta) <= _SAME * size).all():
                other[1] += 1
                break
        else:
            kept.append([descent, 1])
    return [Minimum(parameters=problem.space.values(descent.theta),
                    R2=1.0 - descent.history[-1].RMSE_N**2 * data.size / total, starts=count)
            for descent, count in kept]


def _message(descents: Sequence[Descent], unusable: str | None, loose: Sequence[str], regions: Sequence[Region],
             warnings: Sequence[str]) -> str:
    best = min(descent.error for descent in descents)
    # A descent ends within its tolerance of the minimum.
    same = sum(descent.error <= best * (1 + 1e-4) for descent in descents)
    parts = [f"converged; {same} of {len(descents)} start{'s' if len(descents) != 1 else ''} ended there"
             if unusable is None else unusable]
    if bad := name_misfits(regions):
        parts.append(f"a smooth misfit is left in {bad}")
    elif regions:
        parts.append("no smooth misfit is left in any test")
    if loose:
        parts.append(f"the tests do not determine {', '.join(loose)}")
    return "; ".join([*parts, *warnings])

