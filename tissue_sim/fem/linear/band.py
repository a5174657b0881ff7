"""Band Cholesky factorisation and solution for use inside Taichi kernels.

The lower band is cut into square blocks of `BLOCK` columns. Block (I, J) of block row I lies at ``band[I, w]`` with
``w = J - I + width - 1``; it is stored by columns, each a vector over its `BLOCK` rows, so that the inner products
of the factorisation run on whole vectors.
"""

from functools import cache

import numpy as np

from tissue_sim.fem.taichi.runtime import initialise

BLOCK = 8


def block_shape(size: int, half_band: int) -> tuple[int, int]:
    """Block rows and blocks per row of a band matrix of `size` equations."""
    return max(1, -(-size // BLOCK)), -(-half_band // BLOCK) + 1


def pack(lower: np.ndarray) -> np.ndarray:
    """LAPACK's lower band storage, shape (half_band + 1, n), as blocks, shape (rows, width, BLOCK, BLOCK)."""
    half_band, size = lower.shape[0] - 1, lower.shape[1]
    rows, width = block_shape(size, half_band)
    band = np.zeros((rows, width, BLOCK, BLOCK))
    for d in range(half_band + 1):
        j = np.arange(size - d)
        i = j + d
        band[i // BLOCK, j // BLOCK - i // BLOCK + width - 1, j % BLOCK, i % BLOCK] = lower[d, : size - d]
    for i in range(size, rows * BLOCK):
        band[i // BLOCK, width - 1, i % BLOCK, i % BLOCK] = 1.0
    return band


def unpack(blocks: np.ndarray, size: int, half_band: int) -> np.ndarray:
    """The inverse of `pack`: LAPACK's lower band storage, shape (half_band + 1, size)."""
    width = blocks.shape[1]
    lower = np.zeros((half_band + 1, size))
    for d in range(half_band + 1):
        j = np.arange(size - d)
        i = j + d
        lower[d, : size - d] = blocks[i // BLOCK, j // BLOCK - i // BLOCK + width - 1, j % BLOCK, i % BLOCK]
    return lower


@cache
def add_entry_function():
    """Taichi function ``add_entry(row, column, value, free, width, band)``: add to the lower half of the matrix of the
    first `free` equations."""
    ti = initialise()

    @ti.func
    def add_entry(row, column, value, free, width, band: ti.template()):
        if row < free and column <= row:
            I, J = row // BLOCK, column // BLOCK
            w, c, r = J - I + width - 1, column % BLOCK, row % BLOCK
            band[I, w, c, r] = band[I, w, c, r] + value

    return add_entry


@cache
def subtract_function():
    """Taichi function ``subtract(I, J, first, width, left, right)``: left(I, J) -= sum over the block columns K from
    `first` to before J of left(I, K) right(J, K)^T."""
    ti = initialise()

    @ti.func
    def subtract(I, J, first, width, left: ti.template(), right: ti.template()):
        w = J - I + width - 1
        # Eight columns stay in registers while all earlier blocks are subtracted.
        t0, t1, t2, t3 = left[I, w, 0], left[I, w, 1], left[I, w, 2], left[I, w, 3]
        t4, t5, t6, t7 = left[I, w, 4], left[I, w, 5], left[I, w, 6], left[I, w, 7]
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

    return subtract


@cache
def functions():
    """Taichi functions ``factorise(band, inverse, rows, width) -> int`` and ``solve(band, inverse, x, rows, width)``.

    `band` is overwritten by its Cholesky factor, `inverse` (rows * BLOCK) by the reciprocal of its diagonal.
    `factorise` returns 1, or 0 when the matrix is not positive definite. `solve` overwrites x.
    """
    ti = initialise()
    subtract = subtract_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def factorise(band: ti.template(), inverse: ti.template(), rows, width):
        ok = 1
        for I in range(rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I + 1):
                w = J - I + width - 1
                subtract(I, J, first, width, band, band)
                if J < I:
                    for c in range(BLOCK):
                        v = band[I, w, c]
                        for k in range(c):
                            v -= band[I, w, k] * band[J, width - 1, k][c]
                        band[I, w, c] = v * inverse[J * BLOCK + c]
                else:
                    for c in range(BLOCK):
                        v = band[I, w, c]
                        for k in range(c):
                            column = band[I, w, k]
                            v -= column * band[I, w, k][c]
                        band[I, w, c] = v
                        pivot = band[I, w, c][c]
                        # Written so that a NaN pivot fails too.
                        if not pivot > 0.0:
                            ok = 0
                            pivot = 1.0
                        inverse[I * BLOCK + c] = 1.0 / ti.sqrt(pivot)
                        # Zeros above the diagonal, which `solve` relies on.
                        band[I, w, c] = ti.select(lanes >= c, v * inverse[I * BLOCK + c], 0.0)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve(band: ti.template(), inverse: ti.template(), x: ti.template(), rows, width):
        for I in range(rows):
            v = x[I]
            for J in range(ti.max(0, I - width + 1), I):
                w = J - I + width - 1
                y = x[J]
                for k in ti.static(range(BLOCK)):
                    v -= band[I, w, k] * y[k]
            for c in ti.static(range(BLOCK)):
                value = v[c] * inverse[I * BLOCK + c]
                v += (unit[c] - band[I, width - 1, c]) * value
            x[I] = v
        for reverse in range(rows):
            I = rows - 1 - reverse
            v = x[I]
            for below in range(I + 1, ti.min(rows, I + width)):
                w = I - below + width - 1
                y = x[below]
                for k in ti.static(range(BLOCK)):
                    v -= unit[k] * band[below, w, k].dot(y)
            for c in ti.static(range(BLOCK - 1, -1, -1)):
                column = band[I, width - 1, c]
                value = (v[c] * (1.0 + column[c]) - column.dot(v)) * inverse[I * BLOCK + c]
                v += unit[c] * (value - v[c])
            x[I] = v

    return factorise, solve
