"""Contact offsets far beyond their assumed scatter, such as a displacement set to zero at a preload."""

from __future__ import annotations

from dataclasses import dataclass, replace

from calibration.diagnosis.evidence import FitEvidence, fit_without_effects
from calibration.fit.generalised import INVERSE_WARNINGS
from calibration.fit.run_context import RunContext
from calibration.statistics.jitter import ContactAndForceZeroJitter
from tissue_sim.errors import ConvergenceError


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


_SETTINGS = ContactIterationSettings()


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
    for _ in range(_SETTINGS.max_fits):
        far = {name: contact for name, contact in _get_fitted_contact_offsets(found).items()
               if abs(contact) > INVERSE_WARNINGS.suspect_nuisance * scatter.contact
               or (name in shifts and abs(contact) > _SETTINGS.tolerance * scatter.contact)}
        if not far:
            break
        shifts |= {name: shifts.get(name, 0.0) + contact for name, contact in far.items()}
        measured = {test: tuple(replace(curve, displacement=curve.displacement - shifts.get(curve.name, 0.0))
                                for curve in curves) for test, curves in evidence.measured.items()}
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
