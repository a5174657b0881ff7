"""Band Cholesky factorisation L L^T of symmetric positive definite tangents."""

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
