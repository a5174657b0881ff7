"""Factor of the tangent of a solid, which is used for several Newton iterations (modified Newton).

With a reused factor, pressures and contact forces are eliminated with the stiffness values that the matrix contains.
The iteration is then one for displacements, pressures and contact forces with an earlier tangent, whose convergence
rate depends neither on K/mu nor on the penalty stiffness of the contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.linear.sparse import Factor
from tissue_sim.fem.solid.equations import SolidEquations


@dataclass(frozen=True)
class ReuseSettings:
    """Conditions for the reuse of a factor.

    Attributes:
        gain: largest ratio of the residuals after and before a solution for which the factor is reused, 1.
        more: number of further solutions within which the tolerance must be reached with a larger ratio.
        no_gain: bound of the ratio, 1; a residual that was zero before has no finite ratio.
        far: relative residual above which the next solution needs a new tangent, 1.
    """

    gain: float = 1e-2
    more: int = 3
    no_gain: float = 1e6
    far: float = 100.0


_SETTINGS = ReuseSettings()


class ReusableTangentFactor:
    """Factor of an assembled tangent that several Newton iterations use (modified Newton method).

    Args:
        equations: assembled equations, whose matrix gets the contact stiffness.

    Attributes:
        factor: factor of the free part of the matrix; None before the first factorisation, or if singular.
        stale: whether the factor belongs to an earlier iterate.
    """

    def __init__(self, equations: SolidEquations):
        self._equations = equations
        self.factor: Factor | None = None
        self.stale, self._before = False, np.inf

    def factorise_with_contact_or_none(self, symmetric: bool) -> Factor | None:
        """Add the contact stiffness to the matrix that was assembled last, factorise it, and return the factor.

        The factor is also stored in `factor`; it is None if the matrix is singular.
        """
        contact = self._equations.contact
        self._equations.matrix.add_contact_stiffness(contact.rates)
        contact.store_assembled_contact_rates()
        self.factor, self.stale = self._equations.factorise_or_none(symmetric), False
        return self.factor

    def solve_increment(self, right: np.ndarray, way: np.ndarray | None, apart: np.ndarray) -> np.ndarray:
        """Return the Newton increment of the displacements for a residual, m, shape (freedoms,).

        Args:
            right: residual, the unbalanced forces, N, shape (freedoms,); the array is overwritten.
            way: prescribed increments of the degrees of freedom that move with the tool, m; None: none.
            apart: additional increments of the contact nodes relative to their bodies, m, shape (n, 3).
        """
        assert self.factor is not None
        equations, contact, motion = self._equations, self._equations.contact, np.zeros_like(right)
        if self.stale:
            equations.tissue.correct_forces_for_reused_matrix(right)
        pushed = np.einsum("nij,nj->ni", contact.known_rates, contact.missed)
        if way is not None:
            motion += way
            pushed = pushed + np.einsum("nij,nj->ni", contact.rates, apart)
            right += equations.matrix.all @ way
        np.add.at(right.reshape(-1, 3), contact.nodes, pushed)
        motion[equations.free] = -self.factor.solve(right[equations.free])
        return motion

    def record_residual_and_set_stale(self, ratio: float, far: bool) -> None:
        """Record the relative residual before a linear solution; `can_reuse_factor` compares the next residual with it.

        Args:
            ratio: relative residual before the solution, 1.
            far: whether the solution moved the tool, so that the next iteration needs a new tangent.
        """
        self.stale, self._before = not far and ratio <= _SETTINGS.far, ratio

    def can_reuse_factor(self, ratio: float, goal: float, changed: bool) -> bool:
        """Return whether the factor of an earlier iterate reduces the residual fast enough to be used again.

        Args:
            ratio: present relative residual, 1.
            goal: relative residual at which Newton's method ends, 1.
            changed: whether the active sets of the contact changed; the factor is then not accurate.
        """
        gain = min(ratio / max(self._before, 1e-300), _SETTINGS.no_gain)
        return not changed and (gain <= _SETTINGS.gain or ratio * gain**_SETTINGS.more <= goal)
