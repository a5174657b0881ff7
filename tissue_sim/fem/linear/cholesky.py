"""Band Cholesky factorisation L L^T of symmetric positive definite tangents."""

from functools import cache

from tissue_sim.fem.linear.band import BLOCK, BandSolverFunctions, make_subtract_earlier_products_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


@cache
def make_cholesky_functions() -> BandSolverFunctions:
    """Return the Taichi functions of L L^T; `factorise_band` fails if the matrix is not positive definite."""
    ti = get_initialised_taichi()
    subtract_block_products = make_subtract_earlier_products_function()
    lanes = ti.Vector(list(range(BLOCK)))
    unit = [ti.Vector([float(i == c) for i in range(BLOCK)]) for c in range(BLOCK)]

    @ti.func
    def factorise_band(matrix: ti.template(), _matrix_upper: ti.template(), band: ti.template(), _upper: ti.template(),
                       inverse: ti.template(), rows, width, begin, _skewed):
        """Write the Cholesky factor of `matrix` to `band`; return 1, or 0 if `matrix` is not positive definite."""
        ok = 1
        for I in range(begin, rows):
            first = ti.max(0, I - width + 1)
            for J in range(first, I + 1):
                w = J - I + width - 1
                subtract_block_products(I, J, first, width, matrix, band, band)
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
                        # "not >" also fails for a NaN pivot.
                        if not pivot > 0.0:
                            ok = 0
                            pivot = 1.0
                        inverse[I * BLOCK + c] = 1.0 / ti.sqrt(pivot)
                        # `solve_band` relies on zeros above the diagonal.
                        band[I, w, c] = ti.select(lanes >= c, v * inverse[I * BLOCK + c], 0.0)
            if ok == 0:
                break
        return ok

    @ti.func
    def solve_band(band: ti.template(), _upper: ti.template(), inverse: ti.template(), x: ti.template(), rows, width):
        """Overwrite the right-hand side x with the solution, by forward and backward substitution."""
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

    return BandSolverFunctions(factorise_band, solve_band)
