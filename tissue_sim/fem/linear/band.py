"""Band matrices in blocks and their Cholesky and LU factorisations, for use inside Taichi kernels.

The lower band is divided into square blocks of `BLOCK` columns. Block (I, J) is stored at ``band[I, w]`` with
``w = J - I + width - 1``, by columns, each a vector of its `BLOCK` rows, so that the inner products of the
factorisations run on vectors. A matrix that is not symmetric has two such bands: its lower triangle with the full
diagonal blocks, and the lower triangle of its transpose.

The factorisations and solutions address bands and vectors by their offsets from the origin of
`tissue_sim.fem.taichi.origins`. A `BandTableIndex` names the entries of the table of these offsets, which
`make_band_table` computes.

Tangents without slip are symmetric and positive definite: L L^T. Tangents of slipping contact have the LU factorisation
without pivoting. Such a tangent is symmetric and positive definite but for a few entries of friction. U is stored by
rows where L is stored by columns, so that both halves run like the Cholesky factorisation. In a symmetric part of the
matrix U is the diagonal times L^T, so that one half is enough.
"""

from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.taichi.origins import compute_array_offset, get_address_origin
from tissue_sim.fem.taichi.runtime import BLOCK, get_initialised_taichi


class BandTableIndex(IntEnum):
    """Indices of the table of a band matrix, its factors and the right-hand side.

    Attributes:
        ROWS: number of block rows.
        WIDTH: number of blocks per row.
        MATRIX: offset of the lower band of the matrix.
        MATRIX_UPPER: offset of the lower band of its transpose.
        LOWER: offset of the lower factor.
        UPPER: offset of the upper factor.
        INVERSE: offset of the reciprocals of the diagonal.
        RIGHT: offset of the right-hand side, which the solution replaces.
    """

    ROWS = 0
    WIDTH = 1
    MATRIX = 2
    MATRIX_UPPER = 3
    LOWER = 4
    UPPER = 5
    INVERSE = 6
    RIGHT = 7


class BandSolverFunctions(NamedTuple):
    """Taichi functions of a direct solver for band matrices, for use inside kernels.

    Attributes:
        try_factorising_band: ``try_factorising_band(table, begin, skewed) -> int`` writes the factors of the matrix,
            and the reciprocals of their diagonal. `table` has the entries of `BandTableIndex`. It returns 1, or 0 if
            the factorisation fails. The factors of block rows before `begin` are kept. Entries with a row or column
            before block row `skewed` are symmetric, and their upper half is not read. A symmetric solver reads no upper
            half.
        solve_band: ``solve_band(table)`` overwrites the right-hand side, ROWS vectors, with the solution.

    Source: the pair init and compute of lineax (Rader, Lyons and Kidger, 2023, arXiv:2311.17283).
    """

    try_factorising_band: object
    solve_band: object


def count_block_rows_and_blocks_per_row(size: int, half_band: int) -> tuple[int, int]:
    """Return the number of block rows and of blocks per row of the band of a matrix of `size` equations.

    Args:
        size: number of equations.
        half_band: half-bandwidth, number of subdiagonals.
    """
    return max(1, -(-size // BLOCK)), -(-half_band // BLOCK) + 1


def make_band_table(matrix: np.ndarray, matrix_upper: np.ndarray, lower: np.ndarray, upper: np.ndarray,
                    inverse: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the table of a band matrix, int32, with the entries of `BandTableIndex`; its owner keeps the arrays alive.

    Args:
        matrix: lower band of the matrix, shape (rows, width, BLOCK, BLOCK), as all arrays here allocated by
            `tissue_sim.fem.taichi.origins.allocate_array`.
        matrix_upper: lower band of its transpose, same shape; another array if the solver is symmetric.
        lower: lower factor, same shape.
        upper: upper factor, same shape; another array if the solver is symmetric.
        inverse: reciprocals of the diagonal, shape (rows, BLOCK).
        right: right-hand side, shape (rows, BLOCK).
    """
    rows, width = matrix.shape[:2]
    offsets = [compute_array_offset(array) for array in (matrix, matrix_upper, lower, upper, inverse, right)]
    return np.array([rows, width, *offsets], dtype=np.int32)


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
def make_locate_block_function():
    """Return the Taichi function ``locate_block(band, I, J, width)``: offset of block (I, J), J <= I, of a band."""
    ti = get_initialised_taichi()

    @ti.func
    def locate_block(band, I, J, width):
        """Return the offset of the first column of block (I, J); `band` is the offset of the band."""
        return band + (I * width + J - I + width - 1) * BLOCK

    return locate_block


@cache
def make_add_lower_entry_function():
    """Return the Taichi function ``add_lower_entry(row, column, value, free, table)``.

    It adds `value` to an entry of the lower triangle of the matrix of the first `free` equations; other entries are
    ignored.
    """
    ti = get_initialised_taichi()
    vectors, locate_block = get_address_origin().field, make_locate_block_function()

    @ti.func
    def add_lower_entry(row, column, value, free, table: ti.template()):
        """Add `value` to an entry of the lower triangle; ignore entries above the diagonal or from row `free` on."""
        if row < free and column <= row:
            r = row % BLOCK
            at = locate_block(table[BandTableIndex.MATRIX], row // BLOCK, column // BLOCK,
                              table[BandTableIndex.WIDTH]) + column % BLOCK
            vectors[at][r] = vectors[at][r] + value

    return add_lower_entry


@cache
def make_subtract_earlier_products_function():
    """Return the Taichi function ``subtract_earlier_block_products(I, J, first, width, matrix, left, right)``.

    left(I, J) = matrix(I, J) - sum of left(I, K) right(J, K)^T over the block columns K from `first` to J - 1. Matrix,
    left and right are offsets of bands.
    """
    ti = get_initialised_taichi()
    vectors, locate_block = get_address_origin().field, make_locate_block_function()

    @ti.func
    def subtract_earlier_block_products(I, J, first, width, matrix, left, right):
        """Write matrix(I, J) minus the sum of left(I, K) right(J, K)^T over earlier columns K to left(I, J)."""
        source, target = locate_block(matrix, I, J, width), locate_block(left, I, J, width)
        # Eight columns stay in registers while all earlier blocks are subtracted.
        t0, t1, t2, t3 = vectors[source], vectors[source + 1], vectors[source + 2], vectors[source + 3]
        t4, t5, t6, t7 = vectors[source + 4], vectors[source + 5], vectors[source + 6], vectors[source + 7]
        for K in range(ti.max(first, J - width + 1), J):
            p, q = locate_block(left, I, K, width), locate_block(right, J, K, width)
            for k in range(BLOCK):
                a, b = vectors[p + k], vectors[q + k]
                t0 -= a * b[0]
                t1 -= a * b[1]
                t2 -= a * b[2]
                t3 -= a * b[3]
                t4 -= a * b[4]
                t5 -= a * b[5]
                t6 -= a * b[6]
                t7 -= a * b[7]
        vectors[target], vectors[target + 1], vectors[target + 2], vectors[target + 3] = t0, t1, t2, t3
        vectors[target + 4], vectors[target + 5], vectors[target + 6], vectors[target + 7] = t4, t5, t6, t7

    return subtract_earlier_block_products


@cache
def make_copy_lower_to_upper_band_function():
    """Return the Taichi function ``copy_lower_band_to_upper_band(table, begin, end)``.

    It copies the lower band of a symmetric matrix to the upper band, for block rows `begin` to `end` - 1.
    """
    ti = get_initialised_taichi()
    vectors = get_address_origin().field

    @ti.func
    def copy_lower_band_to_upper_band(table: ti.template(), begin, end):
        """Copy block rows `begin` to `end` - 1 of the lower band to the upper band, which stores the transpose."""
        lower, upper = table[BandTableIndex.MATRIX], table[BandTableIndex.MATRIX_UPPER]
        row = table[BandTableIndex.WIDTH] * BLOCK
        for i in range(begin * row, end * row):
            vectors[upper + i] = vectors[lower + i]

    return copy_lower_band_to_upper_band


@cache
def make_symmetrise_diagonal_blocks_function():
    """Return the Taichi function ``symmetrise_diagonal_blocks(table)``.

    It fills the upper triangles of the diagonal blocks of a symmetric matrix.
    """
    ti = get_initialised_taichi()
    vectors, locate_block = get_address_origin().field, make_locate_block_function()

    @ti.func
    def symmetrise_diagonal_blocks(table: ti.template()):
        """Copy the lower triangle of every diagonal block to its upper triangle."""
        lower, width = table[BandTableIndex.MATRIX], table[BandTableIndex.WIDTH]
        for I in range(table[BandTableIndex.ROWS]):
            diagonal = locate_block(lower, I, I, width)
            for c in range(BLOCK):
                for r in range(c):
                    vectors[diagonal + c][r] = vectors[diagonal + r][c]

    return symmetrise_diagonal_blocks


@cache
def make_fill_unused_diagonal_function():
    """Return the Taichi function ``fill_unused_diagonal(table, free)``.

    It sets the diagonal of the equations from `free` on to 1, which fill the last block.
    """
    ti = get_initialised_taichi()
    vectors, locate_block = get_address_origin().field, make_locate_block_function()

    @ti.func
    def fill_unused_diagonal(table: ti.template(), free):
        """Set the diagonal of the equations from `free` to the end of the last block to 1."""
        lower, width = table[BandTableIndex.MATRIX], table[BandTableIndex.WIDTH]
        for i in range(free, table[BandTableIndex.ROWS] * BLOCK):
            vectors[locate_block(lower, i // BLOCK, i // BLOCK, width) + i % BLOCK][i % BLOCK] = 1.0

    return fill_unused_diagonal


@cache
def make_add_unsymmetric_entry_function():
    """Return the Taichi function ``add_unsymmetric_entry(row, column, value, free, table)``.

    It adds `value` to an entry on either side of the diagonal of the matrix of the first `free` equations.
    """
    ti = get_initialised_taichi()
    vectors, locate_block = get_address_origin().field, make_locate_block_function()

    @ti.func
    def add_unsymmetric_entry(row, column, value, free, table: ti.template()):
        """Add `value` to an entry on either side of the diagonal; ignore rows and columns from `free` on."""
        if row < free and column < free:
            I, J, width = row // BLOCK, column // BLOCK, table[BandTableIndex.WIDTH]
            r, c = row % BLOCK, column % BLOCK
            if J <= I:
                at = locate_block(table[BandTableIndex.MATRIX], I, J, width) + c
                vectors[at][r] = vectors[at][r] + value
            else:
                to = locate_block(table[BandTableIndex.MATRIX_UPPER], J, I, width) + r
                vectors[to][c] = vectors[to][c] + value

    return add_unsymmetric_entry


@cache
def make_cholesky_functions() -> BandSolverFunctions:
    """Return the Taichi functions of L L^T; `try_factorising_band` fails if the matrix is not positive definite."""
    ti = get_initialised_taichi()
    vectors = get_address_origin().field
    locate_block = make_locate_block_function()
    subtract_block_products = make_subtract_earlier_products_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def try_factorising_band(table: ti.template(), begin, _skewed):
        """Write the Cholesky factor of the matrix; return 1, or 0 if the matrix is not positive definite."""
        ok = 1
        rows, width, matrix = table[BandTableIndex.ROWS], table[BandTableIndex.WIDTH], table[BandTableIndex.MATRIX]
        lower, inverse = table[BandTableIndex.LOWER], table[BandTableIndex.INVERSE]
        for I in range(begin, rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I + 1):
                subtract_block_products(I, J, first, width, matrix, lower, lower)
                block, diagonal = locate_block(lower, I, J, width), locate_block(lower, J, J, width)
                if J < I:
                    for c in range(BLOCK):
                        v = vectors[block + c]
                        for k in range(c):
                            v -= vectors[block + k] * vectors[diagonal + k][c]
                        vectors[block + c] = v * vectors[inverse + J][c]
                else:
                    for c in range(BLOCK):
                        v = vectors[block + c]
                        for k in range(c):
                            column = vectors[block + k]
                            v -= column * vectors[block + k][c]
                        vectors[block + c] = v
                        pivot = vectors[block + c][c]
                        # "not >" also fails for a NaN pivot.
                        if not pivot > 0.0:
                            ok = 0
                            pivot = 1.0
                        vectors[inverse + I][c] = 1.0 / ti.sqrt(pivot)
                        # `solve_band` relies on zeros above the diagonal.
                        vectors[block + c] = ti.select(lanes >= c, v * vectors[inverse + I][c], 0.0)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve_band(table: ti.template()):
        """Overwrite the right-hand side with the solution, by forward and backward substitution."""
        rows, width, lower = table[BandTableIndex.ROWS], table[BandTableIndex.WIDTH], table[BandTableIndex.LOWER]
        inverse, x = table[BandTableIndex.INVERSE], table[BandTableIndex.RIGHT]
        for I in range(rows):
            v = vectors[x + I]
            for J in range(ti.max(0, I - width + 1), I):
                block = locate_block(lower, I, J, width)
                y = vectors[x + J]
                for k in ti.static(range(BLOCK)):
                    v -= vectors[block + k] * y[k]
            diagonal = locate_block(lower, I, I, width)
            for c in ti.static(range(BLOCK)):
                value = v[c] * vectors[inverse + I][c]
                v += (unit[c] - vectors[diagonal + c]) * value
            vectors[x + I] = v
        for reverse in range(rows):
            I = rows - 1 - reverse
            v = vectors[x + I]
            for below in range(I + 1, ti.min(rows, I + width)):
                block = locate_block(lower, below, I, width)
                y = vectors[x + below]
                for k in ti.static(range(BLOCK)):
                    v -= unit[k] * vectors[block + k].dot(y)
            diagonal = locate_block(lower, I, I, width)
            for c in ti.static(range(BLOCK - 1, -1, -1)):
                column = vectors[diagonal + c]
                value = (v[c] * (1.0 + column[c]) - column.dot(v)) * vectors[inverse + I][c]
                v += unit[c] * (value - v[c])
            vectors[x + I] = v

    return BandSolverFunctions(try_factorising_band, solve_band)


@cache
def make_lu_functions() -> BandSolverFunctions:
    """Return the Taichi functions of L U (unit diagonal of L); `try_factorising_band` fails if a pivot is too small."""
    ti = get_initialised_taichi()
    vectors = get_address_origin().field
    locate_block = make_locate_block_function()
    subtract_block_products = make_subtract_earlier_products_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def try_factorising_band(table: ti.template(), begin, skewed):
        """Write the LU factors of the matrix; return 1, or 0 if a pivot is too small."""
        ok = 1
        rows, width, matrix = table[BandTableIndex.ROWS], table[BandTableIndex.WIDTH], table[BandTableIndex.MATRIX]
        matrix_upper, inverse = table[BandTableIndex.MATRIX_UPPER], table[BandTableIndex.INVERSE]
        lower, upper = table[BandTableIndex.LOWER], table[BandTableIndex.UPPER]
        for I in range(begin, rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I + 1):
                subtract_block_products(I, J, first, width, matrix, lower, upper)
                left, above = locate_block(lower, I, J, width), locate_block(upper, I, J, width)
                diagonal = locate_block(lower, J, J, width)
                if J < I:
                    if skewed <= J:
                        subtract_block_products(I, J, first, width, matrix_upper, upper, lower)
                        for c in range(BLOCK):
                            u = vectors[above + c]
                            for k in range(c):
                                u -= vectors[above + k] * vectors[diagonal + k][c]
                            vectors[above + c] = u
                    for c in range(BLOCK):
                        v = vectors[left + c]
                        for k in range(c):
                            v -= vectors[left + k] * vectors[diagonal + c][k]
                        if skewed > J:
                            vectors[above + c] = v
                        vectors[left + c] = v * vectors[inverse + J][c]
            block = locate_block(lower, I, I, width)
            for c in range(BLOCK):
                v = vectors[block + c]
                largest = ti.abs(v[c])
                for k in range(c):
                    v -= ti.select(lanes > k, vectors[block + k], 0.0) * v[k]
                pivot = v[c]
                # "not >" also fails for a NaN pivot.
                if not ti.abs(pivot) > 1e-14 * largest:
                    ok = 0
                    pivot = 1.0
                vectors[inverse + I][c] = 1.0 / pivot
                vectors[block + c] = ti.select(lanes > c, v / pivot, v)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve_band(table: ti.template()):
        """Overwrite the right-hand side with the solution, by forward and backward substitution."""
        rows, width, x = table[BandTableIndex.ROWS], table[BandTableIndex.WIDTH], table[BandTableIndex.RIGHT]
        lower, upper = table[BandTableIndex.LOWER], table[BandTableIndex.UPPER]
        inverse = table[BandTableIndex.INVERSE]
        for I in range(rows):
            v = vectors[x + I]
            for J in range(ti.max(0, I - width + 1), I):
                block = locate_block(lower, I, J, width)
                y = vectors[x + J]
                for k in ti.static(range(BLOCK)):
                    v -= vectors[block + k] * y[k]
            diagonal = locate_block(lower, I, I, width)
            for c in ti.static(range(BLOCK)):
                v -= ti.select(lanes > c, vectors[diagonal + c], 0.0) * v[c]
            vectors[x + I] = v
        for reverse in range(rows):
            I = rows - 1 - reverse
            v = vectors[x + I]
            for below in range(I + 1, ti.min(rows, I + width)):
                block = locate_block(upper, below, I, width)
                y = vectors[x + below]
                for k in ti.static(range(BLOCK)):
                    v -= unit[k] * vectors[block + k].dot(y)
            diagonal = locate_block(lower, I, I, width)
            for c in ti.static(range(BLOCK - 1, -1, -1)):
                value = v[c] * vectors[inverse + I][c]
                v -= ti.select(lanes < c, vectors[diagonal + c], 0.0) * value
                v += unit[c] * (value - v[c])
            vectors[x + I] = v

    return BandSolverFunctions(try_factorising_band, solve_band)
