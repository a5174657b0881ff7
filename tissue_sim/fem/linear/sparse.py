"""Factors of sparse matrices by libraries: SciPy's SuperLU, or Intel's Pardiso where pypardiso is installed.

pypardiso (an extra, ``pip install tissue_sim[pardiso]``) takes a tenth of the time for 60,000 equations of a solid.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Any, Protocol

import numpy as np

#: ``TISSUE_SIM_SPARSE=scipy`` keeps to SciPy where pypardiso is installed, too.
_CHOICE = "TISSUE_SIM_SPARSE"


class Factor(Protocol):
    """A factor of a matrix.

    Attributes:
        definite: whether a symmetric matrix is positive definite; True of one that is not symmetric.
    """

    definite: bool

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solutions for right-hand sides, shape (n,) or (n, several)."""


def factorise(matrix: Any, *, symmetric: bool) -> Factor | None:
    """A factor of a square matrix, a `scipy.sparse.csc_array` with sorted rows; None where it is singular."""
    return (_Pardiso if library() == "pardiso" else _SuperLU).of(matrix, symmetric)


def library() -> str:
    """``"pardiso"`` or ``"scipy"``."""
    if os.environ.get(_CHOICE) == "scipy" or importlib.util.find_spec("pypardiso") is None:
        return "scipy"
    return "pardiso"


class _SuperLU:
    def __init__(self, factor: Any, definite: bool):
        self._factor, self.definite = factor, definite

    @classmethod
    def of(cls, matrix: Any, symmetric: bool) -> _SuperLU | None:
        from scipy.sparse.linalg import splu

        options = {"SymmetricMode": True} if symmetric else {}
        try:
            factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0 if symmetric else 0.1,
                          options=options)
        except RuntimeError:  # exactly singular
            return None
        # Without exchanges of rows the pivots have the signs of the eigenvalues (Sylvester's law of inertia).
        unchanged = symmetric and np.array_equal(factor.perm_r, factor.perm_c)
        return cls(factor, not symmetric or (unchanged and bool((factor.U.diagonal() > 0.0).all())))

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._factor.solve(right)


class _Pardiso:
    #: Pardiso's kinds of matrices: real and symmetric, and real.
    _SYMMETRIC, _OTHER = -2, 11
    #: Of its parameters: pivots that it had to make larger, and eigenvalues that are negative.
    _PERTURBED, _NEGATIVE = 14, 23

    def __init__(self, solver: Any, matrix: Any, definite: bool):
        self._solver, self._matrix, self.definite = solver, matrix, definite

    @classmethod
    def of(cls, matrix: Any, symmetric: bool) -> _Pardiso | None:
        from pypardiso import PyPardisoSolver
        from pypardiso.pardiso_wrapper import PyPardisoError
        from scipy import sparse

        solver = PyPardisoSolver(mtype=cls._SYMMETRIC if symmetric else cls._OTHER)
        taken = sparse.csr_matrix(sparse.triu(matrix, format="csr") if symmetric else matrix)
        taken.sort_indices()
        try:
            solver.factorize(taken)
        except PyPardisoError:
            return None
        exact = solver.get_iparm(cls._PERTURBED) == 0
        if not (symmetric or exact):
            return None
        return cls(solver, taken, exact and (not symmetric or solver.get_iparm(cls._NEGATIVE) == 0))

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._solver.solve(self._matrix, right)

    def __del__(self) -> None:
        self._solver.free_memory(everything=True)
