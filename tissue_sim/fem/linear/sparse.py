"""Factorisation of sparse matrices: SciPy's SuperLU, or Intel's Pardiso if pypardiso is installed.

pypardiso (extra ``pip install tissue_sim[pardiso]``) is about ten times faster for 60,000 equations of a solid.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Any, Protocol

import numpy as np

from tissue_sim.fem.linear.pardiso import MatrixType, PardisoError, PardisoPattern
from tissue_sim.fem.linear.single import SingleFactor

#: Environment variable; ``TISSUE_SIM_SPARSE=scipy`` selects SciPy although pypardiso is installed.
_CHOICE = "TISSUE_SIM_SPARSE"
#: Number of equations from which on Pardiso first tries single precision; smaller systems take no noticeable time.
_SINGLE_FROM = 1000


class Factor(Protocol):
    """Factorised matrix, which solves linear equations.

    Attributes:
        definite: whether a symmetric matrix is positive definite; True for other matrices.
    """

    definite: bool

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve for right-hand sides, shape (n,) or (n, m)."""


class CondensedFactor(Factor, Protocol):
    """Factor of a matrix that is condensed onto interface equations (Schur complement).

    Attributes:
        compliance: block of the inverse of the matrix for the interface equations, shape (m, m).
    """

    compliance: np.ndarray

    def begin(self, right: np.ndarray) -> np.ndarray:
        """First half of a solution: the interface rows of the result hold the solution; `finish` computes the others.

        The first half takes half of the time. Results are linear in the right-hand side and may be added.

        Args:
            right: shape (n,) or (n, several).
        """

    def begin_push(self, forces: np.ndarray) -> np.ndarray:
        """First half of a solution for a right-hand side that is 0 except in the interface equations, shape (m,)."""

    def finish(self, begun: np.ndarray) -> np.ndarray:
        """Second half of a solution; returns the solution of all equations."""


class SparseSolver:
    """Factorise matrices of one sparsity pattern.

    The symbolic analysis is done once if the library supports it. Only the newest factor is valid.
    """

    def __init__(self) -> None:
        self._kept: dict[MatrixType, PardisoPattern] = {}
        self._single: dict[MatrixType, PardisoPattern] = {}
        self._single_is_enough = True

    def factorise(self, matrix: Any, *, symmetric: bool) -> Factor | None:
        """Factorise a square matrix.

        Args:
            matrix: a `scipy.sparse.csc_array` with sorted rows.
            symmetric: whether the matrix is symmetric.

        Returns:
            None if the matrix is singular.
        """
        if library() != "pardiso":
            return _SuperLU.of(matrix, symmetric)
        tried = self._single_is_enough and matrix.shape[0] >= _SINGLE_FROM
        if tried:
            kind = MatrixType.DEFINITE if symmetric else MatrixType.UNSYMMETRIC
            single = SingleFactor.of(_find_pattern(self._single, matrix, kind, single=True), matrix, symmetric)
            if single is not None:
                return single
        kind = MatrixType.SYMMETRIC if symmetric else MatrixType.UNSYMMETRIC
        factor = _Pardiso.of(_find_pattern(self._kept, matrix, kind), matrix, symmetric)
        if tried and factor is not None and factor.definite:
            self._single_is_enough = False
            self._single.clear()
        return factor

    def condense(self, matrix: Any, interface: np.ndarray) -> CondensedFactor | None:
        """Factorise a symmetric matrix and condense it onto interface equations.

        Args:
            matrix: a `scipy.sparse.csc_array` with sorted rows.
            interface: sorted indices of the interface equations, shape (m,).

        Returns:
            None if the matrix is singular, or not positive definite with the interface held.
        """
        if library() != "pardiso":
            return _CondensedSuperLU.of(matrix, interface)
        pattern = self._kept.get(MatrixType.DEFINITE)
        if pattern is None or pattern.indices is not matrix.indices or not np.array_equal(pattern.require_interface(),
                                                                                          interface):
            pattern = self._kept[MatrixType.DEFINITE] = PardisoPattern(matrix, MatrixType.DEFINITE, interface)
        return _CondensedPardiso.of(pattern, matrix)


def _find_pattern(kept: dict[MatrixType, PardisoPattern], matrix: Any, kind: MatrixType, *,
                  single: bool = False) -> PardisoPattern:
    pattern = kept.get(kind)
    if pattern is None or pattern.indices is not matrix.indices:
        pattern = kept[kind] = PardisoPattern(matrix, kind, single=single)
    return pattern


def factorise(matrix: Any, *, symmetric: bool) -> Factor | None:
    """Factorise one matrix; see `SparseSolver.factorise`."""
    return SparseSolver().factorise(matrix, symmetric=symmetric)


def library() -> str:
    """Name of the library in use: ``"pardiso"`` or ``"scipy"``."""
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


class _CondensedSuperLU:
    definite = True

    def __init__(self, factor: _SuperLU, compliance: np.ndarray, interface: np.ndarray, size: int):
        self._factor, self.compliance, self._interface, self._size = factor, compliance, interface, size

    @classmethod
    def of(cls, matrix: Any, interface: np.ndarray) -> _CondensedSuperLU | None:
        factor = _SuperLU.of(matrix, True)
        if factor is None:
            return None
        unit = np.zeros((matrix.shape[0], interface.size))
        unit[interface, np.arange(interface.size)] = 1.0
        return cls(factor, np.ascontiguousarray(factor.solve(unit)[interface]), interface, matrix.shape[0])

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._factor.solve(right)

    begin = solve

    def begin_push(self, forces: np.ndarray) -> np.ndarray:
        right = np.zeros(self._size)
        right[self._interface] = forces
        return self._factor.solve(right)

    def finish(self, begun: np.ndarray) -> np.ndarray:
        return begun


class _Pardiso:
    def __init__(self, pattern: PardisoPattern, definite: bool):
        self._find_pattern, self.definite = pattern, definite

    @classmethod
    def of(cls, pattern: PardisoPattern, matrix: Any, symmetric: bool) -> _Pardiso | None:
        try:
            pattern.factorise(matrix)
        except PardisoError:
            return None
        if pattern.perturbed and not symmetric:
            return None
        return cls(pattern, not pattern.perturbed and not (symmetric and pattern.negative))

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._find_pattern.solve(right)


class _CondensedPardiso:
    definite = True

    def __init__(self, pattern: PardisoPattern, compliance: np.ndarray):
        self._find_pattern, self.compliance = pattern, compliance

    @classmethod
    def of(cls, pattern: PardisoPattern, matrix: Any) -> _CondensedPardiso | None:
        from scipy.linalg import lapack

        try:
            schur = pattern.factorise(matrix)
        except PardisoError:
            return None
        assert schur is not None
        lower, failed = lapack.dpotrf(schur, lower=1)
        if not failed:
            inverse, failed = lapack.dpotri(lower, lower=1, overwrite_c=1)
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
        if failed:
            try:
                inverse = np.linalg.inv(schur)
            except np.linalg.LinAlgError:
                return None
        return cls(pattern, np.ascontiguousarray(inverse))

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self.finish(self.begin(right))

    def begin(self, right: np.ndarray) -> np.ndarray:
        begun, interface = self._find_pattern.reduce(right), self._find_pattern.require_interface()
        begun[interface] = self.compliance @ begun[interface]
        return begun

    def begin_push(self, forces: np.ndarray) -> np.ndarray:
        # Forward substitution does not change such a right-hand side.
        begun = np.zeros(self._find_pattern.size)
        begun[self._find_pattern.require_interface()] = self.compliance @ forces
        return begun

    def finish(self, begun: np.ndarray) -> np.ndarray:
        return self._find_pattern.expand(begun)
