"""Factors in single precision with Krylov refinement in double precision.

A factor in single precision takes half of the time and memory. As a preconditioner its error is about 1e-2, so that
each iteration gains two digits. Single precision cannot decide whether a matrix is positive definite; conjugate
gradients can: their curvatures are the pivots of the matrix on the Krylov space, and a negative curvature shows an
indefinite matrix as soon as the right-hand side has a component in that direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
