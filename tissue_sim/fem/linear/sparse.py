"""Factorisation of sparse matrices: SciPy's SuperLU, or Intel's Pardiso if pypardiso is installed.

pypardiso (extra ``pip install tissue_sim[pardiso]``) is about ten times faster for 60,000 equations of a solid.

Pardiso also factorises in single precision, with Krylov refinement in double precision. Such a factor takes half of the
time and memory. As a preconditioner its error is about 1e-2, so that each iteration gains two digits. Single precision
cannot decide whether a matrix is positive definite; conjugate gradients can: their curvatures are the pivots of the
matrix on the Krylov space, and a negative curvature shows an indefinite matrix as soon as the right-hand side has a
component in that direction.
"""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tissue_sim.fem.linear.pardiso import MatrixType, PardisoError, PardisoPatternFactor


@dataclass(frozen=True)
class KrylovRefinementSettings:
    """Settings of the Krylov refinement.

    Attributes:
        tolerance: relative residual of a solution, 1.
        max_iterations: of a solution; after them the matrix is factorised in double precision.
        test_tolerance: relative residual of the solution for a random right-hand side that tests a new factor, 1.
        max_test_iterations: of this test; a factor that needs more is rejected.
    """

    tolerance: float = 1e-13
    max_iterations: int = 40
    test_tolerance: float = 1e-6
    max_test_iterations: int = 12


_SETTINGS = KrylovRefinementSettings()


class SinglePrecisionFactor:
    """Factor in single precision together with its matrix in double precision; see `Factor` in `sparse.py`."""

    definite = True

    def __init__(self, pattern: PardisoPatternFactor, matrix: Any, symmetric: bool):
        self._pattern, self._matrix, self._symmetric = pattern, matrix, symmetric
        self._exact: PardisoPatternFactor | None = None

    @classmethod
    def make_factor_or_none(cls, pattern: PardisoPatternFactor, matrix: Any,
                            symmetric: bool) -> SinglePrecisionFactor | None:
        """Return the factor; None if single precision is too inaccurate, or a symmetric matrix may be indefinite."""
        try:
            pattern.factorise_and_get_schur_if_interface(matrix)
        except PardisoError:
            return None
        if pattern.has_perturbed_pivots:
            return None
        factor = cls(pattern, matrix.copy(), symmetric)
        right = np.random.default_rng(0).standard_normal((matrix.shape[0], 1))
        found = factor._solve_iteratively_or_none(right, _SETTINGS.test_tolerance, _SETTINGS.max_test_iterations)
        return None if found is None else factor

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve for right-hand sides, shape (n,) or (n, m), to the relative residual of the settings."""
        if self._exact is None:
            answer = self._solve_iteratively_or_none(right.reshape(right.shape[0], -1), _SETTINGS.tolerance,
                                                     _SETTINGS.max_iterations)
            if answer is not None:
                return answer.reshape(right.shape)
            kind = MatrixType.SYMMETRIC if self._symmetric else MatrixType.UNSYMMETRIC
            self._exact = PardisoPatternFactor(self._matrix, kind)
            self._exact.factorise_and_get_schur_if_interface(self._matrix)
        return self._exact.solve(right)

    def _solve_iteratively_or_none(self, right: np.ndarray, tolerance: float, max_iterations: int) -> np.ndarray | None:
        """Solve by preconditioned conjugate gradients, or by GCR if the matrix is not symmetric.

        Args:
            right: right-hand sides, shape (n, m).
            tolerance: relative residual.
            max_iterations: limit.

        Returns:
            Shape (n, m); None if the limit is reached, or if conjugate gradients find a direction of zero or negative
            curvature.

        Source: Saad, Iterative Methods for Sparse Linear Systems, algorithms 9.1 and 6.21.
        """
        residual, size = right.copy(), np.linalg.norm(right, axis=0)
        goals, answer = tolerance * size, np.zeros_like(right)
        direction, last = np.zeros_like(right), np.ones_like(size)
        directions: list[np.ndarray] = []
        products: list[np.ndarray] = []
        iteration = 0
        while not (np.linalg.norm(residual, axis=0) <= goals).all():
            if iteration == max_iterations:
                return None
            iteration += 1
            found = self._apply_preconditioner(residual)
            if self._symmetric:
                product = _column_inner_products(residual, found)
                direction = found + _divide_or_zero(product, last) * direction if iteration > 1 else found
                last, image = product, self._matrix @ direction
                curvature = _column_inner_products(direction, image)
                if not ((curvature > 0.0) | (np.linalg.norm(residual, axis=0) == 0.0)).all():
                    return None
                length = _divide_or_zero(product, curvature)
            else:
                # The image of each direction is orthogonal to those of all earlier ones.
                direction, image = found, self._matrix @ found
                for earlier, earlier_image in zip(directions, products, strict=True):
                    length = _column_inner_products(earlier_image, image)
                    direction, image = direction - length * earlier, image - length * earlier_image
                norm = np.linalg.norm(image, axis=0)
                direction, image = _divide_or_zero(direction, norm), _divide_or_zero(image, norm)
                directions.append(direction)
                products.append(image)
                length = _column_inner_products(image, residual)
            answer += length * direction
            residual -= length * image
        return answer

    def _apply_preconditioner(self, right: np.ndarray) -> np.ndarray:
        """Return the single-precision solutions for columns that are normalised first, which avoids underflow."""
        size = np.linalg.norm(right, axis=0)
        return size * self._pattern.solve(_divide_or_zero(right, size))


def _column_inner_products(first: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the inner product of each column of one array with the same column of another."""
    return np.asarray(np.einsum("ij,ij->j", first, other))


def _divide_or_zero(number: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return number / other; 0 where the divisor is 0."""
    return np.divide(number, other, out=np.zeros_like(number), where=other != 0.0)


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
