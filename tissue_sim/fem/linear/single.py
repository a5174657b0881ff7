"""Factors in single precision, whose solutions are made exact by a Krylov iteration in double precision.

Such a factor takes half of the time and memory. Applied to its matrix it leaves one to some 1e-2, so that each step of
the iteration gains two digits. What single precision cannot tell, whether a matrix is positive definite, is asked of
the iteration: conjugate gradients meet a negative curvature where it is not (their curvatures are the pivots of the
matrix on the space that they have seen, which holds the direction once its share of the right-hand side is used up).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tissue_sim.fem.linear.pardiso import OTHER, SYMMETRIC, PardisoError, PardisoPattern

#: What is left of a right-hand side of a solution, and of the random one that a new factor is asked first.
_LEFT, _ASKED = 1e-13, 1e-6
#: Steps until then; a factor that needs more for the first is of no use.
_STEPS, _FIRST_STEPS = 40, 12


class SingleFactor:
    """A factor in single precision, and the matrix; see `Factor` in `sparse.py`."""

    definite = True

    def __init__(self, pattern: PardisoPattern, matrix: Any, symmetric: bool):
        self._pattern, self._matrix, self._symmetric = pattern, matrix, symmetric
        self._exact: PardisoPattern | None = None

    @classmethod
    def of(cls, pattern: PardisoPattern, matrix: Any, symmetric: bool) -> SingleFactor | None:
        """None where single precision is too little, or a symmetric matrix may not be positive definite."""
        try:
            pattern.factorise(matrix)
        except PardisoError:
            return None
        if pattern.perturbed:
            return None
        factor = cls(pattern, matrix.copy(), symmetric)
        asked = np.random.default_rng(0).standard_normal((matrix.shape[0], 1))
        return None if factor._iterate(asked, _ASKED, _FIRST_STEPS) is None else factor

    def solve(self, right: np.ndarray) -> np.ndarray:
        if self._exact is None:
            answer = self._iterate(right.reshape(right.shape[0], -1), _LEFT, _STEPS)
            if answer is not None:
                return answer.reshape(right.shape)
            self._exact = PardisoPattern(self._matrix, SYMMETRIC if self._symmetric else OTHER)
            self._exact.factorise(self._matrix)
        return self._exact.solve(right)

    def _iterate(self, right: np.ndarray, goal: float, most: int) -> np.ndarray | None:
        """Solutions for right-hand sides, shape (n, m); None where `most` steps do not leave their share `goal`, or
        conjugate gradients meet a direction without stiffness."""
        left, size = right.copy(), np.linalg.norm(right, axis=0)
        goals, answer = goal * size, np.zeros_like(right)
        way, last = np.zeros_like(right), np.ones_like(size)
        ways: list[np.ndarray] = []
        pushes: list[np.ndarray] = []
        steps = 0
        while not (np.linalg.norm(left, axis=0) <= goals).all():
            if steps == most:
                return None
            steps += 1
            found = self._apply(left)
            if self._symmetric:
                product = _dot(left, found)
                way = found + _over(product, last) * way if steps > 1 else found
                last, push = product, self._matrix @ way
                curvature = _dot(way, push)
                if not ((curvature > 0.0) | (np.linalg.norm(left, axis=0) == 0.0)).all():
                    return None
                share = _over(product, curvature)
            else:
                # Conjugate residuals, orthogonal to all earlier ones.
                way, push = found, self._matrix @ found
                for earlier, pushed in zip(ways, pushes, strict=True):
                    share = _dot(pushed, push)
                    way, push = way - share * earlier, push - share * pushed
                length = np.linalg.norm(push, axis=0)
                way, push = _over(way, length), _over(push, length)
                ways.append(way)
                pushes.append(push)
                share = _dot(push, left)
            answer += share * way
            left -= share * push
        return answer

    def _apply(self, right: np.ndarray) -> np.ndarray:
        """Solutions of the factor alone; in units in which single precision has no small numbers."""
        size = np.linalg.norm(right, axis=0)
        return size * self._pattern.solve(_over(right, size))


def _dot(first: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ij,ij->j", first, other))


def _over(number: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A quotient; 0 where it has no value."""
    return np.divide(number, other, out=np.zeros_like(number), where=other != 0.0)
