"""Intel MKL Pardiso by pypardiso: factors of matrices of one sparsity pattern, analysed once."""

from __future__ import annotations

import ctypes
import os
import sys
from enum import IntEnum
from typing import Any

import numpy as np


class MatrixType(IntEnum):
    """Matrix types of Pardiso (`mtype`).

    Attributes:
        DEFINITE: symmetric and positive definite.
        SYMMETRIC: symmetric and indefinite.
        UNSYMMETRIC: not symmetric.
    """

    DEFINITE = 2
    SYMMETRIC = -2
    UNSYMMETRIC = 11


class _PardisoPhase(IntEnum):
    """Phases of a call of Pardiso (`phase`)."""

    ANALYSE = 11
    FACTORISE = 22
    SOLVE = 33
    FORWARD = 331
    BACKWARD = 333


class _ParameterIndex(IntEnum):
    """Indices of Pardiso's parameters `iparm`, counted from 0."""

    #: 1: the values below are used instead of the defaults.
    USE = 0
    #: 2: nested dissection.
    ORDERING = 1
    #: Pivots below 10^-value are perturbed.
    SMALLEST_PIVOT = 9
    SCALING = 10
    MATCHING = 12
    #: Output: number of perturbed pivots.
    PERTURBED = 13
    #: 1: pivots of 2 x 2 as well.
    PIVOTING = 20
    #: Output: number of negative eigenvalues.
    NEGATIVE = 22
    SINGLE_PRECISION = 27
    #: 2: Schur complement, with the factors that solutions need.
    SCHUR = 35


#: Environment variable in which pypardiso looks for its library; without it each search takes 0.25 s.
_LIBRARY = "PYPARDISO_MKL_RT"


class PardisoError(RuntimeError):
    """Pardiso returned an error code."""


class PardisoPatternFactor:
    """Pardiso's analysis of one sparsity pattern, and the factor of the last matrix with this pattern.

    Args:
        matrix: one of the matrices, a `scipy.sparse.csc_array` with sorted rows.
        kind: type of the matrices.
        interface: sorted indices of equations whose Schur complement is computed with the factor; None: none.
        single: single precision, which takes half of the time and memory.

    Raises:
        PardisoError: the analysis failed.
    """

    def __init__(self, matrix: Any, kind: MatrixType, interface: np.ndarray | None = None, *, single: bool = False):
        from pypardiso import PyPardisoSolver
        from scipy import sparse

        self._solver = PyPardisoSolver(mtype=kind)
        os.environ.setdefault(_LIBRARY, self._solver.libmkl._name)
        self.indices, self._kind, self.size = matrix.indices, kind, matrix.shape[0]
        numbered = sparse.csc_array((np.arange(1.0, matrix.nnz + 1.0), matrix.indices, matrix.indptr),
                                    shape=matrix.shape)
        rows = sparse.csr_array(numbered if kind == MatrixType.UNSYMMETRIC else sparse.triu(numbered))
        rows.sort_indices()
        self._entries = rows.data.astype(np.intp) - 1
        self._row_starts, self._columns = (part.astype(np.int32) + 1 for part in (rows.indptr, rows.indices))
        self._data = np.zeros(rows.nnz, dtype=np.float32 if single else np.float64)
        parameters = self._solver.iparm
        self.interface = interface
        if interface is not None:
            self._solver.perm = np.zeros(self.size, dtype=np.int32)
            self._solver.perm[interface] = 1
            parameters[[_ParameterIndex.USE, _ParameterIndex.ORDERING, _ParameterIndex.SMALLEST_PIVOT,
                        _ParameterIndex.SCHUR]] = 1, 2, 8, 2
        else:
            # Pardiso's defaults except that iterative refinement, which does not reduce the error here, is off.
            exchanges = int(kind == MatrixType.UNSYMMETRIC)
            parameters[[_ParameterIndex.USE, _ParameterIndex.ORDERING, _ParameterIndex.SMALLEST_PIVOT,
                        _ParameterIndex.SCALING, _ParameterIndex.MATCHING, _ParameterIndex.PIVOTING,
                        _ParameterIndex.SINGLE_PRECISION]] = (
                1, 2, 13 if exchanges else 8, exchanges, exchanges, 1, int(single))
        self._analysed = False

    def factorise_and_get_schur_if_interface(self, matrix: Any) -> np.ndarray | None:
        """Factorise a matrix with the pattern of this object, and keep the factor for `solve`.

        Returns:
            The Schur complement of the interface, shape (m, m); None without an interface.

        Raises:
            PardisoError: the matrix is singular, or not positive definite although its type is.
        """
        self._data[:] = matrix.data[self._entries]
        schur = None if self.interface is None else np.zeros((self.interface.size, self.interface.size))
        unused = np.zeros((self.size, 1), dtype=self._data.dtype)
        if not self._analysed:
            self._call_pardiso(_PardisoPhase.ANALYSE, unused, unused)
            self._analysed = True
        self._call_pardiso(_PardisoPhase.FACTORISE, unused, unused if schur is None else schur)
        if self._kind == MatrixType.UNSYMMETRIC and self.has_perturbed_pivots:
            # The row permutation of the analysis was chosen for other values.
            self._call_pardiso(_PardisoPhase.ANALYSE, unused, unused)
            self._call_pardiso(_PardisoPhase.FACTORISE, unused, unused)
        return schur

    def get_interface_equations_or_raise(self) -> np.ndarray:
        """Return the indices of the interface equations.

        Raises:
            ValueError: the pattern has no interface.
        """
        if self.interface is None:
            raise ValueError("interface must be an array of equation indices; got None. Create the factor with "
                             "interface=indices.")
        return self.interface

    @property
    def has_perturbed_pivots(self) -> bool:
        """Whether Pardiso perturbed small pivots of the last matrix, so that the factor is inaccurate."""
        return bool(self._solver.iparm[_ParameterIndex.PERTURBED])

    @property
    def has_negative_eigenvalues(self) -> bool:
        """Whether the last matrix, which is symmetric, has negative eigenvalues."""
        return bool(self._solver.iparm[_ParameterIndex.NEGATIVE])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solutions for right-hand sides, shape (n,) or (n, m)."""
        return self._solve_phase(_PardisoPhase.SOLVE, right)

    def substitute_forward(self, right: np.ndarray) -> np.ndarray:
        """Return the forward substitution; its interface rows are the right-hand side of the Schur complement."""
        return self._solve_phase(_PardisoPhase.FORWARD, right)

    def substitute_backward(self, reduced: np.ndarray) -> np.ndarray:
        """Return the solution by backward substitution.

        Args:
            reduced: result of `substitute_forward`, with the solution of the Schur complement in the interface rows.
        """
        return self._solve_phase(_PardisoPhase.BACKWARD, reduced)

    def _solve_phase(self, phase: int, right: np.ndarray) -> np.ndarray:
        """Run one solution phase, a `_PardisoPhase`, and return its result in the shape of `right`."""
        columns = np.asfortranarray(right.reshape(self.size, -1), dtype=self._data.dtype)
        answer = np.zeros_like(columns, order="F")
        self._call_pardiso(phase, columns, answer)
        return np.ascontiguousarray(answer, dtype=np.float64).reshape(right.shape)

    def _call_pardiso(self, phase: int, right: np.ndarray, answer: np.ndarray) -> None:
        """Run one phase of Pardiso, which writes to `answer`; raise PardisoError if Pardiso reports an error."""
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
            raise PardisoError(f"Pardiso returned error code {error.value} in phase {int(phase)}. See the error codes "
                               "of MKL Pardiso, or set TISSUE_SIM_SPARSE=scipy.")

    def __del__(self) -> None:
        if hasattr(self, "_solver") and not sys.is_finalizing():
            self._solver.free_memory(everything=True)
