"""Check that the contact offset of a fit covers a preload at the zero of the displacement.

The zero of the force does not count: a fit without a contact offset takes the preload for a zero of the force, and its
modulus is then wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.fit import Fit
from calibration.fit.ordinary_problem import OrdinaryProblem


@dataclass(frozen=True)
class PreloadCoverFractions:
    """Range of a fitted contact offset that covers a preload, as a fraction of the distance from contact.

    Attributes:
        min_fraction: smallest fraction; a smaller offset leaves a part of the preload unexplained.
        max_fraction: largest fraction; a larger offset has another cause.
    """

    min_fraction: float = 0.8
    max_fraction: float = 1.25


_SETTINGS = PreloadCoverFractions()


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
    return _SETTINGS.min_fraction <= -contact / shift <= _SETTINGS.max_fraction
