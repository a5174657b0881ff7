"""Band LU factorisation and solution, without pivoting, for use inside Taichi kernels.

For tangents of slipping contact: those of the tissue, which are symmetric and positive definite, with a few entries
beside. The matrix is kept as two lower bands in the blocks of `tissue_sim.fem.linear.band`: its own lower triangle,
with the whole blocks of the diagonal, and that of its transpose. So rows of U stand where columns of L do, and both
halves of the factorisation run like that of Cholesky.
"""

from functools import cache

from tissue_sim.fem.linear.band import BLOCK, subtract_function
from tissue_sim.fem.taichi.runtime import initialise


@cache
def functions():
    """Taichi functions of a matrix in ``lower`` and ``upper``, each (rows, width) blocks.

    ``mirror(lower, upper, rows, width)`` completes a symmetric matrix of which only the lower triangle is filled in;
    ``add_any(row, column, value, free, width, lower, upper)`` adds to an entry on either side of the diagonal.
    ``factorise(lower, upper, inverse, rows, width) -> int`` overwrites both by the factors, L with a unit diagonal, and
    `inverse` (rows * BLOCK) by the reciprocals of U's; 0 where a pivot is too small against its column.
    ``solve(lower, upper, inverse, x, rows, width)`` overwrites x.
    """
    ti = initialise()
    subtract = subtract_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def mirror(lower: ti.template(), upper: ti.template(), rows, width):
        for I in range(rows):
            for w in range(width):
                for c in range(BLOCK):
                    upper[I, w, c] = lower[I, w, c]
            for c in range(BLOCK):
                # Above the diagonal of the diagonal block.
                for r in range(c):
                    lower[I, width - 1, c][r] = lower[I, width - 1, r][c]

    @ti.func
    def add_any(row, column, value, free, width, lower: ti.template(), upper: ti.template()):
        if row < free and column < free:
            I, J = row // BLOCK, column // BLOCK
            r, c = row % BLOCK, column % BLOCK
            if J <= I:
                lower[I, J - I + width - 1, c, r] = lower[I, J - I + width - 1, c, r] + value
            else:
                upper[J, I - J + width - 1, r, c] = upper[J, I - J + width - 1, r, c] + value

    @ti.func
    def factorise(lower: ti.template(), upper: ti.template(), inverse: ti.template(), rows, width):
        ok = 1
        for I in range(rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I):
                w = J - I + width - 1
                subtract(I, J, first, width, lower, upper)
                subtract(I, J, first, width, upper, lower)
                for c in range(BLOCK):
                    v, u = lower[I, w, c], upper[I, w, c]
                    for k in range(c):
                        v -= lower[I, w, k] * lower[J, width - 1, c][k]
                        u -= upper[I, w, k] * lower[J, width - 1, k][c]
                    lower[I, w, c], upper[I, w, c] = v * inverse[J * BLOCK + c], u
            subtract(I, I, first, width, lower, upper)
            for c in range(BLOCK):
                v = lower[I, width - 1, c]
                largest = ti.abs(v[c])
                for k in range(c):
                    v -= ti.select(lanes > k, lower[I, width - 1, k], 0.0) * v[k]
                pivot = v[c]
                # Written so that a NaN pivot fails too.
                if not ti.abs(pivot) > 1e-14 * largest:
                    ok = 0
                    pivot = 1.0
                inverse[I * BLOCK + c] = 1.0 / pivot
                lower[I, width - 1, c] = ti.select(lanes > c, v / pivot, v)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve(lower: ti.template(), upper: ti.template(), inverse: ti.template(), x: ti.template(), rows, width):
        for I in range(rows):
            v = x[I]
            for J in range(ti.max(0, I - width + 1), I):
                w = J - I + width - 1
                y = x[J]
                for k in ti.static(range(BLOCK)):
                    v -= lower[I, w, k] * y[k]
            for c in ti.static(range(BLOCK)):
                v -= ti.select(lanes > c, lower[I, width - 1, c], 0.0) * v[c]
            x[I] = v
        for reverse in range(rows):
            I = rows - 1 - reverse
            v = x[I]
            for below in range(I + 1, ti.min(rows, I + width)):
                w = I - below + width - 1
                y = x[below]
                for k in ti.static(range(BLOCK)):
                    v -= unit[k] * upper[below, w, k].dot(y)
            for c in ti.static(range(BLOCK - 1, -1, -1)):
                value = v[c] * inverse[I * BLOCK + c]
                v -= ti.select(lanes < c, lower[I, width - 1, c], 0.0) * value
                v += unit[c] * (value - v[c])
            x[I] = v

    return mirror, add_any, factorise, solve
