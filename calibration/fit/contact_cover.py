"""Check that the recordings determine contact well enough for the shear modulus."""

from __future__ import annotations

from typing import Any

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary_problem import OrdinaryProblem
from tissue_sim.recording.contact_error import relative_modulus_error_from_contact
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE


def describe_worst_uncertain_contact_or_empty(estimate: Estimate) -> str:
    """Describe the recordings whose contact is not known well enough; empty if there are none.

    The standard errors of the parameters include the uncertainty of a fitted contact offset.
    """
    if _has_fitted_contact_offsets(estimate.problem):
        return ""
    errors = [(curve, error) for curve in estimate.problem.measured
              if (error := _compute_modulus_change_in_contact_interval(curve)) > MODULUS_TOLERANCE]
    if not errors:
        return ""
    curve, error = max(errors, key=lambda each: each[1])
    assert curve.whole is not None and curve.whole.segmentation.contact is not None
    low, high = curve.whole.segmentation.contact.interval
    place = f"strain {low:.3g} to {high:.3g}" if curve.stressed else f"{1e3 * low:.4g} to {1e3 * high:.4g} mm"
    more = f" and {len(errors) - 1} more" if len(errors) > 1 else ""
    return (f"{curve.name}{more}: contact is known to be at {place} (95 %), and the shear modulus changes by "
            f"{100 * error:.2g} % within that interval; the limit is {100 * MODULUS_TOLERANCE:g} %")


def _has_fitted_contact_offsets(problem: Any) -> bool:
    """Return whether contact offsets are unknowns of the fit."""
    if isinstance(problem, OrdinaryProblem):
        return bool(problem.shifted)
    return "contact" in problem.kinds


def _compute_modulus_change_in_contact_interval(curve: MeasuredCurve) -> float:
    """Return the relative change of the shear modulus within the interval of contact; 0 if contact is recorded."""
    contact = None if curve.whole is None else curve.whole.segmentation.contact
    if contact is None or curve.test.contact != "find":
        return 0.0
    return relative_modulus_error_from_contact(curve.displacement, curve.force, curve.time, contact)
