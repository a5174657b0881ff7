"""Tangent of a solid's bulk at one iterate, condensed onto nodes that the tool may touch (Schur complement)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.fem.condensed.model import Executor
from tissue_sim.fem.linear.sparse import CondensedFactor, SparseSolver
from tissue_sim.fem.solid.equations import FreeDofSubmatrix
from tissue_sim.pose import Pose


class CondensedTangent:
    """Copy of the tangent of one iterate, with its factor and its Schur complement on the interface nodes.

    The copy stays constant while the iteration of the solver continues.

    Args:
        free: free degrees of freedom of the solid, for the sparsity pattern.
        held: indices of the degrees of freedom that the tool holds.

    Attributes:
        time: time of the contact state of the iterate, s; set by the owner.
        pose: pose of the tool at the iterate; set by the owner.
        interface: indices, in the `ContactSurface`, of the nodes onto which the tangent is condensed, shape (m,).
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

    def __init__(self, free: FreeDofSubmatrix, held: np.ndarray):
        from scipy import sparse

        pattern = free.free
        self._matrix = sparse.csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._sparse, self._held = SparseSolver(), held
        self._is_done: Callable[[], bool] = lambda: True
        self.interface = self.nodes = np.zeros(0, dtype=np.intp)
        self.volume_rates, self.held = np.zeros(0), free.all[:, held]
        self.factor: CondensedFactor | None = None

    def start_condensation(self, free: FreeDofSubmatrix, interface: np.ndarray, equations: np.ndarray,
                           volume_rates: np.ndarray, executor: Executor) -> None:
        """Copy the present tangent, and start its factorisation and condensation in an executor.

        Args:
            free: matrix with the present values.
            interface: indices of the interface nodes in the surface, shape (m,).
            equations: equations of their degrees of freedom, shape (m, 3).
            volume_rates: volume derivatives in the matrix.
            executor: runs the factorisation.
        """
        self._matrix.data[:], self.held = free.free.data, free.all[:, self._held]
        self.interface, self.volume_rates, self.factor = interface, volume_rates.copy(), None
        self._order = np.argsort(equations.ravel())
        self._sorted = equations.ravel()[self._order]
        self._is_done = executor(self._condense)

    def _condense(self) -> None:
        """Set `factor`; it stays None if the matrix is singular."""
        self.factor = self._sparse.factorise_condensed_or_none(self._matrix, self._sorted)

    @property
    def is_done(self) -> bool:
        """Whether the factorisation has ended, with or without a factor."""
        return self._is_done()

    def set_published_nodes_and_compliance(self, nodes: np.ndarray, equations: np.ndarray) -> None:
        """Set the published nodes and their compliance.

        Args:
            nodes: indices in the `ContactSurface`, a subset of `interface`, shape (n,).
            equations: numbers of their degrees of freedom among the free ones, shape (n, 3).
        """
        assert self.factor is not None
        indices = np.searchsorted(self._sorted, equations.ravel())
        self.nodes, self.compliance = nodes, self.factor.compliance[np.ix_(indices, indices)]
        self.tool_coupling, self.stiffness = np.zeros((3 * nodes.size, 6)), np.zeros((6, 6))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the displacements, m, under forces on the free degrees of freedom, N, shape (free,) or (free, n)."""
        assert self.factor is not None
        return self.factor.solve(right)

    @property
    def sorted_free_interface_equations(self) -> np.ndarray:
        """Indices of the interface equations among the free degrees of freedom, sorted, shape (3 m,)."""
        return self._sorted

    def begin_solution_with_interface_rows(self, right: np.ndarray) -> np.ndarray:
        """Do the first half of `solve`, after which the rows of the interface already contain displacements, m.

        Args:
            right: forces on the free degrees of freedom, N, shape (free,).

        Returns:
            Argument of `finish_solution`, shape (free,); see `CondensedFactor.solve_up_to_interface`.
        """
        assert self.factor is not None
        return self.factor.solve_up_to_interface(right)

    def begin_solution_for_interface_forces(self, forces: np.ndarray) -> np.ndarray:
        """Do the first half of a solution for forces on the interface nodes only, N, shape (m, 3)."""
        assert self.factor is not None
        return self.factor.solve_up_to_interface_for_force(forces.ravel()[self._order])

    def finish_solution(self, begun: np.ndarray) -> np.ndarray:
        """Do the second half of a solution; return the displacements of all free degrees of freedom, m."""
        assert self.factor is not None
        return self.factor.complete_solution(begun)
