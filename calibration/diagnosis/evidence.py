"""Evidence of a diagnosis: fit of a campaign to whole recordings, and tests of its residuals and contact offsets.

A contact offset far beyond its assumed scatter shows, for example, a displacement that was set to zero at a preload.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
from scipy import special

from calibration.campaign.campaign import Campaign, Noise
from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.settings import LIMITS, REFITS, DecisionLimits, RefitSettings
from calibration.effects.effect import DiagnosisData
from calibration.fit.estimate import Estimate
from calibration.fit.fit import RegionMisfitTest
from calibration.fit.generalised import INVERSE_WARNINGS, GeneralisedLeastSquaresEstimator
from calibration.fit.lack_of_fit import compute_smooth_misfit_tests_of_regions
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.adequacy import (
    CommonSignal,
    compute_f_ratio_and_freedoms,
    compute_orthonormal_basis,
    get_most_significant_common_signal,
)
from calibration.statistics.jitter import ContactAndForceZeroJitter
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.laws import LAWS

#: Largest difference of the displacements of corresponding samples of two recordings, as a fraction of the largest
#: displacement.
_SAME_POSITION = 0.005
#: Test -> its recordings.
Measured = Mapping[str, tuple[MeasuredCurve, ...]]


def make_one_law_whole_recording_campaign(campaign: Campaign, law: str | None = None) -> Campaign:
    """Return the campaign with one law that is fitted to whole recordings, including holds and unloading.

    Args:
        campaign: campaign of an inverse fit.
        law: name or alias of the law; None: the first law of the campaign.

    Raises:
        InputError: the campaign is analytical, or does not list the law.
    """
    if campaign.fit.method != "inverse_fem":
        raise InputError(f'method must be "inverse_fem" for a diagnosis, which simulates the tests; got '
                         f'"{campaign.fit.method}". Set method = "inverse_fem"', file=campaign.path, field="fit.method")
    law = None if law is None else LAWS.get_name_of_alias(law)
    if law is not None and law not in campaign.fit.laws:
        raise InputError(f"law must be one of the laws of the campaign ({', '.join(campaign.fit.laws)}); got {law!r}. "
                         "Choose one of these laws, or add the law to fit.laws", file=campaign.path, field="fit.laws")
    # Samples after a drop of the force are kept: they are evidence of a tear, a puncture or lost steps.
    return replace(campaign, tests=tuple(
        replace(test, failure="keep") if test.failure == "cut" else test for test in campaign.tests),
                   fit=replace(campaign.fit, whole=True, laws=(law or campaign.fit.laws[0],)))


@dataclass(eq=False)
class FitEvidence:
    """Fit of a campaign to whole recordings, and tests of its whitened residuals.

    Attributes:
        campaign: campaign with one law and whole recordings.
        measured: test -> its recordings.
        estimate: minimum of the fit.
        limits: decision limits of the diagnosis.
        refit_settings: settings of the fits with an effect.
    """

    campaign: Campaign
    measured: Measured
    estimate: Estimate
    limits: DecisionLimits = LIMITS
    refit_settings: RefitSettings = REFITS

    @property
    def problem(self) -> GeneralisedProblem:
        """Least-squares problem of the fit, with its jitter and mesh corrections."""
        return self.estimate.problem

    @property
    def law_name(self) -> str:
        """Name of the fitted law."""
        return self.problem.space.law

    @cached_property
    def evaluation(self) -> ProblemEvaluation:
        """Residuals and derivatives at the minimum."""
        return self.estimate.evaluation

    @cached_property
    def parameter_values(self) -> dict[str, float]:
        """Name -> value of all parameters, SI."""
        return self.problem.space.get_values_by_name(self.estimate.theta)

    @cached_property
    def diagnosis_data(self) -> DiagnosisData:
        """Tests and recordings for `calibration.effects.effect.Effect.candidates`."""
        return DiagnosisData(self.campaign, self.measured, self.law_name)

    @cached_property
    def whitened_residual_with_nuisances_and_priors(self) -> np.ndarray:
        """Whitened model minus data, followed by nuisances and priors, shape (M,)."""
        return self.evaluation.full_residual_and_jacobian[0]

    @cached_property
    def fitted_space_basis(self) -> np.ndarray:
        """Orthonormal basis of the space of all fitted unknowns including nuisances, shape (M, k)."""
        return compute_orthonormal_basis(self.evaluation.full_residual_and_jacobian[1])

    @cached_property
    def region_misfit_tests(self) -> list[RegionMisfitTest]:
        """Residual tests of all regions; a region is adequate if its p value exceeds `DecisionLimits.region_level`."""
        return [msgspec.structs.replace(region, adequate=region.p > self.limits.region_level)
                for region in compute_smooth_misfit_tests_of_regions(self.problem, self.evaluation)]

    @property
    def has_adequate_region_residuals(self) -> bool:
        """Whether no region has a significant smooth misfit; common signals of recordings are not tested."""
        return all(region.adequate for region in self.region_misfit_tests)

    @cached_property
    def _first_curve_and_replicate_residuals_by_test(self) -> dict[str, tuple[MeasuredCurve, np.ndarray]]:
        """Test -> its first recording, and the whitened residuals of its recordings, shape (recordings, n).

        Only recordings with the displacements of the first one are included, and only tests with several of them.
        """
        found = {}
        for number, test in enumerate(self.problem.tests):
            mine = [(curve, self.evaluation.residual[rows]) for (t, _), rows, curve in zip(
                self.problem.places, self.problem.rows, self.problem.measured, strict=True) if t == number]
            first = mine[0][0].displacement
            matching = [residual for curve, residual in mine if residual.size == first.size
                        and np.abs(curve.displacement - first).max() < _SAME_POSITION * np.abs(first).max()]
            if len(matching) > 1:
                found[test.name] = mine[0][0], np.array(matching)
        return found

    @cached_property
    def variance_f_ratios_and_freedoms_by_test(self) -> dict[str, tuple[float, int, int]]:
        """Name of a test with several recordings -> F ratio and degrees of freedom of its residuals.

        See `calibration.statistics.adequacy.compute_f_ratio_and_freedoms`.
        """
        return {name: compute_f_ratio_and_freedoms(residuals) for name,
                (_, residuals) in self._first_curve_and_replicate_residuals_by_test.items()}

    @cached_property
    def significant_common_signals_by_test(self) -> dict[str, CommonSignal]:
        """Test -> significant common signal in the residuals of its recordings.

        A rough common signal is missed by the smooth modes of the regions, and it increases the estimated noise.
        """
        found = {}
        for name, (curve, residuals) in self._first_curve_and_replicate_residuals_by_test.items():
            segments = _slice_equal_label_runs(curve.segment, residuals.shape[1])
            signal = get_most_significant_common_signal(residuals, segments)
            if len(self._first_curve_and_replicate_residuals_by_test) * signal.p < self.limits.common_signal_level:
                found[name] = signal
        return found

    @property
    def tests_with_common_signal(self) -> list[str]:
        """Names of tests whose residuals have a significant common signal."""
        return list(self.significant_common_signals_by_test)

    @cached_property
    def common_signal_descriptions(self) -> list[str]:
        """Descriptions of the common signals, such as ``needle (most at 5.1 mm)`` or ``plates (a wave of 17 s)``."""
        words = []
        for name, each in self.significant_common_signals_by_test.items():
            curve = self._first_curve_and_replicate_residuals_by_test[name][0]
            inside = slice(each.first, each.last + 1)
            if each.waves and curve.time is not None:
                words.append(f"{name} (a wave of {np.ptp(curve.sample_times[inside]) / each.waves:.2g} s)")
            elif each.last - each.first + 1 < curve.force.size and not each.waves:
                place = float(np.mean(curve.displacement[inside]))
                at = f"{place:.2g} Hz" if curve.test.modulus else f"strain {place:.2g}" if curve.stressed \
                    else f"{1e3 * place:.2g} mm"
                words.append(f"{name} (most at {at})")
            else:
                words.append(name)
        return words

    @property
    def has_no_misfit_or_common_signal(self) -> bool:
        """Whether the residuals have neither a smooth misfit nor a common signal."""
        return self.has_adequate_region_residuals and not self.tests_with_common_signal

    @cached_property
    def effective_sample_count(self) -> float:
        """Effective number of independent samples of all recordings: n (1 - rho) / (1 + rho), at least 2."""
        total = 0.0
        for curve in self.problem.measured:
            correlation = 0.0
            if curve.noise.correlation_time:
                step = float(np.median(np.diff(curve.sample_times))) if curve.time is not None else 1.0
                correlation = float(np.exp(-step / curve.noise.correlation_time))
            total += curve.force.size * (1.0 - correlation) / (1.0 + correlation)
        return max(total, 2.0)


def _slice_equal_label_runs(labels: np.ndarray | None, size: int) -> list[slice]:
    """Return the runs of equal labels as slices; one slice without labels."""
    if labels is None:
        return [slice(0, size)]
    ends = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), size]
    return list(map(slice, ends[:-1], ends[1:]))


def fit_without_effects(campaign: Campaign, measured: Measured, solves: SimulationCache,
                        context: RunContext, limits: DecisionLimits = LIMITS,
                        refit_settings: RefitSettings = REFITS) -> FitEvidence:
    """Fit the plain model of a campaign, without any effect of the catalogue.

    Args:
        campaign: campaign from `make_one_law_whole_recording_campaign`.
        measured: test -> its recordings.
        solves: cache of simulations.
        context: workers and listeners.
        limits: decision limits of the diagnosis.
        refit_settings: settings of the later fits with an effect.

    Raises:
        ConvergenceError: the simulation fails for all starts.
    """
    law = campaign.fit.laws[0]
    estimator = GeneralisedLeastSquaresEstimator(campaign, measured, solves)
    _, estimate = estimator.fit_laws((law,), context)[law]
    if not isinstance(estimate, Estimate):
        raise ConvergenceError(f"{campaign.path}: no start of {law} can be simulated over the data ({estimate}); state "
                               "another start in fit.start, or a smaller max_strain")
    problem = estimate.problem
    problem = replace(problem, jitter=compute_upper_limit_of_estimated_jitter(
        problem, estimate.theta, estimator.get_stated_or_prior_jitter(problem), limits.jitter_exceedance))
    descent = minimise_from_start(problem, estimate.theta, corrected=True)
    estimate = replace(estimate, theta=descent.theta, error=descent.error, problem=problem)
    return FitEvidence(campaign, measured, estimate, limits, refit_settings)


def compute_upper_limit_of_estimated_jitter(problem: GeneralisedProblem, theta: np.ndarray, stated: Noise,
                                            exceedance: float = LIMITS.jitter_exceedance) -> ContactAndForceZeroJitter:
    """Return an upper confidence limit of an estimated jitter; stated or assumed jitter is returned unchanged.

    Few recordings may agree by chance; with too small a jitter, effects that resemble a contact offset or a zero would
    be found wrongly. The observed variance s^2 = jitter^2 + e^2, with the error e of a single offset, follows a scaled
    chi-square distribution with f degrees of freedom. Its upper limit is s^2 f / chi2_f(0.2).

    Args:
        problem: problem of the fit.
        theta: free parameters, SI, shape (p,).
        stated: jitter that the campaign states; None values were estimated.
        exceedance: probability that the true jitter exceeds the limit.
    """
    jitter = problem.jitter
    if not jitter.freedom:
        return jitter
    factor = jitter.freedom / float(special.chdtri(jitter.freedom, 1.0 - exceedance))
    resolved: dict[str, list[float]] = {"contact": [], "zero": []}
    for test in problem.linearise_replicates(theta):
        for one in test:
            own = np.column_stack([one.contact, one.zero])
            variances = np.diag(np.linalg.pinv(own.T @ own))
            for name, variance in zip(resolved, variances, strict=True):
                resolved[name].append(float(variance))
    known = {"contact": stated.contact_jitter, "zero": stated.zero_jitter}
    found = {}
    for name, several in resolved.items():
        own_variance, value = float(np.median(several)), getattr(jitter, name)
        larger = np.sqrt((value**2 + own_variance) * factor - own_variance)
        found[name] = value if known[name] is not None else float(larger)
    return ContactAndForceZeroJitter(found["contact"], found["zero"], jitter.freedom)


@dataclass(frozen=True)
class ContactIterationSettings:
    """Iteration of fits whose displacements are counted from the contacts of the previous fit.

    Attributes:
        max_fits: maximum number of fits.
        tolerance: contact offset at which the iteration ends, in standard deviations of the prior. A smaller tolerance
            requires more fits.
    """

    max_fits: int = 4
    tolerance: float = 0.2


_CONTACT_ITERATION = ContactIterationSettings()


def refit_from_far_contacts_and_describe_them(evidence: FitEvidence,
                                              context: RunContext) -> tuple[FitEvidence, list[str]]:
    """Repeat the fit with displacements counted from the fitted contacts if these are far beyond their prior.

    The prior and the linear extrapolation of the simulated force bias such a contact, and the bias may appear as an
    effect. The fit is repeated only if all regions are adequate and the scatter was assumed; otherwise the evidence is
    returned unchanged.

    Args:
        evidence: fit without effects.
        context: workers and listeners.

    Returns:
        The evidence, and a sentence for each contact far beyond its prior.
    """
    scatter, found, shifts = evidence.problem.jitter, evidence, dict[str, float]()
    if scatter.freedom != 0 or not evidence.has_no_misfit_or_common_signal:
        return evidence, []
    for _ in range(_CONTACT_ITERATION.max_fits):
        far = {name: contact for name, contact in _get_fitted_contact_offsets(found).items()
               if abs(contact) > INVERSE_WARNINGS.suspect_nuisance * scatter.contact
               or (name in shifts and abs(contact) > _CONTACT_ITERATION.tolerance * scatter.contact)}
        if not far:
            break
        shifts |= {name: shifts.get(name, 0.0) + contact for name, contact in far.items()}
        measured = {test: tuple(curve.subtract_contact_offset(shifts.get(curve.name, 0.0)) for curve in curves)
                    for test, curves in evidence.measured.items()}
        try:
            found = fit_without_effects(evidence.campaign, measured, evidence.problem.solves, context, evidence.limits)
        except ConvergenceError:
            return evidence, []
    if not found.has_no_misfit_or_common_signal:
        return evidence, []
    rest = _get_fitted_contact_offsets(found)
    stressed = {curve.name: curve.stressed for curve in evidence.problem.measured}
    return found, [_describe_contact_offset(name, shift + rest[name], scatter, stressed[name])
                   for name, shift in shifts.items()]


def _get_fitted_contact_offsets(evidence: FitEvidence) -> dict[str, float]:
    """Return recording -> fitted contact offset, m (strain for recordings of stress)."""
    problem, nuisances = evidence.problem, evidence.evaluation.nuisances
    if "contact" not in problem.kinds:
        return {}
    index = problem.kinds.index("contact")
    return {curve.name: float(nuisances[columns][index]) * problem.jitter.contact
            for columns, curve in zip(problem.offset_columns, problem.measured, strict=True)}


def _describe_contact_offset(name: str, contact: float, scatter: ContactAndForceZeroJitter, stressed: bool) -> str:
    """Describe a contact offset beyond the assumed scatter."""
    size, assumed = (f"{each:.2g} of strain" if stressed else f"{1e3 * each:.2f} mm"
                     for each in (abs(contact), scatter.contact))
    return (f"contact offset of {name}: contact lies {size} {'before' if contact < 0 else 'after'} the zero of the "
            f"displacement, {abs(contact) / scatter.contact:.2g} times the assumed scatter of {assumed}")
