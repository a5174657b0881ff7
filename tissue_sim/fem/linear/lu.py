"""Band LU factorisation without pivoting, for tangents of slipping contact.

Such a tangent is symmetric and positive definite but for a few entries of friction. U is stored by rows where L is
stored by columns, so that both halves run like the Cholesky factorisation. In a symmetric part of the matrix U is the
diagonal times L^T, so that one half is enough.
"""

from functools import cache

from tissue_sim.fem.linear.band import (
    BLOCK,
    BandSolverFunctions,
    BandTableIndex,
    make_locate_block_function,
    make_subtract_earlier_products_function,
)
from tissue_sim.fem.taichi.origins import get_address_origin
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


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
