"""Factors of sparse matrices: the same contract for every library."""

import importlib.util

import numpy as np
import pytest
from scipy import sparse

from tissue_sim.fem.linear.sparse import factorise_or_none, get_pardiso_or_scipy_name


@pytest.fixture(params=["scipy", "pardiso"])
def chosen(request, monkeypatch):
    if request.param == "pardiso" and importlib.util.find_spec("pypardiso") is None:
        pytest.skip("asks Intel's Pardiso, which is an extra of 200 MB; pip install tissue_sim[pardiso]")
    monkeypatch.setenv("TISSUE_SIM_SPARSE", request.param)
    assert get_pardiso_or_scipy_name() == request.param
    return request.param


def laplacian(n=12, shift=0.0):
    """Return the Laplacian of an n x n grid plus a multiple of one; smallest eigenvalue 8 sin^2(pi / (2 n + 2))."""
    line = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    one = sparse.eye_array(n)
    matrix = sparse.csc_array(sparse.kron(line, one) + sparse.kron(one, line) + shift * sparse.eye_array(n * n))
    matrix.sort_indices()
    return matrix


def test_solutions(chosen):
    rng = np.random.default_rng(2)
    for matrix, symmetric in ((laplacian(), True),
                              (sparse.csc_array(laplacian() + sparse.diags_array([0.3] * 143, offsets=1)), False)):
        matrix.sort_indices()
        factor = factorise_or_none(matrix, symmetric=symmetric)
        for right in (rng.normal(size=144), rng.normal(size=(144, 6))):
            np.testing.assert_allclose(matrix @ factor.solve(right), right, atol=1e-12)


def test_whether_a_symmetric_matrix_is_definite(chosen):
    least = 8.0 * np.sin(np.pi / 26.0) ** 2
    assert factorise_or_none(laplacian(shift=-0.99 * least), symmetric=True).definite
    below = factorise_or_none(laplacian(shift=-1.01 * least), symmetric=True)
    assert below is None or not below.definite


def test_a_singular_matrix_has_no_factor_that_is_believed(chosen):
    matrix = sparse.csc_array(([1.0, 0.0, 2.0], [0, 1, 2], [0, 1, 2, 3]), shape=(3, 3))
    factor = factorise_or_none(matrix, symmetric=True)
    assert factor is None or not factor.definite


def _large(shift=0.0, skewed=0.0):
    """Return the Laplacian of a 40 x 40 grid with single-precision factors; smallest eigenvalue 8 sin^2(pi / 82)."""
    matrix = laplacian(40, shift)
    if skewed:
        matrix = sparse.csc_array(matrix + sparse.diags_array([skewed] * 1599, offsets=1))
        matrix.sort_indices()
    return matrix


def test_solutions_of_large_matrices_are_in_double_precision(chosen):
    rng = np.random.default_rng(3)
    for matrix, symmetric in ((_large(), True), (_large(skewed=0.3), False)):
        factor = factorise_or_none(matrix, symmetric=symmetric)
        for right in (rng.normal(size=1600), 1e-50 * rng.normal(size=(1600, 6)), np.zeros(1600)):
            left = np.linalg.norm(matrix @ factor.solve(right) - right, axis=0)
            assert (left <= 2e-10 * np.linalg.norm(right, axis=0)).all()


def test_a_factor_keeps_its_matrix_when_the_numbers_change(chosen):
    matrix, right = _large(), np.ones(1600)
    factor = factorise_or_none(matrix, symmetric=True)
    before = factor.solve(right)
    matrix.data *= 3.0
    np.testing.assert_array_equal(factor.solve(right), before)


@pytest.mark.parametrize("share", [1e-2, 1e-4, 1e-6, 1e-8])
def test_whether_a_large_matrix_is_definite_is_seen_in_double_precision(chosen, share):
    """Eigenvalues of 1e-2 to 1e-8 of the matrix's, of either sign; single precision has seven digits."""
    least, vector = 8.0 * np.sin(np.pi / 82.0) ** 2, np.linspace(0.5, 1.5, 1600)
    for sign in (1.0, -1.0):
        matrix = _large(shift=-least + sign * share * least)
        scaled = sparse.csc_array(sparse.diags_array(vector) @ matrix @ sparse.diags_array(vector))
        scaled.sort_indices()
        factor = factorise_or_none(scaled, symmetric=True)
        assert (factor is not None and factor.definite) == (sign > 0.0)
