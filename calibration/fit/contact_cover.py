"""Check that the recordings determine contact well enough for the shear modulus."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary_problem import OrdinaryProblem
from tissue_sim.recording.contact_error import relative_modulus_error_from_contact
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE


def describe_worst_uncertain_contact_or_empty(estimate: Estimate, misfitted_tests: Collection[str]) -> str:
    """Describe the recordings whose contact is not known well enough; empty if there are none.

    The standard errors of the parameters include the uncertainty of a fitted contact offset. Where the recorded
    displacement counts from contact, a fit with residuals near the noise confirms this.

    Args:
        estimate: minimum of the sum of squares.
        misfitted_tests: names of the tests whose residuals are far above the noise.
    """
    if _has_fitted_contact_offsets(estimate.problem):
        return ""
    errors = [(curve, error) for curve in estimate.problem.measured
              if (curve.test.contact == "find" or curve.test.name in misfitted_tests)
              and (error := _compute_modulus_change_in_contact_interval(curve)) > MODULUS_TOLERANCE]
    if not errors:
        return ""
    curve, error = max(errors, key=lambda each: each[1])
    assert curve.whole is not None and curve.whole.segmentation.contact is not None
    low, high = curve.whole.segmentation.contact.interval
    scale, unit = (1.0, "") if curve.stressed else (1e3, " mm")
    of = "a strain of " if curve.stressed else ""
    place = f"at {of}{scale * low:.4g} to {scale * high:.4g}{unit}" if np.isfinite(low) else \
        f"before {of}{scale * high:.4g}{unit}"
    more = f" and {len(errors) - 1} more" if len(errors) > 1 else ""
    return (f"{curve.name}{more}: contact is known to be {place} (95 %), and the shear modulus changes by "
            f"{100 * error:.2g} % within that interval; the limit is {100 * MODULUS_TOLERANCE:g} %")


def _has_fitted_contact_offsets(problem: Any) -> bool:
    """Return whether contact offsets are unknowns of the fit."""
    if isinstance(problem, OrdinaryProblem):
        return bool(problem.shifted)
    return "contact" in problem.kinds


def _compute_modulus_change_in_contact_interval(curve: MeasuredCurve) -> float:
    """Return the relative change of the shear modulus within the interval of contact; 0 if the contact is stated."""
    contact = None if curve.whole is None else curve.whole.segmentation.contact
    is_unclear = contact is not None and contact.status == "unclear"
    if contact is None or curve.test.contact != ("recorded" if is_unclear else "find"):
        return 0.0
    return relative_modulus_error_from_contact(curve.displacement, curve.force, curve.time, contact)
