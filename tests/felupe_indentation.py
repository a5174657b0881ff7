"""Bonded flat punch on a cylinder, solved by FElupe for a sequence of moduli.

This problem is the peer of benchmarks/peers/inverse_fem.py; tests/interop checks it. FElupe has no contact between the
free surface and the side wall of the punch, so the surface may penetrate the wall: the problem is smaller than ours.
"""

from __future__ import annotations

import felupe as fem
import numpy as np
from felupe_problem import boundary, reduced_polynomial, solid, unknowns
from scipy.sparse.linalg import splu

from tissue_sim.mesh import Mesh
from tissue_sim.mesh.elements import Q4P0

#: Of FElupe's Newton iteration. Its default, 1.5e-8, takes 10 % more iterations and moves no force by more than 1e-8.
TOLERANCE = 1e-6


def symmetric_lu(matrix, right):
    """SciPy's SuperLU in its mode for symmetric patterns: of `splu`, FElupe's default `spsolve` and PyPardiso, which
    FElupe's manual recommends, the fastest for these matrices on one thread.
    """
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3,
                options={"SymmetricMode": True}).solve(right)


class Indentation:
    """Forces of the punch at fixed depths as a function of C10 and C20.

    Args:
        mesh: ours of a needle test (node sets axis, base, face); FElupe uses its nodes and elements. Four-node quads
            get FElupe's condensed constant pressure (Q4/P0), nine-node quads three discontinuous pressures (Q9/P-1).
        depths: m, ascending, without rest.
        bulk_ratio: K / mu0.
        warm: start each depth from where the last curve was at that depth; False: each curve starts at rest, each of
            its depths where the one before ended, as FElupe's `Step` does.

    Attributes:
        solves, iterations: curves solved and Newton iterations done so far.
    """

    def __init__(self, mesh: Mesh, depths, *, bulk_ratio: float, warm: bool = False):
        self.depths, self.bulk_ratio, self.warm = np.asarray(depths, float), bulk_ratio, warm
        self.solves = self.iterations = 0
        self._condensed = mesh.element is Q4P0
        self._field = unknowns(mesh, "P0" if self._condensed else "P-1")
        self._moved = boundary(self._field, mesh, "face", "z")
        self._boundaries = {"axis": boundary(self._field, mesh, "axis", "r"),
                            "base": boundary(self._field, mesh, "base", "rz"), "face": self._moved,
                            "face stays": boundary(self._field, mesh, "face", "r")}
        self._prescribed, self._active = fem.dof.partition(self._field, self._boundaries)
        self._rest = self._state()
        #: Unknowns at each depth of the last curve.
        self._last: list[list[np.ndarray]] | None = None

    def forces(self, C10: float, C20: float) -> np.ndarray:
        """Return the forces on the punch, N, positive in compression.

        Raises:
            felupe.tools.NewtonConvergenceError: a depth was not reached.
        """
        law, bulk_modulus = reduced_polynomial(C10, C20), self.bulk_ratio * 2 * C10
        forces, reached = [], []
        self._set(self._rest)
        body = solid(law, self._field, bulk_modulus)
        for i, depth in enumerate(self.depths):
            if self.warm and self._last is not None:
                self._set(self._last[i])
                # A condensed body stores a pressure that belongs to the displacement at its creation.
                body = solid(law, self._field, bulk_modulus) if self._condensed else body
            self._moved.update(-1e3 * depth)
            found = fem.newtonraphson(
                items=[body], x0=self._field, dof0=self._prescribed, dof1=self._active,
                ext0=fem.dof.apply(self._field, self._boundaries, self._prescribed), tol=TOLERANCE,
                solver=symmetric_lu, verbose=False)
            self._field.link(found.x)
            self.iterations += found.iterations
            forces.append(-fem.tools.force(self._field, found.fun, self._moved)[0])
            reached.append(self._state())
        self._last = reached
        self.solves += 1
        return np.array(forces)

    def _state(self) -> list[np.ndarray]:
        return [part.values.copy() for part in self._field.fields]

    def _set(self, state: list[np.ndarray]) -> None:
        for part, values in zip(self._field.fields, state, strict=True):
            part.values[:] = values
