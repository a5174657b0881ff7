"""Band LU factorisation without pivoting, for tangents of slipping contact.

Such a tangent is symmetric and positive definite but for a few entries of friction. U is stored by rows where L is
stored by columns, so that both halves run like the Cholesky factorisation. In a symmetric part of the matrix U is the
diagonal times L^T, so that one half is enough.
"""

from functools import cache

from tissue_sim.fem.linear.band import BLOCK, BandSolverFunctions, make_subtract_earlier_products_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


@cache
def make_lu_functions() -> BandSolverFunctions:
    """Return the Taichi functions of L U (unit diagonal of L); `factorise_band` fails if a pivot is too small."""
    ti = get_initialised_taichi()
    subtract_block_products = make_subtract_earlier_products_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def factorise_band(matrix: ti.template(), matrix_upper: ti.template(), lower: ti.template(), upper: ti.template(),
                       inverse: ti.template(), rows, width, begin, skewed):
        """Write the LU factors of the matrix to `lower` and `upper`; return 1, or 0 if a pivot is too small."""
        ok = 1
        for I in range(begin, rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I + 1):
                w = J - I + width - 1
                subtract_block_products(I, J, first, width, matrix, lower, upper)
                if J < I:
                    if skewed <= J:
                        subtract_block_products(I, J, first, width, matrix_upper, upper, lower)
                        for c in range(BLOCK):
                            u = upper[I, w, c]
                            for k in range(c):
                                u -= upper[I, w, k] * lower[J, width - 1, k][c]
                            upper[I, w, c] = u
                    for c in range(BLOCK):
                        v = lower[I, w, c]
                        for k in range(c):
                            v -= lower[I, w, k] * lower[J, width - 1, c][k]
                        if skewed > J:
                            upper[I, w, c] = v
                        lower[I, w, c] = v * inverse[J * BLOCK + c]
            for c in range(BLOCK):
                v = lower[I, width - 1, c]
                largest = ti.abs(v[c])
                for k in range(c):
                    v -= ti.select(lanes > k, lower[I, width - 1, k], 0.0) * v[k]
                pivot = v[c]
                # "not >" also fails for a NaN pivot.
                if not ti.abs(pivot) > 1e-14 * largest:
                    ok = 0
                    pivot = 1.0
                inverse[I * BLOCK + c] = 1.0 / pivot
                lower[I, width - 1, c] = ti.select(lanes > c, v / pivot, v)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve_band(lower: ti.template(), upper: ti.template(), inverse: ti.template(), x: ti.template(), rows, width):
        """Overwrite the right-hand side x with the solution, by forward and backward substitution."""
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

    return BandSolverFunctions(factorise_band, solve_band)
