"""Frictional contact of nodes on a condensed bulk with the tangent planes of the tool, by semismooth Newton iteration.

The forces f on the tool solve f = P(f + rho g), where g are gaps and slips, linear in f, and P is the projection onto
the admissible contact forces: no tension, and tangential forces within Coulomb's cone. Newton's method on this
piecewise smooth equation finds contact states and forces together (Alart and Curnier, Comput. Methods Appl. Mech. Eng.
92 (1991) 353). The augmentation parameter rho is the stiffness of each node alone; a line search halves the step until
the residual decreases. Gauss-Seidel iteration over the nodes (Jean, ibid. 177 (1999) 235) needs a thousand iterations
on a surface close to an instability.
"""

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.condensed.flat_kernel import FLAT_COLUMNS, FlatKernelInputIndex, make_tangent_plane_contact_kernel
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK


@dataclass(frozen=True)
class TangentPlaneContactSettings:
    """Settings of the semismooth Newton method.

    Attributes:
        max_iterations: maximum number of linear solves.
        max_halvings: maximum number of halvings of the step length in each line search.
        sufficient_decrease: fraction of the predicted decrease of the residual that a step must reach (Armijo rule).
    """

    max_iterations: int = 12
    max_halvings: int = 6
    sufficient_decrease: float = 0.1


#: Settings of every `TangentPlaneContact`.
_SETTINGS = TangentPlaneContactSettings()


class TangentPlaneContact:
    """Solver of the frictional contact of nodes near the tool with the tangent planes of the tool surface.

    Args:
        arrays: arrays of the stepper, by the names of `make_tangent_plane_contact_kernel`; the forces and contact
            states in them are changed.
        near: largest gap of a node that takes part without carrying a force, m.
        floor: smallest force by which the residual is divided, N.
    """

    def __init__(self, arrays: dict[str, np.ndarray], near: float, floor: float):
        n = len(arrays["lists"])
        self._floor, self._found = floor, np.zeros(4)
        self._matrix, self._right = np.zeros(9 * n * n), np.zeros(3 * n)
        self._limits = np.array([near, 0.0, floor, 0.0])
        own = {"found": self._found, "limits": self._limits, "flat": np.zeros((n, FLAT_COLUMNS)),
               "matrix": self._matrix, "right": self._right}
        with LOCK:
            self._kernel = BoundKernel.bind_by_name(make_tangent_plane_contact_kernel(), arrays | own)

    def try_solving_contact_forces(self, tolerance: float) -> bool:
        """Solve for forces and contact states of the nodes; both are written to the arrays of the stepper.

        Args:
            tolerance: largest residual over the norm of the forces.

        Returns:
            Whether the residual is within the tolerance.
        """
        from scipy.linalg import lapack

        self._limits[FlatKernelInputIndex.TOLERANCE] = tolerance
        residual, k = self._take_step_and_get_residual_norm(0.0)
        for _ in range(_SETTINGS.max_iterations):
            if residual <= tolerance:
                return True
            if k:
                right = self._right[:k]
                *_, found, failed = lapack.dgesv(self._matrix[:k * k].reshape(k, k).T, right.reshape(k, 1),
                                                 overwrite_a=1, overwrite_b=1)
                right[:] = found[:, 0]  # the kernel reads the solution there; LAPACK mostly solves in place
                if failed or not math.isfinite(right @ right):
                    return False
            step_length = 1.0
            for halving in range(_SETTINGS.max_halvings + 1):
                now, k = self._take_step_and_get_residual_norm(step_length)
                if now <= (1.0 - _SETTINGS.sufficient_decrease * step_length) * residual:
                    break
                step_length *= 0.5
                if halving == _SETTINGS.max_halvings:
                    return False
            residual = now
        return residual <= tolerance

    def _take_step_and_get_residual_norm(self, step_length: float) -> tuple[float, int]:
        """Evaluate the residual at a step length towards the linear solution, and assemble the next linear equations.

        Args:
            step_length: step length of the line search; 0 evaluates at the present forces.

        Returns:
            Residual over the norm of the forces, and the number of unknowns of the next linear equations.
        """
        self._limits[FlatKernelInputIndex.STEP_LENGTH] = step_length
        with LOCK:
            self._kernel()
        residual, forces, _, unknowns = self._found.tolist()
        return math.sqrt(residual) / max(math.sqrt(forces), self._floor), int(unknowns)
