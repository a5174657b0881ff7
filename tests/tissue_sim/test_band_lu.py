"""Band LU of tangents of slipping contact, against scipy."""

import numpy as np
import pytest
from scipy.linalg import solve_banded

from tissue_sim.fem.linear import band
from tissue_sim.fem.linear.lu import BAND_LU
from tissue_sim.fem.taichi.runtime import initialise


@pytest.fixture(scope="module")
def kernel():
    """Kernel that completes a symmetric matrix, adds entries (row, column, value) to it, factorises it and solves."""
    ti = initialise()
    mirror, add_any = band.mirror_function(), band.add_any_function()
    init, solve = BAND_LU.functions()
    block = ti.types.vector(band.BLOCK, ti.f64)
    blocks, entries, inverses, vectors = (
        ti.types.ndarray(dtype=block, ndim=3), ti.types.ndarray(dtype=ti.f64, ndim=4),
        ti.types.ndarray(dtype=ti.f64, ndim=1), ti.types.ndarray(dtype=block, ndim=1))
    places, numbers = ti.types.ndarray(dtype=ti.i32, ndim=2), ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    def run(free: ti.i32, rows: ti.i32, width: ti.i32, place: places, value: inverses, lower: blocks,
            lower_entries: entries, upper: blocks, upper_entries: entries, inverse: inverses, x: vectors,
            good: numbers):
        ti.loop_config(serialize=True)
        for _ in range(1):
            mirror(lower, upper, rows, width)
            for i in range(value.shape[0]):
                add_any(place[i, 0], place[i, 1], value[i], free, width, lower_entries, upper_entries)
            good[0] = init(lower, upper, inverse, rows, width)
            solve(lower, upper, inverse, x, rows, width)

    return run


def lapack_bands(matrix: np.ndarray, half_band: int) -> np.ndarray:
    """Rows of `scipy.linalg.solve_banded`: diagonal half_band first."""
    size = len(matrix)
    bands = np.zeros((2 * half_band + 1, size))
    for d in range(-half_band, half_band + 1):
        bands[half_band - d, max(d, 0): size + min(d, 0)] = np.diagonal(matrix, d)
    return bands


def solved(kernel, symmetric: np.ndarray, half_band: int, added: np.ndarray, right: np.ndarray):
    """The kernel's solution for a symmetric band matrix plus entries (row, column, value), and whether it was good."""
    size = len(symmetric)
    lower = band.pack(np.stack([np.append(np.diagonal(symmetric, -d), np.zeros(d)) for d in range(half_band + 1)]))
    rows, width = lower.shape[:2]
    upper, inverse, x = np.zeros_like(lower), np.zeros(rows * band.BLOCK), np.zeros((rows, band.BLOCK))
    x.ravel()[:size] = right
    good = np.zeros(1, np.int32)
    place, value = np.ascontiguousarray(added[:, :2], np.int32), np.ascontiguousarray(added[:, 2])
    kernel(size, rows, width, place, value, lower, lower, upper, upper, inverse, x, good)
    return x.ravel()[:size], bool(good[0])


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
def test_against_lapack(kernel, size, half_band, entries):
    symmetric, added, right = problem(size, half_band, entries)
    x, good = solved(kernel, symmetric, half_band, added, right)
    matrix = symmetric.copy()
    np.add.at(matrix, tuple(added[:, :2].astype(int).T), added[:, 2])
    assert size == 1 or abs(matrix - matrix.T).max() > 0.1
    expected = solve_banded((half_band, half_band), lapack_bands(matrix, half_band), right)
    assert good
    np.testing.assert_allclose(x, expected, rtol=1e-11, atol=1e-12 * abs(expected).max())
    # For Python callers: the same factors, once more.
    factors = BAND_LU.init(lapack_bands(matrix, half_band))
    for _ in range(2):
        np.testing.assert_array_equal(BAND_LU.solve(factors, right), x)


def test_symmetric_matrix_is_the_case_without_entries(kernel):
    symmetric, _, right = problem(50, 12, 1)
    x, good = solved(kernel, symmetric, 12, np.zeros((0, 3)), right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(symmetric, right), rtol=1e-12)


def test_entries_beyond_the_equations_are_left_out(kernel):
    """Prescribed freedoms are numbered behind the free ones."""
    symmetric, _, right = problem(20, 6, 1)
    outside = np.array([[20.0, 3.0, 1e9], [3.0, 20.0, 1e9], [25.0, 25.0, 1e9]])
    x, good = solved(kernel, symmetric, 6, outside, right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(symmetric, right), rtol=1e-12)


@pytest.mark.parametrize("pivot", [0.0, np.nan])
def test_a_pivot_that_vanishes_is_noticed(kernel, pivot):
    symmetric, _, right = problem(30, 4, 1)
    symmetric[11, :] = symmetric[:, 11] = 0.0
    symmetric[11, 11] = pivot
    assert not solved(kernel, symmetric, 4, np.zeros((0, 3)), right)[1]


def test_an_indefinite_matrix_is_factorised(kernel):
    """Cholesky would refuse it; a tangent with slip may be like that."""
    symmetric, added, right = problem(60, 9, 100)
    symmetric[17, 17] *= -1.0
    matrix = symmetric.copy()
    np.add.at(matrix, tuple(added[:, :2].astype(int).T), added[:, 2])
    assert np.linalg.eigvals(matrix).real.min() < 0
    x, good = solved(kernel, symmetric, 9, added, right)
    assert good
    np.testing.assert_allclose(x, np.linalg.solve(matrix, right), rtol=1e-9)
