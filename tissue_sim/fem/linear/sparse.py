"""Factors of sparse matrices by libraries: SciPy's SuperLU, or Intel's Pardiso where pypardiso is installed.

pypardiso (an extra, ``pip install tissue_sim[pardiso]``) takes a tenth of the time for 60,000 equations of a solid.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Any, Protocol

import numpy as np

from tissue_sim.fem.linear.pardiso import DEFINITE, OTHER, SYMMETRIC, PardisoError, PardisoPattern
from tissue_sim.fem.linear.single import SingleFactor

#: ``TISSUE_SIM_SPARSE=scipy`` keeps to SciPy where pypardiso is installed, too.
_CHOICE = "TISSUE_SIM_SPARSE"
#: Pardiso's factors of so many equations are in single precision where that is enough; smaller ones take no time.
_SINGLE_FROM = 1000


class Factor(Protocol):
    """A factor of a matrix.

    Attributes:
        definite: whether a symmetric matrix is positive definite; True of one that is not symmetric.
    """

    definite: bool

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solutions for right-hand sides, shape (n,) or (n, several)."""


class CondensedFactor(Factor, Protocol):
    """A factor of a matrix that was condensed onto some of its equations.

    Attributes:
        compliance: of these, the block of the inverse, shape (m, m).
    """

    compliance: np.ndarray

    def begin(self, right: np.ndarray) -> np.ndarray:
        """A solution that is begun: it stands in these equations, and `finish` finds the rest, which takes half of the
        time. What is begun may be added up, shape (n,) or (n, several)."""

    def begin_push(self, forces: np.ndarray) -> np.ndarray:
        """The same for a right-hand side that is 0 but in these equations, shape (m,)."""

    def finish(self, begun: np.ndarray) -> np.ndarray:
        """The whole solution."""


class SparseSolver:
    """Factors of matrices that have their entries in the same places. What does not depend on the numbers is found once
    where the library can; so only the newest factor is one that may be used."""

    def __init__(self) -> None:
        self._kept: dict[int, PardisoPattern] = {}
        self._single: dict[int, PardisoPattern] = {}
        self._single_is_enough = True

    def factorise(self, matrix: Any, *, symmetric: bool) -> Factor | None:
        """A factor of a square matrix, a `scipy.sparse.csc_array` with sorted rows; None where it is singular."""
        if library() != "pardiso":
            return _SuperLU.of(matrix, symmetric)
        tried = self._single_is_enough and matrix.shape[0] >= _SINGLE_FROM
        if tried:
            kind = DEFINITE if symmetric else OTHER
            single = SingleFactor.of(_pattern(self._single, matrix, kind, single=True), matrix, symmetric)
            if single is not None:
                return single
        factor = _Pardiso.of(_pattern(self._kept, matrix, SYMMETRIC if symmetric else OTHER), matrix, symmetric)
        if tried and factor is not None and factor.definite:
            self._single_is_enough = False
            self._single.clear()
        return factor

    def condense(self, matrix: Any, interface: np.ndarray) -> CondensedFactor | None:
        """The same of a symmetric matrix, condensed onto its equations `interface`, sorted; None where it is singular,
        or not positive definite while these are held."""
        if library() != "pardiso":
            return _CondensedSuperLU.of(matrix, interface)
        pattern = self._kept.get(DEFINITE)
        if pattern is None or pattern.indices is not matrix.indices or not np.array_equal(pattern.require_interface(),
                                                                                          interface):
            pattern = self._kept[DEFINITE] = PardisoPattern(matrix, DEFINITE, interface)
        return _CondensedPardiso.of(pattern, matrix)


def _pattern(kept: dict[int, PardisoPattern], matrix: Any, kind: int, *, single: bool = False) -> PardisoPattern:
    pattern = kept.get(kind)
    if pattern is None or pattern.indices is not matrix.indices:
        pattern = kept[kind] = PardisoPattern(matrix, kind, single=single)
    return pattern


def factorise(matrix: Any, *, symmetric: bool) -> Factor | None:
    """A factor of one matrix; see `SparseSolver.factorise`."""
    return SparseSolver().factorise(matrix, symmetric=symmetric)


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
        self._pattern, self.definite = pattern, definite

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
        return self._pattern.solve(right)


class _CondensedPardiso:
    definite = True

    def __init__(self, pattern: PardisoPattern, compliance: np.ndarray):
        self._pattern, self.compliance = pattern, compliance

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
        begun, interface = self._pattern.reduce(right), self._pattern.require_interface()
        begun[interface] = self.compliance @ begun[interface]
        return begun

    def begin_push(self, forces: np.ndarray) -> np.ndarray:
        # The first half of the solution leaves such a right-hand side as it is.
        begun = np.zeros(self._pattern.size)
        begun[self._pattern.require_interface()] = self.compliance @ forces
        return begun

    def finish(self, begun: np.ndarray) -> np.ndarray:
        return self._pattern.expand(begun)
