"""Band LU of tangents of slipping contact, and band Cholesky, against scipy."""

import numpy as np
import pytest
from scipy.linalg import solve_banded, solveh_banded

from tissue_sim.fem.linear import band
from tissue_sim.fem.linear.band import make_cholesky_functions, make_lu_functions
from tissue_sim.fem.taichi.origins import allocate_array
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


def kernels(functions: band.BandSolverFunctions):
    """A kernel that completes a symmetric matrix, adds entries (row, column, value) to it and factorises it from one
    block row on, and one that solves."""
    ti = get_initialised_taichi()
    complete, mirror = band.make_symmetrise_diagonal_blocks_function(), band.make_copy_lower_to_upper_band_function()
    add_any = band.make_add_unsymmetric_entry_function()
    init, solve = functions
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)
    places, numbers = ti.types.ndarray(dtype=ti.i32, ndim=2), ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    def run_init(free: ti.i32, begin: ti.i32, skewed: ti.i32, place: places, value: reals, table: numbers,
                 good: numbers):
        ti.loop_config(serialize=True)
        for _ in range(1):
            if begin == 0:
                complete(table)
                mirror(table, skewed, table[band.BandTableIndex.ROWS])
            for i in range(value.shape[0]):
                add_any(place[i, 0], place[i, 1], value[i], free, table)
            good[0] = init(table, begin, skewed)

    @ti.kernel
    def run_solve(table: numbers):
        ti.loop_config(serialize=True)
        for _ in range(1):
            solve(table)

    return run_init, run_solve


@pytest.fixture(scope="module")
def lu():
    return kernels(make_lu_functions())


@pytest.fixture(scope="module")
def cholesky():
    return kernels(make_cholesky_functions())


def factorised(functions, lower: np.ndarray, added: np.ndarray, skewed: int = 0, later: np.ndarray | None = None):
    """A function from a right-hand side to the solution, for a symmetric matrix in LAPACK's lower band storage plus
    entries (row, column, value), and others `later`, after a first factorisation; and whether it was good. All entries
    that are not symmetric stand in the block row `skewed` and column or behind."""
    run_init, run_solve = functions
    size, packed = lower.shape[1], band.pack_lapack_band_to_blocks(lower)
    rows = len(packed)
    matrix, upper, factor, upper_factor = (allocate_array(packed.shape) for _ in range(4))
    matrix[:] = packed
    # Entries that must not be read are NaN.
    for array in (upper, factor, upper_factor):
        array[:] = np.nan
    inverse, x, good = allocate_array((rows, band.BLOCK)), allocate_array((rows, band.BLOCK)), np.zeros(1, np.int32)
    table = band.make_band_table(matrix, upper, factor, upper_factor, inverse, x)
    for more in (added, later):
        if more is None:
            continue
        place, value = np.ascontiguousarray(more[:, :2], np.int32), np.ascontiguousarray(more[:, 2])
        begin = 0 if more is added else int(place.min()) // band.BLOCK
        run_init(size, begin, skewed, place, value, table, good)

    def solution(right):
        # The arrays are kept alive by this function.
        assert band.make_band_table(matrix, upper, factor, upper_factor, inverse, x).tolist() == table.tolist()
        x[:] = 0.0
        x.ravel()[:size] = right
        run_solve(table)
        return x.ravel()[:size].copy()

    return solution, bool(good[0])


def lapack_bands(matrix: np.ndarray, half_band: int) -> np.ndarray:
    """Rows of `scipy.linalg.solve_banded`: diagonal half_band first."""
    size = len(matrix)
    bands = np.zeros((2 * half_band + 1, size))
    for d in range(-half_band, half_band + 1):
        bands[half_band - d, max(d, 0): size + min(d, 0)] = np.diagonal(matrix, d)
    return bands


def solved(functions, symmetric: np.ndarray, half_band: int, added: np.ndarray, right: np.ndarray):
    """The solution for a symmetric band matrix plus entries (row, column, value), and whether it was good."""
    lower = np.stack([np.append(np.diagonal(symmetric, -d), np.zeros(d)) for d in range(half_band + 1)])
    solution, good = factorised(functions, lower, added)
    x = solution(right)
    # The same factors, once more.
    np.testing.assert_array_equal(solution(right), x)
    return x, good


def problem(size: int, half_band: int, entries: int, seed: int = 0):
    """A symmetric, positive definite band matrix, entries to add on either side of its diagonal, a right-hand side."""
    rng = np.random.default_rng(seed)
    i, j = np.indices((size, size))
    half = rng.normal(size=(size, size)) * (abs(i - j) <= half_band)
    symmetric = half + half.T
    symmetric[np.arange(size), np.arange(size)] = abs(symmetric).sum(axis=1) + 1.0
    inside = np.argwhere(abs(i - j) <= half_band)
    place = inside[rng.integers(len(inside), size=entries)]
    return symmetric, np.column_stack([place, rng.normal(size=entries)]), rng.normal(size=size)


@pytest.mark.parametrize(("size", "half_band", "entries"), [
    (1, 0, 1), (7, 3, 5), (8, 7, 20), (16, 8, 1), (23, 5, 60), (96, 31, 300), (279, 43, 400), (479, 53, 50)])
def test_against_lapack(lu, size, half_band, entries):
    symmetric, added, right = problem(size, half_band, entries)
    x, good = solved(lu, symmetric, half_band, added, right)
    matrix = symmetric.copy()
    np.add.at(matrix, tuple(added[:, :2].astype(int).T), added[:, 2])
    assert size == 1 or abs(matrix - matrix.T).max() > 0.1
    expected = solve_banded((half_band, half_band), lapack_bands(matrix, half_band), right)
    assert good
    np.testing.assert_allclose(x, expected, rtol=1e-11, atol=1e-12 * abs(expected).max())


@pytest.mark.parametrize(("size", "half_band", "skewed", "later"), [
    (64, 9, 0, 3), (96, 31, 4, 6), (96, 31, 7, 7), (350, 47, 20, 33), (350, 47, 20, 20), (350, 47, 44, 12)])
def test_entries_that_come_later_cost_the_rows_behind_them(lu, size, half_band, skewed, later):
    """And where the matrix is symmetric its upper half need not be there."""
    symmetric, _, right = problem(size, half_band, 1)
    rng = np.random.default_rng(1)
    rows = [rng.integers(first * band.BLOCK, size, (40, 2)) if first * band.BLOCK < size else np.zeros((0, 2), int)
            for first in (skewed, max(skewed, later))]
    added, more = (np.column_stack([row, rng.normal(size=len(row))])[abs(row[:, 0] - row[:, 1]) <= half_band]
                   for row in rows)
    # On the diagonal nothing is skewed, however far before.
    diagonal = np.array([[later * band.BLOCK, later * band.BLOCK, 2.0]])
    more = np.concatenate([more, diagonal])
    lower = np.stack([np.append(np.diagonal(symmetric, -d), np.zeros(d)) for d in range(half_band + 1)])
    solution, good = factorised(lu, lower, added, skewed, more)
    matrix = symmetric.copy()
    for each in (added, more):
        np.add.at(matrix, tuple(each[:, :2].astype(int).T), each[:, 2])
    assert good
    np.testing.assert_allclose(solution(right), np.linalg.solve(matrix, right), rtol=1e-11, atol=1e-13)


def test_symmetric_matrix_is_the_case_without_entries(lu):
    symmetric, _, right = problem(50, 12, 1)
    x, good = solved(lu, symmetric, 12, np.zeros((0, 3)), right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(symmetric, right), rtol=1e-12)


def test_entries_beyond_the_equations_are_left_out(lu):
    """Prescribed freedoms are numbered behind the free ones."""
    symmetric, _, right = problem(20, 6, 1)
    outside = np.array([[20.0, 3.0, 1e9], [3.0, 20.0, 1e9], [25.0, 25.0, 1e9]])
    x, good = solved(lu, symmetric, 6, outside, right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(symmetric, right), rtol=1e-12)


@pytest.mark.parametrize("pivot", [0.0, np.nan])
def test_a_pivot_that_vanishes_is_noticed(lu, pivot):
    symmetric, _, right = problem(30, 4, 1)
    symmetric[11, :] = symmetric[:, 11] = 0.0
    symmetric[11, 11] = pivot
    assert not solved(lu, symmetric, 4, np.zeros((0, 3)), right)[1]


def test_an_indefinite_matrix_is_factorised(lu):
    """Cholesky would refuse it; a tangent with slip may be like that."""
    symmetric, added, right = problem(60, 9, 100)
    symmetric[17, 17] *= -1.0
    matrix = symmetric.copy()
    np.add.at(matrix, tuple(added[:, :2].astype(int).T), added[:, 2])
    assert np.linalg.eigvals(matrix).real.min() < 0
    x, good = solved(lu, symmetric, 9, added, right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(matrix, right), rtol=1e-9)


@pytest.mark.parametrize(("size", "half_band"), [(37, 5), (64, 8), (1, 0), (200, 44), (150, 149)])
def test_cholesky_against_lapack(cholesky, size, half_band):
    rng = np.random.default_rng(size)
    lower = rng.normal(size=(half_band + 1, size))
    lower[0] = 3 * half_band + 1
    for d in range(1, half_band + 1):
        lower[d, size - d:] = 0
    np.testing.assert_array_equal(band.unpack_blocks_to_lapack_band(band.pack_lapack_band_to_blocks(lower), size,
                                                                    half_band), lower)
    solution, good = factorised(cholesky, lower, np.zeros((0, 3)))
    assert good
    for right in rng.normal(size=(2, size)):
        np.testing.assert_allclose(solution(right), solveh_banded(lower, right, lower=True), rtol=1e-12, atol=1e-15)
    lower[0, size // 2] = -1.0
    assert not factorised(cholesky, lower, np.zeros((0, 3)))[1]
