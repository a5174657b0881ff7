"""Estimation by ordinary least squares on nominal stress with closed forms.

`fit_hold` fits a Prony series to the force of a hold, for tools without a closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve, add_noise_and_requested_interpolation
from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.parameters import SHARED, ScopedCampaignParameter
from calibration.fit.estimate import Estimate
from calibration.fit.estimator import (
    Estimator,
    FitFieldInputs,
    LawFailureRecord,
    build_fit_record,
    call_and_catch_law_errors,
)
from calibration.fit.fit import Minimum, Nuisance
from calibration.fit.ordinary_problem import OrdinaryProblem, compute_analytical_starts, evaluate_or_none_if_infeasible
from calibration.fit.population import PredictionParameters
from calibration.fit.problem import ProblemEvaluation
from calibration.fit.run_context import RunContext
from calibration.fit.stable_range import constrain_minima_to_stability
from calibration.fit.trust_region import (
    ALTERNATIVES,
    DESCENT,
    DescentResult,
    find_distinct_minima,
    find_index_of_preferred_minimum,
    list_sign_flipped_starts,
    minimise_from_start,
)
from calibration.forward.closed import ClosedFormTest
from calibration.forward.contract import ForwardTest
from calibration.forward.forms import build_closed_form_or_column_test
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.statistics import NOISE_RATIOS, compute_r_squared
from calibration.statistics.uncertainty import ParameterUncertainty, compute_cluster_robust_uncertainty
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.material.material import find_parameter_path_and_declaration
from tissue_sim.material.viscoelasticity import RelaxationSeries
from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class AnalyticalFitSettings:
    """Settings of the descents of an analytical fit.

    Attributes:
        thinned_points: approximate number of samples of a thinned problem, on which all starts are refined. A smaller
            value is faster and may miss a minimum.
        max_minima: number of distinct minima of the thinned problem that are refined on all samples.
        thinned_solves: maximum number of evaluations per start of the thinned problem.
        thinned_tolerance: relative tolerance of descents of the thinned problem.
        solves: maximum number of evaluations per minimum on all samples.
        tolerance: relative tolerance of descents on all samples.
        relaxing_solves: maximum number of evaluations per start of a law with Prony terms, which is fitted to all
            samples at once.
        relaxing_tolerance: relative tolerance of descents of a law with Prony terms.
        correlated_residuals: correlation of neighbouring residuals above which they are reported as a model error.
    """

    thinned_points: int = 200
    max_minima: int = 2
    thinned_solves: int = 300
    thinned_tolerance: float = 1e-8
    solves: int = 80
    tolerance: float = 1e-10
    relaxing_solves: int = 100
    relaxing_tolerance: float = 1e-9
    correlated_residuals: float = 0.5


_SETTINGS = AnalyticalFitSettings()


class OrdinaryLeastSquaresEstimator(Estimator):
    """Analytical fit of closed forms: unweighted residuals of the nominal stress; see `Estimator`."""

    explores = False
    words = "analytical: least squares on nominal stress"

    def __init__(self, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]], solves: SimulationCache):
        super().__init__(campaign, measured, solves)
        self.fitted = [curve for test in campaign.tests if not test.hold_out for curve in measured[test.name]]

    def build_law_problem(self, law: str) -> OrdinaryProblem:
        """Return the least-squares problem of one law over all tests that are not held out."""
        tests = [self._build_closed_form_test(test) for test in self.campaign.tests if not test.hold_out]
        return OrdinaryProblem.build_with_pooled_noise(self._build_parameter_space_without_offsets(law), tests,
                                                       self.campaign.fit, self.solves)

    @property
    def pooled_sensor_stress_noise_or_none(self) -> float | None:
        """Pooled noise of the nominal stress over all samples, Pa."""
        return self.build_law_problem(self.campaign.fit.laws[0]).noise

    def _build_parameter_space_without_offsets(self, law: str) -> ParameterSpace:
        """Return the parameter space of a law, which contains no contact offsets and zeros."""
        return ParameterSpace.from_campaign(law, self.campaign, {name: [curve.name for curve in curves]
                                                                 for name, curves in self.measured.items()})

    def _build_closed_form_test(self, test: Test) -> ClosedFormTest:
        """Return the forward model of a test that computes the force by a closed form."""
        return build_closed_form_or_column_test(test, self.measured[test.name], self.campaign.fit)

    def require_fittable_law(self, law: str, number: int) -> None:
        """Raise an `InputError` unless the tests have more samples than the law has parameters."""
        samples = sum(curve.force.size for curve in self.fitted)
        unknowns = len(self._build_parameter_space_without_offsets(law).names)
        if samples <= unknowns:
            raise InputError(f"the tests must have more samples than the {unknowns} parameters of {law}; got "
                             f"{samples}. Increase max_strain, or choose a law with fewer parameters",
                             file=self.campaign.path, field=f"fit.laws[{number}]")

    def fit_laws(self, laws: Sequence[str],
                 context: RunContext) -> dict[str, tuple[list[DescentResult], Estimate | str]]:
        """Fit laws one after the other in this process; see `Estimator.fit_laws`."""
        found: dict[str, tuple[list[DescentResult], Estimate | str]] = {}
        for law in laws:
            plural = "s" if len(self.fitted) != 1 else ""
            context.report_progress(f"fitting {law} to {len(self.fitted)} recording{plural}")
            answer = call_and_catch_law_errors(fit_law_to_descents_and_estimate, self.build_law_problem(law))
            found[law] = ([], answer.reason) if isinstance(answer, LawFailureRecord) else answer
        return found

    @property
    def problem_uncertainty_function(self) -> Callable[[OrdinaryProblem, ProblemEvaluation], ParameterUncertainty]:
        """Function that returns the sandwich covariance of the unknowns."""
        return partial(compute_sandwich_uncertainty, stated=self.campaign.noise)

    def make_method_specific_fit_fields(self, found: FitFieldInputs) -> dict[str, Any]:
        """Return messages and fields of an analytical fit; see `Estimator.make_method_specific_fit_fields`."""
        problem, spread = found.estimate.problem, found.spread
        on_bound = [name for name, hit in zip(problem.space.free, spread.on_bound, strict=False) if hit]
        nuisances = _build_nuisance_records(problem, found.estimate.theta, spread)
        held = {f"{n.replicate}: {name}": getattr(n, name) for n in nuisances for name in n.on_bound}
        warnings = [*found.estimate.warnings, *(f"{name} ended on its bound {value:.6g}" for name, value in (
            *((problem.space.symbols[name], found.values[name]) for name in on_bound), *held.items()))]
        if found.status != "not_physical":
            warnings += found.lost
        stress = (found.estimate.evaluation.force - problem.data) / problem.area
        recorded = [not curve.test.states_stress for curve in problem.measured]
        measured = problem.data / problem.area
        return {
            "R2": compute_r_squared(measured, stress),
            "RMSE_N": float(np.sqrt(np.mean((stress * problem.area)**2))) if all(recorded) else None,
            "RMSE_Pa": float(np.sqrt(np.mean(stress**2))), "on_bound": [*on_bound, *held],
            "nuisances": nuisances, "warnings": warnings,
            "message": "; ".join([*self._list_convergence_and_error_remarks(found),
                                  *_list_relaxation_and_residual_remarks(problem, found), *warnings])}

    def _list_convergence_and_error_remarks(self, found: FitFieldInputs) -> list[str]:
        """Return remarks on convergence, noise, standard errors and undetermined parameters."""
        spread, count = found.spread, len(found.descents)
        parts = [f"converged from {count} start{'s' if count != 1 else ''}" if found.unusable is None
                 else found.unusable]
        if spread.ratio > NOISE_RATIOS.model_error:
            parts.append(f"residuals are {spread.ratio:.3g} times the noise: model error dominates")
        elif spread.ratio < NOISE_RATIOS.curvature and any(curve.noise.source == "estimated" for curve in self.fitted):
            parts.append(f"residuals are {spread.ratio:.2g} times the estimated noise, so that is too large")
        if spread.basis == "replicates":
            parts.append(f"standard errors follow the scatter of the {len(self.fitted)} replicates")
        elif spread.basis == "residuals" and not found.estimate.problem.is_history_dependent:
            parts.append("standard errors follow the residuals, as if these were independent")
        if found.loose:
            parts.append(f"the data do not determine {found.estimate.problem.space.format_symbols(found.loose)}")
        return parts

    def get_replicate_jitter_or_none(self, estimate: Estimate) -> ContactAndForceZeroJitter | None:
        """Return the stated jitter; None if none is stated."""
        noise = self.campaign.noise
        stated = noise.contact_jitter or noise.zero_jitter
        return ContactAndForceZeroJitter(noise.contact_jitter or 0.0, noise.zero_jitter or 0.0, None) if stated \
            else None

    def build_held_out_test_and_mesh_error(self, test: Test, estimate: Estimate,
                                           predictor: PredictionParameters) -> tuple[ForwardTest, float]:
        """Return the closed form of a held-out test, whose mesh error is 0."""
        return self._build_closed_form_test(test), 0.0


def fit_law_to_descents_and_estimate(problem: OrdinaryProblem) -> tuple[list[DescentResult], Estimate | str]:
    """Fit one law: descents from all starts on thinned samples, then the best minima on all samples.

    Args:
        problem: least-squares problem of the law.

    Returns:
        All descents, and the estimate or the reason of the failure.
    """
    spent, law = problem.solves.make_effort_since_now_function(), problem.space.law
    # The stress of a material with memory depends on the whole motion, so its samples are not thinned.
    stride = 1 if problem.is_history_dependent else -(-problem.samples // _SETTINGS.thinned_points)
    thin = problem if stride == 1 else problem.with_thinned_and_merged_recordings(stride)

    def run_descent(target: OrdinaryProblem, start: np.ndarray, number: int, most: int,
                    tolerance: float = _SETTINGS.tolerance) -> DescentResult:
        """Minimise the sum of squares of `target` from a start with at most `most` evaluations."""
        return minimise_from_start(target, start, start=number, enough=0.0, tolerance=tolerance, gradient=tolerance,
                                   max_solves=most)

    def make_mask_of_agreeing_parameters(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return for each free parameter whether two minima agree, bool, shape (p,)."""
        return (np.abs(one - other) <= DESCENT.same_minimum * np.abs(other) + 1e-9)[: len(problem.space.free)]

    limits = (_SETTINGS.relaxing_solves, _SETTINGS.relaxing_tolerance) if problem.long_term_variables_or_none else \
        (_SETTINGS.thinned_solves, _SETTINGS.thinned_tolerance)
    starts = compute_analytical_starts(thin)
    descents = [run_descent(thin, start, number, *limits) for number, start in enumerate(starts, 1)]
    ends = find_distinct_minima([(d, 1) for d in descents if np.isfinite(d.error)], make_mask_of_agreeing_parameters)
    refined = ends if problem.long_term_variables_or_none else []
    for end, count in ends if not refined else ():
        if len(refined) == _SETTINGS.max_minima:
            break
        # A law may be undefined between the samples of the thinned problem.
        if np.isfinite((descent := run_descent(problem, end.theta, end.start, _SETTINGS.solves)).error):
            refined.append((descent, count))
    refined = sorted((item for item in refined if np.isfinite(item[0].error)), key=lambda item: item[0].error)
    if not refined:
        hint = "" if all(test.specimen is None for test in problem.tests) else \
            "; the specimen may be too heavy for it, so check density_kg_m3"
        return descents, f"no start of {law} gives a finite stress over the data; state one in fit.start{hint}"
    for start in list_sign_flipped_starts(problem.space, refined[0][0].theta):
        if problem.long_term_variables_or_none and not _is_promising_start(problem, start, refined[0][0].error):
            continue
        descents.append(run_descent(thin, start, len(descents) + 1, *limits))
        if np.isfinite(descents[-1].error):
            refined.append((run_descent(problem, descents[-1].theta, descents[-1].start, _SETTINGS.solves), 1))
    refined = find_distinct_minima([item for item in refined if np.isfinite(item[0].error)],
                                   make_mask_of_agreeing_parameters)
    warnings: tuple[str, ...] = ()
    if problem.settings.stable:
        refined, warnings = constrain_minima_to_stability(problem, refined, [
            *(end.theta for end, _ in ends), *starts])
        if not refined:
            return descents, (f"no parameters of {law} are stable over the stretches of fit.stable. State a smaller "
                              "range, or use another law")
    scale = max(1.0, refined[0][0].error / max(problem.samples - problem.bounds[0].size, 1))
    best = refined[find_index_of_preferred_minimum(problem.space,
                                                   [(d.error / scale, d.theta) for d, _ in refined])][0]
    stress, minima = problem.data / problem.area, []
    for descent, count in sorted(refined, key=lambda item: item[0] is not best):
        residual = problem.evaluate(descent.theta).residual * problem.noise
        minima.append(Minimum(parameters=problem.space.get_values_by_name(descent.theta[: len(problem.space.free)]),
                              R2=compute_r_squared(stress, residual), starts=count,
                              rise=(descent.error - refined[0][0].error) / scale))
    history = tuple(step for descent, _ in refined for step in descent.history)
    return descents, Estimate(best.start, best.theta, best.error, best.converged, "", history, *spent(),
                              problem=problem, warnings=warnings, minima=tuple(minima))


def _is_promising_start(problem: OrdinaryProblem, start: np.ndarray, best: float) -> bool:
    """Return whether the sum of squares at a start is close enough to the best one to follow the start."""
    evaluation = evaluate_or_none_if_infeasible(problem, start)
    limit = ALTERNATIVES.promising_ratio * max(best, problem.samples)
    return evaluation is not None and evaluation.penalised_sum_of_squares < limit


def compute_sandwich_uncertainty(problem: OrdinaryProblem, evaluation: ProblemEvaluation,
                                 stated: Noise) -> ParameterUncertainty:
    """Return the sandwich covariance of the unknowns: parameters first, then offsets and zeros.

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.
        stated: noise and jitter of the campaign.
    """
    theta = evaluation.theta
    on_bound = problem.make_mask_of_unknowns_on_bound(theta)
    noise = np.array([curve.noise.deviation / problem.tests[t].area
                      for (t, _), curve in zip(problem.places, problem.measured, strict=True)])
    correlation = compute_residual_autocorrelation(problem, evaluation)
    # Smooth residuals are autocorrelated, which reduces the number of independent samples by (1 - r) / (1 + r)
    # (Bayley and Hammersley 1946).
    repeats = (1.0 + max(correlation, 0.0)) / (1.0 - min(correlation, 0.999)) if problem.is_history_dependent else 1.0
    spread = compute_cluster_robust_uncertainty(
        evaluation.rates * problem.noise, evaluation.residual * problem.noise, problem.recording_index_of_each_sample,
        noise,
        1.0 / problem.prior_deviation**2, problem.compute_stress_changes_per_jitter_or_none(theta, stated),
        [curve.interpolation for curve in problem.measured], on_bound, repeats)
    squares, samples = spread.criteria
    priors = float(evaluation.prior_residual @ evaluation.prior_residual)
    return replace(spread, sizes=np.abs(theta), criteria=(squares + priors, samples))


def compute_residual_autocorrelation(problem: OrdinaryProblem, evaluation: ProblemEvaluation) -> float:
    """Return the lag-1 autocorrelation of the residuals within recordings."""
    residual, same = evaluation.residual, np.diff(problem.recording_index_of_each_sample) == 0
    squares = float(residual @ residual)
    return float(residual[:-1][same] @ residual[1:][same]) / squares if squares else 0.0


def _list_relaxation_and_residual_remarks(problem: OrdinaryProblem, found: FitFieldInputs) -> list[str]:
    """Return remarks on the relaxation times and the smoothness of the residuals of a material with memory."""
    if not problem.is_history_dependent:
        return []
    shortest, longest = problem.median_sampling_interval_and_longest_duration
    times = [] if problem.long_term_variables_or_none is None \
        else found.estimate.theta[problem.long_term_variables_or_none.tau]
    notes = [f"tau {tau:.3g} s is {'shorter than the steps' if tau < shortest else 'longer than the record'} "
             f"({shortest:.3g} to {longest:.3g} s)" for tau in times if not shortest <= tau <= longest]
    correlation = compute_residual_autocorrelation(problem, found.estimate.evaluation)
    if correlation > _SETTINGS.correlated_residuals:
        notes.append(f"the residuals are smooth (neighbours correlate by {correlation:.2f}): they are a model error, "
                     "not noise, and the criteria favour too many terms")
    return notes


def _build_nuisance_records(problem: OrdinaryProblem, theta: np.ndarray,
                            spread: ParameterUncertainty) -> list[Nuisance]:
    """Return contact offset and zero of each recording that has them."""
    free, names = len(problem.space.free), np.array(["contact_offset_mm", "zero_offset_N"])
    values = problem.get_contact_offsets_and_zeros(theta)[problem.shifted]
    errors, hits = spread.standard_errors[free:].reshape(-1, 2), spread.on_bound[free:].reshape(-1, 2)
    known = [[error if np.isfinite(error) else None for error in pair] for pair in (errors * [1e3, 1.0]).tolist()]
    return [Nuisance(replicate=problem.measured[i].name, contact_offset_mm=float(pair[0] * 1e3),
                     contact_offset_error_mm=error[0], zero_offset_N=float(pair[1]), zero_offset_error_N=error[1],
                     on_bound=names[hit].tolist())
            for i, pair, error, hit in zip(problem.shifted, values, known, hits, strict=True)]


@dataclass(frozen=True)
class HoldDriftLimitAndShearStrain:
    """Settings of the fit of a hold.

    Attributes:
        max_drift: largest change of the displacement during a hold, relative to the displacement. A larger value admits
            holds whose force also follows the displacement.
        shear_strain: shear strain at which a Neo-Hookean solid is linear in floating-point precision.
        max_terms: maximum number of Prony terms.
    """

    max_drift: float = 0.05
    shear_strain: float = 1e-6
    max_terms: int = 4


_HOLD = HoldDriftLimitAndShearStrain()
#: Law of the equivalent solid.
_LAW = "neo_hooke"


@dataclass(frozen=True)
class HoldFit:
    """Prony series fitted to a hold.

    Attributes:
        force: force of an instantaneous test to the same depth, N (Pa if nominal stress was recorded).
        prony: Prony series of instantaneous moduli.
        standard_errors: ``force`` and paths such as ``viscoelastic.terms[0].g`` -> standard error, SI; None if not
            determined.
        RMSE: root mean square error of all samples, N.
        status: see `calibration.fit.fit.Fit`.
        message: see `calibration.fit.fit.Fit`.
    """

    force: float
    prony: RelaxationSeries
    standard_errors: dict[str, float | None]
    RMSE: float
    status: str
    message: str


def fit_hold(recording: Recording, terms: int = 1, ramp: float = 0.0) -> HoldFit:
    """Fit a Prony series (g_i and tau_i) to the force of a hold.

    At constant depth the force of a linear viscoelastic solid is proportional to its relaxation modulus for every tool,
    F(t) = F_0 (1 - sum g_i (1 - exp(-t / tau_i))). The hold is therefore fitted as that of a linear solid in shear. The
    proportionality holds for small strains or shallow depths, as in atomic force microscopy.

    Args:
        recording: ``time`` and ``force`` (or ``nominal stress``) of the hold, beginning with its first sample.
        terms: number of Prony terms, 1 to 4; a single hold determines no more.
        ramp: duration of the loading before the hold, s; the elastic force increases linearly in this time.

    Raises:
        InputError: a channel is missing, the displacement changes by more than 5 %, or there are too few samples or too
            many terms.
        ConvergenceError: no start gives a finite force.

    Source: Lee and Radok, J. Appl. Mech. 27 (1960) 438.
    """
    if not 0 <= ramp < np.inf:
        raise InputError(f"ramp must be 0 or positive; got {ramp:g} s", field="ramp")
    if not 1 <= terms <= _HOLD.max_terms:
        raise InputError(f"terms must be 1 to {_HOLD.max_terms}; got {terms}", field="terms")
    channel = "nominal stress" if "nominal stress" in recording and "force" not in recording else "force"
    force, time = recording.channel(channel), recording.time
    if "displacement" in recording and \
            np.ptp(recording.displacement) > _HOLD.max_drift * np.abs(recording.displacement).max():
        raise InputError("displacement must be constant during the hold; select the samples of the hold, "
                         "recording.select(recording.labels['segment'] == 'hold')", field="displacement")
    if force.size <= 1 + 2 * terms:
        raise InputError(f"{force.size} samples cannot determine {1 + 2 * terms} unknowns; give more samples or fewer "
                         "terms", field="recording")
    strain = np.full(force.size, _HOLD.shear_strain)
    if ramp:
        time, force, strain = np.append(time[0] - ramp, time), np.append(0.0, force), np.append(0.0, strain)
    paths = [(f"viscoelastic.terms[{i}].g", f"viscoelastic.terms[{i}].tau") for i in range(terms)]
    start = {name: value for i, (g, tau) in enumerate(paths) for name, value in (
        (g, 0.5 / terms), (tau, float(np.ptp(time)) * 10.0 ** (i - terms)))}
    test = Test("hold", KINDS["simple_shear"], None, (Path("hold"),))
    named = {path: ScopedCampaignParameter(path, find_parameter_path_and_declaration(path)[1], False, SHARED,
                                           (test.name,))
             for path in start}
    campaign = Campaign(Path("hold"), {}, (test,), FitSettings((_LAW,), named=named, start=start), Noise(), "")
    curve = MeasuredCurve(test.name, test, time, strain, force, np.full(force.size, "hold"), Path("hold"), "", True)
    noisy = replace(curve, noise=add_noise_and_requested_interpolation(curve, campaign).noise)
    estimator = OrdinaryLeastSquaresEstimator(campaign, {test.name: (noisy,)}, SimulationCache())
    descents, estimate = fit_law_to_descents_and_estimate(estimator.build_law_problem(_LAW))
    if not isinstance(estimate, Estimate):
        raise ConvergenceError("no start gives a finite force over the hold; check the units of force and time")
    spread = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    fit = build_fit_record(estimator, estimate, spread, descents, (), campaign)
    material = estimate.problem.space.build_material(fit.parameters)
    size = 2.0 * _HOLD.shear_strain
    error = fit.standard_errors["C10"]
    errors = {"force": None if error is None else size * error, **{name: fit.standard_errors[name] for name in start}}
    message = fit.message.replace("C10", "force")
    residual = estimate.evaluation.force - estimate.problem.data
    return HoldFit(size * fit.parameters["C10"], material.viscoelastic, errors,
                   float(np.sqrt(np.mean(residual**2))), fit.status, message)
