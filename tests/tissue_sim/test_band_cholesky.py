"""Band Cholesky, for Python callers, against LAPACK."""

import numpy as np
import pytest
from scipy.linalg import solveh_banded

from tissue_sim.fem.linear import band
from tissue_sim.fem.linear.cholesky import BAND_CHOLESKY


@pytest.mark.parametrize(("size", "half_band"), [(37, 5), (64, 8), (1, 0), (200, 44), (150, 149)])
def test_band_cholesky_against_lapack(size, half_band):
    rng = np.random.default_rng(size)
    lower = rng.normal(size=(half_band + 1, size))
    lower[0] = 3 * half_band + 1
    for d in range(1, half_band + 1):
        lower[d, size - d:] = 0
    np.testing.assert_array_equal(band.unpack(band.pack(lower), size, half_band), lower)
    factors = BAND_CHOLESKY.init(both_sides(lower))
    for right in rng.normal(size=(2, size)):
        np.testing.assert_allclose(BAND_CHOLESKY.solve(factors, right), solveh_banded(lower, right, lower=True),
                                   rtol=1e-12, atol=1e-15)
    lower[0, size // 2] = -1.0
    with pytest.raises(ArithmeticError, match="pivot"):
        BAND_CHOLESKY.init(both_sides(lower))


def both_sides(lower: np.ndarray) -> np.ndarray:
    """Bands below and above the diagonal, as `scipy.linalg.solve_banded` takes them."""
    above = [np.concatenate([np.zeros(d), lower[d, : lower.shape[1] - d]]) for d in range(len(lower) - 1, 0, -1)]
    return np.concatenate([np.array(above).reshape(-1, lower.shape[1]), lower])
