"""Base class of the two estimation methods (ordinary and generalised least squares), and assembly of a `Fit` record.

The record contains the estimate with intervals, stability, population and usability.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.fit import Fit, ParameterCovariance, ProfileLikelihood
from calibration.fit.identifiability import (
    ShearModulusPrecision,
    assess_modulus_error_and_bound_dependence,
    find_undetermined_parameters,
)
from calibration.fit.population import (
    PredictionParameters,
    determine_population_and_left_out_specimens,
    list_warning_if_specimens_differ,
)
from calibration.fit.problem import ProblemEvaluation
from calibration.fit.result import compute_specimen_sags_mm
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import (
    DescentResult,
    find_equally_good_different_materials,
    replace_misleading_standard_errors,
)
from calibration.fit.uncertainty import ProfileSide
from calibration.fit.usability import (
    USABILITY,
    UsabilityEvidence,
    UsabilitySettings,
    compute_misfit_percents_and_noise_ratios,
    describe_instability,
    evaluate_usability_clauses_and_status,
)
from calibration.forward.contract import ForwardTest, InfeasibleError, StretchRange
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.statistics import compute_aic_and_bic, compute_correlation_matrix
from calibration.statistics.uncertainty import ParameterUncertainty
from tissue_sim.errors import ConvergenceError
from tissue_sim.laws import StabilityRange, find_law, find_stability_range
from tissue_sim.laws.stability import STRETCH_RANGE

#: Exceptions that the parameter values of one law can cause: no convergence, no force, an invalid material
#: (`InputError` is a `ValueError`), overflow, a singular matrix (`LinAlgError` is a `ValueError`).
LAW_ERRORS = (ConvergenceError, InfeasibleError, ArithmeticError, ValueError)


@dataclass(frozen=True)
class LawFailureRecord:
    """Failure of the calibration of one law, which does not end the calibration of the other laws.

    Attributes:
        reason: description of the failure.
    """

    reason: str


def call_and_catch_law_errors(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function and convert exceptions of `LAW_ERRORS` to a `LawFailureRecord`.

    Args:
        function: function to call.
        arguments: arguments of the function.

    Returns:
        Result of the function, or a `LawFailureRecord`.
    """
    try:
        return function(*arguments)
    except LAW_ERRORS as error:
        return LawFailureRecord(str(error) or type(error).__name__)


@dataclass(frozen=True, eq=False)
class FitFieldInputs:
    """Results of an estimate from which `Estimator.make_method_specific_fit_fields` derives text and further fields.

    Attributes:
        estimate: minimum of the fit.
        spread: uncertainty of the estimate.
        descents: descents from all starts.
        values: name -> value of all parameters, SI.
        loose: names of parameters that the data do not determine.
        status: status of the fit.
        unusable: reason why the fit is not usable; None: it is usable.
        lost: further warnings, such as instability in other modes of loading.
    """

    estimate: Estimate
    spread: ParameterUncertainty
    descents: Sequence[DescentResult]
    values: Mapping[str, float]
    loose: Sequence[str]
    status: str
    unusable: str | None
    lost: Sequence[str]


class Estimator(ABC):
    """Estimation method of a campaign.

    Attributes:
        explores: whether profile likelihoods are computed and simulations are kept on disk.
        words: description of the method for material files.
        campaign: campaign.
        measured: test -> its recordings.
        solves: cache of simulations.
    """

    explores: bool
    words: str

    def __init__(self, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]], solves: SimulationCache):
        self.campaign, self.measured, self.solves = campaign, measured, solves

    @property
    def pooled_sensor_stress_noise_or_none(self) -> float | None:
        """Pooled noise of the nominal stress, Pa; None if each test has its own noise."""
        return None

    @abstractmethod
    def require_fittable_law(self, law: str, number: int) -> None:
        """Check that a law can be fitted.

        Args:
            law: name of the law.
            number: index of the law in ``fit.laws``.

        Raises:
            InputError: the law cannot be fitted; with file and field.
        """

    @abstractmethod
    def fit_laws(self, laws: Sequence[str],
                 context: RunContext) -> dict[str, tuple[list[DescentResult], Estimate | str]]:
        """Estimate the parameters of several laws.

        Args:
            laws: names of the laws.
            context: workers and listeners.

        Returns:
            Law -> its descents, and its estimate or the reason of the failure.
        """

    @property
    @abstractmethod
    def problem_uncertainty_function(self) -> Callable[[Any, ProblemEvaluation], ParameterUncertainty]:
        """Function that returns the uncertainty of a problem at its minimum; it can be pickled for worker processes."""

    @abstractmethod
    def make_method_specific_fit_fields(self, found: FitFieldInputs) -> dict[str, Any]:
        """Return name -> value of the fields of `Fit` with messages, and of those that only this estimator computes."""

    @abstractmethod
    def build_held_out_test_and_mesh_error(self, test: Test, estimate: Estimate,
                                           predictor: PredictionParameters) -> tuple[ForwardTest, float]:
        """Return the forward model of a held-out test, and the relative error of its mesh.

        Args:
            test: held-out test.
            estimate: minimum of the fit.
            predictor: parameters for the prediction.
        """

    def get_replicate_jitter_or_none(self, estimate: Estimate) -> ContactAndForceZeroJitter | None:
        """Return the scatter of contact and zero between recordings; None: unknown."""
        return None


def build_fit_record(estimator: Estimator, estimate: Estimate, spread: ParameterUncertainty,
                     descents: Sequence[DescentResult],
                     sides: Sequence[ProfileSide], campaign: Campaign, limits: UsabilitySettings = USABILITY) -> Fit:
    """Return the `Fit` of an estimate, without computing effort and rank.

    Args:
        estimator: method of the fit.
        estimate: minimum of the sum of squares.
        spread: uncertainty of the estimate.
        descents: descents from all starts.
        sides: sides of the profile likelihoods.
        campaign: campaign.
        limits: limits of the usability rule.
    """
    problem, space = estimate.problem, estimate.problem.space
    law = find_law(space.law)
    theta = estimate.theta[: len(space.free)]
    values = space.get_values_by_name(theta)
    free = slice(0, len(space.free))
    specimens = determine_population_and_left_out_specimens(space, theta, spread.covariance[free, free],
                                                            spread.standard_errors[free])
    moduli = space.select_law_parameter_values(specimens.replace_specimen_values_by_representative(space, values))
    reached = {test.name: test.compute_stretch_range(space, theta) for test in problem.tests}
    stretches = (min(one.principal[0] for one in reached.values()), max(one.principal[1] for one in reached.values()))
    stretch_range = min(STRETCH_RANGE[0], stretches[0]), max(STRETCH_RANGE[1], stretches[1])
    stability = find_stability_range(law, law.convert_parameters_to_array(moduli), stretch_range)
    mu0 = law.mu0(moduli)
    units = {each.name: each.declaration.unit for each in space.unknowns}
    alternatives = find_equally_good_different_materials(law, space.select_law_parameter_values(values),
                                                         [(minimum,
                                                           space.select_law_parameter_values(minimum.parameters))
                                                          for minimum in estimate.minima], stretches)
    determination = _assess_shear_modulus_precision(estimate, spread, mu0, campaign)
    clauses, status, unusable = evaluate_usability_clauses_and_status(UsabilityEvidence(
        estimate, stability, reached, mu0, specimens, alternatives, determination, space.symbols, units, limits))
    loose = find_undetermined_parameters(space, spread)
    spread = replace_misleading_standard_errors(space, spread, theta, alternatives)
    errors: dict[str, float | None] = dict.fromkeys(space.fixed, 0.0)
    errors |= {name: float(e) if np.isfinite(e) else None
               for name, e in zip(space.free, spread.standard_errors, strict=False)}
    profiles, intervals, notes = _collect_profiles_intervals_and_notes(estimate, spread, sides)
    aic, bic = compute_aic_and_bic(*spread.criteria, problem.bounds[0].size)
    order = list(space.names)
    covariance = np.zeros((len(order), len(order)))
    indices = [order.index(name) for name in space.free]
    covariance[np.ix_(indices, indices)] = spread.covariance[free, free]
    shared = {
        "law": law.name, "formula": law.formula(), "parameters": values, "symbols": space.symbols,
        "units": units, "alternatives": alternatives, "clauses": clauses,
        "standard_errors": {name: errors[name] for name in order},
        "derivatives": _classify_parameter_derivatives(estimate, theta),
        "covariance": ParameterCovariance(order=order, matrix=covariance.tolist()),
        "correlation": compute_correlation_matrix(covariance).tolist(), "covariance_from": spread.basis,
        "intervals95": intervals, "not_identifiable": loose,
        "noise_ratio": spread.ratio, "AIC": aic, "BIC": bic, "E0": law.E0(moduli),
        "mu0": mu0, "stable_from": stability.stable_from, "stable_to": stability.stable_to,
        "stability": stability.describe(), "stretch_range": (float(stretches[0]), float(stretches[1])),
        "minima": list(estimate.minima), "starts": len(descents),
        "misfits": compute_misfit_percents_and_noise_ratios(estimate)[0], "status": status, "unusable": unusable,
        "cpu_s": 0.0,
        "interval_notes": notes, "profiles": profiles,
        "iterations": sum(len(descent.history) for descent in descents) + len(estimate.history),
        "population": specimens.population, "material_of": list(specimens.material_of),
        "left_out_specimens": dict(specimens.left_out),
        "material_file": f"{law.name}.material.json" if mu0 > 0 and not specimens.missing_population_reason else None}
    lost = [*law.describe_limiting_cases(moduli),
            *_describe_instability_in_unmeasured_modes(stability, reached, stretches),
            *list_warning_if_specimens_differ(estimate), *specimens.list_specimen_warnings(unusable)]
    found = FitFieldInputs(estimate, spread, descents, values, loose, status, unusable, lost)
    fit = Fit(**shared | estimator.make_method_specific_fit_fields(found))
    return replace(fit, sag_mm=compute_specimen_sags_mm(fit, campaign))


def _assess_shear_modulus_precision(estimate: Estimate, spread: ParameterUncertainty, mu0: float,
                                    campaign: Campaign) -> ShearModulusPrecision | None:
    """Return how well the tests determine the shear modulus.

    None if the modulus is not positive, or if each specimen has its own moduli, which the clause `population` judges.
    """
    space = estimate.problem.space
    if not mu0 > 0 or any(each.is_law_parameter and each.specimen is not None for each in space.unknowns):
        return None
    law = find_law(space.law)
    stated = {each.name for each in space.free_parameters if each.path in campaign.fit.bounds}
    return assess_modulus_error_and_bound_dependence(
        estimate, spread,
        lambda theta: law.mu0(space.select_law_parameter_values(space.get_values_by_name(theta))), stated)


def _classify_parameter_derivatives(estimate: Estimate, theta: np.ndarray) -> dict[str, str]:
    """Return free parameter -> ``"difference"`` if any test uses finite differences for it, otherwise ``"exact"``."""
    problem, names = estimate.problem, set()
    for test in problem.tests:
        names |= test.list_finite_difference_parameters(test.solve(problem.space, theta, problem.solves))
    return {name: "difference" if name in names else "exact" for name in problem.space.free}


def _describe_instability_in_unmeasured_modes(stability: StabilityRange, reached: Mapping[str, StretchRange],
                                              stretches: tuple[float, float]) -> list[str]:
    """Return a warning if the law is unstable in other modes of loading within the measured stretches."""
    measured = {one.mode for one in reached.values()}
    found = [loss for mode in stability.limits if mode not in measured
             if (loss := describe_instability(stability, mode, stretches))]
    return [f"not stable {' and '.join(found)}, which was not measured"] if found else []


def _collect_profiles_intervals_and_notes(estimate: Estimate, spread: ParameterUncertainty,
                                          sides: Sequence[ProfileSide]):
    """Return profiles, 95 % intervals and notes on the intervals, each by name of the parameter."""
    space, theta = estimate.problem.space, estimate.theta
    values = space.get_values_by_name(theta[: len(space.free)])
    profiles: dict[str, ProfileLikelihood] = {}
    intervals: dict[str, tuple[float, float] | None] = {name: (values[name], values[name]) for name in space.fixed}
    notes: dict[str, str] = {}
    for i, name in enumerate(space.free):
        mine = sorted((side for side in sides if side.index == i), key=lambda side: side.side)
        if len(mine) == 2:
            down, up = mine
            points = sorted({*zip(down.values.tolist(), down.rises.tolist(), strict=True),
                             *zip(up.values.tolist(), up.rises.tolist(), strict=True)})
            cuts = [f"{end}: {side.note}" for end, side in (("low", down), ("high", up)) if side.note]
            profiles[name] = ProfileLikelihood(values=[v for v, _ in points], rises=[r for _, r in points],
                                               level=float(spread.quantile[i]**2), notes=cuts)
            # A parameter that differs between equally good optima has no interval.
            intervals[name] = (down.end, up.end) if np.isfinite(spread.standard_errors[i]) else None
            if cuts:
                notes[name] = "; ".join(cuts)
        else:
            error = spread.standard_errors[i]
            ends = np.clip(values[name] + spread.quantile[i] * error * np.array([-1.0, 1.0]), space.low[i],
                           space.high[i])
            intervals[name] = (float(ends[0]), float(ends[1])) if np.isfinite(error) else None
    return profiles, {name: intervals[name] for name in space.names}, notes
