"""Factorisation of sparse matrices: SciPy's SuperLU, or Intel's Pardiso if pypardiso is installed.

pypardiso (extra ``pip install tissue_sim[pardiso]``) is about ten times faster for 60,000 equations of a solid.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Any, Protocol

import numpy as np

from tissue_sim.fem.linear.pardiso import MatrixType, PardisoError, PardisoPatternFactor
from tissue_sim.fem.linear.single import SinglePrecisionFactor

#: Environment variable; ``TISSUE_SIM_SPARSE=scipy`` selects SciPy although pypardiso is installed.
_CHOICE = "TISSUE_SIM_SPARSE"
#: Number of equations from which on Pardiso first tries single precision; smaller systems take no noticeable time.
_SINGLE_FROM = 1000


class Factor(Protocol):
    """Factorised sparse matrix, with which linear equations are solved.

    Attributes:
        definite: whether a symmetric matrix is positive definite; True for other matrices.
    """

    definite: bool

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solutions for right-hand sides, shape (n,) or (n, m)."""


class CondensedFactor(Factor, Protocol):
    """Factor of a matrix that is condensed onto interface equations (Schur complement).

    Attributes:
        compliance: block of the inverse of the matrix for the interface equations, shape (m, m).
    """

    compliance: np.ndarray

    def solve_up_to_interface(self, right: np.ndarray) -> np.ndarray:
        """Return the argument of `complete_solution`; its interface rows are already the solution (half of the work).

        Results are linear in the right-hand side and may be added.

        Args:
            right: shape (n,) or (n, several).
        """

    def solve_up_to_interface_for_force(self, forces: np.ndarray) -> np.ndarray:
        """Return `solve_up_to_interface` of a right-hand side that is 0 except in the interface equations.

        Args:
            forces: right-hand side of the interface equations, shape (m,).
        """

    def complete_solution(self, begun: np.ndarray) -> np.ndarray:
        """Return the solution of all equations from a result of `solve_up_to_interface` (second half of the work)."""


class SparseSolver:
    """Direct solver: factorises sparse matrices that share one sparsity pattern.

    The symbolic analysis is done once if the library supports it. Only the newest factor is valid.
    """

    def __init__(self) -> None:
        self._kept: dict[MatrixType, PardisoPatternFactor] = {}
        self._single: dict[MatrixType, PardisoPatternFactor] = {}
        self._single_is_enough = True

    def factorise_or_none(self, matrix: Any, *, symmetric: bool) -> Factor | None:
        """Factorise a square matrix.

        Args:
            matrix: a `scipy.sparse.csc_array` with sorted rows.
            symmetric: whether the matrix is symmetric.

        Returns:
            None if the matrix is singular.
        """
        if get_pardiso_or_scipy_name() != "pardiso":
            return _SuperLUFactor.make_factor_or_none(matrix, symmetric)
        tried = self._single_is_enough and matrix.shape[0] >= _SINGLE_FROM
        if tried:
            kind = MatrixType.DEFINITE if symmetric else MatrixType.UNSYMMETRIC
            pattern = _find_or_analyse_pattern(self._single, matrix, kind, single=True)
            single = SinglePrecisionFactor.make_factor_or_none(pattern, matrix, symmetric)
            if single is not None:
                return single
        kind = MatrixType.SYMMETRIC if symmetric else MatrixType.UNSYMMETRIC
        factor = _PardisoFactor.make_factor_or_none(_find_or_analyse_pattern(self._kept, matrix, kind), matrix,
                                                    symmetric)
        if tried and factor is not None and factor.definite:
            self._single_is_enough = False
            self._single.clear()
        return factor

    def factorise_condensed_or_none(self, matrix: Any, interface: np.ndarray) -> CondensedFactor | None:
        """Factorise a symmetric matrix, and condense the matrix onto interface equations.

        Args:
            matrix: a `scipy.sparse.csc_array` with sorted rows.
            interface: sorted indices of the interface equations, shape (m,).

        Returns:
            None if the matrix is singular, or not positive definite with the interface held.
        """
        if get_pardiso_or_scipy_name() != "pardiso":
            return _CondensedSuperLUFactor.make_factor_or_none(matrix, interface)
        pattern = self._kept.get(MatrixType.DEFINITE)
        if pattern is None or pattern.indices is not matrix.indices or not np.array_equal(
                pattern.get_interface_equations_or_raise(), interface):
            pattern = self._kept[MatrixType.DEFINITE] = PardisoPatternFactor(matrix, MatrixType.DEFINITE, interface)
        return _CondensedPardisoFactor.make_factor_or_none(pattern, matrix)


def _find_or_analyse_pattern(kept: dict[MatrixType, PardisoPatternFactor], matrix: Any, kind: MatrixType, *,
                             single: bool = False) -> PardisoPatternFactor:
    """Return the analysis of the pattern of a matrix from `kept`; analyse the pattern first if it is a new one."""
    pattern = kept.get(kind)
    if pattern is None or pattern.indices is not matrix.indices:
        pattern = kept[kind] = PardisoPatternFactor(matrix, kind, single=single)
    return pattern


def factorise_or_none(matrix: Any, *, symmetric: bool) -> Factor | None:
    """Factorise one sparse matrix; for arguments and result see `SparseSolver.factorise_or_none`."""
    return SparseSolver().factorise_or_none(matrix, symmetric=symmetric)


def get_pardiso_or_scipy_name() -> str:
    """Return the name of the library that factorises sparse matrices: ``"pardiso"`` or ``"scipy"``."""
    if os.environ.get(_CHOICE) == "scipy" or importlib.util.find_spec("pypardiso") is None:
        return "scipy"
    return "pardiso"


class _SuperLUFactor:
    """`Factor` by SciPy's SuperLU."""

    def __init__(self, factor: Any, definite: bool):
        self._factor, self.definite = factor, definite

    @classmethod
    def make_factor_or_none(cls, matrix: Any, symmetric: bool) -> _SuperLUFactor | None:
        """Return the factor of a matrix; None if the matrix is singular."""
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


class _CondensedSuperLUFactor:
    """`CondensedFactor` by SuperLU; `solve_up_to_interface` computes the whole solution."""

    definite = True

    def __init__(self, factor: _SuperLUFactor, compliance: np.ndarray, interface: np.ndarray, size: int):
        self._factor, self.compliance, self._interface, self._size = factor, compliance, interface, size

    @classmethod
    def make_factor_or_none(cls, matrix: Any, interface: np.ndarray) -> _CondensedSuperLUFactor | None:
        """Return the factor of a matrix; None if the matrix is singular."""
        factor = _SuperLUFactor.make_factor_or_none(matrix, True)
        if factor is None:
            return None
        unit = np.zeros((matrix.shape[0], interface.size))
        unit[interface, np.arange(interface.size)] = 1.0
        return cls(factor, np.ascontiguousarray(factor.solve(unit)[interface]), interface, matrix.shape[0])

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._factor.solve(right)

    solve_up_to_interface = solve

    def solve_up_to_interface_for_force(self, forces: np.ndarray) -> np.ndarray:
        right = np.zeros(self._size)
        right[self._interface] = forces
        return self._factor.solve(right)

    def complete_solution(self, begun: np.ndarray) -> np.ndarray:
        return begun


class _PardisoFactor:
    """`Factor` by Pardiso in double precision."""

    def __init__(self, pattern: PardisoPatternFactor, definite: bool):
        self._pattern, self.definite = pattern, definite

    @classmethod
    def make_factor_or_none(cls, pattern: PardisoPatternFactor, matrix: Any, symmetric: bool) -> _PardisoFactor | None:
        """Return the factor of a matrix; None if the matrix is singular."""
        try:
            pattern.factorise_and_get_schur_if_interface(matrix)
        except PardisoError:
            return None
        if pattern.has_perturbed_pivots and not symmetric:
            return None
        return cls(pattern, not pattern.has_perturbed_pivots and not (symmetric and pattern.has_negative_eigenvalues))

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._pattern.solve(right)


class _CondensedPardisoFactor:
    """`CondensedFactor` by Pardiso, with the inverse of the Schur complement as compliance."""

    definite = True

    def __init__(self, pattern: PardisoPatternFactor, compliance: np.ndarray):
        self._pattern, self.compliance = pattern, compliance

    @classmethod
    def make_factor_or_none(cls, pattern: PardisoPatternFactor, matrix: Any) -> _CondensedPardisoFactor | None:
        """Return the factor of a matrix; None if it is singular, or not positive definite with the interface held."""
        from scipy.linalg import lapack

        try:
            schur = pattern.factorise_and_get_schur_if_interface(matrix)
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
        return self.complete_solution(self.solve_up_to_interface(right))

    def solve_up_to_interface(self, right: np.ndarray) -> np.ndarray:
        begun, interface = self._pattern.substitute_forward(right), self._pattern.get_interface_equations_or_raise()
        begun[interface] = self.compliance @ begun[interface]
        return begun

    def solve_up_to_interface_for_force(self, forces: np.ndarray) -> np.ndarray:
        # Forward substitution does not change such a right-hand side.
        begun = np.zeros(self._pattern.size)
        begun[self._pattern.get_interface_equations_or_raise()] = self.compliance @ forces
        return begun

    def complete_solution(self, begun: np.ndarray) -> np.ndarray:
        return self._pattern.substitute_backward(begun)
