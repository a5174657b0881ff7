"""The tangent of a solid in its factor, which serves for more than one linear solution.

Where a factor serves again, pressures and contact forces are eliminated with the rates that the matrix holds: the
iteration is then one for displacements, pressures and contact forces with an earlier tangent, whose error shrinks by a
share that depends neither on K/mu nor on the springs of the contact.
"""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.linear.sparse import Factor, SparseSolver
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.free_part import FreePart
from tissue_sim.fem.solid.tissue import Tissue

#: A factor serves again where each solution takes the unbalanced forces down to this share, or where so many more that
#: gain as much as the last one will do.
_GAIN, _MORE = 1e-2, 3
#: More than that is no gain at all; what was balanced exactly would have none.
_LOST = 1e6
#: A solution that begins so far off is followed by a new tangent.
_FAR = 100.0


class Tangent:
    """Factor of the last matrix, and what it holds.

    Args:
        tissue: whose stiffness stands in `matrix`. contact: whose rates are added to it. sparse: makes the factors.
        free: numbers of the free freedoms.

    Attributes:
        factor: None where there is none.
        stale: whether it is that of an earlier state.
    """

    def __init__(self, tissue: Tissue, contact: ContactNodes, matrix: FreePart, sparse: SparseSolver,
                 free: np.ndarray):
        self._tissue, self._contact, self._matrix, self._sparse, self._free = tissue, contact, matrix, sparse, free
        self.factor: Factor | None = None
        self.stale, self._before = False, np.inf

    def factorise(self, symmetric: bool) -> Factor | None:
        """Of the matrix that was assembled last, with the rates of the contact; None where it is singular."""
        self._matrix.add(self._contact.rates)
        self._contact.keep_rates()
        self.factor, self.stale = self._sparse.factorise(self._matrix.free, symmetric=symmetric), False
        return self.factor

    def solve(self, right: np.ndarray, way: np.ndarray | None, apart: np.ndarray) -> np.ndarray:
        """Motion that balances these unbalanced forces, N, shape (freedoms,).

        Args:
            right: they are changed.
            way: what freedoms still have to go with the tool, m; None: nothing.
            apart: how the contact's nodes move against their bodies beside that, m, shape (n, 3).
        """
        assert self.factor is not None
        contact, motion = self._contact, np.zeros_like(right)
        if self.stale:
            self._tissue.add_known_volumes(right)
        pushed = np.einsum("nij,nj->ni", contact.known_rates, contact.missed)
        if way is not None:
            motion += way
            pushed = pushed + np.einsum("nij,nj->ni", contact.rates, apart)
            right += self._matrix.all @ way
        np.add.at(right.reshape(-1, 3), contact.nodes, pushed)
        motion[self._free] = -self.factor.solve(right[self._free])
        return motion

    def keep(self, ratio: float, far: bool) -> None:
        """After a solution from a state with this ratio of unbalanced to balanced forces; `far`: a new one is due."""
        self.stale, self._before = not far and ratio <= _FAR, ratio

    def serves(self, ratio: float, goal: float, changed: bool) -> bool:
        """Whether an earlier state's factor is near enough; none is where the contact has changed."""
        gain = min(ratio / max(self._before, 1e-300), _LOST)
        return not changed and (gain <= _GAIN or ratio * gain**_MORE <= goal)
