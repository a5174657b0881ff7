"""Factors of the tangent of a solid: reused by Newton iterations, or condensed onto nodes that the tool may touch.

With a reused factor (modified Newton method), pressures and contact forces are eliminated with the stiffness values
that the matrix contains. The iteration is then one for displacements, pressures and contact forces with an earlier
tangent, whose convergence rate depends neither on K/mu nor on the penalty stiffness of the contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.condensed.model import Executor
from tissue_sim.fem.linear.sparse import CondensedFactor, Factor, SparseSolver
from tissue_sim.fem.solid.equations import SolidEquations
from tissue_sim.pose import Pose


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


class CondensedTangent:
    """Copy of the tangent of a solid's bulk at one iterate, with its factor and Schur complement on interface nodes.

    The copy stays constant while the iteration of the solver continues.

    Args:
        equations: equations of the solid.

    Attributes:
        time: time of the contact state of the iterate, s; set by the owner.
        pose: pose of the tool at the iterate; set by the owner.
        interface: indices, in the `ContactSurface`, of the nodes onto which the tangent is condensed, shape (m,).
        interface_rows: sorted indices of their degrees of freedom among the free ones, shape (3 m,).
        nodes: interface nodes that are published to the contact solver, shape (n,).
        volume_rates: volume derivatives with which the pressures were eliminated, see `ElementBatches`.
        held: columns of the matrix for the degrees of freedom that the tool holds.
        factor: None before it is computed, or if the matrix is singular.
        compliance: compliance matrix of the published nodes, m/N, shape (3 n, 3 n).
        tool_coupling: derivative of the nodal displacements with respect to the pose of the tool that holds tissue,
            shape (3 n, 6).
        stiffness: minus the derivative of the wrench of the held nodes with respect to the pose, shape (6, 6).
    """

    time: float
    pose: Pose
    compliance: np.ndarray
    tool_coupling: np.ndarray
    stiffness: np.ndarray

    def __init__(self, equations: SolidEquations):
        from scipy import sparse

        pattern, self._equations = equations.matrix.free, equations
        self._matrix = sparse.csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._sparse = SparseSolver()
        self._is_done: Callable[[], bool] = lambda: True
        self.interface = self.nodes = np.zeros(0, dtype=np.intp)
        self.volume_rates, self.held = np.zeros(0), equations.matrix.all[:, equations.held_dofs]
        self.factor: CondensedFactor | None = None

    def start_condensation(self, interface: np.ndarray, rows: np.ndarray, executor: Executor) -> None:
        """Copy the tangent that was assembled last, and start its factorisation and condensation in an executor.

        Args:
            interface: indices of the interface nodes in the surface, shape (m,).
            rows: indices of their degrees of freedom among the free ones, shape (m, 3).
            executor: runs the factorisation.
        """
        matrix = self._equations.matrix
        self._matrix.data[:], self.held = matrix.free.data, matrix.all[:, self._equations.held_dofs]
        self.interface, self.volume_rates = interface, self._equations.batches.volume_rates.copy()
        self.factor, self._order = None, np.argsort(rows.ravel())
        self.interface_rows = rows.ravel()[self._order]
        self._is_done = executor(self._condense)

    def _condense(self) -> None:
        """Set `factor`; it stays None if the matrix is singular."""
        self.factor = self._sparse.factorise_condensed_or_none(self._matrix, self.interface_rows)

    @property
    def is_done(self) -> bool:
        """Whether the factorisation has ended, with or without a factor."""
        return self._is_done()

    def set_published_nodes_and_compliance(self, nodes: np.ndarray, rows: np.ndarray) -> None:
        """Set the published nodes and their compliance.

        Args:
            nodes: indices in the `ContactSurface`, a subset of `interface`, shape (n,).
            rows: indices of their degrees of freedom among the free ones, shape (n, 3).
        """
        assert self.factor is not None
        indices = np.searchsorted(self.interface_rows, rows.ravel())
        self.nodes, self.compliance = nodes, self.factor.compliance[np.ix_(indices, indices)]
        self.tool_coupling, self.stiffness = np.zeros((3 * nodes.size, 6)), np.zeros((6, 6))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return displacements of the free degrees of freedom, m, shape (free, n), under forces on all, N."""
        assert self.factor is not None
        return self.factor.solve(right[self._equations.free])

    def begin_solution_with_interface_rows(self, right: np.ndarray) -> np.ndarray:
        """Do the first half of `solve`, after which the rows of the interface already contain displacements, m.

        Args:
            right: forces on all degrees of freedom, N, shape (freedoms,).

        Returns:
            Argument of `finish_solution`, shape (free,); see `CondensedFactor.solve_up_to_interface`.
        """
        assert self.factor is not None
        return self.factor.solve_up_to_interface(right[self._equations.free])

    def begin_solution_for_interface_forces(self, forces: np.ndarray) -> np.ndarray:
        """Do the first half of a solution for forces on the interface nodes only, N, shape (m, 3)."""
        assert self.factor is not None
        return self.factor.solve_up_to_interface_for_force(forces.ravel()[self._order])

    def finish_solution(self, begun: np.ndarray) -> np.ndarray:
        """Do the second half of a solution; return the displacements of all free degrees of freedom, m."""
        assert self.factor is not None
        return self.factor.complete_solution(begun)
