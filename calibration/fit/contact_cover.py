"""Check that the recordings determine contact well enough for the shear modulus."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary_problem import OrdinaryProblem
from calibration.fit.usability_settings import UsabilitySettings
from tissue_sim.recording.contact import (
    relative_modulus_error_from_contact,
    relative_modulus_error_from_contact_range,
)
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE


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
