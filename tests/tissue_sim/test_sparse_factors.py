"""Factors of sparse matrices: the same contract for every library."""

import importlib.util

import numpy as np
import pytest
from scipy import sparse

from tissue_sim.fem.linear.sparse import factorise, library


@pytest.fixture(params=["scipy", "pardiso"])
def chosen(request, monkeypatch):
    if request.param == "pardiso" and importlib.util.find_spec("pypardiso") is None:
        pytest.skip("asks Intel's Pardiso, which is an extra of 200 MB; pip install tissue_sim[pardiso]")
    monkeypatch.setenv("TISSUE_SIM_SPARSE", request.param)
    assert library() == request.param
    return request.param


def laplacian(n=12, shift=0.0):
    """Of a grid, n x n, plus a multiple of one; its least eigenvalue is 8 sin^2(pi / (2 n + 2))."""
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
        factor = factorise(matrix, symmetric=symmetric)
        for right in (rng.normal(size=144), rng.normal(size=(144, 6))):
            np.testing.assert_allclose(matrix @ factor.solve(right), right, atol=1e-12)


def test_whether_a_symmetric_matrix_is_definite(chosen):
    least = 8.0 * np.sin(np.pi / 26.0) ** 2
    assert factorise(laplacian(shift=-0.99 * least), symmetric=True).definite
    below = factorise(laplacian(shift=-1.01 * least), symmetric=True)
    assert below is None or not below.definite


def test_a_singular_matrix_has_no_factor_that_is_believed(chosen):
    matrix = sparse.csc_array(([1.0, 0.0, 2.0], [0, 1, 2], [0, 1, 2, 3]), shape=(3, 3))
    factor = factorise(matrix, symmetric=True)
    assert factor is None or not factor.definite
