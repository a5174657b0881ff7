"""Estimation by generalised least squares on forces, with finite elements and marginalised nuisances.

The module contains the starting values, the checks of the first start, and the estimator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, cycle, product
from typing import Any

import numpy as np

from calibration.campaign.campaign import Campaign, Noise, Test
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.estimate import Estimate, iterate_mesh_correction_and_jitter, make_test_with_mesh_correction
from calibration.fit.estimator import Estimator, FitFieldInputs
from calibration.fit.fit import MeshCorrectionSummary, Minimum, Nuisance, ReplicateJitterRecord
from calibration.fit.identifiability import (
    compute_information_condition_or_none,
    find_weak_directions,
    suggest_further_tests,
)
from calibration.fit.lack_of_fit import compute_smooth_misfit_tests_of_regions, format_regions_with_misfit
from calibration.fit.population import PredictionParameters
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation, build_generalised_problem
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import (
    ALTERNATIVES,
    DESCENT,
    DescentResult,
    Listener,
    find_distinct_minima,
    find_index_of_preferred_minimum,
    list_sign_flipped_starts,
    minimise_from_start,
)
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.forms import build_forward_test_of_inverse_fit
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.statistics import NOISE_RATIOS, compute_r_squared
from calibration.statistics.uncertainty import ParameterUncertainty
from tissue_sim.errors import InputError
from tissue_sim.laws import find_law, find_stability_range

#: Starting values of exponents in the order of their use. Moduli need no such list: the fit rescales them at once.
EXPONENTS = (2.0, 8.0, -4.0, 15.0, -10.0, 4.0, -2.0)
#: Factors of single parameters in further starts.
FACTORS = (3.0, 1.0 / 3.0, 10.0, 0.1)
#: Starting value of the first modulus, Pa; that of modulus i is smaller by 1 / i.
_MODULUS = 1000.0


def list_starts_with_varied_exponents(space: ParameterSpace, count: int) -> list[np.ndarray]:
    """Return starting values of a law: those that the campaign states, then others spread around them.

    Args:
        space: parameter space of the law.
        count: maximum number of starts.

    Returns:
        Free parameters inside their bounds, SI, each of shape (p,).
    """
    dimensionless = [each for each in space.free_parameters if each.is_dimensionless_law_parameter]
    exponents = [each.name for each in dimensionless if each.path not in space.law_starts]
    own = {each.name: space.law_starts[each.path] for each in dimensionless if each.path in space.law_starts}
    grids = [grid for grid in combinations_with_replacement(EXPONENTS, len(exponents))
             if len(set(grid)) == len(grid)] or [()]
    # Exponents of different signs come before those of equal signs.
    grids.sort(key=lambda grid: (len({np.sign(e) for e in grid}) < min(len(grid), 2),
                                 sum(EXPONENTS.index(e) for e in grid)))
    found: list[np.ndarray] = []
    moduli = [each.name for each in space.free_parameters if each.is_modulus]
    combinations = [(*grid, *values) for values in product(*own.values()) for grid in grids]
    for turns, grid in enumerate(cycle(combinations)):
        factors = [1.0] * len(space.free)
        if turns >= len(combinations) and len(space.free) > 1:
            step = turns // len(combinations) - 1
            place = step % len(space.free)
            factors[place] = FACTORS[step // len(space.free) % len(FACTORS)]
        guess = dict(zip((*exponents, *own), grid, strict=True))
        guess |= {name: _MODULUS / (1 + i) for i, name in enumerate(moduli)}
        values = [space.start.get(name, guess.get(name, 1.0)) for name in space.free]
        theta = np.clip(np.array(values) * factors, space.low, space.high)
        if not any(np.allclose(theta, other) for other in found):
            found.append(theta)
        if len(found) >= count or turns > 50 * count:
            return found
    return found


#: Norm of the change of all forces, in units of their noise, below which a change of a parameter by its own size counts
#: as undetectable.
UNSEEN = 0.1


def require_fittable_start(problem: GeneralisedProblem, campaign: Campaign, number: int) -> None:
    """Simulate the tests with the first starting values, and check that a fit can start from these values.

    Args:
        problem: problem of one law.
        campaign: campaign of the problem.
        number: index of the law in ``fit.laws``.

    Raises:
        InputError: a stated start or fixed value is invalid or unstable within the data, there are more unknowns than
            samples, or no test depends on a parameter; with file and field.
    """
    space, law = problem.space, find_law(problem.space.law)
    if problem.samples <= len(space.free):
        raise InputError(f"the tests must have more samples than the {len(space.free)} unknown parameters of "
                         f"{law.name}; got {problem.samples}. Increase max_strain, or choose a law with fewer "
                         "parameters", file=campaign.path, field=f"fit.laws[{number}]")
    theta = list_starts_with_varied_exponents(space, 1)[0]
    values = space.get_values_by_name(theta)
    stated = [name for name in space.select_law_parameter_values(values) if name in campaign.fit.start
              or name in campaign.fit.fixed]
    key = "start" if any(name in campaign.fit.start for name in stated) else "fixed"
    try:
        space.build_material(values)
    except InputError as error:
        raise InputError(f"the values must give a valid material of {law.name}; got: {error.problem}. Change them",
                         file=campaign.path, field=f"fit.{key}") from None
    if stated:
        _require_stable_law_in_homogeneous_tests(problem, theta, campaign, key)
    try:
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        if stated:
            raise InputError(f"the simulation of the tests with these parameter values fails ({error}). State other "
                             "values, or reduce max_strain", file=campaign.path, field=f"fit.{key}") from None
        return
    seen = np.linalg.norm(evaluation.rates, axis=0) * space.compute_typical_parameter_sizes(values)
    for name, size in zip(space.free, seen, strict=True):
        if size < UNSEEN and not np.isfinite(space.prior_deviation[space.free.index(name)]):
            field = f"fit.start.{name}" if name in campaign.fit.start else f"fit.laws[{number}]"
            raise InputError(f"the force of at least one test must depend on {name}; a change of {name} by its "
                             f"typical size changes the forces of all tests by only {size:.2g} times their noise. Fix "
                             f"{name} in [fit.fixed], or add a test that depends on {name}",
                             file=campaign.path, field=field)


def _require_stable_law_in_homogeneous_tests(problem: GeneralisedProblem, theta: np.ndarray, campaign: Campaign,
                                             key: str) -> None:
    """Raise an `InputError` if stated values make the law unstable within the data of a homogeneous test."""
    law, space = find_law(problem.space.law), problem.space
    own = law.convert_parameters_to_array(space.select_law_parameter_values(space.get_values_by_name(theta)))
    for test in problem.tests:
        if not test.is_homogeneous or not test.closed_form.rest:
            continue
        reached = test.compute_stretch_range(space, theta)
        if reached.mode is None:
            continue
        low, high = reached.low, reached.high
        lower, upper = find_stability_range(law, own, (min(low, 0.99), max(high, 1.01))).limits[reached.mode]
        if lower > low or upper < high:
            limit, end = (lower, low) if lower > low else (upper, high)
            raise InputError(f"the values must make {law.name} stable up to stretch {end:.3g}, which {test.name} "
                             f"reaches; the law loses stability at stretch {limit:.3g}. Change the values",
                             file=campaign.path, field=f"fit.{key}")


@dataclass(frozen=True)
class NuisanceAndJitterWarningLimits:
    """Limits above which an inverse fit warns.

    Attributes:
        suspect_nuisance: nuisance, in standard deviations, above which a warning is given. A smaller value warns about
            recordings that are right.
        few_degrees_of_freedom: degrees of freedom below which an estimated scatter of 0 gives a warning.
    """

    suspect_nuisance: float = 4.0
    few_degrees_of_freedom: int = 6


INVERSE_WARNINGS = NuisanceAndJitterWarningLimits()


class GeneralisedLeastSquaresEstimator(Estimator):
    """Inverse fit of any tests: residuals of the force, weighted by noise, jitter and mesh error; see `Estimator`."""

    explores = True
    words = "inverse FEM: generalised least squares on force"

    def build_law_problem(self, law: str) -> GeneralisedProblem:
        """Return the least-squares problem of one law over all tests that are not held out."""
        return build_generalised_problem(law, self.campaign, self.measured, self.solves)

    def require_fittable_law(self, law: str, number: int) -> None:
        """Simulate the first start of a law; errors are those of `require_fittable_start`."""
        require_fittable_start(self.build_law_problem(law), self.campaign, number)

    def fit_laws(self, laws: Sequence[str],
                 context: RunContext) -> dict[str, tuple[list[DescentResult], Estimate | str]]:
        """Fit laws: descents from all starts of all laws in parallel, then all mesh corrections in parallel."""
        problems = {law: self.build_law_problem(law) for law in laws}
        keys = [(law, number, theta) for law in laws
                for number,
                theta in enumerate(list_starts_with_varied_exponents(problems[law].space, self.campaign.fit.starts),
                                   1)]
        ends = context.run_descents(descend_from_start, [law for law, *_ in keys],
                                    [(problems[law], number, theta) for law, number, theta in keys],
                                    f"{len(keys)} start{'s' if len(keys) > 1 else ''}")
        descents: dict[str, list[DescentResult]] = {law: [] for law in laws}
        for (law, *_), end in zip(keys, ends, strict=True):
            descents[law].append(end)
        self._add_sign_flipped_descents(laws, problems, descents, context)
        best = {law: _select_best_descent_or_failed_one(descents[law], problems[law]) for law in laws}
        usable = [law for law in laws if np.isfinite(best[law].error)]
        settled = context.run_descents(
            compute_estimate_from_minimum, usable,
            [(problems[law], best[law], self.get_stated_or_prior_jitter(problems[law])) for law in usable],
            "the difference of the accurate mesh")
        found: dict[str, tuple[list[DescentResult], Estimate | str]] = {
            law: (descents[law], best[law].failure) for law in laws}
        for law, estimate in zip(usable, settled, strict=True):
            # Results of worker processes contain copies of the cache.
            estimate = replace(estimate, problem=estimate.problem.with_simulation_cache(self.solves),
                               minima=tuple(_collect_distinct_minima(descents[law], problems[law])))
            found[law] = descents[law], estimate if np.isfinite(estimate.error) else estimate.failure
        return found

    def _add_sign_flipped_descents(self, laws: Sequence[str], problems: Mapping[str, GeneralisedProblem],
                                   descents: dict[str, list[DescentResult]], context: RunContext) -> None:
        """Add descents from the best minimum of each law with other signs of the exponents."""
        keys = []
        for law in laws:
            best = min(descents[law], key=lambda end: end.error)
            if np.isfinite(best.error):
                limit = ALTERNATIVES.promising_ratio * max(best.error, problems[law].samples)
                keys += [(law, len(descents[law]) + number, theta, limit)
                         for number, theta in enumerate(list_sign_flipped_starts(problems[law].space, best.theta), 1)]
        if keys:
            ends = context.run_descents(descend_unless_start_exceeds_limit, [law for law, *_ in keys],
                                        [(problems[law], *rest) for law, *rest in keys],
                                        "other signs of the exponents")
            for (law, *_), end in zip(keys, ends, strict=True):
                descents[law].append(end)

    def get_stated_or_prior_jitter(self, problem: GeneralisedProblem) -> Noise:
        """Return the stated jitter, or the priors of fitted offsets; None values are estimated."""
        if self.campaign.fit.offset == "fit":
            return Noise(contact_jitter=problem.jitter.contact, zero_jitter=problem.jitter.zero)
        return self.campaign.noise

    @property
    def problem_uncertainty_function(self) -> Callable[[GeneralisedProblem, ProblemEvaluation], ParameterUncertainty]:
        """Function that returns the uncertainty of the parameters with the nuisances marginalised."""
        return compute_marginal_uncertainty

    def make_method_specific_fit_fields(self, found: FitFieldInputs) -> dict[str, Any]:
        """Return messages and fields of an inverse fit; see `Estimator.make_method_specific_fit_fields`."""
        estimate, spread, evaluation = found.estimate, found.spread, found.estimate.evaluation
        problem, space = estimate.problem, estimate.problem.space
        on_bound = [name for name, hit in zip(space.free, spread.on_bound, strict=True) if hit]
        regions = compute_smooth_misfit_tests_of_regions(problem, evaluation)
        directions = find_weak_directions(space, spread)
        held = [f"{space.symbols[name]} ended on its bound {found.values[name]:.6g}" for name in on_bound]
        warnings = [*estimate.warnings, *held, *found.lost,
                    *_list_residual_and_nuisance_warnings(problem, evaluation, spread)]
        stressed = [curve for curve in problem.measured if curve.test.states_stress]
        residual = evaluation.force - problem.data
        root = float(np.sqrt(np.mean(residual**2)))
        history = [entry for descent in found.descents for entry in descent.history] + list(estimate.history)
        best = min(descent.error for descent in found.descents)
        # The tolerance accounts for the end of a descent near the minimum.
        same = sum(descent.error <= best * (1 + 1e-4) for descent in found.descents)
        count = len(found.descents)
        parts = [f"converged; {same} of {count} start{'s' if count != 1 else ''} ended there"
                 if found.unusable is None else found.unusable]
        if bad := format_regions_with_misfit(regions):
            parts.append(f"a smooth misfit remains in {bad}")
        elif regions:
            parts.append("no smooth misfit remains in any test")
        if found.loose:
            parts.append(f"the tests do not determine {space.format_symbols(found.loose)}")
        return {
            "R2": compute_r_squared(problem.data, residual), "RMSE_N": None if stressed else root,
            "RMSE_Pa": root if len(stressed) == len(problem.measured) and not any(
                curve.test.modulus for curve in stressed) else None, "on_bound": on_bound,
            "nuisances": _build_nuisance_records(problem, evaluation), "warnings": warnings,
            "message": "; ".join([*parts, *warnings]), "history": history, "regions": regions,
            "condition": compute_information_condition_or_none(spread), "directions": directions,
            "suggestions": suggest_further_tests(problem, estimate.theta, spread)
            if (found.loose or directions) and not on_bound else [],
            "jitter": _build_jitter_record(problem),
            "mesh": [MeshCorrectionSummary(test=test.name, remainder_percent=100.0 * error,
                                           refreshes=estimate.refreshes,
                                           largest_percent=100.0 * difference if np.isfinite(difference) else None)
                     for test, difference, error in zip(problem.tests, estimate.differences, problem.mesh_error,
                                                        strict=True)]}

    def build_held_out_test_and_mesh_error(self, test: Test, estimate: Estimate,
                                           predictor: PredictionParameters) -> tuple[ForwardTest, float]:
        """Return a held-out test with its mesh correction, and its relative mesh error."""
        problem = estimate.problem
        found = build_forward_test_of_inverse_fit(test, self.measured[test.name], self.campaign.fit,
                                                  problem.jitter.contact)
        corrected, _, error = make_test_with_mesh_correction(found, predictor.space, predictor.theta, self.solves)
        return corrected, error

    def get_replicate_jitter_or_none(self, estimate: Estimate) -> ContactAndForceZeroJitter | None:
        """Return the jitter over which the fit marginalises."""
        return estimate.problem.jitter


def descend_from_start(problem: GeneralisedProblem, number: int, theta: np.ndarray,
                       listen: Listener | None = None) -> DescentResult:
    """Run a descent from one start on the fast mesh."""
    return minimise_from_start(problem, theta, start=number, enough=DESCENT.min_gain_of_start, listen=listen)


def descend_unless_start_exceeds_limit(problem: GeneralisedProblem, number: int, theta: np.ndarray, limit: float,
                                       listen: Listener | None = None) -> DescentResult:
    """Run a descent from one start; return a failed result if the sum of squares at the start exceeds `limit`."""
    spent = problem.solves.make_effort_since_now_function()
    try:
        error = problem.evaluate(theta).penalised_sum_of_squares
    except InfeasibleError as failure:
        return DescentResult(number, theta, np.inf, False, str(failure), (), *spent())
    if error > limit:
        return DescentResult(number, theta, np.inf, False, "the data exclude these signs of the exponents", (),
                             *spent())
    return descend_from_start(problem, number, theta, listen)


def _select_best_descent_or_failed_one(descents: Sequence[DescentResult], problem: GeneralisedProblem) -> DescentResult:
    """Return the best descent; of equally good ones that with most positive exponents; a failed one if all failed."""
    ordered = sorted(descents, key=lambda end: end.error)
    if not np.isfinite(ordered[0].error):
        return ordered[0]
    finite = [end for end in ordered if np.isfinite(end.error)]
    scale = _compute_variance_ratio_of_at_least_one(finite[0].error, problem)
    return finite[find_index_of_preferred_minimum(problem.space,
                                                  [(end.error / scale, end.theta) for end in finite])]


def _compute_variance_ratio_of_at_least_one(error: float, problem: GeneralisedProblem) -> float:
    """Return the variance of the residuals in units of the noise, at least 1."""
    return max(1.0, error / max(problem.samples - len(problem.space.free), 1))


def compute_estimate_from_minimum(problem: GeneralisedProblem, best: DescentResult, stated: Noise,
                                  listen: Listener | None = None) -> Estimate:
    """Compute the estimate from the best minimum; see `calibration.fit.estimate.iterate_mesh_correction_and_jitter`."""
    return iterate_mesh_correction_and_jitter(problem, best.theta, stated, start=best.start, past=len(best.history),
                                              listen=listen)


def _build_jitter_record(problem: GeneralisedProblem) -> ReplicateJitterRecord:
    """Return the jitter of a problem as a record of `fit.json`."""
    return ReplicateJitterRecord(contact_mm=problem.jitter.contact * 1e3, zero_N=problem.jitter.zero,
                                 freedom=problem.jitter.freedom,
                                 stressed=all(curve.stressed for curve in problem.measured))


def _list_residual_and_nuisance_warnings(problem: GeneralisedProblem, evaluation: ProblemEvaluation,
                                         spread: ParameterUncertainty) -> list[str]:
    """Return warnings on unused samples, jitter, large residuals and large nuisances."""
    warnings, jitter = [], problem.jitter
    if later := sum(curve.later for curve in problem.measured):
        names = dict.fromkeys(curve.test.name for curve in problem.measured if curve.later)
        warnings.append(f"samples after the loading in {', '.join(names)} are not fitted ({later} samples), because an "
                        'elastic material has no relaxation and no hysteresis; name "viscoelastic.terms[0].g" and '
                        '".tau_s", or "softening.loss", in fit.start to use them')
    few = jitter.freedom is not None and 0 < jitter.freedom < INVERSE_WARNINGS.few_degrees_of_freedom
    has_contact = any(curve.has_contact_offset for curve in problem.measured)
    if few and not (jitter.zero and (jitter.contact or not has_contact)):
        kind = "contact" if has_contact and not jitter.contact else "zero"
        warnings.append(f"the estimated scatter of the {kind} from few recordings is 0, which may be chance: state "
                        f"{'contact_jitter_mm' if kind == 'contact' else 'zero_jitter_N'}")
    if jitter.freedom == 0:
        assumed = _build_jitter_record(problem)
        of_strain = " (1000 times strain, and Pa)" if assumed.stressed else ""
        contact, zero = assumed.contact_and_zero_jitter_texts
        contact, keys = (f"contact {contact}, ", "contact_jitter_mm and zero_jitter_N") if has_contact else \
            ("", "zero_jitter_N")
        warnings.append("no test has two recordings, so the scatter between recordings is not known and was assumed: "
                        f"{contact}zero {zero}; state {keys}{of_strain}")
    if spread.ratio > NOISE_RATIOS.model_error:
        warnings.append(f"residuals are {spread.ratio:.3g} times the noise: the model is incomplete, and the standard "
                        "errors are rough estimates")
    sizes, limit = np.abs(evaluation.nuisances), INVERSE_WARNINGS.suspect_nuisance
    if stuck := [curve.name for columns, curve in zip(problem.offset_columns, problem.measured, strict=True)
                 if sizes[columns].max(initial=0.0) > limit]:
        warnings.append(f"contact or zero of {', '.join(stuck)} is more than {limit:g} times the stated or estimated "
                        "scatter away: check the contact of these recordings, or the model")
    if sizes[len(problem.offset_columns) * len(problem.kinds):].max(initial=0.0) > limit:
        warnings.append(f"the fitted mesh error is more than {limit:g} times its standard deviation: it "
                        "compensates an error of the model")
    return warnings


def _build_nuisance_records(problem: GeneralisedProblem, evaluation: ProblemEvaluation) -> list[Nuisance]:
    """Return contact offset and zero of each recording with their conditional standard errors."""
    if not problem.kinds:
        return []
    matrix = np.linalg.inv(np.eye(evaluation.nuisances.size) + evaluation.columns.T @ evaluation.columns)
    deviations = np.sqrt(np.diag(matrix))
    size = {kind: getattr(problem.jitter, kind) for kind in problem.kinds}
    found = []
    for columns, curve in zip(problem.offset_columns, problem.measured, strict=True):
        values = dict(zip(problem.kinds, evaluation.nuisances[columns], strict=True))
        errors = dict(zip(problem.kinds, deviations[columns], strict=True))
        pairs = {kind: (values[kind] * size[kind], errors[kind] * size[kind]) if kind in values and exists
                 else (0.0, 0.0) for kind, exists in (("contact", curve.has_contact_offset), ("zero", curve.has_zero))}
        found.append(Nuisance(
            replicate=curve.name, contact_offset_mm=float(pairs["contact"][0] * 1e3),
            contact_offset_error_mm=float(pairs["contact"][1] * 1e3), zero_offset_N=float(pairs["zero"][0]),
            zero_offset_error_N=float(pairs["zero"][1])))
    return found


def _collect_distinct_minima(descents: Sequence[DescentResult], problem: GeneralisedProblem) -> list[Minimum]:
    """Return the distinct minima of all starts on the fast mesh."""
    total = float(np.sum((problem.data - problem.data.mean())**2))
    kept = find_distinct_minima([(d, 1) for d in descents if d.history and np.isfinite(d.error)],
                                lambda one, other: np.abs(one - other) <= DESCENT.same_minimum
                                * problem.compute_unknown_scales(one))
    return [Minimum(parameters=problem.space.get_values_by_name(descent.theta),
                    R2=1.0 - descent.history[-1].RMSE_N**2 * problem.data.size / total, starts=count,
                    rise=(descent.error - kept[0][0].error)
                    / _compute_variance_ratio_of_at_least_one(kept[0][0].error, problem))
            for descent, count in kept]
