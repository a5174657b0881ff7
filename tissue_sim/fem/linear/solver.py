"""Factorise once, solve many: what a linear solver of band matrices is, inside kernels and for Python callers.

A matrix stands in two arrays of blocks (see `tissue_sim.fem.linear.band`): its lower triangle, with the whole blocks of
the diagonal, and the lower triangle of its transpose, which a symmetric solver does not look at.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.linear.band import BLOCK, block_shape
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK, initialise


class KernelFunctions(NamedTuple):
    """Taichi functions of a linear solver.

    Attributes:
        init: ``init(lower, upper, inverse, rows, width) -> int`` overwrites the matrix by its factors, and `inverse`
            (rows * BLOCK) by the reciprocals of their diagonal; 0 where it cannot, else 1.
        solve: ``solve(lower, upper, inverse, x, rows, width)`` overwrites the right-hand side x, (rows) vectors.
    """

    init: object
    solve: object


@dataclass(frozen=True, eq=False)
class Factors:
    """What `LinearSolver.init` makes of a matrix of `size` equations."""

    size: int
    lower: np.ndarray
    upper: np.ndarray
    inverse: np.ndarray


class LinearSolver(ABC):
    """A direct solver, named after its factorisation.

    Source: the pair init and compute of lineax (Rader, Lyons and Kidger, 2023, arXiv:2311.17283).
    """

    @abstractmethod
    def functions(self) -> KernelFunctions:
        """For use inside kernels; made once."""

    def init(self, bands: np.ndarray) -> Factors:
        """Factorise a matrix.

        Args:
            bands: as `scipy.linalg.solve_banded` takes them, with as many below the diagonal as above it, shape
                (2 half_band + 1, n).

        Raises:
            ArithmeticError: singular, or what this factorisation cannot take.
        """
        size, half_band = bands.shape[1], bands.shape[0] // 2
        rows, width = block_shape(size, half_band)
        lower, upper = np.zeros((2, rows, width, BLOCK, BLOCK))
        for d in range(-half_band, half_band + 1):
            j = np.arange(max(0, d), size + min(0, d))
            i = j - d
            below = j // BLOCK <= i // BLOCK
            for target, r, c, chosen in ((lower, i, j, below), (upper, j, i, ~below)):
                r, c = r[chosen], c[chosen]
                target[r // BLOCK, c // BLOCK - r // BLOCK + width - 1, c % BLOCK, r % BLOCK] = bands[
                    half_band - d, j[chosen]]
        for i in range(size, rows * BLOCK):
            lower[i // BLOCK, width - 1, i % BLOCK, i % BLOCK] = 1.0
        good, inverse = np.zeros(1, np.int32), np.zeros(rows * BLOCK)
        with LOCK:
            BoundKernel(self._kernels[0], {"lower": lower, "upper": upper, "inverse": inverse, "good": good})()
        if not good[0]:
            raise ArithmeticError(f"{type(self).__name__} cannot factorise this matrix: a pivot is too small")
        return Factors(size, lower, upper, inverse)

    def solve(self, factors: Factors, right: np.ndarray) -> np.ndarray:
        """The solution for one right-hand side, shape (n,)."""
        x = np.zeros((len(factors.lower), BLOCK))
        x.ravel()[: factors.size] = right
        with LOCK:
            BoundKernel(self._kernels[1], {"lower": factors.lower, "upper": factors.upper, "inverse": factors.inverse,
                                           "x": x})()
        return x.ravel()[: factors.size].copy()

    @cached_property
    def _kernels(self):
        ti = initialise()
        init, solve = self.functions()
        vector = ti.types.vector(BLOCK, ti.f64)
        blocks, vectors = ti.types.ndarray(dtype=vector, ndim=3), ti.types.ndarray(dtype=vector, ndim=1)
        reals, numbers = ti.types.ndarray(dtype=ti.f64, ndim=1), ti.types.ndarray(dtype=ti.i32, ndim=1)

        @ti.kernel
        def run_init(lower: blocks, upper: blocks, inverse: reals, good: numbers):
            ti.loop_config(serialize=True)
            for _ in range(1):
                good[0] = init(lower, upper, inverse, lower.shape[0], lower.shape[1])

        @ti.kernel
        def run_solve(lower: blocks, upper: blocks, inverse: reals, x: vectors):
            ti.loop_config(serialize=True)
            for _ in range(1):
                solve(lower, upper, inverse, x, lower.shape[0], lower.shape[1])

        return run_init, run_solve
