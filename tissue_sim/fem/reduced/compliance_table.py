"""Table of the compliance of the contact nodes of a reduced solid, for the missing-compliance error estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class ContactNodeComplianceTable:
    """Compliance matrices of the contact nodes along the axis of the tool, for the undeformed or resting solid.

    Attributes:
        nodes: node numbers, shape (n,).
        axis: axis of the tool at its start, unit vector, shape (3,).
        whole: compliance G of the full-order solid, m/N, shape (n, n).
        missing: compliance G - G_r that the reduced solid lacks, m/N, shape (n, n).
        forces: forces on the tool, N, ascending from 0, shape (k,).
        accepted: missing force (`MissingComplianceErrorEstimator`) up to which the training paths showed no error of
            the force on the tool, at each of `forces`, N, shape (k,).
    """

    nodes: np.ndarray
    axis: np.ndarray
    whole: np.ndarray
    missing: np.ndarray
    forces: np.ndarray
    accepted: np.ndarray

    @property
    def unlimited_acceptance_copy(self) -> ContactNodeComplianceTable:
        """Copy of the table with infinite accepted missing force, so that the error by missing compliance is 0."""
        return replace(self, forces=np.zeros(1), accepted=np.full(1, np.inf))

    def get_accepted_missing_force_at_tool_force(self, force: float) -> float:
        """Interpolate the accepted missing force, N, for a force on the tool, N; beyond the table in proportion."""
        last = float(self.forces[-1])
        if force > last > 0.0:
            return float(self.accepted[-1]) * force / last
        return float(np.interp(force, self.forces, self.accepted))


def calibrate_accepted_missing_forces(table: ContactNodeComplianceTable, forces: Sequence[float],
                                      missing: Sequence[float],
                                      errors: Sequence[float]) -> ContactNodeComplianceTable:
    """Return a copy of a table with accepted missing forces from states whose true force error is known.

    In each state the accepted missing force is max(0, missing force - true error). The value at a force F is the
    larger of the largest accepted value at forces below F and F times the largest accepted fraction at forces above F:
    the fraction falls as more nodes touch.

    Args:
        table: table of the reduced solid.
        forces: force on the tool in each state, N.
        missing: missing force in each state, N.
        errors: true error of the force in each state, N.
    """
    order = np.argsort(forces)
    force, accepted = np.asarray(forces)[order], np.maximum(0.0, np.asarray(missing) - np.asarray(errors))[order]
    fraction = np.divide(accepted, force, out=np.zeros_like(accepted), where=force > 0.0)
    of_larger = force * np.maximum.accumulate(fraction[::-1])[::-1]
    accepted = np.maximum(np.maximum.accumulate(accepted), of_larger)
    return replace(table, forces=np.concatenate([[0.0], force]), accepted=np.concatenate([[0.0], accepted]))
