"""The tangent of a solid's bulk at one of its iterates, condensed onto nodes that the tool can meet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.fem.condensed.model import Beside
from tissue_sim.fem.linear.sparse import CondensedFactor, SparseSolver
from tissue_sim.fem.solid.free_dofs import FreeDofSystem


class CondensedTangent:
    """Numbers of a tangent, which stay what they were while the tissue goes on, and what is made of them.

    Args:
        free: of the solid, as a pattern.
        held: numbers of the freedoms that the tool holds.

    Attributes:
        interface: numbers in the `ContactSurface` of the nodes onto which it is condensed, shape (m,).
        nodes: those of them that are published, shape (n,).
        volume_rates: with which its pressures were eliminated, see `ElementBatches`.
        held: columns of the matrix, of the freedoms that the tool holds.
        factor: None before it is there, or where there is none.
        compliance: of the nodes, m/N, shape (3 n, 3 n).
        drive, stiffness: how the nodes and the wrench follow what the tool holds, shape (3 n, 6) and (6, 6).
    """

    compliance: np.ndarray
    drive: np.ndarray
    stiffness: np.ndarray

    def __init__(self, free: FreeDofSystem, held: np.ndarray):
        from scipy import sparse

        pattern = free.free
        self._matrix = sparse.csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._sparse, self._held = SparseSolver(), held
        self._is_done: Callable[[], bool] = lambda: True
        self.interface = self.nodes = np.zeros(0, dtype=np.intp)
        self.volume_rates, self.held = np.zeros(0), free.all[:, held]
        self.factor: CondensedFactor | None = None

    def take(self, free: FreeDofSystem, interface: np.ndarray, equations: np.ndarray, volume_rates: np.ndarray,
             beside: Beside) -> None:
        """Take the numbers of now, and make a factor of them.

        Args:
            free: the matrix.
            interface: see there. equations: of their freedoms, shape (m, 3).
            volume_rates: of the matrix.
            beside: where.
        """
        self._matrix.data[:], self.held = free.free.data, free.all[:, self._held]
        self.interface, self.volume_rates, self.factor = interface, volume_rates.copy(), None
        self._order = np.argsort(equations.ravel())
        self._sorted = equations.ravel()[self._order]
        self._is_done = beside(self._compute)

    def _compute(self) -> None:
        self.factor = self._sparse.condense(self._matrix, self._sorted)

    @property
    def is_done(self) -> bool:
        """Whether the factor is there, or it is known that there is none."""
        return self._is_done()

    def choose(self, nodes: np.ndarray, equations: np.ndarray) -> None:
        """Publish these nodes of the interface, with the equations of their freedoms, shape (n, 3)."""
        assert self.factor is not None
        places = np.searchsorted(self._sorted, equations.ravel())
        self.nodes, self.compliance = nodes, self.factor.compliance[np.ix_(places, places)]
        self.drive, self.stiffness = np.zeros((3 * nodes.size, 6)), np.zeros((6, 6))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Motion under forces on the free freedoms, shape (free,) or (free, several)."""
        assert self.factor is not None
        return self.factor.solve(right)

    @property
    def rows(self) -> np.ndarray:
        """Places among the free freedoms of those of the interface, sorted, shape (3 m,)."""
        return self._sorted

    def begin(self, right: np.ndarray) -> np.ndarray:
        """The same motion, begun: it stands in the rows of the interface; see `CondensedFactor.begin`."""
        assert self.factor is not None
        return self.factor.begin(right)

    def push(self, forces: np.ndarray) -> np.ndarray:
        """A motion begun under forces on the interface alone, shape (m, 3)."""
        assert self.factor is not None
        return self.factor.begin_push(forces.ravel()[self._order])

    def finish(self, begun: np.ndarray) -> np.ndarray:
        """The motion of all free freedoms that was begun."""
        assert self.factor is not None
        return self.factor.finish(begun)
