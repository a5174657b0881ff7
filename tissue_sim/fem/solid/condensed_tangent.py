"""The tangent of a solid's bulk at one of its iterates, condensed onto nodes that the tool can meet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from tissue_sim.fem.condensed.model import Beside
from tissue_sim.fem.linear.sparse import CondensedFactor, SparseSolver
from tissue_sim.fem.solid.free_part import FreePart

class CondensedTangent:
    """Numbers of a tangent, which stay what they were while the tissue goes on, and what is made of them.

    Args:
        free: of the solid, as a pattern.

    Attributes:
        nodes: numbers onto which it is condensed, in the `ContactSurface`, shape (n,).
        volume_rates: with which its pressures were eliminated, see `ElementBatches`.
        factor: None before it is there, or where there is none.
        drive, stiffness: how the nodes and the wrench follow what the tool holds, shape (3 n, 6) and (6, 6).
    """

    def __init__(self, free: FreePart):
        pattern = free.free
        self._matrix = sparse.csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._sparse = SparseSolver()
        self._is_done: Callable[[], bool] = lambda: True
        self.nodes, self.volume_rates = np.zeros(0, dtype=np.intp), np.zeros(0)
        self.factor: CondensedFactor | None = None

    def begin(self, free: FreePart, nodes: np.ndarray, equations: np.ndarray, volume_rates: np.ndarray,
              beside: Beside) -> None:
        """Take the numbers of now, and make a factor of them.

        Args:
            free: the matrix.
            nodes: see there. equations: of their freedoms, shape (n, 3).
            volume_rates: of the matrix.
            beside: where.
        """
        self._matrix.data[:] = free.free.data
        self.nodes, self.volume_rates, self.factor = nodes, volume_rates.copy(), None
        self.drive, self.stiffness = np.zeros((3 * nodes.size, 6)), np.zeros((6, 6))
        self._order = np.argsort(equations.ravel())
        self._interface = equations.ravel()[self._order]
        self._is_done = beside(self._compute)

    def _compute(self) -> None:
        factor = self._sparse.condense(self._matrix, self._interface)
        if factor is not None:
            back = np.argsort(self._order)
            self._compliance = factor.compliance[np.ix_(back, back)]
        self.factor = factor

    @property
    def is_done(self) -> bool:
        """Whether the factor is there, or it is known that there is none."""
        return self._is_done()

    @property
    def compliance(self) -> np.ndarray:
        """Of the nodes, m/N, shape (3 n, 3 n)."""
        return self._compliance

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Motion under forces on the free freedoms, shape (free,) or (free, several)."""
        assert self.factor is not None
        return self.factor.solve(right)

    def push(self, forces: np.ndarray) -> np.ndarray:
        """Motion of the free freedoms under forces on the nodes alone, shape (n, 3)."""
        assert self.factor is not None
        return self.factor.push(forces.ravel()[self._order])
