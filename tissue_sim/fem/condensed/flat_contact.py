"""Lift-off and friction of the nodes on a condensed bulk, the tool being as flat at each of them as it was last found.

Forces f on the tool solve f = P(f + rho g), where g are the gaps and slips, linear in f, and P projects onto what a
contact can carry: no pull, and no more friction than Coulomb's. Newton's method on that, which is piecewise smooth,
finds states and forces together (Alart and Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353), with rho the
stiffness of each node alone, and steps that are halved until what is left of the equation is less than before. Going
round the nodes one after the other (Jean, ibid. 177 (1999) 235) takes a thousand rounds on a surface about to fold.
"""

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.condensed.flat_kernel import FLAT_COLUMNS, Limit, flat_kernel
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK


@dataclass(frozen=True)
class FlatContactSettings:
    """Settings of the semismooth Newton method.

    Attributes:
        max_iterations: maximum number of linear solves.
        max_halvings: maximum number of halvings of the step length in each line search.
        sufficient_decrease: fraction of the predicted decrease of the residual that a step must reach (Armijo rule).
    """

    max_iterations: int = 12
    max_halvings: int = 6
    sufficient_decrease: float = 0.1


#: Settings of every `FlatContact`.
_SETTINGS = FlatContactSettings()


class FlatContact:
    """Solves the contact of the nodes that are near the tool.

    Args:
        arrays: of the stepper, by the names in `flat_kernel`; forces and states are changed.
        near: nodes farther from the tool take no part unless they carry a force, m.
        floor: forces that are smaller than this are nothing, N.
    """

    def __init__(self, arrays: dict[str, np.ndarray], near: float, floor: float):
        n = len(arrays["lists"])
        self._floor, self._found = floor, np.zeros(4)
        self._matrix, self._right = np.zeros(9 * n * n), np.zeros(3 * n)
        self._limits = np.array([near, 0.0, floor, 0.0])
        own = {"found": self._found, "limits": self._limits, "flat": np.zeros((n, FLAT_COLUMNS)),
               "matrix": self._matrix, "right": self._right}
        with LOCK:
            self._kernel = BoundKernel.of(flat_kernel(), arrays | own)

    def solve(self, tolerance: float) -> bool:
        """Find the forces of the nodes; whether what is left of the equation is less than a share of them."""
        from scipy.linalg import lapack

        self._limits[Limit.TOLERANCE] = tolerance
        left, k = self._look(0.0)
        for _ in range(_SETTINGS.max_iterations):
            if left <= tolerance:
                return True
            if k:
                right = self._right[:k]
                *_, found, failed = lapack.dgesv(self._matrix[:k * k].reshape(k, k).T, right.reshape(k, 1),
                                                 overwrite_a=1, overwrite_b=1)
                right[:] = found[:, 0]  # where the kernel looks for it; mostly it is there already
                if failed or not math.isfinite(right @ right):
                    return False
            share = 1.0
            for halving in range(_SETTINGS.max_halvings + 1):
                now, k = self._look(share)
                if now <= (1.0 - _SETTINGS.sufficient_decrease * share) * left:
                    break
                share *= 0.5
                if halving == _SETTINGS.max_halvings:
                    return False
            left = now
        return left <= tolerance

    def _look(self, share: float) -> tuple[float, int]:
        """Go a share of the way to the linear solution; what is left of the equation there, over the size of the
        forces, and how many unknowns the next one has."""
        self._limits[Limit.STEP_LENGTH] = share
        with LOCK:
            self._kernel()
        left, forces, _, unknowns = self._found.tolist()
        return math.sqrt(left) / max(math.sqrt(forces), self._floor), int(unknowns)
