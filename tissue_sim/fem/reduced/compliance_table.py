"""Compliances of the contact nodes of a reduced solid, and the missing forces at which its answers are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class ContactCompliance:
    """Displacements of the contact nodes along the tool's axis under unit forces on them along this axis, at rest.

    Attributes:
        nodes: numbers of the nodes, shape (n,).
        axis: of the tool at its start, shape (3,).
        whole: of the whole solid, m/N, shape (n, n).
        missing: `whole` less that of the reduced solid, m/N, shape (n, n).
        forces: forces on the tool, N, ascending from 0, shape (k,).
        accepted: the missing force (`MissingForce`) at which the answer was right at forces up to these, N, shape (k,).
    """

    nodes: np.ndarray
    axis: np.ndarray
    whole: np.ndarray
    missing: np.ndarray
    forces: np.ndarray
    accepted: np.ndarray

    @property
    def accepting_all(self) -> ContactCompliance:
        """The table of a reduced solid whose error by missing compliance counts as 0."""
        return replace(self, forces=np.zeros(1), accepted=np.full(1, np.inf))

    def accepted_at(self, force: float) -> float:
        """Missing force, N, at which the answer was right at a force, N; beyond the largest it grows in proportion."""
        last = float(self.forces[-1])
        if force > last > 0.0:
            return float(self.accepted[-1]) * force / last
        return float(np.interp(force, self.forces, self.accepted))


def with_accepted(table: ContactCompliance, forces: Sequence[float], missing: Sequence[float],
                  errors: Sequence[float]) -> ContactCompliance:
    """A table that knows at which missing forces answers were right.

    In each state the missing force less the true error may be accepted. The value at a force is the largest one at
    smaller forces, or the largest fraction of the force at larger ones: the fraction falls as more nodes touch.

    Args:
        table: of the reduced solid.
        forces: on the tool, N; missing: missing forces, N; errors: true errors of the force, N; one each for a state.
    """
    order = np.argsort(forces)
    force, accepted = np.asarray(forces)[order], np.maximum(0.0, np.asarray(missing) - np.asarray(errors))[order]
    fraction = np.divide(accepted, force, out=np.zeros_like(accepted), where=force > 0.0)
    of_larger = force * np.maximum.accumulate(fraction[::-1])[::-1]
    accepted = np.maximum(np.maximum.accumulate(accepted), of_larger)
    return replace(table, forces=np.concatenate([[0.0], force]), accepted=np.concatenate([[0.0], accepted]))
