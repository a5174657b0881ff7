"""Usability rule of a fit: a list of clauses, each of which holds or fails with a reason and a remedy.

Values between the clauses are compared after noise and the scatter between recordings have been taken out, so that a
noisy recording of the right law is usable and a precise recording of the wrong law is not. A fit whose residuals are
many times the noise is usable as long as the limits below hold: real tissue obeys no law to the precision of a sensor.

Two clauses concern contact. The recordings must determine contact well enough for the shear modulus. The contact offset
must cover a preload at the zero of the displacement; the zero of the force does not count: a fit without a contact
offset takes the preload for a zero of the force, and its modulus is then wrong.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.fit import AlternativeMinimum, Fit, UsabilityClauseResult
from calibration.fit.identifiability import PRECISION as DETERMINATION
from calibration.fit.identifiability import ShearModulusPrecision
from calibration.fit.lack_of_fit import (
    compute_lack_of_fit_r2_and_relative_error,
    describe_stiffness_disagreement_or_empty,
    get_residual_scale,
)
from calibration.fit.ordinary_problem import OrdinaryProblem
from calibration.fit.population import PopulationAndLeftOutSpecimens
from calibration.fit.replicates import find_replicate_disagreements, find_same_kind_disagreements
from calibration.fit.trust_region import describe_alternative_minima
from calibration.forward.contract import StretchRange
from calibration.statistics.statistics import NOISE_RATIOS, compute_median_sampling_interval_or_zero
from tissue_sim.errors import InputError
from tissue_sim.laws import StabilityRange
from tissue_sim.recording.contact import (
    relative_modulus_error_from_contact,
    relative_modulus_error_from_contact_range,
)
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE
from tissue_sim.settings import require_all_settings_positive


@dataclass(frozen=True)
class UsabilitySettings:
    """Limits of the clauses of the usability rule; a fit is usable if all clauses hold.

    Attributes:
        largest_residual: largest root mean square residual of a test, relative to its largest force. A smaller value
            rejects laws whose error is below the scatter between specimens.
        smallest_R2: smallest fraction of the variance of the force (of the displacement if the force is controlled)
            that a law must explain in each test, over the samples in which the controlled quantity moves. A larger
            value rejects laws that describe measured tissue; docs/calibration.md compares the limit with measured data.
        noise_ratio: residuals below this many times the noise fail no clause on residuals. A larger value accepts a
            misfit in recordings with little noise.
        start_samples: number of samples whose mean is the force at the start of a recording.
        start_fraction: a force against the load at the start counts above this fraction of the range of the force ...
        start_noise: ... and above this many times the noise; the remedy of a misfit is then the zero of the load cell.
            A force that exceeds that at the start by more is a clear rise, before which the tool may be in the air.
        largest_modulus_noise: largest estimated noise of a storage or loss modulus, relative to it. A rheometer has a
            few percent; a larger scatter of neighbouring frequencies shows several sweeps in one table. Stated noise is
            not limited.

    Raises:
        InputError: a limit is not positive, or `smallest_R2` is 1 or more.
    """

    largest_residual: float = 0.10
    smallest_R2: float = 0.95
    noise_ratio: float = NOISE_RATIOS.model_error
    start_samples: int = 3
    start_fraction: float = 0.02
    start_noise: float = 5.0
    largest_modulus_noise: float = 0.2

    def __post_init__(self) -> None:
        require_all_settings_positive(self)
        if not self.smallest_R2 < 1:
            raise InputError(f"smallest_R2 must be below 1; got {self.smallest_R2:g}", field="smallest_R2")


#: Default limits of the usability rule.
USABILITY = UsabilitySettings()


def describe_worst_uncertain_contact_or_empty(estimate: Estimate, misfitted_tests: Collection[str],
                                              limits: UsabilitySettings) -> str:
    """Describe the recordings whose contact is not known well enough; empty if there are none.

    The standard errors of the parameters include the uncertainty of a fitted contact offset. An unclear contact does
    not count if the residuals are near the noise: they then show no motion in air.

    Args:
        estimate: minimum of the sum of squares.
        misfitted_tests: names of the tests whose residuals are far above the noise.
        limits: limits of a clear rise of the force, `start_samples` and `start_noise`.
    """
    if _has_fitted_contact_offsets(estimate.problem):
        return ""
    found = []
    for curve in estimate.problem.measured:
        contact = None if curve.whole is None else curve.whole.segmentation.contact
        if contact is None:
            continue
        if curve.test.contact == "find":
            error = relative_modulus_error_from_contact(curve.displacement, curve.force, curve.time, contact)
            found.append((error, curve, contact.interval))
        elif curve.test.contact == "recorded" and contact.status == "unclear" and curve.test.name in misfitted_tests:
            high = _find_last_displacement_without_clear_rise(curve, limits)
            error = relative_modulus_error_from_contact_range(curve.displacement, curve.force, curve.time,
                                                              0.5 * (high - float(curve.displacement[0])))
            found.append((error, curve, (-np.inf, high)))
    errors = [each for each in found if each[0] > MODULUS_TOLERANCE]
    if not errors:
        return ""
    error, curve, (low, high) = max(errors, key=lambda each: each[0])
    scale, unit, of = (1.0, "", "a strain of ") if curve.stressed else (1e3, " mm", "")
    known = f"contact is known to be at {of}{scale * low:.4g} to {scale * high:.4g}{unit} (95 %)" if np.isfinite(low) \
        else (f"contact is not found, and the force does not rise clearly before {of}{scale * high:.4g}{unit}, so the "
              "tool may be in the air")
    more = f" and {len(errors) - 1} more" if len(errors) > 1 else ""
    return (f"{curve.name}{more}: {known}; the shear modulus changes by {100 * error:.2g} % within this range, and the "
            f"limit is {100 * MODULUS_TOLERANCE:g} %")


def _find_last_displacement_without_clear_rise(curve: MeasuredCurve, limits: UsabilitySettings) -> float:
    """Return the displacement, m, of the last sample of the loading whose force is not clearly above that at the start.

    The tool may be in the air up to this displacement.
    """
    start = float(np.mean(curve.force[:limits.start_samples]))
    low = np.flatnonzero(curve.force - start <= limits.start_noise * curve.noise.deviation)
    return float(curve.displacement[low[low <= np.argmax(curve.displacement)].max(initial=0)])


def _has_fitted_contact_offsets(problem: Any) -> bool:
    """Return whether contact offsets are unknowns of the fit."""
    if isinstance(problem, OrdinaryProblem):
        return bool(problem.shifted)
    return "contact" in problem.kinds


@dataclass(frozen=True)
class PreloadCoverFractions:
    """Range of a fitted contact offset that covers a preload, as a fraction of the distance from contact.

    Attributes:
        min_fraction: smallest fraction; a smaller offset leaves a part of the preload unexplained.
        max_fraction: largest fraction; a larger offset has another cause.
    """

    min_fraction: float = 0.8
    max_fraction: float = 1.25


_PRELOAD = PreloadCoverFractions()


def get_fitted_contact_offsets(estimate: Estimate) -> Mapping[str, float]:
    """Return recording -> fitted contact offset, m; negative if contact lies before the zero of the displacement."""
    problem: Any = estimate.problem
    if isinstance(problem, OrdinaryProblem):
        values = problem.get_contact_offsets_and_zeros(estimate.theta)[:, 0]
    elif "contact" in problem.kinds:
        first = [columns.start + problem.kinds.index("contact") for columns in problem.offset_columns]
        values = problem.jitter.contact * estimate.evaluation.nuisances[first]
    else:
        values = np.zeros(len(problem.places))
    return {curve.name: float(contact) for curve, contact in zip(problem.measured, values, strict=True)}


def copy_notes_with_explained_preload(curve: MeasuredCurve, fit: Fit) -> dict[str, str]:
    """Return the notes of a recording; the note on a preload is replaced if the fitted contact offset covers it.

    Args:
        curve: recording.
        fit: best fit.
    """
    notes, preload = dict(curve.notes), curve.screening.preload
    contacts = {each.replicate: 1e-3 * each.contact_offset_mm for each in fit.nuisances}
    if preload is None or curve.stressed or curve.name not in contacts:
        return notes
    contact = contacts[curve.name]
    if _equals_preload_distance(contact, preload.shift):
        notes["preload"] = (f"the displacement was zeroed at a preload of {preload.force:.3g} N; the fitted contact "
                            f"offset of {1e3 * contact:.3g} mm covers it")
    return notes


def is_preload_absent_or_explained(curve: MeasuredCurve, contact: float) -> bool:
    """Return whether a contact offset, m, explains the preload at zero displacement; true without such a preload."""
    preload = curve.screening.preload
    return preload is None or preload.is_settled or _equals_preload_distance(contact, preload.shift)


def _equals_preload_distance(contact: float, shift: float) -> bool:
    """Return whether a contact offset, m, equals the distance of a preload from contact, m, within the limits."""
    return _PRELOAD.min_fraction <= -contact / shift <= _PRELOAD.max_fraction


#: Status of a usable fit.
USABLE = "converged"
#: Remedy of a misfit where neither the recordings nor their zero are at fault.
_OTHER_LAW = "end the test before something else begins, such as failure (max_strain), or take another law"


@dataclass(frozen=True, eq=False)
class UsabilityEvidence:
    """Estimate and recordings from which the clauses of the usability rule are evaluated.

    Attributes:
        estimate: minimum of the sum of squares.
        stability: stability of the law at the minimum, see `tissue_sim.laws.find_stability_range`.
        reached: test -> range of stretches that its recordings reach.
        mu0: shear modulus at rest, Pa.
        specimens: specimens with individual parameters.
        alternatives: other parameters that fit equally well.
        determination: determination of the shear modulus by the tests; None if there is no such modulus.
        symbols: name of a parameter -> its symbol in messages.
        units: name of a parameter -> its unit.
        limits: limits of the clauses.
    """

    estimate: Estimate
    stability: StabilityRange
    reached: Mapping[str, StretchRange]
    mu0: float
    specimens: PopulationAndLeftOutSpecimens
    alternatives: Sequence[AlternativeMinimum]
    determination: ShearModulusPrecision | None
    symbols: Mapping[str, str]
    units: Mapping[str, str]
    limits: UsabilitySettings = USABILITY


def evaluate_usability_clauses_and_status(
        evidence: UsabilityEvidence) -> tuple[list[UsabilityClauseResult], str, str | None]:
    """Evaluate all clauses of the usability rule; a fit is usable if all clauses hold.

    Returns:
        All clauses in the order of their weight, the status, and the reasons why the fit is not usable (None: it is).
    """
    clauses = [check(evidence) for check in _CHECKS]
    failed = [clause for clause in clauses if not clause.holds]
    if not failed:
        return clauses, USABLE, None
    # Without a material or a minimum the other clauses have no meaning; several optima matter for a law that fits.
    first = failed[:1] if failed[0].name in ("physical", "converged") else \
        [clause for clause in failed if clause.name != "unique" or len(failed) == 1]
    remedies = dict.fromkeys(clause.remedy for clause in first if clause.remedy)
    # Where the recordings themselves are at fault, another law is no remedy.
    at_fault = any(clause.name in ("recordings", "modulus_noise", "replicates") for clause in first)
    specific = [remedy for remedy in remedies if remedy != _OTHER_LAW] or ([] if at_fault else list(remedies))
    return clauses, first[0].status, "; ".join([*(clause.reason for clause in first), *specific])


def _clause_from_reason(name: str, status: str, reason: str, remedy: str = "") -> UsabilityClauseResult:
    """Return a record of a clause: the clause holds if `reason` is empty, and `remedy` is kept only if it fails."""
    return UsabilityClauseResult(name=name, holds=not reason, status=status, reason=reason,
                                 remedy=remedy if reason else "")


def _evaluate_positive_shear_modulus_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the shear modulus is positive."""
    if evidence.mu0 > 0:
        return _clause_from_reason("physical", "not_physical", "")
    remedy = "no material has that, so no material file is written: set bounds or use another law"
    falling = [curve.name for curve in evidence.estimate.problem.measured
               if _is_force_anticorrelated_to_displacement(curve)]
    if falling:
        remedy = (f"the force of {', '.join(falling)} falls while the displacement grows: check the sign of both "
                  "columns, and which of them is the force")
    return _clause_from_reason("physical", "not_physical", f"its shear modulus at rest is {evidence.mu0:.4g} Pa",
                               remedy)


def _is_force_anticorrelated_to_displacement(curve: MeasuredCurve) -> bool:
    """Return whether force and displacement of a recording are negatively correlated."""
    centred = curve.displacement - curve.displacement.mean()
    return float(centred @ curve.force) < 0


def _evaluate_minimiser_convergence_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the minimisation converged."""
    estimate = evidence.estimate
    return _clause_from_reason("converged", "not_converged",
                               "" if estimate.converged else estimate.failure or "it did not converge",
                               "the optimiser ran out of evaluations in a flat valley where other parameters fit as "
                               "well: fix one, or use a law with fewer")


def _evaluate_stability_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the law is Drucker-stable inside the measured stretches of each mode of loading."""
    ranges: dict[str, tuple[float, float]] = {}
    for one in evidence.reached.values():
        if one.mode:
            low, high = ranges.get(one.mode, (one.low, one.high))
            ranges[one.mode] = min(low, one.low), max(high, one.high)
    lost = [loss for mode, stretches in ranges.items()
            if (loss := describe_instability(evidence.stability, mode, stretches))]
    return _clause_from_reason("stable", "unstable",
                               f"not stable {' and '.join(lost)}, where there are data" if lost else "")


def describe_instability(stability: StabilityRange, mode: str, stretches: tuple[float, float]) -> str:
    """Describe where one mode of loading loses Drucker stability inside these stretches; empty if it is stable."""
    (low, high), (lower, upper) = stretches, stability.limits[mode]
    if lower == upper == 1.0:
        return f"in {mode} loading at every stretch"
    ends = [f"{side} stretch {limit:.3g}" for side, limit, lost in (("below", lower, lower > low),
                                                                    ("above", upper, upper < high)) if lost]
    return f"in {mode} loading {' and '.join(ends)}" if ends else ""


def _evaluate_screening_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the screening of the recordings found nothing that makes the moduli wrong."""
    problem = evidence.estimate.problem
    space = problem.space
    is_history_dependent = evidence.mu0 > 0 and space.build_material(
        space.get_values_by_name(evidence.estimate.theta[: len(space.free)])).is_history_dependent
    found: dict[str, list[str]] = {}
    contacts = get_fitted_contact_offsets(evidence.estimate)
    for curve in problem.measured:
        preload = curve.screening.preload
        is_explained = preload is not None and is_preload_absent_or_explained(curve, contacts[curve.name])
        covered = preload.sentence if is_explained else None
        for sentence in list_findings_contradicting_fit(curve, is_history_dependent):
            if sentence == covered:
                continue
            found.setdefault(sentence, []).append(curve.name)
    reasons = [f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}: {sentence}"
               for sentence, names in found.items()]
    return _clause_from_reason("recordings", "misfit", "; ".join(reasons))


def _evaluate_modulus_noise_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the estimated noise of moduli is that of one sweep, not the scatter of several sweeps."""
    limit = evidence.limits.largest_modulus_noise
    found = {curve.test.name: curve.noise.deviation for curve in evidence.estimate.problem.measured
             if curve.test.modulus and curve.noise.source == "estimated" and curve.noise.deviation > limit}
    reasons = [f"{name}: the estimated noise is {deviation:.0%} of the modulus, and the limit is {limit:.0%}"
               for name, deviation in found.items()]
    return _clause_from_reason("modulus_noise", "misfit", "; ".join(reasons),
                               "write sweeps of several temperatures, strain amplitudes or specimens to files of their "
                               "own, or state modulus_relative in [noise]")


def _evaluate_contact_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that a contact that is not fitted is certain enough for the shear modulus."""
    _, ratios = compute_misfit_percents_and_noise_ratios(evidence.estimate)
    misfitted = [name for name, ratio in ratios.items() if ratio > evidence.limits.noise_ratio]
    return _clause_from_reason("contact", "not_determined",
                               describe_worst_uncertain_contact_or_empty(evidence.estimate, misfitted, evidence.limits),
                               "set offset = \"fit\" in [fit], state the contact in mm, or record more air with less "
                               "noise")


def list_findings_contradicting_fit(curve: MeasuredCurve, remembers: bool) -> list[str]:
    """Return the sentences of the screening that make the moduli of a fit wrong.

    Relaxation, creep and dissipation contradict a law without memory only.

    Args:
        curve: recording.
        remembers: whether the material of the fit has a memory.
    """
    screening = curve.screening
    of_memory = screening.control.sentence if remembers and screening.control is not None else None
    return [sentence for sentence in screening.elastic_fit_contradictions if sentence != of_memory]


def _evaluate_replicate_and_same_kind_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that recordings of one test, and tests of one kind, have similar stiffnesses."""
    problem = evidence.estimate.problem
    if any(each.recording is not None for each in problem.space.unknowns):
        return _clause_from_reason("replicates", "misfit", "")
    measured = {test.name: test.measured for test in problem.tests}
    found = [each.describe() for each in find_replicate_disagreements(measured)]
    # A memory, another effect of the material, or parameters of single tests explain different stiffnesses.
    if all(each.is_law_parameter and each.tests is None for each in problem.space.unknowns
           if each.is_material_parameter):
        found += [each.describe() for each in find_same_kind_disagreements(measured)]
    return _clause_from_reason("replicates", "misfit", "; ".join(found))


def compute_misfit_percents_and_noise_ratios(estimate: Estimate) -> tuple[dict[str, float], dict[str, float]]:
    """Return the root mean square residual of each test, % of its largest force, and as a multiple of the noise.

    Residuals of a table of moduli are in % of the modulus.
    """
    problem, gap = estimate.problem, estimate.evaluation.force - estimate.problem.data
    percents, ratios = {}, {}
    for number, test in enumerate(problem.tests):
        mine = [(rows, test.measured[r]) for rows, (t, r) in zip(problem.rows, problem.places, strict=True)
                if t == number]
        residual = np.concatenate([gap[rows] for rows, _ in mine])
        scaled = np.concatenate([gap[rows] / curve.noise.deviation for rows, curve in mine])
        largest = max(get_residual_scale(curve) for _, curve in mine)
        percents[test.name] = 100.0 * float(np.sqrt(np.mean(residual**2))) / largest
        ratios[test.name] = float(np.sqrt(np.mean(scaled**2)))
    return percents, ratios


def _evaluate_residual_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause on the residuals of each test, which fails if they exceed the limits of force and of noise."""
    problem = evidence.estimate.problem
    percents, ratios = compute_misfit_percents_and_noise_ratios(evidence.estimate)
    missed = [f"its residuals in {test.name} are {percents[test.name]:.2g} % of the "
              f"{_name_largest_load(test.measured[0])} and {ratios[test.name]:.3g} times the noise"
              for test in problem.tests if percents[test.name] > 100 * evidence.limits.largest_residual
              and ratios[test.name] > evidence.limits.noise_ratio]
    return _clause_from_reason("residuals", "misfit",
                               f"does not describe the data: {' and '.join(missed)}" if missed else "",
                               _describe_misfit_remedy(evidence) if missed else "")


def _name_largest_load(curve: MeasuredCurve) -> str:
    """Return the name of the quantity to which residuals are relative."""
    return "modulus" if curve.test.modulus else f"largest {'stress' if curve.stressed else 'force'}"


def _evaluate_explained_variance_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause on the explained fraction of the variance of the force, without samples of holds."""
    problem, (_, ratios) = evidence.estimate.problem, compute_misfit_percents_and_noise_ratios(evidence.estimate)
    gap, missed = evidence.estimate.evaluation.force - problem.data, []
    for number, test in enumerate(problem.tests):
        R2 = compute_lack_of_fit_r2_and_relative_error(problem, gap, number).R2
        if R2 is not None and evidence.limits.smallest_R2 > R2 and ratios[test.name] > evidence.limits.noise_ratio:
            missed.append(f"R2 in {test.name} is {R2:.3f} over the part in which the displacement moves (noise and "
                          f"scatter taken out), and the limit is {evidence.limits.smallest_R2:g}")
    return _clause_from_reason("explained", "misfit", " and ".join(missed),
                               _describe_misfit_remedy(evidence) if missed else "")


def _describe_misfit_remedy(evidence: UsabilityEvidence) -> str:
    """Return the remedy of a misfit.

    The remedy is the zero of the load cell if a recording begins with a force against the load, separate materials if
    the law describes the tests one by one, and otherwise another law.
    """
    problem = evidence.estimate.problem
    found = [f"{curve.name}: the force begins at {start:.3g} {'Pa' if curve.stressed else 'N'}, against the load, so "
             "the load cell was not zeroed: set offset = \"start\" for the force in columns"
             for curve in problem.measured if curve.has_zero
             and (start := _get_negative_start_force_or_zero(curve, evidence.limits)) < 0]
    return "; ".join(found) or describe_stiffness_disagreement_or_empty(problem, evidence.estimate.evaluation.force,
                                                                        evidence.limits.smallest_R2) or _OTHER_LAW


def _get_negative_start_force_or_zero(curve: MeasuredCurve, limits: UsabilitySettings) -> float:
    """Return the mean force of the first samples if it is significantly below zero, N; otherwise 0."""
    start = float(np.mean(curve.force[:limits.start_samples]))
    limit = max(limits.start_fraction * float(np.ptp(curve.force)), limits.start_noise * curve.noise.deviation)
    return start if start < -limit else 0.0


def _evaluate_force_control_displacement_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause on the misfit of the displacement in recordings whose force is controlled.

    The residuals of the force do not show this misfit.
    """
    problem = evidence.estimate.problem
    model, missed = evidence.estimate.evaluation.force, []
    for rows, curve in zip(problem.rows, problem.measured, strict=True):
        control = curve.screening.control
        if control is None or control.quantity != "force":
            continue
        R2 = compute_displacement_r_squared(curve, model[rows])
        if evidence.limits.smallest_R2 > R2:
            missed.append(f"{curve.name}: the force is controlled, and the law explains {max(R2, 0.0):.1%} of the "
                          f"variance of the displacement (R2 {R2:.3g}, limit {evidence.limits.smallest_R2:g})")
    return _clause_from_reason("displacement", "misfit", "; ".join(missed),
                               "the displacement creeps under a held force: name viscoelastic.terms[0].g and .tau_s (a "
                               "second term: terms[1]) in fit.start, or record the test at a controlled displacement")


def compute_displacement_r_squared(curve: MeasuredCurve, model: np.ndarray) -> float:
    """Return the fraction of the variance of the displacement that a model explains at the measured force.

    The misfit of the force is divided by the secant stiffness of the model.

    Args:
        curve: recording.
        model: force at the samples, N, shape (n,).
    """
    stiffness = float(model @ curve.displacement) / float(curve.displacement @ curve.displacement)
    variance = float(np.var(curve.displacement))
    if stiffness <= 0 or variance <= 0:
        return 0.0
    return 1.0 - float(np.mean(((model - curve.force) / stiffness)**2)) / variance


def _evaluate_modulus_unstated_bounds_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that the shear modulus does not depend on bounds that the campaign does not state."""
    found = evidence.determination
    if found is None or not found.held:
        return _clause_from_reason("bounds", "not_determined", "")
    names = ", ".join(evidence.symbols[name] for name in found.held)
    change = f"changes by about {abs(found.change):.0%}" if np.isfinite(found.change) else "is not determined"
    return _clause_from_reason("bounds", "not_determined",
                               f"the shear modulus mu0 depends on the bounds of {names}, which the campaign does not "
                               f"state: without these bounds it {change}",
                               f"state fit.bounds or fit.fixed for {names} if their values are known, or fit a law "
                               "without them")


def _evaluate_modulus_precision_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause on the standard error of the shear modulus; single parameters may be undetermined."""
    found = evidence.determination
    if found is None:
        return _clause_from_reason("determined", "not_determined", "")
    if found.is_precise_enough:
        return _clause_from_reason("determined", "not_determined", _describe_fast_relaxation(evidence),
                                   "fit the law without viscoelastic terms, record with a shorter sampling interval, "
                                   "or state the relaxation time in fit.fixed")
    error = f"its standard error is {found.relative_error:.0%} of its value" if np.isfinite(found.relative_error) else \
        "the samples contain no information on it"
    return _clause_from_reason("determined", "not_determined",
                               f"the tests do not determine the shear modulus mu0: {error}, and the limit is "
                               f"{DETERMINATION.relative_error:.0%}",
                               "add a test or a longer recording, fix a parameter in fit.fixed, or use a law with "
                               "fewer")


def _describe_fast_relaxation(evidence: UsabilityEvidence) -> str:
    """Describe the fitted Prony terms that relax faster than the recordings resolve; empty if there are none.

    The samples contain no information on the modulus before such a relaxation. Its standard error does not show this
    where the relaxation time is on its bound, because parameters on bounds count as fixed.
    """
    space, measured = evidence.estimate.problem.space, evidence.estimate.problem.measured
    material = space.build_material(space.get_values_by_name(evidence.estimate.theta[: len(space.free)]))
    if material.viscoelastic is None:
        return ""
    # A table of moduli resolves relaxation times down to the inverse of its largest angular frequency.
    resolved = [1.0 / (2.0 * np.pi * float(curve.displacement.max())) for curve in measured if curve.test.modulus]
    sampled = compute_median_sampling_interval_or_zero([curve.time for curve in measured if curve.time is not None])
    interval = min([*resolved, *([sampled] if sampled > 0.0 else [])], default=0.0)
    found = [f"{evidence.symbols[name]} = {term.tau:.3g} s (g = {term.g:.2g})"
             for index, term in enumerate(material.viscoelastic.terms)
             if (name := f"viscoelastic.terms[{index}].tau") in space.free
             and term.tau < interval and term.g > DETERMINATION.change]
    return (f"the tests do not determine the shear modulus mu0 before relaxation: the fitted relaxation time "
            f"{', '.join(found)} is shorter than "
            f"{'1 / omega of the largest frequency' if interval in resolved else 'the sampling interval'}, "
            f"{interval:.3g} s") if found else ""


def _evaluate_unique_material_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that no other parameters fit equally well and describe another material."""
    sentence = describe_alternative_minima(evidence.alternatives, evidence.symbols, evidence.units)
    remedy = f"add a test such as {evidence.alternatives[0].separated_by}, or bound the parameters in fit.bounds" \
        if evidence.alternatives else ""
    return _clause_from_reason("unique", "ambiguous", f"ambiguous: {sentence}" if sentence else "", remedy)


def _evaluate_population_mean_exists_clause(evidence: UsabilityEvidence) -> UsabilityClauseResult:
    """Return the clause that specimens with individual parameters have a population mean."""
    return _clause_from_reason("population", "no_population", evidence.specimens.missing_population_reason or "")


#: Checks of all clauses, in the order of their weight.
_CHECKS = (_evaluate_positive_shear_modulus_clause, _evaluate_minimiser_convergence_clause, _evaluate_stability_clause,
           _evaluate_screening_clause, _evaluate_modulus_noise_clause, _evaluate_contact_clause,
           _evaluate_replicate_and_same_kind_clause, _evaluate_residual_clause, _evaluate_explained_variance_clause,
           _evaluate_force_control_displacement_clause, _evaluate_modulus_unstated_bounds_clause,
           _evaluate_modulus_precision_clause, _evaluate_unique_material_clause,
           _evaluate_population_mean_exists_clause)
