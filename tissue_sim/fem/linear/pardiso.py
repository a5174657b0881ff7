"""Intel's Pardiso by pypardiso: matrices of one pattern, whose analysis is done once."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

import numpy as np

#: Pardiso's kinds of matrices: symmetric and positive definite, symmetric, and any.
DEFINITE, SYMMETRIC, OTHER = 2, -2, 11
#: Its phases: analysis, numbers, all of a solution, and its two halves.
_ANALYSE, _FACTORISE, _SOLVE, _FORWARD, _BACKWARD = 11, 22, 33, 331, 333
#: Of its parameters, counted from 0: use of what follows, ordering (2: nested dissection), size of pivots that are made
#: larger, scaling, matching, how many pivots were made larger, pivots of 2 x 2, eigenvalues that are negative, single
#: precision, and whether a Schur complement is left over (2: with what solutions need).
_USE, _ORDERING, _SMALLEST, _SCALING, _MATCHING, _PERTURBED, _PIVOTING, _NEGATIVE, _SINGLE, _SCHUR = (
    0, 1, 9, 10, 12, 13, 20, 22, 27, 35)
#: Where pypardiso looks for its library, which takes it a quarter of a second each time.
_LIBRARY = "PYPARDISO_MKL_RT"


class PardisoError(RuntimeError):
    """Pardiso could not do what it was asked for."""


class PardisoPattern:
    """Factors of matrices that have their entries in the same places; one at a time.

    Args:
        matrix: one of them, a `scipy.sparse.csc_array` with sorted rows.
        kind: `DEFINITE`, `SYMMETRIC` or `OTHER`.
        interface: sorted numbers of equations that are left over: their Schur complement is found with the factor.
        single: single precision, which takes half of the time and memory.

    Raises:
        PardisoError: the analysis failed.
    """

    def __init__(self, matrix: Any, kind: int, interface: np.ndarray | None = None, *, single: bool = False):
        from pypardiso import PyPardisoSolver
        from scipy import sparse

        self._solver = PyPardisoSolver(mtype=kind)
        os.environ.setdefault(_LIBRARY, self._solver.libmkl._name)
        self.indices, self._kind, self.size = matrix.indices, kind, matrix.shape[0]
        numbered = sparse.csc_array((np.arange(1.0, matrix.nnz + 1.0), matrix.indices, matrix.indptr),
                                    shape=matrix.shape)
        rows = sparse.csr_array(numbered if kind == OTHER else sparse.triu(numbered))
        rows.sort_indices()
        self._places = rows.data.astype(np.intp) - 1
        self._row_starts, self._columns = (part.astype(np.int32) + 1 for part in (rows.indptr, rows.indices))
        self._data = np.zeros(rows.nnz, dtype=np.float32 if single else np.float64)
        parameters = self._solver.iparm
        self.interface = interface
        if interface is not None:
            self._solver.perm = np.zeros(self.size, dtype=np.int32)
            self._solver.perm[interface] = 1
            parameters[[_USE, _ORDERING, _SMALLEST, _SCHUR]] = 1, 2, 8, 2
        else:
            # Its own choices, but for solutions: without this each is refined twice, to no smaller error.
            exchanges = int(kind == OTHER)
            parameters[[_USE, _ORDERING, _SMALLEST, _SCALING, _MATCHING, _PIVOTING, _SINGLE]] = (
                1, 2, 13 if exchanges else 8, exchanges, exchanges, 1, int(single))
        self._analysed = False

    def factorise(self, matrix: Any) -> np.ndarray | None:
        """Take the numbers of a matrix; returns the Schur complement of the interface, where there is one.

        Raises:
            PardisoError: a singular matrix, or one that is not definite where it should be.
        """
        self._data[:] = matrix.data[self._places]
        left = None if self.interface is None else np.zeros((self.interface.size, self.interface.size))
        nothing = np.zeros((self.size, 1), dtype=self._data.dtype)
        if not self._analysed:
            self._run(_ANALYSE, nothing, nothing)
            self._analysed = True
        self._run(_FACTORISE, nothing, nothing if left is None else left)
        if self._kind == OTHER and self.perturbed:
            # Its exchanges of rows were chosen for other numbers.
            self._run(_ANALYSE, nothing, nothing)
            self._run(_FACTORISE, nothing, nothing)
        return left

    def require_interface(self) -> np.ndarray:
        """The equations that are left over.

        Raises:
            ValueError: there are none.
        """
        if self.interface is None:
            raise ValueError("this pattern has no interface")
        return self.interface

    @property
    def perturbed(self) -> bool:
        """Whether pivots of the last matrix had to be made larger."""
        return bool(self._solver.iparm[_PERTURBED])

    @property
    def negative(self) -> bool:
        """Whether a symmetric matrix had negative eigenvalues."""
        return bool(self._solver.iparm[_NEGATIVE])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solutions for right-hand sides, shape (n,) or (n, several)."""
        return self._solved(_SOLVE, right)

    def reduce(self, right: np.ndarray) -> np.ndarray:
        """The first half of a solution: in the rows of the interface, what its Schur complement has to carry."""
        return self._solved(_FORWARD, right)

    def expand(self, reduced: np.ndarray) -> np.ndarray:
        """The other half, once the solution of the interface stands in its rows."""
        return self._solved(_BACKWARD, reduced)

    def _solved(self, phase: int, right: np.ndarray) -> np.ndarray:
        columns = np.asfortranarray(right.reshape(self.size, -1), dtype=self._data.dtype)
        answer = np.zeros_like(columns, order="F")
        self._run(phase, columns, answer)
        return np.ascontiguousarray(answer, dtype=np.float64).reshape(right.shape)

    def _run(self, phase: int, right: np.ndarray, answer: np.ndarray) -> None:
        solver, numbers = self._solver, ctypes.POINTER(ctypes.c_int32)
        one, error = ctypes.byref(ctypes.c_int32(1)), ctypes.c_int32(0)
        reals = ctypes.POINTER(ctypes.c_double)
        solver._mkl_pardiso(
            solver.pt.ctypes.data_as(ctypes.POINTER(solver._pt_type[0])), one, one,
            ctypes.byref(ctypes.c_int32(self._kind)), ctypes.byref(ctypes.c_int32(phase)),
            ctypes.byref(ctypes.c_int32(self.size)), self._data.ctypes.data_as(reals),
            self._row_starts.ctypes.data_as(numbers), self._columns.ctypes.data_as(numbers),
            solver.perm.ctypes.data_as(numbers), ctypes.byref(ctypes.c_int32(right.shape[1])),
            solver.iparm.ctypes.data_as(numbers), ctypes.byref(ctypes.c_int32(0)), right.ctypes.data_as(reals),
            answer.ctypes.data_as(reals), ctypes.byref(error))
        if error.value:
            raise PardisoError(f"Pardiso ended with error {error.value} in phase {phase}")

    def __del__(self) -> None:
        if hasattr(self, "_solver") and not sys.is_finalizing():
            self._solver.free_memory(everything=True)
