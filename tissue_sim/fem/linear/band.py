"""Band matrices in blocks, for use inside Taichi kernels.

The lower band is divided into square blocks of `BLOCK` columns. Block (I, J) is stored at ``band[I, w]`` with
``w = J - I + width - 1``, by columns, each a vector of its `BLOCK` rows, so that the inner products of the
factorisations run on vectors. A matrix that is not symmetric has two such bands: its lower triangle with the full
diagonal blocks, and the lower triangle of its transpose.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Rows and columns of a block; the number of lanes of a vector.
BLOCK = 8


class BandSolverFunctions(NamedTuple):
    """Taichi functions of a direct solver for band matrices, for use inside kernels.

    Attributes:
        factorise_band: ``factorise_band(matrix, matrix_upper, lower, upper, inverse, rows, width, begin, skewed) ->
            int`` writes the factors to the bands `lower` and `upper`, and the reciprocals of their diagonal to
            `inverse` (rows * BLOCK). It returns 1, or 0 if the factorisation fails. The factors of block rows before
            `begin` are kept. Entries with a row or column before block row `skewed` are symmetric, and their upper half
            is not read. A symmetric solver reads no upper half.
        solve_band: ``solve_band(lower, upper, inverse, x, rows, width)`` overwrites the right-hand side x, (rows)
            vectors, with the solution.

    Source: the pair init and compute of lineax (Rader, Lyons and Kidger, 2023, arXiv:2311.17283).
    """

    factorise_band: object
    solve_band: object


def count_block_rows_and_blocks_per_row(size: int, half_band: int) -> tuple[int, int]:
    """Return the number of block rows and of blocks per row of the band of a matrix of `size` equations.

    Args:
        size: number of equations.
        half_band: half-bandwidth, number of subdiagonals.
    """
    return max(1, -(-size // BLOCK)), -(-half_band // BLOCK) + 1


def pack_lapack_band_to_blocks(lower: np.ndarray) -> np.ndarray:
    """Convert LAPACK's lower band storage, shape (half_band + 1, n), to blocks, shape (rows, width, BLOCK, BLOCK)."""
    half_band, size = lower.shape[0] - 1, lower.shape[1]
    rows, width = count_block_rows_and_blocks_per_row(size, half_band)
    band = np.zeros((rows, width, BLOCK, BLOCK))
    for d in range(half_band + 1):
        j = np.arange(size - d)
        i = j + d
        band[i // BLOCK, j // BLOCK - i // BLOCK + width - 1, j % BLOCK, i % BLOCK] = lower[d, : size - d]
    for i in range(size, rows * BLOCK):
        band[i // BLOCK, width - 1, i % BLOCK, i % BLOCK] = 1.0
    return band


def unpack_blocks_to_lapack_band(blocks: np.ndarray, size: int, half_band: int) -> np.ndarray:
    """Convert blocks to LAPACK's lower band storage, shape (half_band + 1, size).

    This is the inverse of `pack_lapack_band_to_blocks`.
    """
    width = blocks.shape[1]
    lower = np.zeros((half_band + 1, size))
    for d in range(half_band + 1):
        j = np.arange(size - d)
        i = j + d
        lower[d, : size - d] = blocks[i // BLOCK, j // BLOCK - i // BLOCK + width - 1, j % BLOCK, i % BLOCK]
    return lower


@cache
def make_add_lower_entry_function():
    """Return the Taichi function ``add_lower_entry(row, column, value, free, width, band)``.

    It adds `value` to an entry of the lower triangle of the matrix of the first `free` equations; other entries are
    ignored.
    """
    ti = get_initialised_taichi()

    @ti.func
    def add_lower_entry(row, column, value, free, width, band: ti.template()):
        """Add `value` to an entry of the lower triangle; ignore entries above the diagonal or from row `free` on."""
        if row < free and column <= row:
            I, J = row // BLOCK, column // BLOCK
            w, c, r = J - I + width - 1, column % BLOCK, row % BLOCK
            band[I, w, c, r] = band[I, w, c, r] + value

    return add_lower_entry


@cache
def make_subtract_earlier_products_function():
    """Return the Taichi function ``subtract_earlier_block_products(I, J, first, width, matrix, left, right)``.

    left(I, J) = matrix(I, J) - sum of left(I, K) right(J, K)^T over the block columns K from `first` to J - 1.
    """
    ti = get_initialised_taichi()

    @ti.func
    def subtract_earlier_block_products(I, J, first, width, matrix: ti.template(), left: ti.template(),
                                        right: ti.template()):
        """Write matrix(I, J) minus the sum of left(I, K) right(J, K)^T over earlier columns K to left(I, J)."""
        w = J - I + width - 1
        # Eight columns stay in registers while all earlier blocks are subtracted.
        t0, t1, t2, t3 = matrix[I, w, 0], matrix[I, w, 1], matrix[I, w, 2], matrix[I, w, 3]
        t4, t5, t6, t7 = matrix[I, w, 4], matrix[I, w, 5], matrix[I, w, 6], matrix[I, w, 7]
        for K in range(ti.max(first, J - width + 1), J):
            wi, wj = K - I + width - 1, K - J + width - 1
            for k in range(BLOCK):
                a, b = left[I, wi, k], right[J, wj, k]
                t0 -= a * b[0]
                t1 -= a * b[1]
                t2 -= a * b[2]
                t3 -= a * b[3]
                t4 -= a * b[4]
                t5 -= a * b[5]
                t6 -= a * b[6]
                t7 -= a * b[7]
        left[I, w, 0], left[I, w, 1], left[I, w, 2], left[I, w, 3] = t0, t1, t2, t3
        left[I, w, 4], left[I, w, 5], left[I, w, 6], left[I, w, 7] = t4, t5, t6, t7

    return subtract_earlier_block_products


@cache
def make_copy_lower_to_upper_band_function():
    """Return the Taichi function ``copy_lower_band_to_upper_band(lower, upper, begin, end, width)``.

    It copies the lower band of a symmetric matrix to the upper band, for block rows `begin` to `end` - 1.
    """
    ti = get_initialised_taichi()

    @ti.func
    def copy_lower_band_to_upper_band(lower: ti.template(), upper: ti.template(), begin, end, width):
        """Copy block rows `begin` to `end` - 1 of the lower band to the upper band, which stores the transpose."""
        for I in range(begin, end):
            for w in range(width):
                for c in range(BLOCK):
                    upper[I, w, c] = lower[I, w, c]

    return copy_lower_band_to_upper_band


@cache
def make_symmetrise_diagonal_blocks_function():
    """Return the Taichi function ``symmetrise_diagonal_blocks(lower, rows, width)``.

    It fills the upper triangles of the diagonal blocks of a symmetric matrix.
    """
    ti = get_initialised_taichi()

    @ti.func
    def symmetrise_diagonal_blocks(lower: ti.template(), rows, width):
        """Copy the lower triangle of every diagonal block to its upper triangle."""
        for I in range(rows):
            for c in range(BLOCK):
                for r in range(c):
                    lower[I, width - 1, c][r] = lower[I, width - 1, r][c]

    return symmetrise_diagonal_blocks


@cache
def make_add_unsymmetric_entry_function():
    """Return the Taichi function ``add_unsymmetric_entry(row, column, value, free, width, lower, upper)``.

    It adds `value` to an entry on either side of the diagonal of the matrix of the first `free` equations.
    """
    ti = get_initialised_taichi()

    @ti.func
    def add_unsymmetric_entry(row, column, value, free, width, lower: ti.template(), upper: ti.template()):
        """Add `value` to an entry on either side of the diagonal; ignore rows and columns from `free` on."""
        if row < free and column < free:
            I, J = row // BLOCK, column // BLOCK
            r, c = row % BLOCK, column % BLOCK
            if J <= I:
                lower[I, J - I + width - 1, c, r] = lower[I, J - I + width - 1, c, r] + value
            else:
                upper[J, I - J + width - 1, r, c] = upper[J, I - J + width - 1, r, c] + value

    return add_unsymmetric_entry
